"""Names of tensors in the published checkpoint, and which network their shapes are of.

The names are those that Lightning wrote for timm's, CLIP's and the authors' modules; ours are
others, so each of ours has a published one.
"""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from splatseg.errors import FileFormatError
from splatseg.models.lseg._network import LSegNetwork
from splatseg.models.lseg._sizes import LEVELS, PATCH, Sizes

PREFIX = "net."
"""What Lightning puts before every name; weights that were taken out of it lack it."""

_SOME = 3
_BLOCK = {
    "image.transformer": {
        "norm_1": "norm1", "attention.qkv.": "attn.qkv.", "attention.out": "attn.proj",
        "norm_2": "norm2", "wider": "mlp.fc1", "back": "mlp.fc2",
    },
    "text": {
        "norm_1": "ln_1", "attention.qkv.": "attn.in_proj_", "attention.out": "attn.out_proj",
        "norm_2": "ln_2", "wider": "mlp.c_fc", "back": "mlp.c_proj",
    },
}  # fmt: skip
_BLOCKS = {
    "image.transformer": "pretrained.model.blocks",
    "text": "clip_pretrained.transformer.resblocks",
}
_WHOLE = {
    "image.transformer.class_token": "pretrained.model.cls_token",
    "image.transformer.positions": "pretrained.model.pos_embed",
    "image.transformer.patches.weight": "pretrained.model.patch_embed.proj.weight",
    "image.transformer.patches.bias": "pretrained.model.patch_embed.proj.bias",
    "head.weight": "scratch.head1.weight",
    "head.bias": "scratch.head1.bias",
    "text.tokens.weight": "clip_pretrained.token_embedding.weight",
    "text.positions": "clip_pretrained.positional_embedding",
    "text.norm.weight": "clip_pretrained.ln_final.weight",
    "text.norm.bias": "clip_pretrained.ln_final.bias",
    "text.projection": "clip_pretrained.text_projection",
}
_LEVEL = {"readout": "0.project.0", "project": "3", "resample": "4"}
_FUSION = {"merge": "resConfUnit1", "refine": "resConfUnit2"}
_UNIT = {"conv_1": "conv1", "norm_1": "bn1", "conv_2": "conv2", "norm_2": "bn2"}

_COUNTER = "num_batches_tracked"
"""A batch normalisation's number of training steps, which no answer depends on."""

_NOT_NEEDED = (
    "pretrained.model.norm.",
    "pretrained.model.head.",
    "pretrained.model.fc_norm.",
    "scratch.refinenet4.resConfUnit1.",  # the coarsest level has nothing to be merged with
    "scratch.output_conv.",
    "scratch.head_block.",  # smooths scores of words, not embeddings
    "clip_pretrained.visual.",
    "clip_pretrained.logit_scale",
    "logit_scale",
    "auxlayer.",
    "mean",
    "std",
)
"""Tensors of the published checkpoint that dense embeddings do not need."""


def published_name(name: str) -> str:
    """What the checkpoint calls a tensor of `LSegNetwork`, without Lightning's prefix."""
    if name in _WHOLE:
        return _WHOLE[name]
    block = re.fullmatch(r"(image\.transformer|text)\.blocks\.(\d+)\.(.+)", name)
    if block is not None:
        side, index, rest = block.groups()
        old, new = next(pair for pair in _BLOCK[side].items() if rest.startswith(pair[0]))
        return f"{_BLOCKS[side]}.{index}.{new}{rest.removeprefix(old)}"
    _, part, index, piece, *rest = name.split(".")
    level = int(index) + 1
    if part == "levels":
        return f"pretrained.act_postprocess{level}.{_LEVEL[piece]}.{rest[0]}"
    if piece == "reduce":
        return f"scratch.layer{level}_rn.{rest[0]}"
    if piece == "out":
        return f"scratch.refinenet{level}.out_conv.{rest[0]}"
    return f"scratch.refinenet{level}.{_FUSION[piece]}.{_UNIT[rest[0]]}.{rest[1]}"


