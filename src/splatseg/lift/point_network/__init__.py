"""RandLA-Net: features of points from their neighbourhoods, at ever wider scales."""

from splatseg.lift.point_network.checkpoint import PointEncoder as PointEncoder
from splatseg.lift.point_network.checkpoint import load_point_encoder as load_point_encoder
from splatseg.lift.point_network.checkpoint import load_point_network as load_point_network
from splatseg.lift.point_network.checkpoint import save_point_encoder as save_point_encoder
from splatseg.lift.point_network.checkpoint import save_point_network as save_point_network
from splatseg.lift.point_network.config import PUBLISHED_S3DIS as PUBLISHED_S3DIS
from splatseg.lift.point_network.config import RandlaConfig as RandlaConfig
from splatseg.lift.point_network.config import RandlaVariant as RandlaVariant
from splatseg.lift.point_network.encoder import RandlaEncoder as RandlaEncoder
from splatseg.lift.point_network.features import SpatialFeatures as SpatialFeatures
from splatseg.lift.point_network.features import SpatialOptions as SpatialOptions
from splatseg.lift.point_network.features import scene_options as scene_options
from splatseg.lift.point_network.features import spatial_features as spatial_features
from splatseg.lift.point_network.grid import GridPoints as GridPoints
from splatseg.lift.point_network.grid import average_on_grid as average_on_grid
from splatseg.lift.point_network.inputs import PointInputs as PointInputs
from splatseg.lift.point_network.inputs import feed_points as feed_points
from splatseg.lift.point_network.inputs import points_origin as points_origin
from splatseg.lift.point_network.network import RandlaNet as RandlaNet
from splatseg.lift.point_network.pyramid import PointPyramid as PointPyramid
from splatseg.lift.point_network.pyramid import PyramidOptions as PyramidOptions
from splatseg.lift.point_network.pyramid import join_pyramids as join_pyramids
from splatseg.lift.point_network.pyramid import point_pyramid as point_pyramid
