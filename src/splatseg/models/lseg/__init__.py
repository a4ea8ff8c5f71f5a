"""LSeg: dense image features in CLIP's space of words, by a network of our own writing.

Li et al. 2022, "Language-driven Semantic Segmentation" (arXiv:2201.03546): a dense prediction
transformer whose pixels were trained to lie where CLIP's text encoder puts the names of their
classes. No library has it; the published checkpoint is read as it is.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import FeatureMap
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.models import DeepFeatures, Image
from splatseg.errors import FileFormatError, RangeError
from splatseg.models._encoded import LastImages
from splatseg.models._family import Checkpoint, Loading, ModelFamily
from splatseg.models._images import HALVES, PatchGrid, patch_grid, patch_input
from splatseg.models._images import Normalisation as Normalisation
from splatseg.models.lseg._layout import network_of
from splatseg.models.lseg._reading import read_checkpoint
from splatseg.models.lseg._sizes import PATCH
from splatseg.models.lseg._tokenizer import Tokenizer, tokenizer_folder
from splatseg.models.networks._library import settings_of

_STEP = 2
"""Pixels of the input that a cell of the decoder's map stands for."""

_MULTIPLE = 2 * PATCH
"""Sides of the input are multiples of this, so that each level is half as large as the next."""

_TRAINED_SIZE = 480
"""Side of the crops that the published weights were trained on, pixels."""

_SHOWN = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class LSegOptions:
    """How fine the features are, and where words come from."""

    cell: int = 4
    """Pixels of the network's input that a feature stands for, along both axes: 2 is the finest
    that the network gives, 4, 8, 16 or 32 are means. Files grow as its square shrinks."""

    tokenizer: str | None = None
    """Folder of CLIP's vocabulary (tokenizer.json, or vocab.json and merges.txt), or the id of a
    CLIP that the hub's cache has. None looks beside the weights. Only words need it."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.cell not in (2, 4, 8, 16, 32):
            raise RangeError(f"cell: expected 2, 4, 8, 16 or 32, got {self.cell}.")


class LSeg:
    """Cells of an image and words as unit vectors in one space."""

    def __init__(self, options: LSegOptions, place: Loading) -> None:
        if place.file is None:
            raise FileFormatError(f"{place.folder}: expected a file of weights, got a folder.")
        network, unknown = network_of(read_checkpoint(place.file), place.file)
        if unknown:
            more = ", ..." if len(unknown) > _SHOWN else ""
            place.report(
                f"{place.file}: {len(unknown)} tensors are not of LSeg and not used "
                f"({', '.join(unknown[:_SHOWN])}{more})."
            )
        self.name = "lseg"
        self.note = f"weights {place.name}"
        self.batch_size = place.images_together
        self._options = options
        self._place = place
        self._network = network.to(place.device, place.dtype)
        self._size = place.size or _TRAINED_SIZE
        self._last = LastImages[Tensor](self._encode)
        self._tokenizer: Tokenizer | None = None
        if options.tokenizer is not None:
            self._tokenizer = self._read_tokenizer()

    @property
    def settings(self) -> Mapping[str, Any]:
        """Options, weights, precision and size of the input."""
        return self._settings(self._options)

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """The same with default options."""
        return self._settings(LSegOptions())

    def _settings(self, options: LSegOptions) -> Mapping[str, Any]:
        # One vocabulary fits the weights; where it lies changes no answer.
        return settings_of(options, self._place, size=self._size, unrecorded=("tokenizer",))

    def encode(self, images: Sequence[Image]) -> None:
        """Pass images of one size through the network at once."""
        self._last.encode(images)

    def text_features(self, image: Image) -> FeatureMap:
        """Unit vectors of the image's cells in the space of words."""
        return self._map(image, self.in_word_space(self._last.of(image)))

    def features(self, image: Image) -> DeepFeatures:
        """The decoder's map, from which `in_word_space` leads on: half as wide, and not of words.

        Methods that keep a feature a Gaussian or a voxel keep this one.
        """
        return DeepFeatures(maps=(self._map(image, self._last.of(image)),), depths=("decoder",))

    @boundary
    def in_word_space(self, decoded: Float[Tensor, "*n decoder"]) -> Float[Tensor, "*n embedding"]:
        """Unit vectors in the space of words of what `features` gives, or of means of it.

        Raises:
            ShapeError: If the last axis is not the decoder's width.
        """
        head = self._network.head
        check_shape("decoded", decoded, (*decoded.shape[:-1], head.in_channels))
        with torch.inference_mode():
            found = self._network.in_word_space(decoded.to(self._place.device)).cpu()
        return found.clone()  # outside, so that it is an ordinary tensor

    def encode_text(self, words: Sequence[str]) -> Float[Tensor, "n embedding"]:
        """Unit vectors of words or phrases, as they are: no sentence is put around them.

        Raises:
            MissingFileError: If CLIP's vocabulary is not on this machine.
            FileFormatError: If it is broken, or does not fit the weights.
            InputError: If a text is too long.
        """
        if not words:
            return torch.zeros(0, self._network.head.out_channels)
        if self._tokenizer is None:
            self._tokenizer = self._read_tokenizer()
        tokens, last = self._tokenizer.tokens(words)
        device = self._place.device
        with torch.inference_mode():
            found = self._network.text(tokens.to(device), last.to(device)).float()
            found = F.normalize(found, dim=-1).cpu()
        return found.clone()

    def _read_tokenizer(self) -> Tokenizer:
        text = self._network.text
        return Tokenizer(
            tokenizer_folder(self._options.tokenizer, self._place.folder),
            vocabulary=int(text.tokens.num_embeddings),
            context=len(text.positions),
        )

    @torch.inference_mode()
    def _encode(self, images: Sequence[Image]) -> list[Tensor]:
        """The decoder's map of each image, (rows, columns, channels)."""
        height, width = (int(side) for side in images[0].shape[:2])
        grid = self._grid(height, width)
        whole = _MULTIPLE // self._options.cell
        padded = PatchGrid(
            rows=-(-grid.rows // whole) * whole,
            columns=-(-grid.columns // whole) * whole,
            stride=grid.stride,
            patch=grid.patch,
        )
        batch = patch_input(
            images, padded, HALVES,
            device=self._place.device, dtype=self._place.dtype, mode="bilinear",
        )  # fmt: skip
        decoded = self._network.image(batch).float()
        cells = F.avg_pool2d(decoded, self._options.cell // _STEP)
        cells = cells[:, :, : grid.rows, : grid.columns].permute(0, 2, 3, 1).cpu()
        return [one.clone() for one in cells]

    def _grid(self, height: int, width: int) -> PatchGrid:
        return patch_grid(height, width, patch=self._options.cell, size=self._size)

    def _map(self, image: Image, features: Tensor) -> FeatureMap:
        height, width = (int(side) for side in image.shape[:2])
        stride = self._grid(height, width).stride
        return FeatureMap(features=features, stride=stride, height=height, width=width)


LSEG = ModelFamily(
    name="lseg",
    summary="dense features in CLIP's space of words, trained on labelled pixels",
    reference="arXiv:2201.03546",
    gives=("text", "features"),
    options=LSegOptions,
    load=lambda options, place: LSeg(options, cast(Loading, place)),
    checkpoints=(
        Checkpoint(
            id="demo_e200.ckpt",
            megabytes=1620,
            licence="MIT",
            note="on Google Drive, linked from github.com/isl-org/lang-seg",
            on_hub=False,
        ),
    ),
    single_file=True,
    instead="dense CLIP or SigLIP 2 (--model clip, siglip2) serve in its place",
)
