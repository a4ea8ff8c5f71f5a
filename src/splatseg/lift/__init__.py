"""2D evidence to per-Gaussian layers, and layers back to label maps of views."""

from splatseg.lift._recorded import EvidenceSegments as EvidenceSegments
from splatseg.lift.associate import AssociateOptions as AssociateOptions
from splatseg.lift.associate import associate as associate
from splatseg.lift.attach import Attached as Attached
from splatseg.lift.attach import AttachOptions as AttachOptions
from splatseg.lift.attach import attach as attach
from splatseg.lift.complete import CompletionOptions as CompletionOptions
from splatseg.lift.complete import complete as complete
from splatseg.lift.confusion import ConfusionOptions as ConfusionOptions
from splatseg.lift.confusion import reconsider as reconsider
from splatseg.lift.identity import IdentityField as IdentityField
from splatseg.lift.identity import IdentityOptions as IdentityOptions
from splatseg.lift.identity import identity as identity
from splatseg.lift.identity import identity_features as identity_features
from splatseg.lift.identity import train_identity as train_identity
from splatseg.lift.label_maps import label_map as label_map
from splatseg.lift.matching import MatchedMaps as MatchedMaps
from splatseg.lift.panoptic import merge_panoptic as merge_panoptic
from splatseg.lift.sharpen import Sharpened as Sharpened
from splatseg.lift.sharpen import SharpenOptions as SharpenOptions
from splatseg.lift.sharpen import sharpen as sharpen
from splatseg.lift.uplift import LabelSource as LabelSource
from splatseg.lift.uplift import UpliftOptions as UpliftOptions
from splatseg.lift.uplift import uplift as uplift
from splatseg.lift.vote import VoteOptions as VoteOptions
from splatseg.lift.vote import vote as vote
