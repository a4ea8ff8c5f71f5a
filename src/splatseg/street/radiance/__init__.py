"""Colour, opacity and classes on primitives: features of vertices, and networks that read them.

A ray meets triangles of primitives; features of their vertices are interpolated there (eq. 3), a
network makes opacity, colour and classes of them (eq. 4), and these are composited (eq. 5). What
is behind all primitives has a colour and classes too, the sky among them.
"""

from splatseg.street.radiance.compositing import composite as composite
from splatseg.street.radiance.model import FieldOutputs as FieldOutputs
from splatseg.street.radiance.model import RadianceModel as RadianceModel
from splatseg.street.radiance.options import PUBLISHED_RADIANCE as PUBLISHED_RADIANCE
from splatseg.street.radiance.options import RadianceOptions as RadianceOptions
from splatseg.street.radiance.render import RayValues as RayValues
from splatseg.street.radiance.render import depth_from_distance as depth_from_distance
from splatseg.street.radiance.render import render_rays as render_rays
from splatseg.street.radiance.render import render_view as render_view
from splatseg.street.radiance.train import RadianceFit as RadianceFit
from splatseg.street.radiance.train import RadianceRecord as RadianceRecord
from splatseg.street.radiance.train import train_radiance as train_radiance
