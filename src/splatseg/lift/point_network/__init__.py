"""RandLA-Net: features of points from their neighbourhoods, at ever wider scales."""

from splatseg.lift.point_network.config import PUBLISHED_S3DIS as PUBLISHED_S3DIS
from splatseg.lift.point_network.config import RandlaConfig as RandlaConfig
from splatseg.lift.point_network.config import RandlaVariant as RandlaVariant
from splatseg.lift.point_network.encoder import RandlaEncoder as RandlaEncoder
from splatseg.lift.point_network.pyramid import PointPyramid as PointPyramid
from splatseg.lift.point_network.pyramid import PyramidOptions as PyramidOptions
from splatseg.lift.point_network.pyramid import join_pyramids as join_pyramids
from splatseg.lift.point_network.pyramid import point_pyramid as point_pyramid
