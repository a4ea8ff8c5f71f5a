"""Networks that find what words mean, to the pixel: SAM 3 with words, and CLIPSeg.

Carion et al. 2025 (arXiv:2511.16719), Lueddecke and Ecker 2022 (arXiv:2112.10003).
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from splatseg.core import UNLABELLED, ClassTable, LabelMap, MaskSet, Rle, Segment
from splatseg.core.boundary import boundary
from splatseg.core.models import Image, Panoptic, TextMasks
from splatseg.core.options import Share, options
from splatseg.core.threads import network_inference
from splatseg.errors import FileFormatError, RangeError, quoted
from splatseg.models._images import HALVES, LastImages, Normalisation, frame_of, input_side
from splatseg.models._weights import Loading
from splatseg.models.networks._library import BatchedNetwork, configuration, network, side_of
from splatseg.models.networks._words import (
    Tokens,
    WordOptions,
    checked_words,
    in_sentences,
    word_classes,
)

_CLIPSEG_SIZE = 352
_CLIPSEG_SENTENCE = "a photo of a {}"
"""Sentence that each word stands in for CLIPSeg, as published."""


class WordMasks(BatchedNetwork[TextMasks]):
    """Masks and segments of what some words mean."""

    def __init__(self, name: str, options: Any, place: Loading) -> None:
        super().__init__(name, options, place)
        self._words = checked_words(options.words)

    @abstractmethod
    def _find(self, images: Sequence[Image], words: Sequence[str]) -> list[TextMasks]:
        """Masks of what words mean in images of one size."""

    @property
    def categories(self) -> ClassTable:
        """The words; without any an `InputError`, as of the other questions about an image."""
        return word_classes(checked_words(self._words, needed=self.name))

    def masks(self, image: Image) -> MaskSet:
        """What the words mean; masks may overlap."""
        return self._last.of(image).masks

    def panoptic(self, image: Image) -> Panoptic:
        """What the words mean, a segment each: `segments_of`."""
        return segments_of(self._last.of(image))

    @boundary
    def grounded_masks(self, image: Image, words: Sequence[str]) -> TextMasks:
        """Masks of what words mean, those of the options or others.

        Raises:
            InputError: If a word is empty or stands there twice.
            RangeError: If a word, or all of them, are more than the network takes.
        """
        asked = checked_words(words)
        return self._last.of(image) if asked == self._words else self._find([image], asked)[0]

    @override
    def _encode(self, images: Sequence[Image]) -> list[TextMasks]:
        return self._find(images, checked_words(self._words, needed=self.name))


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


@options
class Sam3TextOptions(WordOptions):
    """Which words are looked for, and when one is found."""

    threshold: Share = 0.5
    """Least probability, in [0, 1], that a mask is what the word means: that it fits the word, by
    that the word means anything in the image."""

    mask_threshold: Share = 0.5
    """Least probability, in [0, 1], of a pixel of a mask."""


class Sam3Text(WordMasks):
    """The detector of SAM 3. The image is encoded once, and asked about each word."""

    def __init__(self, name: str, options: Sam3TextOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        content = configuration(place, ("sam3", "sam3_video"))
        self._network = network(place, "Sam3Model", content)
        config = self._network.config
        self._longest = int(config.text_config.max_position_embeddings)
        self._tokens = Tokens(place, config, longest=self._longest)
        self._more_settings = {"tokenizer": self._tokens.digest}
        self._input_size = side_of(place.folder, config.vision_config.backbone_config.image_size)
        self._check_size(self._input_size)
        self._normalisation = Normalisation.of(place.folder, HALVES)
        self._seen = LastImages[Any](self._see, resizable=False)

    @override
    @network_inference()
    def _find(self, images: Sequence[Image], words: Sequence[str]) -> list[TextMasks]:
        if not words:
            return [self._masks_of(image, []) for image in images]
        self._seen.encode(images)
        texts = self._tokens.of(list(words), padded_to=self._longest)
        asked = [
            (texts["input_ids"][i : i + 1], texts["attention_mask"][i : i + 1])
            for i in range(len(words))
        ]
        return [self._masks_of(image, asked) for image in images]

    @network_inference()
    def _see(self, images: Sequence[Image]) -> list[Any]:
        height, width = (int(side) for side in images[0].shape[:2])
        frame = frame_of(height, width, size=self._input_size, shape="square")
        seen = self._network.get_vision_features(self._input(images, frame))
        return [
            type(seen)(
                fpn_hidden_states=tuple(one[i : i + 1] for one in seen.fpn_hidden_states),
                fpn_position_encoding=tuple(
                    # The encoding of places is the same for all images.
                    one[min(i, len(one) - 1)][None]
                    for one in seen.fpn_position_encoding
                ),
            )
            for i in range(len(images))
        ]

    def _masks_of(self, image: Image, asked: Sequence[tuple[Tensor, Tensor]]) -> TextMasks:
        size = int(image.shape[0]), int(image.shape[1])
        masks: list[Rle] = []
        scores: list[float] = []
        words: list[int] = []
        for word, (ids, attention) in enumerate(asked):
            output = self._network(
                vision_embeds=self._seen.of(image), input_ids=ids, attention_mask=attention
            )
            fits = output.pred_logits[0].float().sigmoid()
            fits = fits * output.presence_logits[0].float().sigmoid()
            for i in (fits >= self._options.threshold).nonzero()[:, 0].tolist():
                # As the network's own program: probabilities are enlarged, not logits.
                probability = output.pred_masks[0, i].float().sigmoid()[None, None]
                full = F.interpolate(probability, size, mode="bilinear")[0, 0]
                masks.append(Rle.encode((full > self._options.mask_threshold).cpu()))
                scores.append(float(fits[i]))
                words.append(word)
        return text_masks(masks, scores, words, size)


@options(removed={"template": f'words stand in "{_CLIPSEG_SENTENCE}"'})
class ClipSegOptions(WordOptions):
    """Which words are looked for, and when one is found."""

    threshold: Share = 0.3
    """Least probability, in [0, 1], that a pixel is meant by its word; below it has none."""


class ClipSeg(BatchedNetwork[Tensor]):
    """The likeliest of some words for every pixel.

    Each word is asked for by itself, so the probabilities of a pixel do not sum to 1: a pixel may
    be of no word, and of several words takes the likeliest, the first among equals.

    Raises:
        InputError: If there are no words.
        RangeError: If the size of the input is no multiple of a patch, or a word is too long.
    """

    _constants: ClassVar = {"template": _CLIPSEG_SENTENCE}

    def __init__(self, name: str, options: ClipSegOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        words = checked_words(options.words, needed=name)
        content = configuration(place, ("clipseg",))
        self._network = network(place, "CLIPSegForImageSegmentation", content)
        config = self._network.config
        count = int(config.vision_config.num_hidden_layers)
        if not all(0 <= block < count for block in config.extract_layers):
            raise FileFormatError(
                f"{place.folder / 'config.json'}: extract_layers: expected some of {count} blocks, "
                f"got {quoted(config.extract_layers)}."
            )
        patch = side_of(place.folder, config.vision_config.patch_size)
        size = place.size or input_side(place.folder, "height", _CLIPSEG_SIZE)
        if size % patch and place.size is None:
            raise FileFormatError(
                f"{place.folder}: expected a size of images that is a multiple of {patch}, got "
                f"{size}."
            )
        if size % patch:
            raise RangeError(f"size: expected a multiple of {patch}, got {size}.")
        self._input_size = size
        self._threshold = options.threshold
        self._normalisation = Normalisation.of(place.folder)
        tokens = Tokens(place, config, longest=int(config.text_config.max_position_embeddings))
        self._more_settings = {"tokenizer": tokens.digest}
        self._classes = word_classes(words)
        self._conditions = self._encode_words(tokens, in_sentences(words, _CLIPSEG_SENTENCE))

    @property
    def classes(self) -> ClassTable:
        """The words."""
        return self._classes

    def label_map(self, image: Image) -> LabelMap:
        """The word of every pixel, -1 where none is likely enough, and its probability."""
        height, width = (int(side) for side in image.shape[:2])
        best = torch.full((height, width), -torch.inf)
        ids = torch.full((height, width), UNLABELLED, dtype=torch.int32)
        for i, logits in enumerate(self._last.of(image), start=1):
            full = F.interpolate(logits[None, None], (height, width), mode="bilinear")[0, 0]
            ids[full > best] = i
            best = torch.maximum(best, full)
        probability = best.sigmoid()
        ids[probability < self._threshold] = UNLABELLED
        return LabelMap(ids=ids, confidence=probability)

    @network_inference()
    def _encode_words(self, tokens: Tokens, texts: Sequence[str]) -> Float[Tensor, "words width"]:
        found = tokens.of(texts)
        return self._network.get_conditional_embeddings(
            batch_size=len(texts),
            input_ids=found["input_ids"],
            attention_mask=found["attention_mask"],
        )

    @override
    @network_inference()
    def _encode(self, images: Sequence[Image]) -> list[Tensor]:
        """Logits (words, size, size) of images. The image's encoder runs once for all words."""
        height, width = (int(side) for side in images[0].shape[:2])
        frame = frame_of(height, width, size=self._input_size, shape="square")
        states = self._network.clip.vision_model(
            self._input(images, frame), interpolate_pos_encoding=True, output_hidden_states=True
        ).hidden_states
        # The first of the states is the one before any block.
        taken = [states[block + 1] for block in self._network.config.extract_layers]
        count = len(self._conditions)
        return [
            self._network.decoder(
                [state[i : i + 1].expand(count, -1, -1) for state in taken], self._conditions
            )
            .logits.float()
            .cpu()
            for i in range(len(images))
        ]
