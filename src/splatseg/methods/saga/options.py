"""Switches of SAGA, and its published setting."""

from dataclasses import field
from typing import Annotated, Literal

from msgspec import Meta

from splatseg.core import LayerInfo
from splatseg.core.options import Count, Natural, NonNegative, options
from splatseg.errors import InputError, RangeError, quoted
from splatseg.lift.training import SamplingOptions, TrainingOptions
from splatseg.methods._method import ANY_COMPANION
from splatseg.methods.saga.decomposition import DecomposeOptions

CHANNELS = 32
"""Width of a Gaussian's feature, as published."""

PUBLISHED_RATE = 2.5e-3
PUBLISHED_STEPS = 30_000
"""Each with the grid of one view."""

PUBLISHED_GRID = 64
"""Cells a side of the grid of a view: that of SAM's features."""

SHORT_STEPS = 300
"""Steps that `SagaOptions.published` takes instead, at 100 times the rate:
docs/decisions/features.md."""

_PUBLISHED_EPSILON = 1e-15

# What features that start from associated masks are trained with.
_PIXELS, _VIEWS, _PASSES, _MIN_WEIGHT = 4096, 8, 4, 0.01
_SCORE_EVERY, _PATIENCE = 50, 2

_BY_START = "it follows from `start`: association or normal, as published"
_BY_GRID = "it follows from `grid`: pixels or cells of views"
_FIXED = "it is fixed at the value that was best"


