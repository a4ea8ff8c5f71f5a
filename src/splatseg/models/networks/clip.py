"""CLIP and SigLIP: patches of an image and words in one space.

Radford et al. 2021 (arXiv:2103.00020), Zhai et al. 2023 (arXiv:2303.15343), Tschannen et al. 2025
(arXiv:2502.14786); patches in the manner of MaskCLIP, Zhou, Loy and Dai 2022 (arXiv:2112.01071),
section 3.2.
"""

from abc import abstractmethod
from collections.abc import Sequence
from math import isqrt
from typing import Any, ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from splatseg.core import FeatureMap
from splatseg.core.boundary import boundary
from splatseg.core.models import Image
from splatseg.core.options import options
from splatseg.core.threads import network_inference
from splatseg.errors import FileFormatError
from splatseg.models._images import HALVES, Normalisation, PatchGrid, patch_grid, patch_input
from splatseg.models._weights import Loading
from splatseg.models.networks._library import BatchedNetwork, configuration, network, side_of
from splatseg.models.networks._words import Tokens, WordVectorOptions, checked_words, in_sentences

_CLIP_COLOURS = Normalisation(
    mean=(0.48145466, 0.4578275, 0.40821073), std=(0.26862954, 0.26130258, 0.27577711)
)
_SIGLIP_CLASSES = {"siglip": "SiglipModel", "siglip2": "Siglip2Model"}
"""Class of the library by the weights' ``model_type``. SigLIP 2 for images of one size is of the
first kind; the second takes images of any proportions (NaFlex)."""


@options
class ClipOptions(WordVectorOptions):
    """How patches and words come into the joint space."""

    patches: Literal["value", "plain"] = "value"
    """What a patch of the last block is: its own value (MaskCLIP), or what it attends to (plain).
    Only the token of the whole image was trained to attend there, so plain patches describe the
    image more than themselves."""


@options
class SiglipOptions(WordVectorOptions):
    """How words come into the joint space."""

    template: str = "this is a photo of {}."
    """Sentence that each word stands in, at {}."""


