"""Protocols of published benchmarks as data: what is asked, every choice, the published figures."""

from splatseg.evaluate.protocols._catalogue import CANONICAL_NEGATIVES as CANONICAL_NEGATIVES
from splatseg.evaluate.protocols._catalogue import PROTOCOLS as PROTOCOLS
from splatseg.evaluate.protocols._catalogue import find_protocol as find_protocol
from splatseg.evaluate.protocols._masks import MaskRow as MaskRow
from splatseg.evaluate.protocols._masks import mask_scores as mask_scores
from splatseg.evaluate.protocols._masks import resized_mask as resized_mask
from splatseg.evaluate.protocols._masks import score_mask as score_mask
from splatseg.evaluate.protocols._protocol import Protocol as Protocol
from splatseg.evaluate.protocols._protocol import switch_value as switch_value
from splatseg.evaluate.protocols._published import PublishedFigure as PublishedFigure
from splatseg.evaluate.protocols._scene_lists import SCENE_LISTS as SCENE_LISTS
from splatseg.evaluate.protocols._scene_lists import SceneList as SceneList
from splatseg.evaluate.protocols._switches import MapSwitches as MapSwitches
from splatseg.evaluate.protocols._switches import PointSwitches as PointSwitches
from splatseg.evaluate.protocols._switches import RoomSwitches as RoomSwitches
from splatseg.evaluate.protocols._switches import SpokenSwitches as SpokenSwitches
from splatseg.evaluate.protocols._switches import Switches as Switches
from splatseg.evaluate.protocols._switches import TargetSwitches as TargetSwitches
from splatseg.evaluate.protocols._switches import differences as differences
from splatseg.evaluate.protocols._switches import recorded as recorded
from splatseg.evaluate.protocols._words import box_filtered as box_filtered
from splatseg.evaluate.protocols._words import peak_in_boxes as peak_in_boxes
from splatseg.evaluate.protocols._words import relevancy_mask as relevancy_mask
from splatseg.evaluate.protocols._words import smoothed_relevancy as smoothed_relevancy
from splatseg.evaluate.protocols._words import stretched as stretched
from splatseg.evaluate.protocols.published import published_figures as published_figures
