"""Segment Anything 3 with words: masks of all that a phrase means.

Carion et al. 2025 (arXiv:2511.16719).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from typing_extensions import override

from splatseg.core import Rle
from splatseg.core.boundary import convert_fields
from splatseg.core.models import Image, TextMasks
from splatseg.errors import RangeError
from splatseg.models._encoded import LastImages
from splatseg.models._family import Checkpoint, Loading
from splatseg.models._images import HALVES, Normalisation, frame_of, network_input
from splatseg.models._words import checked_words
from splatseg.models.networks._library import (
    configuration,
    network,
    network_family,
    settings_of,
    side_of,
)
from splatseg.models.networks._tokens import Tokens
from splatseg.models.networks._word_masks import Finder, WordMasks, text_masks


@dataclass(frozen=True, slots=True, kw_only=True)
class Sam3TextOptions:
    """Which words are looked for, and when one is found."""

    words: tuple[str, ...] = ()
    """Words or phrases that are looked for, one after the other."""

    threshold: float = 0.5
    """Least probability, in [0, 1], that a mask is what the word means: that it fits the word, by
    that the word means anything in the image."""

    mask_threshold: float = 0.5
    """Least probability, in [0, 1], of a pixel of a mask."""

    def __post_init__(self) -> None:
        convert_fields(self)
        checked_words(self.words)
        for name in ("threshold", "mask_threshold"):
            if not 0 <= getattr(self, name) <= 1:
                raise RangeError(f"{name}: expected 0 to 1, got {getattr(self, name)}.")


class _Sam3(Finder):
    """The detector of SAM 3. The image is encoded once, and asked about each word."""

    def __init__(self, options: Sam3TextOptions, place: Loading) -> None:
        content = configuration(place, ("sam3", "sam3_video"))
        self._options = options
        self._place = place
        self._network = network(place, "Sam3Model", content)
        config = self._network.config
        self._longest = int(config.text_config.max_position_embeddings)
        self._tokens = Tokens(place, config, longest=self._longest)
        self._size = side_of(place.folder, config.vision_config.backbone_config.image_size)
        if place.size not in (None, self._size):
            raise RangeError(f"size: {place.name} takes {self._size} alone, got {place.size}.")
        self._normalisation = Normalisation.of(place.folder, HALVES)
        self._last = LastImages[Any](self._encode, resizable=False)

    def settings(self, options: Sam3TextOptions) -> Mapping[str, Any]:
        """Options, weights, tokenizer, precision and size of the input."""
        found = settings_of(options, self._place, size=self._size)
        return found | {"tokenizer": self._tokens.digest}

    @override
    @torch.inference_mode()
    def found(self, images: Sequence[Image], words: Sequence[str]) -> list[TextMasks]:
        if not words:
            return [self._masks(image, []) for image in images]
        self._last.encode(images)
        texts = self._tokens.of(list(words), padded_to=self._longest)
        asked = [
            (texts["input_ids"][i : i + 1], texts["attention_mask"][i : i + 1])
            for i in range(len(words))
        ]
        return [self._masks(image, asked) for image in images]

    @torch.inference_mode()
    def _encode(self, images: Sequence[Image]) -> list[Any]:
        height, width = (int(side) for side in images[0].shape[:2])
        batch = network_input(
            images,
            frame_of(height, width, size=self._size, shape="square"),
            self._normalisation,
            device=self._place.device,
            dtype=self._place.dtype,
        )
        seen = self._network.get_vision_features(batch)
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

    def _masks(self, image: Image, asked: Sequence[tuple[Tensor, Tensor]]) -> TextMasks:
        size = int(image.shape[0]), int(image.shape[1])
        masks: list[Rle] = []
        scores: list[float] = []
        words: list[int] = []
        for word, (ids, attention) in enumerate(asked):
            output = self._network(
                vision_embeds=self._last.of(image), input_ids=ids, attention_mask=attention
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


def _sam3_text(name: str, options: Sam3TextOptions, place: Loading) -> WordMasks:
    finder = _Sam3(options, place)
    return WordMasks(
        name,
        options,
        Sam3TextOptions(),
        place,
        finder=finder,
        settings=finder.settings,
    )


SAM3_TEXT = network_family(
    "sam3-text",
    "Segment Anything 3 with words: masks of all that a phrase means",
    Checkpoint(
        id="facebook/sam3", megabytes=3440, licence="SAM License", note="access must be asked for"
    ),
    reference="arXiv:2511.16719",
    gives=("masks", "panoptic"),
    options=Sam3TextOptions,
    make=_sam3_text,
)
