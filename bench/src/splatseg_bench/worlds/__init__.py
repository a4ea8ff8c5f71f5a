"""Generated worlds of tests, trainings and benchmarks: streets, varied rooms, meshes, pointmaps."""

from splatseg_bench.worlds._classes import INTERIOR_CLASSES as INTERIOR_CLASSES
from splatseg_bench.worlds._classes import STREET_CLASSES as STREET_CLASSES
from splatseg_bench.worlds._clutter import clutter as clutter
from splatseg_bench.worlds._clutter import clutter_camera as clutter_camera
from splatseg_bench.worlds._pointmaps import PointmapErrors as PointmapErrors
from splatseg_bench.worlds._pointmaps import SyntheticPointmaps as SyntheticPointmaps
from splatseg_bench.worlds._pointmaps import synthetic_pointmaps as synthetic_pointmaps
from splatseg_bench.worlds._recorded import SurfaceCloud as SurfaceCloud
from splatseg_bench.worlds._recorded import SurfaceOptions as SurfaceOptions
from splatseg_bench.worlds._recorded import drive_cameras as drive_cameras
from splatseg_bench.worlds._recorded import scene_mesh as scene_mesh
from splatseg_bench.worlds._recorded import surface_points as surface_points
from splatseg_bench.worlds._streets import street as street
from splatseg_bench.worlds._varied_rooms import varied_room as varied_room