@options(
    removed={
        **dict.fromkeys(
            (
                "sparsity_weight", "mask_scale", "unit", "norm_weight", "gate", "epsilon", "adam",
                "schedule",
            ),
            _BY_START,
        ),
        **dict.fromkeys(
            ("pixels", "views_per_batch", "sampling", "passes", "min_weight"), _BY_GRID
        ),
        **dict.fromkeys(
            (
                "correspondence_weight", "sparsity_share", "channels", "scales", "gate_rate",
                "projector_rate", "final_rate", "score_every", "patience",
            ),
            _FIXED,
        ),
        "smoothing": "features of associated masks need none",
        "smoothing_drop": "features of associated masks need none",
        "max_pixel_weight": "pixels of small masks count as much as others",
    }
)  # fmt: skip
class SagaOptions:
    """How affinity features are trained."""

    guidance: str | None = None
    """Name of evidence of features (such as features_dino) whose projection queries the masks;
    any takes what the scene has, SAM's before others. None takes masks alone: a mask is queried by
    the mean of what is rendered in it, which is not the published loss."""

    guidance_weight: NonNegative = 0.0
    """Weight of the SAM-guidance loss; 0 is without."""

    correspondence: Literal["scale", "overlap", "none"] = "scale"
    """Which pixels are to be similar. scale: those that belong together at a random scale, behind a
    gate of that scale, hard pairs only; goes with start association. overlap: the more the more
    masks they share, as published; goes with start normal. none: without."""

    start: Literal["association", "normal"] = "association"
    """What features start as. association: the masks are associated first, and each Gaussian has
    the code of its part, its object and its group; features are unit vectors. normal: random
    numbers, as published, trained with the published losses and Adam over all Gaussians."""

    rate: NonNegative = 0.001
    """Adam's rate for features."""

    steps: Count = 200
    """Steps of Adam at most."""

    batch: Count = 2048
    """Pixels a step; with a grid a step has all cells of one view."""

    grid: Natural = 0
    """Cells a side of the grid over a view that is learnt on instead of its pixels, as published
    with 64: a cell shows all Gaussians in it. 0 learns from pixels."""

    memory: Natural = 1 << 30
    """Bytes of drawn rows kept in memory; more go to temporary files."""

    held_out: Annotated[float, Meta(ge=0, lt=1)] = 0.05
    """Share of the views that is not learnt from but scored every 50 steps, to stop when two scores
    in a row are no better; 0 holds out none and does all steps."""

    readout: Literal["features", "tree"] = "features"
    """What is stored. features: what is trained, which selections are made by. tree: what they
    decompose into without a prompt, groups of objects of parts."""

    features: str | None = None
    """With the readout tree: name of a layer of such features of the scene, which is decomposed
    instead of training again; None trains."""

    decompose: DecomposeOptions = field(default_factory=DecomposeOptions)
    """How features are decomposed."""

    def __post_init__(self) -> None:
        if self.features is not None and self.readout != "tree":
            raise InputError(
                f"features: expected --readout tree to decompose {quoted(self.features)}, "
                f"got {self.readout}."
            )
        wrong = {"association": "overlap", "normal": "scale"}[self.start]
        if self.correspondence == wrong:
            raise InputError(
                f"correspondence: {wrong} does not go with --start {self.start}; expected none or "
                f"{'scale' if wrong == 'overlap' else 'overlap'}."
            )
        if self.guidance_weight == 0 and self.correspondence == "none":
            raise RangeError(
                "guidance_weight, correspondence: expected one of the two losses, got neither."
            )
        if self.guidance is not None and self.guidance_weight == 0:
            raise RangeError(
                f"guidance_weight: expected above 0 to be guided by {self.guidance}, got 0."
            )

    @property
    def is_published(self) -> bool:
        """Whether features are those of the paper: free, without a gate, begun at random.

        Selections compare them as it does, see `trained_as_published`.
        """
        return self.start == "normal"

    @property
    def gated(self) -> bool:
        """Whether features are compared behind a gate of the scale, and scales are levels."""
        return self.correspondence == "scale"

    def trained(self, steps: int) -> str:
        """How long features were trained, beside what was published."""
        if not self.is_published:
            return f"{steps} steps, not the published setting"
        left_out = [
            name
            for name, missing in (
                ("2D features", self.guidance is None and self.guidance_weight > 0),
                ("guidance", self.guidance_weight == 0),
                ("correspondence", self.correspondence == "none"),
            )
            if missing
        ]
        without = f" without {' and '.join(left_out)}" if left_out else ""
        times = self.rate / PUBLISHED_RATE
        rate = "" if times == 1 else f" at {times:g} times the rate"
        return f"published{without}, {steps} steps{rate} of {PUBLISHED_STEPS}"

    @classmethod
    def published(
        cls, *, steps: int = SHORT_STEPS, guidance: str | None = ANY_COMPANION
    ) -> "SagaOptions":
        """The published setting: its losses, whole grids of views, and Adam of all Gaussians.

        A step has the 64 x 64 cells of one view. Nothing is held out and all steps are done. Rate
        times steps stays 75, as published (0.0025 times 30 000): Adam moves a feature by about
        the rate each time that it is shown, whatever the gradient. Results are not the same:
        fewer steps end farther from the start (docs/decisions/features.md). ``steps=30_000`` is
        the paper's.

        Args:
            steps: How many.
            guidance: As the option says; None is without 2D features.
        """
        return cls(
            guidance=guidance,
            guidance_weight=1.0,
            correspondence="overlap",
            start="normal",
            rate=PUBLISHED_RATE * PUBLISHED_STEPS / steps,
            steps=steps,
            grid=PUBLISHED_GRID,
            held_out=0.0,
        )

    def training(self) -> TrainingOptions:
        """How training goes: with a grid, rows are drawn once, and a step has those of one view."""
        published = self.is_published
        return TrainingOptions(
            steps=self.steps,
            batch=self.grid**2 or self.batch,
            passes=0 if self.grid else _PASSES,
            schedule="constant" if published else "cosine",
            epsilon=_PUBLISHED_EPSILON if published else 1e-8,
            adam="dense" if published else "rows",
            held_out=self.held_out,
            score_every=_SCORE_EVERY,
            score_start=True,
            patience=_PATIENCE,
        )

    def drawing(self) -> SamplingOptions:
        """Which pixels are drawn: as many of each mask and of what is in none, or all cells."""
        return SamplingOptions(
            pixels=self.grid**2 or _PIXELS,
            sampling="uniform" if self.grid else "groups",
            min_weight=0.0 if self.grid else _MIN_WEIGHT,
            views_per_batch=1 if self.grid else _VIEWS,
            memory=self.memory,
        )


def trained_as_published(info: LayerInfo) -> bool:
    """Whether a layer's record says that its features are those of SAGA's paper."""
    return info.method == "saga" and info.details.get("published") is True
