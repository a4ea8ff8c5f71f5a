"""Shapes of primitives: an icosphere deformed by a code, and the auto-encoder of the codes."""

from splatseg.street.shapes.autoencoder import ShapeAutoEncoder as ShapeAutoEncoder
from splatseg.street.shapes.autoencoder import new_shapes as new_shapes
from splatseg.street.shapes.chamfer import chamfer as chamfer
from splatseg.street.shapes.chamfer import sample_faces as sample_faces
from splatseg.street.shapes.checkpoint import load_shapes as load_shapes
from splatseg.street.shapes.checkpoint import save_shapes as save_shapes
from splatseg.street.shapes.checkpoint import shape_facts as shape_facts
from splatseg.street.shapes.codes import interpolate_codes as interpolate_codes
from splatseg.street.shapes.codes import sphere_code as sphere_code
from splatseg.street.shapes.config import PUBLISHED as PUBLISHED
from splatseg.street.shapes.config import ShapeConfig as ShapeConfig
from splatseg.street.shapes.intersections import self_intersections as self_intersections
from splatseg.street.shapes.patches import cut_patches as cut_patches
from splatseg.street.shapes.patches import primitive_scale as primitive_scale
from splatseg.street.shapes.regularisers import MeshRegularisers as MeshRegularisers
from splatseg.street.shapes.regularisers import mesh_regularisers as mesh_regularisers
from splatseg.street.shapes.scores import ShapeScore as ShapeScore
from splatseg.street.shapes.scores import score_shapes as score_shapes
from splatseg.street.shapes.template import template as template
