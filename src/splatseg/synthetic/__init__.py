"""Generated scenes with exact truth, for the demo and for tests."""

from splatseg.synthetic.builder import ROOM_CLASSES as ROOM_CLASSES
from splatseg.synthetic.building import building as building
from splatseg.synthetic.capture import write_capture as write_capture
from splatseg.synthetic.furnishing import room as room
from splatseg.synthetic.photographs import cameras as cameras
from splatseg.synthetic.photographs import look_at as look_at
from splatseg.synthetic.photographs import machine_labels as machine_labels
from splatseg.synthetic.photographs import start_points as start_points
from splatseg.synthetic.raycast import Truth as Truth
from splatseg.synthetic.raycast import cast as cast
from splatseg.synthetic.raycast import render_truth as render_truth
from splatseg.synthetic.solids import ObjectInfo as ObjectInfo
from splatseg.synthetic.solids import Primitive as Primitive
from splatseg.synthetic.solids import SyntheticScene as SyntheticScene
from splatseg.synthetic.solids import Texture as Texture
