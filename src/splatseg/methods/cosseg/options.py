"""Switches of CoSSegGaussians, and its published setting."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

from splatseg.core.options import Count, NonNegative, options
from splatseg.errors import RangeError
from splatseg.lift.label_maps import Blend
from splatseg.lift.training import SamplingOptions, TrainingOptions
from splatseg.methods._trained import LabelTrainingOptions

Spatial = Literal["all", "first", "none"]

# Dou et al. 2024, sections 3.3, 3.4 and 4.1.
PUBLISHED_RATE = 1e-3
PUBLISHED_STEPS = 10_000
"""Each of one whole picture."""
PUBLISHED_DECODED = (32, 32, 128, 256, 512, 1024)
"""Channels decoded at each level, the Gaussians' own first: RandLA-Net's own decoder for S3DIS,
which the paper extends."""
PUBLISHED_DROPOUT = 0.5
"""RandLA-Net's, before its classifier."""
PUBLISHED_MIN_PIXELS = 10
"""Gaussians in fewer pixels are pruned; the paper gives no number."""
PUBLISHED_DIFFERS = (
    "It differs: a step is of 8 views x 512 pixels and not of one whole picture, without weights "
    "below 0.01; the point encoder was trained on generated rooms, not on S3DIS, unless --encoder "
    "names one; Gaussians stay as they are (--joint moves them); a Gaussian has the mean of what "
    "is decoded of it in the training views that show it."
)

DECODED = (32, 64, 64, 64, 64, 64)
"""The same channels where all Gaussians are decoded at once."""
HEAD = (64, 32)
"""Channels of the layers between what is decoded and the classifier."""
COMPONENTS = 64
"""Principal components that wider blocks of features are reduced to, as published."""
LIFTED_SIDE = 256
"""Longest side, in pixels, of the views through which features are lifted; they come in patches of
many pixels."""

_NOT_PUBLISHED = ("steps", "features", "encoder", "memory")
"""What may be otherwise in the published setting."""

_BY_POINTS = "it follows from `points`: visible, as published, or all"
_MEASURED = "it was measured to be worse; --method object-classes bears labels that contradict"
_FIXED = "it is fixed at the published value"


@options(
    removed={
        "link": "segments of panoptic maps are associated, other ids are taken as they are",
        **dict.fromkeys(("division", "min_pixels", "decoded", "blend", "dropout"), _BY_POINTS),
        **dict.fromkeys(
            ("lifted_side", "components", "head", "rgb_weight", "label_weight", "joint_start"),
            _FIXED,
        ),
        **dict.fromkeys(("label_loss", "weighting", "transitions", "transition_rate"), _MEASURED),
        "block_points": "--points all or visible are left",
        "joint_training": "give `joint_steps` itself",
    }
)
class CossegOptions(LabelTrainingOptions):
    """How labels are decoded from features and space."""

    features: str | None = None
    """Name of evidence of features, such as features_dino: several blocks of a network. None
    decodes space alone."""

    semantic: Literal["all", "first", "none"] = "all"
    """Which blocks the decoder is given. all: each at a scale of its own. first: the shallowest
    alone, at the Gaussians themselves. none: space alone."""

    spatial: Spatial = "all"
    """Which levels of the point network are used. all: each is joined to what is decoded there.
    first: the last one alone, of the widest neighbourhood. none: each Gaussian is decoded from its
    own features."""

    points: Literal["visible", "all"] = "all"
    """What the decoder is given. all: all Gaussians at once; probabilities are rendered. visible:
    what each view shows, as published; what is decoded is rendered and then classified."""

    encoder: Path | None = None
    """Checkpoint of a point network; None is the one that comes along."""

    rate: NonNegative = 3e-3
    """Adam's rate for the decoder."""

    views_per_step: Count = 8
    """Views whose mean gradient makes a step, with points visible: each is decoded from its own
    points, one after the other. A step of more views learns more, and takes as much longer."""

    joint: Path | None = None
    """Folder of a new scene whose Gaussians learn from photographs and labels together with the
    decoder, as published; the layer is written there. None: Gaussians stay as they are, and
    learning is faster."""

    joint_steps: Count = 2000
    """Steps of joint training, each with one whole picture."""

    def __post_init__(self) -> None:
        if self.spatial == "none" and self.semantic == "none":
            raise RangeError("semantic, spatial: expected one of the two, got neither.")

    @property
    def by_view(self) -> bool:
        """Whether each view is decoded from the points that it shows."""
        return self.points == "visible" and self.spatial != "none"

    @property
    def is_published(self) -> bool:
        """Whether the decoder is the published one."""
        return self.points == "visible"

    @property
    def blend(self) -> Blend:
        """What is rendered."""
        return "features" if self.is_published else "probabilities"

    @property
    def decoded(self) -> tuple[int, ...]:
        """Channels decoded at each level."""
        return PUBLISHED_DECODED if self.is_published else DECODED

    @property
    def dropout(self) -> float:
        """Share of what is decoded that is dropped before the classifier while training."""
        return PUBLISHED_DROPOUT if self.is_published else 0.0

    @property
    def min_pixels(self) -> int:
        """Pixels, of all views, in which a Gaussian must take part to be decoded."""
        return PUBLISHED_MIN_PIXELS if self.is_published else 0

    def drawing(self) -> SamplingOptions:
        """Which pixels are drawn: batches of one view where each has points of its own."""
        drawn = LabelTrainingOptions.drawing(self)
        return replace(drawn, views_per_batch=1 if self.by_view else None)

    def training(self) -> TrainingOptions:
        """How training goes: a step is of as many views as it should have."""
        usual = LabelTrainingOptions.training(self)
        if not self.by_view:
            return usual
        views = self.views_per_step
        return replace(usual, batch=max(1, self.batch // views), accumulate=views)

    def trained(self, steps: int) -> str:
        """How long the decoder was trained, beside what was published."""
        if self.by_view:
            each = f"{self.views_per_step} views x {self.batch // self.views_per_step} pixels"
        else:
            each = f"{self.batch} pixels of all views"
        theirs = {name: getattr(self, name) for name in _NOT_PUBLISHED}
        if self != replace(self.published(), **theirs):
            return f"{steps} steps of {each}, not the published setting"
        return f"published, {steps} of {PUBLISHED_STEPS} steps of {each}"

    @classmethod
    def published(cls, *, steps: int = PUBLISHED_STEPS) -> "CossegOptions":
        """The published setting: its features, points, decoder, loss, steps and rate.

        A published step is of a whole picture; here it is of 4096 pixels, of `views_per_step`
        pictures.
        """
        return cls(
            features="features_dino",
            readout="rendered",
            steps=steps,
            sampling="strata",
            points="visible",
            rate=PUBLISHED_RATE,
            schedule="constant",
            held_out=0.0,
            patience=0,
        )
