"""SigLIP and SigLIP 2: patches of an image and words in one space.

Zhai et al. 2023 (arXiv:2303.15343), Tschannen et al. 2025 (arXiv:2502.14786); patches in the manner
of MaskCLIP, Zhou, Loy and Dai 2022 (arXiv:2112.01071).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isqrt
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from splatseg.core.boundary import convert_fields
from splatseg.errors import FileFormatError
from splatseg.models._family import Checkpoint, Loading
from splatseg.models._images import HALVES, Normalisation, PatchGrid
from splatseg.models._words import checked_template, checked_words
from splatseg.models.networks._joint_space import JointSpace, Towers
from splatseg.models.networks._library import configuration, network, network_family, side_of
from splatseg.models.networks._tokens import Tokens

_CLASSES = {"siglip": "SiglipModel", "siglip2": "Siglip2Model"}
"""Class of the library by the weights' ``model_type``. SigLIP 2 for images of one size is of the
first kind; the second takes images of any proportions (NaFlex)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SiglipOptions:
    """How words come into the joint space."""

    words: tuple[str, ...] = ()
    """Words or phrases whose vectors are written beside the features, with the phrases that they
    are compared with (object, things, stuff, texture). They can be changed later at no cost."""

    template: str = "this is a photo of {}."
    """Sentence that each word stands in, at {}."""

    def __post_init__(self) -> None:
        convert_fields(self)
        checked_words(self.words)
        checked_template(self.template)


class _SiglipTowers(Towers):
    r"""SigLIP's encoders.

    Its image vector is made by a head: a learned query attends to all tokens and the sum of their
    values passes a residual MLP,

    .. math:: z = b_o + W_o \sum_j a_j (W_v x_j + b_v), \quad
        y = z + \mathrm{MLP}(\mathrm{LN}(z)).

    A patch gets what the head would give if that token were the only one: then :math:`a_j = 1`
    whatever the query is, so value, output projection and MLP are applied to each token. The same
    as MaskCLIP does with CLIP's last block. Of an image of one patch it is the image's vector.
    """

    def __init__(self, place: Loading) -> None:
        content = configuration(place, tuple(_CLASSES))
        kind = str(content["model_type"])
        self._network = network(place, _CLASSES[kind], content)
        vision, text = self._network.config.vision_config, self._network.config.text_config
        if not getattr(vision, "vision_use_head", True):
            raise FileFormatError(
                f"{place.folder}: expected a network with a pooling head, which leads to the "
                "words, got one without."
            )
        self._longest = int(text.max_position_embeddings)
        self._tokens = Tokens(place, self._network.config, longest=self._longest)
        self._is_flexible = kind == "siglip2"
        self.patch = side_of(place.folder, vision.patch_size)
        self.size = (
            self.patch * isqrt(int(vision.num_patches))
            if self._is_flexible
            else side_of(place.folder, vision.image_size)
        )
        self.width = int(vision.hidden_size)
        self.normalisation = Normalisation.of(place.folder, HALVES)
        self.tokenizer = self._tokens.digest

    @override
    def patches(
        self, batch: Float[Tensor, "images 3 h w"], grid: PatchGrid
    ) -> Float[Tensor, "images n width"]:
        vision = self._network.vision_model
        if self._is_flexible:
            count = len(batch)
            output = vision(
                in_patches(batch, self.patch),
                pixel_attention_mask=torch.ones(
                    count, grid.rows * grid.columns, dtype=torch.int32, device=batch.device
                ),
                spatial_shapes=torch.tensor([[grid.rows, grid.columns]] * count),
            )
        else:
            output = vision(batch, interpolate_pos_encoding=True)
        return _own_vectors(vision.head, output.last_hidden_state)

    @override
    def sentences(self, texts: Sequence[str]) -> Float[Tensor, "n width"]:
        # It learned with sentences that are filled up to one length, in lower case, unmasked.
        lower = [text.lower() for text in texts]
        found = self._tokens.of(lower, padded_to=self._longest)
        return self._network.get_text_features(input_ids=found["input_ids"]).pooler_output


def in_patches(
    batch: Float[Tensor, "images 3 h w"], patch: int
) -> Float[Tensor, "images patches values"]:
    """Patches row by row, each as its pixels row by row, each as red, green and blue."""
    images, channels, height, width = batch.shape
    rows, columns = height // patch, width // patch
    cut = batch.reshape(images, channels, rows, patch, columns, patch)
    return cut.permute(0, 2, 4, 3, 5, 1).reshape(images, rows * columns, -1)


def _own_vectors(
    head: Any, tokens: Float[Tensor, "images n channels"]
) -> Float[Tensor, "images n channels"]:
    """What the pooling head gives for each token alone."""
    attention = head.attention
    # The weights of query, key and value lie below each other.
    value, bias = attention.in_proj_weight.chunk(3)[2], attention.in_proj_bias.chunk(3)[2]
    found = attention.out_proj(F.linear(tokens, value, bias))
    return found + head.mlp(head.layernorm(found))


def _siglip(name: str, options: SiglipOptions, place: Loading) -> JointSpace:
    return JointSpace(name, options, SiglipOptions(), place, _SiglipTowers(place))


SIGLIP2 = network_family(
    "siglip2",
    "patches and words in one space, of 2025; images of any proportions",
    Checkpoint(id="google/siglip2-base-patch16-naflex", megabytes=1500, licence="Apache-2.0"),
    reference="arXiv:2502.14786",
    gives=("text",),
    options=SiglipOptions,
    make=_siglip,
)
