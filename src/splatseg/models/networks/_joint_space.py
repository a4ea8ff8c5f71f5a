"""Networks that lay patches of an image and words into one space: what they have in common."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatseg.core import FeatureMap
from splatseg.core.boundary import boundary
from splatseg.core.models import Image
from splatseg.models._encoded import LastImages
from splatseg.models._family import Loading
from splatseg.models._images import Normalisation, PatchGrid, patch_grid, patch_input
from splatseg.models._words import checked_words, in_sentences
from splatseg.models.networks._library import settings_of


class Towers(ABC):
    """The two encoders of such a network."""

    patch: int
    """Pixels of the input that a patch has, along both axes."""

    size: int
    """Side of the input that the weights were made for, pixels."""

    width: int
    """Numbers of a vector of the joint space."""

    normalisation: Normalisation

    tokenizer: str
    """Digest of the tokenizer."""

    @abstractmethod
    def patches(
        self, batch: Float[Tensor, "images 3 h w"], grid: PatchGrid
    ) -> Float[Tensor, "images n width"]:
        """Vectors of patches, row by row, of any length."""

    @abstractmethod
    def sentences(self, texts: Sequence[str]) -> Float[Tensor, "n width"]:
        """Vectors of sentences, of any length."""


class JointSpace:
    """Unit vectors of patches and of words; their cosine says how well they fit.

    Args:
        name: Name of the family.
        options: Its options, with `words` and `template`.
        defaults: Default options.
        place: The weights.
        towers: The network.
    """

    def __init__(
        self, name: str, options: Any, defaults: Any, place: Loading, towers: Towers
    ) -> None:
        self.name = name
        self.note = f"weights {place.name}"
        self.batch_size = place.images_together
        self.words = checked_words(options.words)
        """Words whose vectors are written beside the features."""

        self._options, self._defaults = options, defaults
        self._place = place
        self._towers = towers
        self._size = place.size or towers.size
        self._last = LastImages[FeatureMap](self._encode)

    @property
    def settings(self) -> Mapping[str, Any]:
        """Options, weights, tokenizer, precision and size of the input; words change no answer."""
        return self._settings(self._options)

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """The same with default options."""
        return self._settings(self._defaults)

    def _settings(self, options: Any) -> Mapping[str, Any]:
        found = settings_of(options, self._place, size=self._size, unrecorded=("words",))
        return found | {"tokenizer": self._towers.tokenizer}

    def encode(self, images: Sequence[Image]) -> None:
        """Pass images of one size through the network at once."""
        self._last.encode(images)

    def text_features(self, image: Image) -> FeatureMap:
        """Unit vectors of the patches, on cells of whole pixels."""
        return self._last.of(image)

    @boundary
    @torch.inference_mode()
    def encode_text(self, words: Sequence[str]) -> Float[Tensor, "n width"]:
        """Unit vectors of words, each in the sentence of the option `template`.

        Raises:
            RangeError: If one is longer than the network takes.
        """
        if not words:
            return torch.zeros(0, self._towers.width)
        texts = in_sentences(words, self._options.template)
        return F.normalize(self._towers.sentences(texts).float().cpu(), dim=-1)

    @torch.inference_mode()
    def _encode(self, images: Sequence[Image]) -> list[FeatureMap]:
        height, width = (int(side) for side in images[0].shape[:2])
        grid = patch_grid(height, width, patch=self._towers.patch, size=self._size)
        batch = patch_input(
            images,
            grid,
            self._towers.normalisation,
            device=self._place.device,
            dtype=self._place.dtype,
        )
        vectors = F.normalize(self._towers.patches(batch, grid).float().cpu(), dim=-1)
        return [
            FeatureMap(
                features=one.reshape(grid.rows, grid.columns, -1).contiguous(),
                stride=grid.stride,
                height=height,
                width=width,
            )
            for one in vectors
        ]
