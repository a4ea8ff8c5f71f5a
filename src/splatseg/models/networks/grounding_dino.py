"""Grounding DINO: boxes of what words mean; with Segment Anything after it, their masks.

Liu et al. 2023 (arXiv:2303.05499); MMDetection's form of it, Zhao et al. 2024 (arXiv:2401.02361).
The pair is known as Grounded SAM, Ren et al. 2024 (arXiv:2401.14159), and as LangSAM.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from splatseg.core import Rle
from splatseg.core.models import Boxes, Image, Prompt, TextMasks
from splatseg.core.options import Share, options
from splatseg.core.threads import network_inference
from splatseg.errors import InputError
from splatseg.models._images import Frame, Normalisation, frame_of, input_side
from splatseg.models._mask_generator import distinct
from splatseg.models._registry import family_of_sam
from splatseg.models._weights import Loading, second_loading
from splatseg.models.networks._library import NetworkModel, configuration, network
from splatseg.models.networks._words import Tokens, checked_words
from splatseg.models.networks.sam import Sam, SamOptions
from splatseg.models.networks.word_masks import WordMasks, text_masks

_CLASSES = {
    "grounding-dino": "GroundingDinoForObjectDetection",
    "mm-grounding-dino": "MMGroundingDinoForObjectDetection",
}
"""Class of the library by the weights' ``model_type``."""

_SHORTEST, _LONGEST = 800, 1333
"""Sides of the input where the weights do not say: the shorter one, and the longer at most."""

_SEPARATORS = ".?"
"""What the network takes for the end of a phrase."""


MAX_OVERLAP = 0.8
"""Boxes of one word that overlap more, as IoU, are of one thing; the surest is kept."""


@options(removed={"max_overlap": f"boxes of one word are held apart at an IoU of {MAX_OVERLAP}"})
class GroundingDinoOptions:
    """When a box counts as found, and for which word."""

    box_threshold: Share = 0.35
    """Least probability, in [0, 1], of the token that a box fits best, out of those of its word."""

    text_threshold: Share = 0.25
    """Least probability, in [0, 1], of a token that speaks for its word."""


