"""The geometry of primitives: first hits, depth to fit to, and the fit (eq. 2)."""

from splatseg.street.geometry.depth_sources import DepthSource as DepthSource
from splatseg.street.geometry.depth_sources import capture_views as capture_views
from splatseg.street.geometry.depth_sources import evidence_views as evidence_views
from splatseg.street.geometry.depth_sources import field_views as field_views
from splatseg.street.geometry.depth_sources import filled_views as filled_views
from splatseg.street.geometry.depth_sources import point_views as point_views
from splatseg.street.geometry.depth_sources import scan_views as scan_views
from splatseg.street.geometry.depth_views import DepthView as DepthView
from splatseg.street.geometry.depth_views import distances_of as distances_of
from splatseg.street.geometry.first_hits import PrimitiveCaster as PrimitiveCaster
from splatseg.street.geometry.first_hits import mesh_depth as mesh_depth
from splatseg.street.geometry.first_hits import mesh_distances as mesh_distances
from splatseg.street.geometry.fit import GeometryFit as GeometryFit
from splatseg.street.geometry.fit import GeometryRecord as GeometryRecord
from splatseg.street.geometry.fit import fit_geometry as fit_geometry
from splatseg.street.geometry.inside import enclosing as enclosing
from splatseg.street.geometry.options import PUBLISHED_GEOMETRY as PUBLISHED_GEOMETRY
from splatseg.street.geometry.options import GeometryOptions as GeometryOptions
