"""What a selection is made from, and what follows."""

from dataclasses import dataclass
from typing import Literal, get_args

from splatseg._check import check_choice
from splatseg.core import tree_level
from splatseg.core.boundary import convert_fields
from splatseg.errors import InputError
from splatseg.prompting.pipeline import StepName

SelectMode = Literal["new", "add", "subtract", "intersect"]
SelectThreshold = Literal["auto", "fixed", "adaptive", "code"]
SelectPostProcessing = Literal["auto", "own", "published"]

_LEVELS = {"group": 0.0, "object": 0.5, "part": 1.0}
_STEPS: tuple[StepName, ...] = ("filter", "grow", "refine", "fill_holes", "hidden")
PUBLISHED_STEPS: tuple[StepName, ...] = ("filter", "grow")
"""The steps that SAGA's section 3.5 has."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectOptions:
    """What a selection is made from, and what follows."""

    source: str = "auto"
    """What says which Gaussians belong together: features, masks or layer. auto takes a
    tree, then affinity features, then masks, then labels: the first that the scene has."""

    from_layer: str | None = None
    """Name of the layer of features, labels or a tree that the source takes. Without it, the one
    of its kind that fits best: a tree before labels of instances before other labels."""

    evidence: str | None = None
    """Name of the masks that the source takes, where there are several; auto then takes them."""

    granularity: str | float = "auto"
    """How much a click means: group, object, part, or a number from 0 (groups) by 0.5 (objects)
    to 1 (the finest parts). auto lets the source choose."""

    threshold: SelectThreshold = "auto"
    """How alike features must be. fixed: a cosine of 0.85. adaptive: more than the mean of all
    scores, after masks mean and deviation of products with 2D features, as in SAGA's section 3.4.
    code: as its published code. auto: adaptive of features trained as published, else fixed."""

    post_processing: SelectPostProcessing = "auto"
    """What follows features. own: the steps below. published: SAGA's section 3.5 to the letter, of
    the steps filter and grow alone. auto: published of features trained as published, else own."""

    mode: SelectMode = "new"
    """What becomes of a selection that was there before: it is replaced, added to, subtracted
    from, or intersected with."""

    filter: bool = True
    """Leave out specks and outliers."""

    grow: bool = True
    """Add what is near enough to what is surely selected."""

    refine: bool = True
    """Decide the border anew between what the prompts say is in and out."""

    fill_holes: bool = True
    """Close gaps inside."""

    hidden: bool = True
    """Add what no view shows, where it is inside."""

    max_pixels: int = 1024
    """Most pixels that a mask, a box or strokes are thinned to."""

    seed: int = 0
    """Seed of random choices, recorded in the layer."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("threshold", self.threshold, get_args(SelectThreshold))
        check_choice("post_processing", self.post_processing, get_args(SelectPostProcessing))

    @property
    def level(self) -> float | None:
        """The granularity as a number, None for the source's choice.

        Raises:
            InputError: If it is neither a level nor a number from 0 to 1.
        """
        if self.granularity == "auto":
            return None
        try:
            level = tree_level(str(self.granularity))
        except InputError:
            raise InputError(
                "granularity: expected auto, group, object, part or a number from 0 to 1, "
                f"got {self.granularity!r}."
            ) from None
        return _LEVELS[level] if isinstance(level, str) else level

    @property
    def steps(self) -> tuple[StepName, ...]:
        """Steps that follow the source."""
        return tuple(name for name in _STEPS if getattr(self, name))
