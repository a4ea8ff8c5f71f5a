"""CLIPSeg: for each word a map of where it is meant.

Lueddecke and Ecker 2022 (arXiv:2112.10003).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatseg.core import UNLABELLED, ClassTable, LabelMap
from splatseg.core.boundary import convert_fields
from splatseg.core.models import Image
from splatseg.errors import FileFormatError, RangeError, quoted
from splatseg.models._encoded import LastImages
from splatseg.models._family import Checkpoint, Loading
from splatseg.models._images import Normalisation, frame_of, input_side, network_input
from splatseg.models._words import checked_template, checked_words, in_sentences, word_classes
from splatseg.models.networks._library import (
    configuration,
    network,
    network_family,
    settings_of,
    side_of,
)
from splatseg.models.networks._tokens import Tokens

_DEFAULT_SIZE = 352


@dataclass(frozen=True, slots=True, kw_only=True)
class ClipSegOptions:
    """Which words are looked for, and when one is found."""

    words: tuple[str, ...] = ()
    """Words or phrases that pixels are given to: the ids 1, 2, ... in this order."""

    threshold: float = 0.3
    """Least probability, in [0, 1], that a pixel is meant by its word; below it has none."""

    template: str = "a photo of a {}"
    """Sentence that each word stands in, at {}."""

    def __post_init__(self) -> None:
        convert_fields(self)
        checked_words(self.words)
        checked_template(self.template)
        if not 0 <= self.threshold <= 1:
            raise RangeError(f"threshold: expected 0 to 1, got {self.threshold}.")


class ClipSeg:
    """The likeliest of some words for every pixel.

    Each word is asked for by itself, so the probabilities of a pixel do not sum to 1: a pixel may
    be of no word, and of several words takes the likeliest, the first among equals.

    Raises:
        InputError: If there are no words.
        RangeError: If the size of the input is no multiple of a patch, or a word is too long.
    """

    def __init__(self, name: str, options: ClipSegOptions, place: Loading) -> None:
        words = checked_words(options.words, needed=name)
        config = configuration(place, ("clipseg",))
        self.name = name
        self.note = f"weights {place.name}"
        self.batch_size = place.images_together
        self._options = options
        self._place = place
        self._network = network(place, "CLIPSegForImageSegmentation", config)
        known = self._network.config
        count = int(known.vision_config.num_hidden_layers)
        if not all(0 <= block < count for block in known.extract_layers):
            raise FileFormatError(
                f"{place.folder / 'config.json'}: extract_layers: expected some of {count} blocks, "
                f"got {quoted(known.extract_layers)}."
            )
        patch = side_of(place.folder, known.vision_config.patch_size)
        self._size = place.size or input_side(place.folder, "height", _DEFAULT_SIZE)
        if self._size % patch and place.size is None:
            raise FileFormatError(
                f"{place.folder}: expected a size of images that is a multiple of {patch}, got "
                f"{self._size}."
            )
        if self._size % patch:
            raise RangeError(f"size: expected a multiple of {patch}, got {self._size}.")
        self._normalisation = Normalisation.of(place.folder)
        tokens = Tokens(place, known, longest=int(known.text_config.max_position_embeddings))
        self._tokenizer = tokens.digest
        self._classes = word_classes(words)
        self._conditions = self._encode_words(tokens, in_sentences(words, options.template))
        self._last = LastImages[Tensor](self._encode)

    @property
    def settings(self) -> Mapping[str, Any]:
        """Options, weights, tokenizer, precision and size of the input."""
        return self._settings(self._options)

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """The same with default options."""
        return self._settings(ClipSegOptions())

    def _settings(self, options: ClipSegOptions) -> Mapping[str, Any]:
        return settings_of(options, self._place, size=self._size) | {"tokenizer": self._tokenizer}

    @property
    def classes(self) -> ClassTable:
        """The words."""
        return self._classes

    def encode(self, images: Sequence[Image]) -> None:
        """Pass images of one size through the network at once."""
        self._last.encode(images)

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
        ids[probability < self._options.threshold] = UNLABELLED
        return LabelMap(ids=ids, confidence=probability)

    @torch.inference_mode()
    def _encode_words(self, tokens: Tokens, texts: Sequence[str]) -> Float[Tensor, "words width"]:
        found = tokens.of(texts)
        return self._network.get_conditional_embeddings(
            batch_size=len(texts),
            input_ids=found["input_ids"],
            attention_mask=found["attention_mask"],
        )

    @torch.inference_mode()
    def _encode(self, images: Sequence[Image]) -> list[Tensor]:
        """Logits (words, size, size) of images. The image's encoder runs once for all words."""
        height, width = (int(side) for side in images[0].shape[:2])
        batch = network_input(
            images,
            frame_of(height, width, size=self._size, shape="square"),
            self._normalisation,
            device=self._place.device,
            dtype=self._place.dtype,
        )
        states = self._network.clip.vision_model(
            batch, interpolate_pos_encoding=True, output_hidden_states=True
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


CLIPSEG = network_family(
    "clipseg",
    "the likeliest of some words for every pixel, without things",
    Checkpoint(id="CIDAS/clipseg-rd64-refined", megabytes=603, licence="Apache-2.0"),
    reference="arXiv:2112.10003",
    gives=("labels",),
    options=ClipSegOptions,
    make=ClipSeg,
)
