"""Closed, textured meshes of objects from what views show of labelled Gaussians."""

from splatseg.mesh.fusion import Grid as Grid
from splatseg.mesh.fusion import fuse_object as fuse_object
from splatseg.mesh.fusion import pixel_size as pixel_size
from splatseg.mesh.hulls import convex_hulls as convex_hulls
from splatseg.mesh.maps import MapStore as MapStore
from splatseg.mesh.maps import ViewMaps as ViewMaps
from splatseg.mesh.maps import map_store as map_store
from splatseg.mesh.maps import render_maps as render_maps
from splatseg.mesh.texture import SeenColours as SeenColours
from splatseg.mesh.texture import Texture as Texture
from splatseg.mesh.texture import bake_texture as bake_texture
from splatseg.mesh.texture import seen_colours as seen_colours
from splatseg.mesh.texture import vertex_normals as vertex_normals
