"""Switches of SAGA, and its published setting."""

from dataclasses import dataclass, field
from typing import Literal, get_args

from splatseg._check import check_choice, check_range
from splatseg.core import LayerInfo
from splatseg.errors import InputError, RangeError, quoted
from splatseg.lift.decomposition.options import DecomposeOptions
from splatseg.lift.training import Moving, Sampling, SamplingOptions, Schedule, TrainingOptions
from splatseg.methods._method import ANY_COMPANION
from splatseg.methods._trained import check_rate

Correspondence = Literal["scale", "overlap", "none"]
GateStart = Literal["levels", "steps", "random"]
Start = Literal["association", "normal"]
MaskScale = Literal["level", "size"]
SagaReadout = Literal["features", "tree"]

# Cen et al. 2023, section 3.3, and the published code: what `published` is made of.
PUBLISHED_CHANNELS = 32
PUBLISHED_RATE = 2.5e-3
PUBLISHED_EPSILON = 1e-15
PUBLISHED_CORRESPONDENCE_WEIGHT = 1.0
PUBLISHED_SPARSITY_WEIGHT = 0.1
PUBLISHED_SPARSITY_SHARE = 0.1
PUBLISHED_STEPS = 30_000
"""Each with the grid of one view."""

PUBLISHED_GRID = 64
"""Cells a side of the grid of a view: that of SAM's features."""

