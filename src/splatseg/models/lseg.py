"""LSeg: dense image features in CLIP's space of words, by a network of our own writing.

Li et al. 2022, "Language-driven Semantic Segmentation" (arXiv:2201.03546): a dense prediction
transformer whose pixels were trained to lie where CLIP's text encoder puts the names of their
classes. No library has it; the published checkpoint is read as it is.
"""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal, cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from splatseg._check import check_shape
from splatseg.core import FeatureMap
from splatseg.core.boundary import boundary
from splatseg.core.models import DeepFeatures, Image
from splatseg.core.options import options
from splatseg.core.threads import network_inference
from splatseg.errors import FileFormatError, MissingFileError
from splatseg.io.tensors import read_tensors, read_torch_file
from splatseg.models._images import HALVES, PatchGrid, patch_grid, patch_input
from splatseg.models._lseg_network import LEVELS, PATCH, LSegNetwork, Sizes
from splatseg.models._weights import Loading, cached_file
from splatseg.models.networks._library import BatchedNetwork
from splatseg.models.networks._words import Tokens

_STEP = 2
"""Pixels of the input that a cell of the decoder's map stands for."""

_MULTIPLE = 2 * PATCH
"""Sides of the input are multiples of this, so that each level is half as large as the next."""

_TRAINED_SIZE = 480
"""Side of the crops that the published weights were trained on, pixels."""

_SHOWN = 3
_TOKENIZER = "tokenizer.json"
_TOKENIZER_PARTS = ("vocab.json", "merges.txt")
PUBLISHED = "openai/clip-vit-base-patch32"


def tokenizer_folder(asked: str | None, weights: Path) -> Path:
    """The folder of the vocabulary: the one asked for, or an id of the hub, else the weights'."""
    folder = weights if asked is None else Path(asked)
    if _is_tokenizer(folder):
        return folder
    if asked is None:
        raise MissingFileError(
            f"{weights}: expected CLIP's vocabulary beside the weights ({_TOKENIZER}, or "
            f"{' and '.join(_TOKENIZER_PARTS)}), got none; --tokenizer takes a folder, or the id "
            f"{PUBLISHED} where the hub's cache has it."
        )
    if not folder.exists() and asked.count("/") == 1:
        found = cached_file(asked, _TOKENIZER) or cached_file(asked, _TOKENIZER_PARTS[0])
        if found is not None and _is_tokenizer(found.parent):
            return found.parent
    raise MissingFileError(
        f"tokenizer: expected a folder with {_TOKENIZER}, or {' and '.join(_TOKENIZER_PARTS)}, or "
        f"an id whose files the hub's cache of this machine has, got {asked}."
    )


def _is_tokenizer(folder: Path) -> bool:
    return (folder / _TOKENIZER).is_file() or all(
        (folder / name).is_file() for name in _TOKENIZER_PARTS
    )


@options
class LSegOptions:
    """How fine the features are, and where words come from."""

    cell: Literal[2, 4, 8, 16, 32] = 4
    """Pixels of the network's input that a feature stands for, along both axes: 2 is the finest
    that the network gives, others are means. Files grow as its square shrinks."""

    tokenizer: str | None = None
    """Folder of CLIP's vocabulary (tokenizer.json, or vocab.json and merges.txt), or the id of a
    CLIP that the hub's cache has. None looks beside the weights. Only words need it."""


