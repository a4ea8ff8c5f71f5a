"""CLIP: patches of an image and words in one space.

Radford et al. 2021 (arXiv:2103.00020); patches in the manner of MaskCLIP, Zhou, Loy and Dai 2022
(arXiv:2112.01071), section 3.2.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from splatseg.core.boundary import convert_fields
from splatseg.models._family import Checkpoint, Loading
from splatseg.models._images import Normalisation, PatchGrid
from splatseg.models._words import checked_template, checked_words
from splatseg.models.networks._joint_space import JointSpace, Towers
from splatseg.models.networks._library import configuration, network, network_family, side_of
from splatseg.models.networks._tokens import Tokens

_COLOURS = Normalisation(
    mean=(0.48145466, 0.4578275, 0.40821073), std=(0.26862954, 0.26130258, 0.27577711)
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClipOptions:
    """How patches and words come into the joint space."""

    words: tuple[str, ...] = ()
    """Words or phrases whose vectors are written beside the features, with the phrases that they
    are compared with (object, things, stuff, texture). They can be changed later at no cost."""

    template: str = "a photo of a {}"
    """Sentence that each word stands in, at {}."""

    patches: Literal["value", "plain"] = "value"
    """What a patch of the last block is: its own value (MaskCLIP), or what it attends to (plain).
    Only the token of the whole image was trained to attend there, so plain patches describe the
    image more than themselves."""

    def __post_init__(self) -> None:
        convert_fields(self)
        checked_words(self.words)
        checked_template(self.template)


class _ClipTowers(Towers):
    r"""CLIP's encoders.

    The class token is all that CLIP compares with words: it collects the values of all patches,

    .. math:: y = x_{cls} + W_o \sum_j a_j v_j + b_o, \quad v_j = W_v\,\mathrm{LN}_1(x_j) + b_v

    then passes the block's MLP, the last normalisation and the projection. MaskCLIP gives a patch
    what that sum would be if it attended to itself alone, :math:`a_j = 1`: query and key are
    dropped, and all the rest of the block stays.
    """

    def __init__(self, options: ClipOptions, place: Loading) -> None:
        self._network = network(place, "CLIPModel", configuration(place, ("clip",)))
        known = self._network.config
        vision = known.vision_config
        self._tokens = Tokens(place, known, longest=int(known.text_config.max_position_embeddings))
        self._patches = options.patches
        self.patch, self.size = (
            side_of(place.folder, vision.patch_size),
            side_of(place.folder, vision.image_size),
        )
        self.width = int(self._network.config.projection_dim)
        self.normalisation = Normalisation.of(place.folder, _COLOURS)
        self.tokenizer = self._tokens.digest

    @override
    def patches(
        self, batch: Float[Tensor, "images 3 h w"], grid: PatchGrid
    ) -> Float[Tensor, "images n width"]:
        vision = self._network.vision_model
        output = vision(batch, interpolate_pos_encoding=True, output_hidden_states=True)
        if self._patches == "plain":
            tokens = output.last_hidden_state
        else:
            tokens = _own_values(vision.encoder.layers[-1], output.hidden_states[-2])
        return self._network.visual_projection(vision.post_layernorm(tokens[:, 1:]))

    @override
    def sentences(self, texts: Sequence[str]) -> Float[Tensor, "n width"]:
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


def _clip(name: str, options: ClipOptions, place: Loading) -> JointSpace:
    return JointSpace(name, options, ClipOptions(), place, _ClipTowers(options, place))


CLIP = network_family(
    "clip",
    "patches and words in one space, of 2021",
    Checkpoint(id="openai/clip-vit-base-patch16", megabytes=600, licence="MIT"),
    Checkpoint(id="openai/clip-vit-large-patch14", megabytes=1710, licence="MIT"),
    reference="arXiv:2103.00020",
    gives=("text",),
    options=ClipOptions,
    make=_clip,
)