SHORT_STEPS = 300
"""Steps that `SagaOptions.published` takes instead, at 100 times the rate: decision 0048."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SagaOptions:
    """How affinity features are trained."""

    guidance: str | None = None
    """Name of evidence of features (such as features_dino) whose projection queries the masks;
    any takes what the scene has, SAM's before others. None takes masks alone: a mask is queried by
    the mean of what is rendered in it, which is not the published loss."""

    guidance_weight: float = 0.0
    """Weight of the SAM-guidance loss; 0 is without."""

    correspondence: Correspondence = "scale"
    """Which pixels are to be alike. scale: those that belong together at a scale drawn by
    chance, compared behind a gate of that scale, hard pairs only. overlap: the more the more
    masks they share, as published. none: without."""

    correspondence_weight: float = PUBLISHED_CORRESPONDENCE_WEIGHT
    """Lambda, the weight of the correspondence loss."""

    sparsity_weight: float = 0.0
    """Weight of the mean positive product of queries with Gaussians anywhere, which goes with
    the guidance loss; 0 is without."""

    sparsity_share: float = PUBLISHED_SPARSITY_SHARE
    """Share of all Gaussians that it is estimated from in a step, in (0, 1]."""

    start: Start = "association"
    """What features start as. association: the masks are associated first, and each Gaussian has
    the code of its part, its object and its group. normal: random numbers, as published."""

    mask_scale: MaskScale = "level"
    """What the scale of a mask is. level: that of its node among the associated masks, 0 for
    parts, 0.5 for objects, 1 for groups. size: its rank among all masks by their extent in 3D,
    as published."""

    channels: int = PUBLISHED_CHANNELS
    """Width of a Gaussian's feature."""

    unit: bool = True
    """Features are directions: each gets length 1 before it is rendered, and what pixels show is
    to keep it."""

    norm_weight: float = 1.0
    """Weight of (1 - length of what a pixel shows)^2; goes with `unit`."""

    smoothing: int = 1
    """Gaussians that a feature is averaged over, itself counted; goes with `unit`. 1 is without;
    the published code has 16, which a random start needs."""

    smoothing_drop: float = 0.5
    """Share of these neighbours that each step of training leaves out by chance, in [0, 1)."""

    scales: int = 4
    """Scales drawn by chance in a step, besides the smallest and the largest."""

    gate: GateStart = "levels"
    """What the gate of scales starts as. levels: a third of the channels is open up to the scales
    of parts, a third up to those of objects, a third always. steps: each channel is open up to a
    scale of its own. random: as a linear layer usually does, as published."""

    max_pixel_weight: float = 1.0
    """What pixels of the smallest masks count in the loss of scales; those of masks of a tenth
    of the view and more count 1."""

    rate: float = 0.001
    """Adam's rate for features."""

    gate_rate: float = 0.01
    """Adam's rate for the scale gate."""

    projector_rate: float = PUBLISHED_RATE
    """Adam's rate for the network that projects 2D features."""

    epsilon: float = 1e-8
    """What Adam adds to the root of the mean of squared gradients."""

    adam: Moving = "rows"
    """Which Gaussians a step of Adam moves. rows: those that its pixels show, each on a clock of
    its own. dense: all on one clock, as published: what a view does not show goes on along its
    fading mean gradient."""

    steps: int = 200
    """Steps of Adam at most."""

    batch: int = 2048
    """Pixels a step."""

    views_per_batch: int = 8
    """Views that they are of: pixels are compared with others of their view."""

    pixels: int = 4096
    """Pixels of each view that are drawn at a time."""

    grid: int = 0
    """Cells a side of the grid over a view that is learnt on instead of its pixels, as published
    with 64: a cell shows all Gaussians in it. 0 learns from pixels."""

    sampling: Sampling = "groups"
    """uniform: all pixels alike. groups: equally many of each mask, and of what is in none."""

    passes: int = 4
    """How often drawn pixels are gone through before new ones are drawn; 0 draws once."""

    min_weight: float = 0.01
    """Blending weight in [0, 1] below which a Gaussian is left out of a pixel; 0 keeps all."""

    memory: int = 1 << 30
    """Bytes of drawn rows kept in memory; more go to temporary files."""

    schedule: Schedule = "cosine"
    """How rates fall: constant, exponential or cosine."""

    final_rate: float = 0.1
    """Share of the rates that is left at the last step."""

    held_out: float = 0.05
    """Share of the views that is not learnt from but scored, to stop in time; 0 holds out none
    and does all steps."""

    score_every: int = 50
    """Steps from one score to the next."""

    patience: int = 2
    """Scores in a row without a better one before training stops, and the best is kept; 0
    never stops."""

    readout: SagaReadout = "features"
    """What is stored. features: what is trained, which selections are made by. tree: what they
    decompose into without a prompt, groups of objects of parts."""

    features: str | None = None
    """With the readout tree: name of a layer of such features of the scene, which is decomposed
    instead of training again; None trains."""

    decompose: DecomposeOptions = field(default_factory=DecomposeOptions)
    """How features are decomposed."""

    def __post_init__(self) -> None:
        check_choice("readout", self.readout, get_args(SagaReadout))
        if self.features is not None and self.readout != "tree":
            raise InputError(
                f"features: expected --readout tree to decompose {quoted(self.features)}, "
                f"got {self.readout}."
            )
        check_choice("correspondence", self.correspondence, get_args(Correspondence))
        check_choice("gate", self.gate, get_args(GateStart))
        check_choice("start", self.start, get_args(Start))
        check_choice("mask_scale", self.mask_scale, get_args(MaskScale))
        if self.grid < 0:
            raise RangeError(f"grid: expected 0 or more, got {self.grid}.")
        if self.grid and self.sampling == "groups":
            raise InputError("grid: expected --sampling uniform, cells have no groups; got groups.")
        for name in ("channels", "smoothing"):
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        if self.scales < 0:
            raise RangeError(f"scales: expected 0 or more, got {self.scales}.")
        if not self.max_pixel_weight >= 1:
            raise RangeError(f"max_pixel_weight: expected 1 or more, got {self.max_pixel_weight}.")
        for name in (
            "guidance_weight", "correspondence_weight", "sparsity_weight", "norm_weight", "rate",
            "gate_rate", "projector_rate",
        ):  # fmt: skip
            check_rate(name, getattr(self, name))
        if not 0 <= self.smoothing_drop < 1:
            raise RangeError(
                f"smoothing_drop: expected at least 0 and less than 1, got {self.smoothing_drop}."
            )
        check_range("sparsity_share", self.sparsity_share, 0.0, 1.0)
        if self.sparsity_share == 0:
            raise RangeError("sparsity_share: expected above 0, got 0.")
        if self.guidance_weight == 0 and self._without_correspondence:
            raise RangeError(
                "guidance_weight, correspondence: expected one of the two losses, got neither."
            )
        if self.guidance is not None and self.guidance_weight == 0:
            raise RangeError(
                f"guidance_weight: expected above 0 to be guided by {self.guidance}, got 0."
            )
        self.training()
        self.drawing()

    @property
    def _without_correspondence(self) -> bool:
        return self.correspondence == "none" or self.correspondence_weight == 0

    @property
    def is_published(self) -> bool:
        """Whether features are those of the paper: free, without a gate, begun at random.

        Selections compare them as it does, see `trained_as_published`.
        """
        return self.start == "normal" and not self.unit and self.correspondence != "scale"

    def trained(self, steps: int) -> str:
        """How long features were trained, beside what was published."""
        if not self.is_published:
            return f"{steps} steps, not the published setting"
        left_out = [
            name
            for name, missing in (
                ("2D features", self.guidance is None and self.guidance_weight > 0),
                ("guidance", self.guidance_weight == 0),
                ("correspondence", self._without_correspondence),
            )
            if missing
        ]
        without = f" without {' and '.join(left_out)}" if left_out else ""
        times = self.rate / PUBLISHED_RATE
        rate = "" if times == 1 else f" at {times:g} times the rate"
        return f"published{without}, {steps} steps{rate} of {PUBLISHED_STEPS}"

    @property
    def by_level(self) -> bool:
        """Whether scales of masks are levels; without a gate, none is asked for."""
        return self.mask_scale == "level" and self.correspondence == "scale"

    @property
    def associated(self) -> bool:
        """Whether masks are associated first."""
        return self.start == "association" or self.by_level

    @classmethod
    def published(
        cls, *, steps: int = SHORT_STEPS, guidance: str | None = ANY_COMPANION
    ) -> "SagaOptions":
        """The published setting: its losses, whole grids of views, and Adam of all Gaussians.

        A step has the 64 x 64 cells of one view. Nothing is held out and all steps are done. Rate
        times steps stays 75, as published (0.0025 times 30 000): Adam moves a feature by about
        the rate each time that it is shown, whatever the gradient. Results are not the same:
        fewer steps end farther from the start (decision 0048). ``steps=30_000`` is the paper's.

        Args:
            steps: How many.
            guidance: As the option says; None is without 2D features.
        """
        rate = PUBLISHED_RATE * PUBLISHED_STEPS / steps
        return cls(
            guidance=guidance,
            guidance_weight=1.0,
            correspondence="overlap",
            sparsity_weight=PUBLISHED_SPARSITY_WEIGHT,
            start="normal",
            mask_scale="size",
            gate="random",
            unit=False,
            norm_weight=0.0,
            smoothing=1,
            rate=rate,
            projector_rate=PUBLISHED_RATE,
            epsilon=PUBLISHED_EPSILON,
            adam="dense",
            steps=steps,
            batch=PUBLISHED_GRID**2,
            views_per_batch=1,
            pixels=PUBLISHED_GRID**2,
            grid=PUBLISHED_GRID,
            sampling="uniform",
            passes=0,
            min_weight=0.0,
            schedule="constant",
            held_out=0.0,
            patience=0,
        )

    def training(self) -> TrainingOptions:
        """How training goes."""
        return TrainingOptions(
            steps=self.steps,
            batch=self.batch,
            passes=self.passes,
            schedule=self.schedule,
            final_rate=self.final_rate,
            epsilon=self.epsilon,
            adam=self.adam,
            held_out=self.held_out,
            score_every=self.score_every,
            score_start=True,
            patience=self.patience,
        )

    def drawing(self) -> SamplingOptions:
        """Which pixels are drawn."""
        return SamplingOptions(
            pixels=self.pixels,
            sampling=self.sampling,
            min_weight=self.min_weight,
            views_per_batch=self.views_per_batch,
            memory=self.memory,
        )


def trained_as_published(info: LayerInfo) -> bool:
    """Whether a layer's record says that its features are those of SAGA's paper."""
    return info.method == "saga" and info.details.get("published") is True
