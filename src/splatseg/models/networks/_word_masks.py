"""Networks that find what words mean, to the pixel: masks and segments out of what they find."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from splatseg.core import UNLABELLED, ClassTable, LabelMap, MaskSet, Segment
from splatseg.core.boundary import boundary
from splatseg.core.models import Image, Panoptic, TextMasks
from splatseg.models._encoded import LastImages
from splatseg.models._family import Loading
from splatseg.models._words import checked_words, word_classes


class Finder(ABC):
    """What finds them."""

    @abstractmethod
    def found(self, images: Sequence[Image], words: Sequence[str]) -> list[TextMasks]:
        """Masks of what words mean in images of one size."""


class WordMasks:
    """Masks and segments of what some words mean.

    Args:
        name: Name of the family.
        options: Its options, with `words`.
        defaults: Default options.
        place: The weights.
        finder: The network.
        settings: Gives what changes its answers, of options.
    """

    def __init__(
        self,
        name: str,
        options: Any,
        defaults: Any,
        place: Loading,
        *,
        finder: Finder,
        settings: Callable[[Any], Mapping[str, Any]],
    ) -> None:
        self.name = name
        self.note = f"weights {place.name}"
        self.batch_size = place.images_together
        self._words = checked_words(options.words)
        self._options, self._defaults = options, defaults
        self._finder = finder
        self._settings = settings
        self._last = LastImages[TextMasks](self._found)

    @property
    def settings(self) -> Mapping[str, Any]:
        """Options, weights, tokenizer, precision and size of the input."""
        return self._settings(self._options)

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """The same with default options."""
        return self._settings(self._defaults)

    @property
    def categories(self) -> ClassTable:
        """The words.

        Raises:
            InputError: If there are none.
        """
        return word_classes(checked_words(self._words, needed=self.name))

    def encode(self, images: Sequence[Image]) -> None:
        """Look for the words in images of one size at once."""
        self._last.encode(images)

    def masks(self, image: Image) -> MaskSet:
        """What the words mean; masks may overlap.

        Raises:
            InputError: If there are no words.
        """
        return self._last.of(image).masks

    def panoptic(self, image: Image) -> Panoptic:
        """What the words mean, a segment each: `segments_of`.

        Raises:
            InputError: If there are no words.
        """
        return segments_of(self._last.of(image))

    @boundary
    def grounded_masks(self, image: Image, words: Sequence[str]) -> TextMasks:
        """Masks of what words mean, those of the options or others.

        Raises:
            InputError: If a word is empty or stands there twice.
            RangeError: If a word, or all of them, are more than the network takes.
        """
        asked = checked_words(words)
        if asked == self._words:
            return self._last.of(image)
        return self._finder.found([image], asked)[0]

    def _found(self, images: Sequence[Image]) -> list[TextMasks]:
        return self._finder.found(images, checked_words(self._words, needed=self.name))


def segments_of(found: TextMasks) -> Panoptic:
    """A segment for each mask, of its word as a thing; of masks that overlap the surest one shows.

    A mask that surer ones cover whole gives none. Ids are 1, 2, ... in the order of the masks.
    """
    masks = found.masks
    ids = torch.full((masks.height, masks.width), UNLABELLED, dtype=torch.int32)
    order = torch.sort(masks.scores, descending=True, stable=True).indices.tolist()
    for i in reversed(order):
        ids[masks.dense(i)] = i + 1
    shown = set(ids.unique().tolist())
    return Panoptic(
        ids=LabelMap(ids=ids),
        segments=tuple(
            Segment(id=i + 1, category=word + 1, isthing=True, score=float(masks.scores[i]))
            for i, word in enumerate(found.words)
            if i + 1 in shown
        ),
    )


def text_masks(
    masks: Sequence[Any], scores: Sequence[float], words: Sequence[int], size: tuple[int, int]
) -> TextMasks:
    """Masks with a pixel, the surest first, the first among equals.

    Args:
        masks: Run-length masks.
        scores: How sure each is, in [0, 1].
        words: Index of each one's word.
        size: Rows and columns of the image.
    """
    order = sorted((i for i, mask in enumerate(masks) if mask.area), key=lambda i: -scores[i])
    return TextMasks(
        masks=MaskSet(
            height=size[0],
            width=size[1],
            masks=tuple(masks[i] for i in order),
            scores=torch.tensor([scores[i] for i in order], dtype=torch.float32).clamp(0, 1),
            levels=torch.zeros(len(order), dtype=torch.int32),
        ),
        words=tuple(words[i] for i in order),
    )