class GroundingDino(NetworkModel):
    """Boxes of what words mean, all words in one pass."""

    _constants: ClassVar = {"max_overlap": MAX_OVERLAP}
    _unrecorded: ClassVar = ("sam_weights",)

    def __init__(self, name: str, options: GroundingDinoOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        content = configuration(place, tuple(_CLASSES))
        self._network = network(place, _CLASSES[str(content["model_type"])], content)
        config = self._network.config
        longest = min(int(config.max_text_len), int(config.text_config.max_position_embeddings))
        self._tokens = Tokens(place, config, longest=longest)
        self._more_settings = {"tokenizer": self._tokens.digest}
        self._shortest = input_side(place.folder, "shortest_edge", _SHORTEST)
        self._longest = input_side(place.folder, "longest_edge", _LONGEST)
        self._input_size = place.size or self._longest
        self._normalisation = Normalisation.of(place.folder)

    def boxes(self, image: Image, words: Sequence[str]) -> Boxes:
        """Boxes of what the words mean, the surest first.

        Raises:
            InputError: If a word is empty, stands there twice or holds a full stop.
            RangeError: If the words are more than the network takes.
        """
        return self.boxes_of([image], words)[0]

    @network_inference()
    def boxes_of(self, images: Sequence[Image], words: Sequence[str]) -> list[Boxes]:
        """`boxes` of images of one size, which pass the network together."""
        height, width = (int(side) for side in images[0].shape[:2])
        if not words:
            return [_no_boxes()] * len(images)
        text, places = phrases(words)
        tokens = word_tokens(self._tokens.spans(text), places)
        asked = self._tokens.of([text] * len(images))
        output = self._network(
            pixel_values=self._input(images, self._frame(height, width)), **asked
        )
        return [
            found_boxes(
                logits.float().sigmoid().cpu(),
                boxes.float().cpu(),
                tokens,
                self._options,
                size=(height, width),
            )
            for logits, boxes in zip(output.logits, output.pred_boxes, strict=True)
        ]

    def _frame(self, height: int, width: int) -> Frame:
        """The input: the shorter side as the weights say, unless the longer one is too long."""
        if self._place.size is not None:
            return frame_of(height, width, size=self._place.size)
        scale = min(self._shortest / min(height, width), self._longest / max(height, width))
        return frame_of(height, width, size=max(1, round(max(height, width) * scale)))


def phrases(words: Sequence[str]) -> tuple[str, list[tuple[int, int]]]:
    """The words as the network reads them, and where each stands: first character, and the end.

    Raises:
        InputError: If a word is empty, stands there twice or holds a full stop.

    Example:
        >>> phrases(["Chair", "red mug"])
        ('chair. red mug.', [(0, 5), (7, 14)])
    """
    text, places = "", list[tuple[int, int]]()
    for word in checked_words(words):
        if any(sign in word for sign in _SEPARATORS):
            raise InputError(
                f"words: expected words without full stops and question marks, which end a phrase "
                f"for the network, got {word!r:.60}."
            )
        start = len(text) + (1 if text else 0)
        text = f"{text} {word.lower()}." if text else f"{word.lower()}."
        places.append((start, len(text) - 1))
    return text, places


def word_tokens(
    spans: Sequence[tuple[int, int]], places: Sequence[tuple[int, int]]
) -> list[list[int]]:
    """Indices of the tokens of each word, by where tokens and words stand in the text."""
    return [
        [i for i, (low, high) in enumerate(spans) if start <= low < high <= end]
        for start, end in places
    ]


def found_boxes(
    probabilities: Float[Tensor, "n tokens"],
    boxes: Float[Tensor, "n 4"],
    tokens: Sequence[Sequence[int]],
    options: GroundingDinoOptions,
    *,
    size: tuple[int, int],
) -> Boxes:
    """The boxes that fit a word.

    A box is of the word of whose tokens it fits most: the sum of their probabilities, those below
    `text_threshold` left out, by their number. Its score is that of the token that it fits best.

    Args:
        probabilities: How well each box fits each token.
        boxes: Centre x, y, width, height as shares of the image.
        tokens: Indices of the tokens of each word.
        options: The thresholds.
        size: Rows and columns of the image.
    """
    share = torch.zeros(len(boxes), len(tokens))
    score = torch.zeros(len(boxes), len(tokens))
    for i, of_word in enumerate(tokens):
        if of_word:
            fits = probabilities[:, list(of_word)]
            share[:, i] = torch.where(fits >= options.text_threshold, fits, 0.0).mean(dim=1)
            score[:, i] = fits.amax(dim=1)
    most, word = share.max(dim=1)
    score = score.gather(1, word[:, None])[:, 0]
    height, width = size
    corners = torch.cat((boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2), dim=1)
    corners = corners.clamp(0, 1)
    keep = (most > 0) & (score >= options.box_threshold)
    keep &= (corners[:, 2:] > corners[:, :2]).all(dim=1)
    corners, score, word = corners[keep], score[keep], word[keep]
    order = _one_a_thing(corners, score, word)
    return Boxes(
        boxes=corners[order] * torch.tensor([width, height, width, height]),
        scores=score[order],
        words=tuple(word[order].tolist()),
    )


def _one_a_thing(corners: Float[Tensor, "n 4"], score: Float[Tensor, "n"], word: Tensor) -> Tensor:
    """Indices of boxes, the surest first, without those that a surer box of their word covers."""
    kept: list[Tensor] = []
    for one in word.unique():
        of_word = (word == one).nonzero()[:, 0]
        kept.append(of_word[distinct(corners[of_word], score[of_word], MAX_OVERLAP)])
    index = torch.cat(kept).sort().values if kept else torch.zeros(0, dtype=torch.int64)
    return index[torch.sort(score[index], descending=True, stable=True).indices]


def _no_boxes() -> Boxes:
    return Boxes(boxes=torch.zeros(0, 4), scores=torch.zeros(0), words=())


@options
class LangSamOptions(GroundingDinoOptions):
    """Which words are looked for, when a box counts as found, and which SAM makes its mask."""

    words: tuple[str, ...] = ()
    """Words or phrases that are looked for, all in one pass."""

    sam_model: Literal["sam", "sam-hq", "sam2", "sam3"] = "sam2"
    """Model that makes masks of the boxes."""

    sam_weights: str | None = None
    """Folder or id of that model's weights, as --weights has those of Grounding DINO. None takes
    its default; `see --model NAME --help` names it."""

    def __post_init__(self) -> None:
        checked_words(self.words)


class LangSam(WordMasks):
    """Masks of what words mean: boxes by Grounding DINO, their masks by SAM."""

    def __init__(self, name: str, options: LangSamOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        self._detector = GroundingDino(name, options, place)
        family = family_of_sam(options.sam_model)
        second = second_loading(family, options.sam_weights, place, flag="--sam-weights")
        self._segmenter = Sam(family.name, SamOptions(), second)

    @override
    def settings_of(self, options: Any) -> dict[str, Any]:
        """Both networks: weights go by their digest, wherever they lie."""
        other = {f"sam_{name}": self._segmenter.settings[name] for name in ("weights", "size")}
        return {**self._detector.settings_of(options), **other}

    @override
    def _find(self, images: Sequence[Image], words: Sequence[str]) -> list[TextMasks]:
        boxes = self._detector.boxes_of(images, words)
        shown = [image for image, one in zip(images, boxes, strict=True) if one.words]
        if shown:
            self._segmenter.encode(shown)
        return [self._masks_of(image, one) for image, one in zip(images, boxes, strict=True)]

    def _masks_of(self, image: Image, boxes: Boxes) -> TextMasks:
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
