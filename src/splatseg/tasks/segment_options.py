"""What every method of segmentation shares."""

from dataclasses import dataclass
from typing import Literal

from splatseg._check import check_choice
from splatseg.core.boundary import convert_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentOptions:
    """What every method shares."""

    evidence: str | None = None
    """Name of the evidence: a folder of the scene's or of its capture, such as labels_semantic.
    None takes the only one there is."""

    layer: str | None = None
    """Name of the layer. None names it like the evidence."""

    zero_is_class: bool = False
    """The id 0 of the evidence's files is a class and not void: ids grow by 1, and the layer
    records what they were."""

    void: int | None = None
    """A further id of the evidence's files that means none, such as 255."""

    views: tuple[str, ...] = ("train",)
    """Which views may be used: train, all, or names by comma or by space. What is asked for
    is recorded in the layer."""

    view_masks: Literal["auto", "ignore", "off"] = "auto"
    """Meaning of the views' masks to label maps, panoptic segments and tracks. ignore: pixels where
    they are 0 have no label, such as those of moving things. off: masks are not used. auto: ignore
    where the fit ignored them too, else off."""

    published: bool = False
    """The method as its authors published it: their options, and no completion."""

    complete: bool = True
    """Label Gaussians that no view explains by their neighbours; they are marked as inferred."""

    classes: str | None = None
    """With instances: name of a layer of classes to merge them with. Instances take their class
    from it, and what is no thing becomes one segment a class: the layer is panoptic."""

    seed: int = 0
    """Seed of random choices, recorded in the layer."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("view_masks", self.view_masks, ("auto", "ignore", "off"))
