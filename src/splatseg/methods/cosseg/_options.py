"""How a fusion decoder is trained."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

from splatseg._check import check_choice, check_range
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError
from splatseg.lift.label_maps import Blend
from splatseg.lift.training import SamplingOptions, TrainingOptions
from splatseg.methods._robust_losses import LABEL_LOSSES, LabelLoss
from splatseg.methods._trained import LabelTrainingOptions, check_rate
from splatseg.methods.cosseg._distilled import Division
from splatseg.methods.cosseg._joint_options import JointOptions
from splatseg.methods.cosseg._linked import Link

Semantic = Literal["all", "first", "none"]
Spatial = Literal["all", "first", "none"]
Points = Literal["visible", "all", "blocks"]
Weighting = Literal["none", "agreement"]
Transitions = Literal["none", "views"]

# Dou et al. 2024, sections 3.3, 3.4 and 4.1: what `published` is made of.
PUBLISHED_COMPONENTS = 64
PUBLISHED_RATE = 1e-3
PUBLISHED_STEPS = 10_000
"""Each of one whole picture."""
PUBLISHED_DECODED = (32, 32, 128, 256, 512, 1024)
"""RandLA-Net's own decoder for S3DIS, which the paper extends."""
PUBLISHED_DROPOUT = 0.5
"""RandLA-Net's, before its classifier."""
PUBLISHED_DIFFERS = (
    "It differs: a step is of 8 views x 512 pixels and not of one whole picture, without weights "
    "below 0.01; the point encoder was trained on generated rooms, not on S3DIS, unless --encoder "
    "names one; Gaussians stay as they are (--joint moves them); a Gaussian has the mean of what "
    "is decoded of it in the training views that show it."
)


_NOT_PUBLISHED = ("steps", "features", "encoder", "memory")
"""What may be otherwise in the published setting."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CossegOptions(LabelTrainingOptions):
    """How labels are decoded from features and space."""

    features: str | None = None
    """Name of evidence of features, such as features_dino: several blocks of a network. None
    decodes space alone."""

    link: Link | None = None
    """How ids are linked over views. given: ids are of tracks or classes. associate:
    segments become objects (`segment --method associate`) and have the ids of these. None: as
    given, and panoptic segments by association."""

    semantic: Semantic = "all"
    """Which blocks the decoder is given. all: each at a scale of its own. first: the shallowest
    alone, at the Gaussians themselves. none: space alone."""

    lifted_side: int = 256
    """Longest side, in pixels, of the views through which features are lifted; they come in
    patches of many pixels."""

    spatial: Spatial = "all"
    """Which levels of the point network are used. all: each is joined to what is decoded there.
    first: the last one alone, of the widest neighbourhood. none: each Gaussian is decoded from its
    own features."""

    division: Division = "mean"
    """What features summed over pixels are divided by. mean: their weights. pixels: the number of
    pixels, as equation 2 counts them and its source divides. sum: nothing, as it is printed."""

    components: int = PUBLISHED_COMPONENTS
    """Principal components that wider blocks are reduced to."""

    min_pixels: int = 0
    """Pixels, of all views, in which a Gaussian must take part to be decoded; others take the
    labels of their neighbours."""

    points: Points = "all"
    """What the point network is given. visible: what each view shows, as published. all: all
    Gaussians at once. blocks: all, in boxes that do not see each other, for less memory."""

    block_points: int = 40_960
    """Gaussians of a box at most."""

    encoder: Path | None = None
    """Checkpoint of a point network; None is the one that comes along."""

    decoded: tuple[int, ...] = (32, 64, 64, 64, 64, 64)
    """Channels that are decoded at each level, the Gaussians' own first."""

    head: tuple[int, ...] = (64, 32)
    """Channels of the layers between them and the classifier."""

    blend: Blend = "probabilities"
    """features: what is decoded is rendered and then classified, as published. probabilities:
    Gaussians are classified and their probabilities rendered."""

    label_loss: LabelLoss = "cross_entropy"
    """What a pixel's label costs. generalised and symmetric: bounded, so that labels which fit
    nothing count little. bootstrap: the answer itself is a part of the label."""

    weighting: Weighting = "none"
    """How much a pixel counts. none: all alike. agreement: as much as all views together vote for
    its label on the Gaussians that it shows."""

    transitions: Transitions = "none"
    """views: each view has a matrix by which its labels differ from the true ones, learnt along."""

    transition_rate: float = 0.01
    """Adam's rate for these matrices."""

    rate: float = 3e-3
    """Adam's rate for the decoder."""

    dropout: float = 0.0
    """Share of what is decoded, in [0, 1), that is dropped before the classifier while training."""

    views_per_step: int = 8
    """Views whose mean gradient makes a step, with points visible: each is decoded from its own
    points, one after the other. A step of more views learns more, and takes as much longer."""

    joint: Path | None = None
    """Folder of a new scene whose Gaussians learn from photographs and labels together with the
    decoder, as published; the layer is written there. None: Gaussians stay as they are, and
    learning is faster."""

    joint_training: JointOptions = field(default_factory=JointOptions)
    """How they learn together."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.link is not None:
            check_choice("link", self.link, get_args(Link))
        check_choice("semantic", self.semantic, get_args(Semantic))
        check_choice("spatial", self.spatial, get_args(Spatial))
        check_choice("division", self.division, get_args(Division))
        check_choice("points", self.points, get_args(Points))
        check_choice("label_loss", self.label_loss, LABEL_LOSSES)
        check_choice("weighting", self.weighting, get_args(Weighting))
        check_choice("transitions", self.transitions, get_args(Transitions))
        for name, least in (
            ("components", 1),
            ("min_pixels", 0),
            ("block_points", 1),
            ("lifted_side", 1),
            ("views_per_step", 1),
        ):
            if getattr(self, name) < least:
                raise RangeError(f"{name}: expected at least {least}, got {getattr(self, name)}.")
        for name in ("decoded", "head"):
            if not getattr(self, name) or min(getattr(self, name)) < 1:
                raise RangeError(f"{name}: expected numbers from 1, got {getattr(self, name)}.")
        check_rate("rate", self.rate)
        check_rate("transition_rate", self.transition_rate)
        if not 0 <= self.dropout < 1:
            raise RangeError(f"dropout: expected at least 0 and below 1, got {self.dropout}.")
        check_range("min_share", self.min_share, 0.0, 1.0)
        if self.spatial == "none" and self.semantic == "none":
            raise RangeError("semantic, spatial: expected one of the two, got neither.")

    @property
    def by_view(self) -> bool:
        """Whether each view is decoded from the points that it shows."""
        return self.points == "visible" and self.spatial != "none"

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
        published = self == replace(self.published(), **theirs)
        if not published:
            return f"{steps} steps of {each}, not the published setting"
        return f"published, {steps} of {PUBLISHED_STEPS} steps of {each}"

    @classmethod
    def published(cls, *, steps: int = PUBLISHED_STEPS) -> "CossegOptions":
        """The published setting: its features, points, decoder, loss, steps and rate.

        A published step is of a whole picture; here it is of 4096 pixels, of `views_per_step`
        pictures. The paper prunes Gaussians by their pixels and does not say below how many.
        """
        return cls(
            features="features_dino",
            readout="rendered",
            steps=steps,
            batch=4096,
            views_per_step=8,
            sampling="strata",
            division="pixels",
            min_pixels=10,
            points="visible",
            decoded=PUBLISHED_DECODED,
            dropout=PUBLISHED_DROPOUT,
            blend="features",
            rate=PUBLISHED_RATE,
            schedule="constant",
            min_weight=0.01,
            held_out=0.0,
            patience=0,
        )
