"""How classes of objects are found."""

from dataclasses import dataclass, field
from typing import Literal, get_args

from splatseg._check import check_choice, check_range
from splatseg.errors import RangeError
from splatseg.lift.object_classes import ObjectClassOptions

Compared = Literal["deepest", "all"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectLabelOptions:
    """How objects get their classes, and Gaussians those of their objects."""

    features: str | None = None
    """Name of evidence of features, such as features_dino, by which objects look alike. None takes
    the votes of each object alone."""

    masks: str | None = None
    """Name of evidence of masks, such as masks_sam, by which objects are found. None takes the
    segments that are labelled themselves, of tracks and of panoptic maps; maps of classes have
    none."""

    compared: Compared = "deepest"
    """Which blocks tell that objects look alike: the deepest, which knows classes best, or all."""

    lifted_side: int = 256
    """Longest side, in pixels, of the views through which features are lifted; they come in
    patches of many pixels."""

    components: int = 64
    """Principal components that wider blocks are reduced to."""

    classification: ObjectClassOptions = field(default_factory=ObjectClassOptions)
    """How votes and features of objects are weighed."""

    own_share: float | None = None
    """Share, in [0, 1], that a Gaussian's own votes have in its class beside its object's. None:
    the more the less neighbouring views err alike, as measured. Of tracks none."""

    candidates: int = 1
    """Ids kept of each Gaussian. 1 makes a hard layer; with more it keeps their shares and is
    rendered softly."""

    max_correlation: float = 1 / 3
    """Correlation of neighbouring views, in [0, 1], from which on own votes have no share, unless
    objects are heterogeneous."""

    max_heterogeneity: float = 0.22
    """Share of the disagreement of votes, in (0, 1], that may be between the Gaussians of an object
    before own votes have a share; they have all of it at twice as much."""

    def __post_init__(self) -> None:
        check_choice("compared", self.compared, get_args(Compared))
        for name in ("lifted_side", "components", "candidates"):
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        if self.own_share is not None:
            check_range("own_share", self.own_share, 0.0, 1.0)
        check_range("max_correlation", self.max_correlation, 0.0, 1.0)
        if not 0 < self.max_heterogeneity <= 1:
            raise RangeError(
                f"max_heterogeneity: expected above 0 and at most 1, got {self.max_heterogeneity}."
            )