class JointSpace(BatchedNetwork[FeatureMap]):
    """Unit vectors of patches and of words; their cosine says how well they fit."""

    _unrecorded: ClassVar = ("words",)

    patch: int
    """Pixels of the input that a patch has, along both axes."""

    width: int
    """Numbers of a vector of the joint space."""

    def __init__(self, name: str, options: WordVectorOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        self.words = checked_words(options.words)
        """Words whose vectors are written beside the features."""

        self._template = options.template

    @abstractmethod
    def _patches(
        self, batch: Float[Tensor, "images 3 h w"], grid: PatchGrid
    ) -> Float[Tensor, "images n width"]:
        """Vectors of patches, row by row, of any length."""

    @abstractmethod
    def _sentences(self, texts: Sequence[str]) -> Float[Tensor, "n width"]:
        """Vectors of sentences, of any length."""

    def text_features(self, image: Image) -> FeatureMap:
        """Unit vectors of the patches, on cells of whole pixels."""
        return self._last.of(image)

    @boundary
    @network_inference()
    def encode_text(self, words: Sequence[str]) -> Float[Tensor, "n width"]:
        """Unit vectors of words, each in the sentence of the option `template`.

        Raises:
            RangeError: If one is longer than the network takes.
        """
        if not words:
            return torch.zeros(0, self.width)
        texts = in_sentences(words, self._template)
        return F.normalize(self._sentences(texts).float().cpu(), dim=-1)

    @override
    @network_inference()
    def _encode(self, images: Sequence[Image]) -> list[FeatureMap]:
        height, width = (int(side) for side in images[0].shape[:2])
        grid = patch_grid(height, width, patch=self.patch, size=self._input_size)
        batch = patch_input(
            images, grid, self._normalisation, device=self._place.device, dtype=self._place.dtype
        )
        vectors = F.normalize(self._patches(batch, grid).float().cpu(), dim=-1)
        return [
            FeatureMap(
                features=one.reshape(grid.rows, grid.columns, -1).contiguous(),
                stride=grid.stride,
                height=height,
                width=width,
            )
            for one in vectors
        ]


class Clip(JointSpace):
    r"""CLIP's encoders.

    The class token is all that CLIP compares with words: it collects the values of all patches,

    .. math:: y = x_{cls} + W_o \sum_j a_j v_j + b_o, \quad v_j = W_v\,\mathrm{LN}_1(x_j) + b_v

    then passes the block's MLP, the last normalisation and the projection. MaskCLIP gives a patch
    what that sum would be if it attended to itself alone, :math:`a_j = 1`: query and key are
    dropped, and all the rest of the block stays.
    """

    def __init__(self, name: str, options: ClipOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        self._network = network(place, "CLIPModel", configuration(place, ("clip",)))
        config = self._network.config
        self._plain = options.patches == "plain"
        longest = int(config.text_config.max_position_embeddings)
        self._tokens = Tokens(place, config, longest=longest)
        self._more_settings = {"tokenizer": self._tokens.digest}
        self.patch = side_of(place.folder, config.vision_config.patch_size)
        self._input_size = place.size or side_of(place.folder, config.vision_config.image_size)
        self.width = int(config.projection_dim)
        self._normalisation = Normalisation.of(place.folder, _CLIP_COLOURS)

    @override
    def _patches(
        self, batch: Float[Tensor, "images 3 h w"], grid: PatchGrid
    ) -> Float[Tensor, "images n width"]:
        vision = self._network.vision_model
        output = vision(batch, interpolate_pos_encoding=True, output_hidden_states=True)
        if self._plain:
            tokens = output.last_hidden_state
        else:
            tokens = _own_values(vision.encoder.layers[-1], output.hidden_states[-2])
        return self._network.visual_projection(vision.post_layernorm(tokens[:, 1:]))

    @override
    def _sentences(self, texts: Sequence[str]) -> Float[Tensor, "n width"]:
        found = self._tokens.of(texts)
        return self._network.get_text_features(
            input_ids=found["input_ids"], attention_mask=found["attention_mask"]
        ).pooler_output


def _own_values(
    block: Any, tokens: Float[Tensor, "images n channels"]
) -> Float[Tensor, "images n channels"]:
    """Tokens after a block in which each attends to itself alone."""
    attention = block.self_attn
    tokens = tokens + attention.out_proj(attention.v_proj(block.layer_norm1(tokens)))
    return tokens + block.mlp(block.layer_norm2(tokens))


class Siglip(JointSpace):
    r"""SigLIP's encoders.

    Its image vector is made by a head: a learned query attends to all tokens and the sum of their
    values passes a residual MLP,

    .. math:: z = b_o + W_o \sum_j a_j (W_v x_j + b_v), \quad
        y = z + \mathrm{MLP}(\mathrm{LN}(z)).

    A patch gets what the head would give if that token were the only one: then :math:`a_j = 1`
    whatever the query is, so value, output projection and MLP are applied to each token. The same
    as MaskCLIP does with CLIP's last block. Of an image of one patch it is the image's vector.
    """

    def __init__(self, name: str, options: SiglipOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        content = configuration(place, tuple(_SIGLIP_CLASSES))
        kind = str(content["model_type"])
        self._network = network(place, _SIGLIP_CLASSES[kind], content)
        vision, text = self._network.config.vision_config, self._network.config.text_config
        if not getattr(vision, "vision_use_head", True):
            raise FileFormatError(
                f"{place.folder}: expected a network with a pooling head, which leads to the "
                "words, got one without."
            )
        self._longest = int(text.max_position_embeddings)
        self._tokens = Tokens(place, self._network.config, longest=self._longest)
        self._more_settings = {"tokenizer": self._tokens.digest}
        self._is_flexible = kind == "siglip2"
        self.patch = side_of(place.folder, vision.patch_size)
        size = (
            self.patch * isqrt(int(vision.num_patches))
            if self._is_flexible
            else side_of(place.folder, vision.image_size)
        )
        self._input_size = place.size or size
        self.width = int(vision.hidden_size)
        self._normalisation = Normalisation.of(place.folder, HALVES)

    @override
    def _patches(
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
    def _sentences(self, texts: Sequence[str]) -> Float[Tensor, "n width"]:
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
