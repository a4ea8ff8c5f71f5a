"""Grounding DINO and Segment Anything, one after the other: masks of what words mean.

The pair is known as Grounded SAM, Ren et al. 2024 (arXiv:2401.14159), and as LangSAM.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from typing_extensions import override

from splatseg.core import Rle
from splatseg.core.boundary import convert_fields
from splatseg.core.models import Boxes, Image, Prompt, TextMasks
from splatseg.models._family import Loading
from splatseg.models._loading import second_loading
from splatseg.models._words import checked_words
from splatseg.models.networks import sam
from splatseg.models.networks._library import network_family
from splatseg.models.networks._word_masks import Finder, WordMasks, text_masks
from splatseg.models.networks.grounding_dino import (
    GROUNDING_DINO,
    GroundingDino,
    GroundingDinoOptions,
)

_SAM = {"sam": sam.SAM, "sam-hq": sam.SAM_HQ, "sam2": sam.SAM2, "sam3": sam.SAM3}


@dataclass(frozen=True, slots=True, kw_only=True)
class LangSamOptions(GroundingDinoOptions):
    """Which words are looked for, when a box counts as found, and who makes its mask."""

    words: tuple[str, ...] = ()
    """Words or phrases that are looked for, all in one pass."""

    sam_model: Literal["sam", "sam-hq", "sam2", "sam3"] = "sam2"
    """Who makes masks of the boxes."""

    sam_weights: str | None = None
    """Folder or id of that one's weights, as --weights has those of Grounding DINO. None takes
    its default; `see --model NAME --help` names it."""

    def __post_init__(self) -> None:
        convert_fields(self)
        GroundingDinoOptions.__post_init__(self)
        checked_words(self.words)


class _LangSam(Finder):
    def __init__(self, detector: GroundingDino, segmenter: sam.Sam) -> None:
        self._detector, self._segmenter = detector, segmenter

    @override
    def found(self, images: Sequence[Image], words: Sequence[str]) -> list[TextMasks]:
        boxes = self._detector.boxes_of(images, words)
        shown = [image for image, one in zip(images, boxes, strict=True) if one.words]
        if shown:
            self._segmenter.encode(shown)
        return [self._masks(image, one) for image, one in zip(images, boxes, strict=True)]

    def _masks(self, image: Image, boxes: Boxes) -> TextMasks:
        """The mask of each box, with the score of the box: SAM's own is not of the word."""
        masks: list[Rle] = []
        if boxes.words:
            embedding = self._segmenter.embed(image)
            masks = [
                self._segmenter.prompted_masks(embedding, Prompt(box=box)).masks[0]
                for box in boxes.boxes
            ]
        size = int(image.shape[0]), int(image.shape[1])
        return text_masks(masks, boxes.scores.tolist(), boxes.words, size)


def _langsam(name: str, options: LangSamOptions, place: Loading) -> WordMasks:
    detector = GroundingDino(name, options, place)
    family = _SAM[options.sam_model]
    second = second_loading(family, options.sam_weights, place, flag="--sam-weights")
    segmenter = sam.Sam(family.name, sam.SamOptions(), second)
    return WordMasks(
        name,
        options,
        LangSamOptions(),
        place,
        finder=_LangSam(detector, segmenter),
        settings=lambda chosen: _settings(detector, segmenter, chosen),
    )


def _settings(detector: GroundingDino, segmenter: sam.Sam, options: Any) -> dict[str, Any]:
    """Both networks: weights go by their digest, wherever they lie."""
    mine = detector.settings_with(options, unrecorded=("sam_weights",))
    other = {f"sam_{name}": segmenter.settings[name] for name in ("weights", "size")}
    return {**mine, **other}


LANGSAM = network_family(
    "langsam",
    "masks of what words mean: boxes by Grounding DINO, their masks by SAM",
    *GROUNDING_DINO.checkpoints,
    reference="arXiv:2401.14159",
    gives=("masks", "panoptic"),
    options=LangSamOptions,
    make=_langsam,
)