class LSeg(BatchedNetwork[Tensor]):
    """Cells of an image and words as unit vectors in one space."""

    _unrecorded: ClassVar = ("tokenizer",)  # one vocabulary fits; where it lies changes no answer

    def __init__(self, name: str, options: LSegOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        if place.file is None:
            raise FileFormatError(f"{place.folder}: expected a file of weights, got a folder.")
        network, unknown = network_of(read_checkpoint(place.file), place.file)
        if unknown:
            more = ", ..." if len(unknown) > _SHOWN else ""
            place.report(
                f"{place.file}: {len(unknown)} tensors are not of LSeg and not used "
                f"({', '.join(unknown[:_SHOWN])}{more})."
            )
        self._cell = options.cell
        self._network = network.to(place.device, place.dtype)
        self._input_size = place.size or _TRAINED_SIZE
        self._tokenizer: Tokens | None = None
        if options.tokenizer is not None:
            self._tokenizer = self._read_tokenizer()

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
        with network_inference():
            found = self._network.in_word_space(decoded.to(self._place.device)).cpu()
        return found.clone()  # outside, so that it is an ordinary tensor

    def encode_text(self, words: Sequence[str]) -> Float[Tensor, "n embedding"]:
        """Unit vectors of words or phrases, as they are: no sentence is put around them.

        Raises:
            MissingFileError: If CLIP's vocabulary is not on this machine.
            FileFormatError: If it is broken, or does not fit the weights.
            RangeError: If a text is too long.
        """
        if not words:
            return torch.zeros(0, self._network.head.out_channels)
        if self._tokenizer is None:
            self._tokenizer = self._read_tokenizer()
        tokens = self._tokenizer.of(words)
        last = tokens["attention_mask"].sum(dim=1) - 1
        with network_inference():
            found = F.normalize(self._network.text(tokens["input_ids"], last).float(), dim=-1).cpu()
        return found.clone()

    def _read_tokenizer(self) -> Tokens:
        text, place = self._network.text, self._place
        place = replace(place, folder=tokenizer_folder(self._options.tokenizer, place.folder))
        tokens = Tokens(
            place, None, longest=len(text.positions), kind="CLIPTokenizer", padding_side="right"
        )
        known = int(text.tokens.num_embeddings)
        if len(tokens) != known:
            raise FileFormatError(
                f"{place.folder}: expected a vocabulary of {known} tokens, as the weights have, "
                f"got {len(tokens)}."
            )
        return tokens

    @override
    @network_inference()
    def _encode(self, images: Sequence[Image]) -> list[Tensor]:
        """The decoder's map of each image, (rows, columns, channels)."""
        height, width = (int(side) for side in images[0].shape[:2])
        grid = self._grid(height, width)
        whole = _MULTIPLE // self._cell
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
        cells = F.avg_pool2d(decoded, self._cell // _STEP)
        cells = cells[:, :, : grid.rows, : grid.columns].permute(0, 2, 3, 1).cpu()
        return [one.clone() for one in cells]

    def _grid(self, height: int, width: int) -> PatchGrid:
        return patch_grid(height, width, patch=self._cell, size=self._input_size)

    def _map(self, image: Image, features: Tensor) -> FeatureMap:
        height, width = (int(side) for side in image.shape[:2])
        stride = self._grid(height, width).stride
        return FeatureMap(features=features, stride=stride, height=height, width=width)


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """Floating point tensors of a file by name.

    Of a file of PyTorch nothing is run, see `read_torch_file`.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it cannot be read so, or holds no tensors by name.
    """
    if path.suffix == ".safetensors":
        tensors: Mapping[str, Any] = read_tensors(path)
    else:
        tensors = _state(read_torch_file(path), path)
    found = {
        name: value
        for name, value in tensors.items()
        if isinstance(value, Tensor) and value.is_floating_point()
    }
    if not found:
        raise FileFormatError(f"{path}: expected tensors by name, got none.")
    return found


def _state(content: object, path: Path) -> Mapping[str, Any]:
    """Tensors by name of what a checkpoint holds: Lightning's ``state_dict``, or the whole."""
    for _ in range(2):
        if not isinstance(content, Mapping):
            break
        inner = cast(Mapping[object, object], content)
        if "state_dict" not in inner:
            return {str(name): value for name, value in inner.items()}
        content = inner["state_dict"]
    raise FileFormatError(
        f"{path}: expected tensors by name or a state_dict of them, got {type(content).__name__}."
    )


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
