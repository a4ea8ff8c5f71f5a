"""Splat files of other tools become scenes: laid onto a capture, or given virtual cameras."""

from splatseg.adopt._alignment import Alignment as Alignment
from splatseg.adopt._alignment import align as align
from splatseg.adopt._virtual import SceneKind as SceneKind
from splatseg.adopt._virtual import VirtualViews as VirtualViews
from splatseg.adopt._virtual import place_cameras as place_cameras
