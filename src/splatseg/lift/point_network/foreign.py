"""An encoder out of tensors that another implementation of RandLA-Net named."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from splatseg.errors import FileFormatError
from splatseg.io.foreign import made_from
from splatseg.lift.point_network.config import MAX_LEVELS, RandlaConfig
from splatseg.lift.point_network.encoder import RandlaEncoder
from splatseg.lift.point_network.layers import SharedMlp
from splatseg.lift.point_network.layouts import LAYOUTS, Layout
from splatseg.lift.point_network.tensor_table import COUNTER, TensorTable, with_state

_RATIOS = {5: (4, 4, 4, 4, 2)}
"""Ratios of networks of so many levels in the public configurations; otherwise they are 4."""


def layout_of(tensors: Mapping[str, Tensor], path: Path) -> Layout:
    """Whose tensors these are, by their names.

    Raises:
        FileFormatError: If nobody's that is known.
    """
    found = [one for one in LAYOUTS if all(name in tensors for name in one.signature)]
    if len(found) == 1:
        return found[0]
    known = "; ".join(f"{one.name}: {', '.join(one.signature)}" for one in LAYOUTS)
    raise FileFormatError(
        f"{path}: expected a RandLA-Net of splatseg, or tensors of a known layout ({known}), "
        "got other ones."
    )


def foreign_encoder(tensors: Mapping[str, Tensor], path: Path, layout: Layout) -> RandlaEncoder:
    """The encoder of a file in a layout. Tensors of decoder and head are not looked at.

    Neighbours and ratios, which such a file does not hold, are those of the public
    configurations: 16, and 4, 4, 4, 4, 2 of five levels or 4 at every level of others.

    Raises:
        FileFormatError: If a tensor is missing, has another shape or is none of the layout's.
    """
    table = TensorTable(tensors, path)
    config = _config(table, layout, path)
    with torch.device("meta"):
        encoder = RandlaEncoder(config)
    state: dict[str, Tensor] = {}
    for name, module in encoder.named_modules():
        if isinstance(module, SharedMlp):
            found = _layer(table, layout, name, module)
            state |= {f"{name}.{key}": value for key, value in found.items()}
        elif isinstance(module, nn.Linear) and name.endswith(".score"):
            state[f"{name}.weight"] = _score(table, layout, name, module)
    table.check_none_left(layout.rest)
    return with_state(encoder, state)


def _config(table: TensorTable, layout: Layout, path: Path) -> RandlaConfig:
    entry = layout.layers["entry"]
    widths: list[int] = []
    for level in range(MAX_LEVELS + 1):
        block = layout.block.format(level)
        if not any(name.startswith(block) for name in table.names()):
            break
        half, _ = table.matrix_shape(f"{block}{entry}{layout.linear}.weight")
        widths.append(2 * half)
    first, inputs = table.matrix_shape(f"{layout.start}.weight")
    with made_from(path):
        return RandlaConfig(
            inputs=inputs,
            first_width=first,
            widths=tuple(widths),
            ratios=_RATIOS.get(len(widths), (4,) * len(widths)),
            variant=layout.variant,
        )


def _layer(table: TensorTable, layout: Layout, name: str, module: SharedMlp) -> dict[str, Tensor]:
    """The tensors of one of our layers."""
    linear, norm = _names(table, layout, name)
    outputs, inputs = module.linear.weight.shape
    weight = table.take(f"{linear}.weight", (outputs, inputs))
    bias = torch.zeros(outputs)
    if f"{linear}.bias" in table or not layout.bias_optional:
        bias = table.take(f"{linear}.bias", (outputs,))
    if norm is None:
        scale, shift, mean = torch.ones(outputs), torch.zeros(outputs), torch.zeros(outputs)
        variance = torch.full((outputs,), 1 - module.norm.eps)
    else:
        scale, shift, mean = (
            table.take(f"{norm}.{key}", (outputs,)) for key in ("weight", "bias", "running_mean")
        )
        variance = table.take_variances(f"{norm}.running_var", outputs)
        table.leave(f"{norm}.{COUNTER}")
    return {
        "linear.weight": _reordered(weight, layout, name.split(".", 2)[-1]),
        "linear.bias": bias,
        "norm.weight": scale,
        "norm.bias": shift,
        "norm.running_mean": mean,
        "norm.running_var": variance,
        f"norm.{COUNTER}": torch.zeros((), dtype=torch.int64),
    }


def _names(table: TensorTable, layout: Layout, name: str) -> tuple[str, str | None]:
    """What the linear map and the batch norm of one of our layers are called."""
    if name == "start":
        known = (one for one in layout.start_norms if f"{one}.weight" in table)
        return layout.start, next(known, layout.start_norms[0])
    _, level, ours = name.split(".", 2)
    layer = layout.block.format(level) + layout.layers[ours]
    for end in layout.copies:
        table.leave(f"{layer}{end}")
    return f"{layer}{layout.linear}", None if ours in layout.plain else f"{layer}{layout.norm}"


def _reordered(weight: Tensor, layout: Layout, ours: str) -> Tensor:
    """A layer with its columns in our order."""
    of_ten = ours == "encode1" or layout.variant.second_encoding == "direct"
    if ours in ("encode1", "encode2") and of_ten:
        return weight[:, list(layout.encoding_order)]
    if ours in ("pool1.mlp", "pool2.mlp") and not layout.features_first:
        return _halves_swapped(weight, 1)
    return weight


def _score(table: TensorTable, layout: Layout, name: str, module: nn.Linear) -> Tensor:
    """A linear map of attention. Its bias, the same for all neighbours, has no effect."""
    _, level, ours = name.split(".", 2)
    theirs = layout.block.format(level) + layout.scores[ours]
    width = module.in_features
    if f"{theirs}.bias" in table:
        table.take(f"{theirs}.bias", (width,))
    weight = table.take(f"{theirs}.weight", (width, width))
    if layout.features_first:
        return weight
    return _halves_swapped(_halves_swapped(weight, 0), 1)


def _halves_swapped(weight: Tensor, axis: int) -> Tensor:
    return weight.roll(weight.shape[axis] // 2, axis)
