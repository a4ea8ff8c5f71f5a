"""Street scenes as deformable neural mesh primitives, with labels for any point.

A drive's points become a sparse grid of small watertight meshes (`street.shapes`), whose shapes are
fitted to depth (`street.geometry`), and which carry colour, opacity and classes for rays that hit
them (`street.radiance`). The whole is a `core.Renderable`, `MeshField`.
"""

from splatseg.street.build import DnmpOptions as DnmpOptions
from splatseg.street.build import MeshFieldFit as MeshFieldFit
from splatseg.street.build import build_mesh_field as build_mesh_field
from splatseg.street.field import BallQuery as BallQuery
from splatseg.street.field import MeshField as MeshField
from splatseg.street.field import MeshFieldView as MeshFieldView
from splatseg.street.files import load_mesh_field as load_mesh_field
from splatseg.street.files import save_mesh_field as save_mesh_field
