"""Splat files of other tools become scenes: laid onto a capture, or given virtual cameras."""

from splatseg.importing._alignment import Alignment as Alignment
from splatseg.importing._alignment import align as align
from splatseg.importing._virtual import VIEWS as VIEWS
from splatseg.importing._virtual import SceneKind as SceneKind
from splatseg.importing._virtual import VirtualViews as VirtualViews
from splatseg.importing._virtual import place_cameras as place_cameras
