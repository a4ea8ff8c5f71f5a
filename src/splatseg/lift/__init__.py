"""2D evidence to per-Gaussian layers, and layers back to label maps of views."""

from splatseg.lift.attachment.attach import Attached as Attached
from splatseg.lift.attachment.attach import AttachOptions as AttachOptions
from splatseg.lift.attachment.attach import attach as attach
from splatseg.lift.boundaries.box import cut_box as cut_box
from splatseg.lift.boundaries.cut import Cut as Cut
from splatseg.lift.boundaries.cut import CutOptions as CutOptions
from splatseg.lift.boundaries.cut import cut_labels as cut_labels
from splatseg.lift.boundaries.cut import cut_masks as cut_masks
from splatseg.lift.boundaries.sharpen import Sharpened as Sharpened
from splatseg.lift.boundaries.sharpen import SharpenOptions as SharpenOptions
from splatseg.lift.boundaries.sharpen import sharpen as sharpen
from splatseg.lift.boundaries.split import split as split
from splatseg.lift.completion.complete import CompletionOptions as CompletionOptions
from splatseg.lift.completion.complete import complete as complete
from splatseg.lift.label_maps import label_map as label_map
from splatseg.lift.mass.confusion import ConfusionOptions as ConfusionOptions
from splatseg.lift.mass.confusion import correct_confusion as correct_confusion
from splatseg.lift.mass.uplift import UpliftOptions as UpliftOptions
from splatseg.lift.mass.uplift import uplift as uplift
from splatseg.lift.segments.matching import MatchedMaps as MatchedMaps
from splatseg.lift.segments.panoptic import merge_panoptic as merge_panoptic
from splatseg.lift.segments.recorded import EvidenceSegments as EvidenceSegments