def published_tensors(sizes: Sizes) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors that a network of these sizes takes from a checkpoint."""
    with torch.device("meta"):
        network = LSegNetwork(sizes)
    return {
        published_name(name): tuple(tensor.shape)
        for name, tensor in network.state_dict().items()
        if not name.endswith(_COUNTER)
    }


def network_of(tensors: Mapping[str, Tensor], path: Path) -> tuple[LSegNetwork, Sequence[str]]:
    """The network whose weights these are, and names of tensors that nothing is known of.

    Args:
        tensors: By their published names, with or without Lightning's prefix.
        path: Their file, for messages.

    Raises:
        FileFormatError: If tensors are missing, or have another shape than the others ask for.
    """
    prefix = PREFIX if any(name.startswith(PREFIX) for name in tensors) else ""
    there = {name.removeprefix(prefix): one for name, one in tensors.items()}
    sizes = _sizes_of(there, path)
    wanted = published_tensors(sizes)
    _check_there(there, wanted, path)
    wrong = [name for name, shape in wanted.items() if tuple(there[name].shape) != shape]
    if wrong:
        raise FileFormatError(
            f"{path}: expected {wrong[0]} of shape {wanted[wrong[0]]}, as the other tensors ask "
            f"for, got {tuple(there[wrong[0]].shape)}."
        )
    with torch.device("meta"):
        network = LSegNetwork(sizes)
    network.load_state_dict(
        {
            name: torch.tensor(0)
            if name.endswith(_COUNTER)
            else there[published_name(name)].detach().to(torch.float32, copy=True)
            for name in network.state_dict()
        },
        assign=True,
    )
    unknown = [
        name
        for name in there
        if name not in wanted and not name.startswith(_NOT_NEEDED) and not name.endswith(_COUNTER)
    ]
    return network.requires_grad_(False).eval(), sorted(unknown)  # noqa: FBT003


def _sizes_of(there: Mapping[str, Tensor], path: Path) -> Sizes:
    """The sizes that the shapes of some tensors tell."""
    telling = {
        "pretrained.model.patch_embed.proj.weight": 4,
        "pretrained.model.pos_embed": 3,
        "scratch.head1.weight": 4,
        "clip_pretrained.token_embedding.weight": 2,
        "clip_pretrained.positional_embedding": 2,
        **{f"pretrained.act_postprocess{i + 1}.3.weight": 4 for i in range(LEVELS)},
    }
    _check_there(there, telling, path)
    for name, axes in telling.items():
        if there[name].ndim != axes or 0 in there[name].shape:
            raise FileFormatError(
                f"{path}: expected {name} of {axes} axes, got shape {tuple(there[name].shape)}."
            )
    shape = {name: tuple(int(n) for n in there[name].shape) for name in telling}
    patch = shape["pretrained.model.patch_embed.proj.weight"][2:]
    if patch != (PATCH, PATCH):
        raise FileFormatError(
            f"{path}: expected patches of {PATCH}x{PATCH} pixels, got {patch[1]}x{patch[0]}."
        )
    grid = math.isqrt(shape["pretrained.model.pos_embed"][1])
    blocks = _count(there, "pretrained.model.blocks")
    if not blocks or blocks % LEVELS:
        raise FileFormatError(
            f"{path}: expected a number of blocks of the image side that {LEVELS} divides, "
            f"got {blocks}."
        )
    first, second, third, fourth = (
        shape[f"pretrained.act_postprocess{i + 1}.3.weight"][0] for i in range(LEVELS)
    )
    return Sizes(
        grid=grid,
        width=shape["pretrained.model.patch_embed.proj.weight"][0],
        blocks=blocks,
        channels=(first, second, third, fourth),
        decoder=shape["scratch.head1.weight"][1],
        embedding=shape["scratch.head1.weight"][0],
        text_width=shape["clip_pretrained.token_embedding.weight"][1],
        text_blocks=_count(there, "clip_pretrained.transformer.resblocks"),
        context=shape["clip_pretrained.positional_embedding"][0],
        vocabulary=shape["clip_pretrained.token_embedding.weight"][0],
    )


def _count(there: Collection[str], prefix: str) -> int:
    """How many blocks there are tensors of."""
    found = (re.match(rf"{re.escape(prefix)}\.(\d+)\.", name) for name in there)
    return len({match[1] for match in found if match is not None})


def _check_there(there: Collection[str], wanted: Collection[str], path: Path) -> None:
    lacking = sorted(set(wanted) - set(there))
    if lacking:
        more = ", ..." if len(lacking) > _SOME else ""
        raise FileFormatError(
            f"{path}: expected the weights of LSeg, got none for {len(lacking)} of its "
            f"{len(wanted)} tensors ({', '.join(lacking[:_SOME])}{more})."
        )
