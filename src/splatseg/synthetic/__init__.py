"""Generated scenes with exact truth, for the demo and for tests."""

from splatseg.synthetic._builder import ROOM_CLASSES as ROOM_CLASSES
from splatseg.synthetic._capture import write_capture as write_capture
from splatseg.synthetic._classes import INTERIOR_CLASSES as INTERIOR_CLASSES
from splatseg.synthetic._classes import STREET_CLASSES as STREET_CLASSES
from splatseg.synthetic._drive import drive_cameras as drive_cameras
from splatseg.synthetic._labels import machine_labels as machine_labels
from splatseg.synthetic._mesh import scene_mesh as scene_mesh
from splatseg.synthetic._pointmaps import PointmapErrors as PointmapErrors
from splatseg.synthetic._pointmaps import SyntheticPointmaps as SyntheticPointmaps
from splatseg.synthetic._pointmaps import synthetic_pointmaps as synthetic_pointmaps
from splatseg.synthetic._raycast import Truth as Truth
from splatseg.synthetic._raycast import cast as cast
from splatseg.synthetic._raycast import render_truth as render_truth
from splatseg.synthetic._room import room as room
from splatseg.synthetic._scene import ObjectInfo as ObjectInfo
from splatseg.synthetic._scene import SyntheticScene as SyntheticScene
from splatseg.synthetic._shapes import Primitive as Primitive
from splatseg.synthetic._shapes import Texture as Texture
from splatseg.synthetic._street import street as street
from splatseg.synthetic._surface_points import SurfaceCloud as SurfaceCloud
from splatseg.synthetic._surface_points import SurfaceOptions as SurfaceOptions
from splatseg.synthetic._surface_points import surface_points as surface_points
from splatseg.synthetic._varied_room import varied_room as varied_room
from splatseg.synthetic._views import cameras as cameras
from splatseg.synthetic._views import look_at as look_at
from splatseg.synthetic._views import start_points as start_points
