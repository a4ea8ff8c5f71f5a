"""Encoders out of the tensors of Open3D-ML's RandLA-Net (isl-org/Open3D-ML, ml3d/torch).

Names are those of its source since January 2022; no file of it was at hand.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from splatseg.errors import FileFormatError
from splatseg.io.foreign import derived_from
from splatseg.io.tensor_table import COUNTER, TensorTable, with_state
from splatseg.methods.cosseg.network import RandlaEncoder, SharedMlp
from splatseg.methods.cosseg.pyramid import MAX_LEVELS, PointInputs, RandlaConfig

COLOUR_INPUTS = PointInputs(grid_size=0.04, origin="floor", colour_range=255.0)
"""How a network with colours is fed, as it is trained for S3DIS."""

PLAIN_INPUTS = PointInputs(grid_size=0.06)
"""How one without is fed, as it is trained for SemanticKITTI."""

_SIGNATURE = ("fc0.weight", "encoder.0.lse1.mlp.conv.weight")
"""Tensors that only its files have both of."""

_REST = ("mlp.", "decoder.", "fc1.")
"""What tensors of the decoder and the head begin with."""

_NAMES = {
    "entry": "mlp1", "encode1": "lse1.mlp", "pool1.mlp": "pool1.mlp", "encode2": "lse2.mlp",
    "pool2.mlp": "pool2.mlp", "exit": "mlp2", "shortcut": "shortcut",
    "pool1.score": "pool1.score_fn.0", "pool2.score": "pool2.score_fn.0",
}  # fmt: skip
"""Layers of a block, by what `ResidualBlock` calls them."""

_RATIOS = {5: (4, 4, 4, 4, 2)}
"""Ratios of networks of so many levels in the public configurations; otherwise they are 4."""

_SUM_SLOPE = 0.01
"""Its last LeakyReLU is torch's default, the others have the authors' slope."""


def open3d_encoder(tensors: Mapping[str, Tensor], path: Path) -> RandlaEncoder:
    """The encoder of a file. Tensors of decoder and head are not looked at.

    Neighbours and ratios, which such a file does not hold, are those of the public
    configurations: 16, and 4, 4, 4, 4, 2 of five levels or 4 at every level of others.

    Raises:
        FileFormatError: If it is another's, or a tensor is missing, has another shape or is none
            of such a network.
    """
    if not all(name in tensors for name in _SIGNATURE):
        raise FileFormatError(
            f"{path}: expected a RandLA-Net of splatseg, or tensors of Open3D-ML's "
            f"({', '.join(_SIGNATURE)}), got other ones."
        )
    table = TensorTable(tensors, path)
    with torch.device("meta"):
        encoder = RandlaEncoder(_config(table, path))
    state: dict[str, Tensor] = {}
    for name, module in encoder.named_modules():
        if isinstance(module, SharedMlp):
            found = _layer(table, name, module)
            state |= {f"{name}.{key}": value for key, value in found.items()}
        elif isinstance(module, nn.Linear) and name.endswith(".score"):
            theirs, width = _name(name), module.in_features
            if f"{theirs}.bias" in table:  # the same for all neighbours, it has no effect
                table.take(f"{theirs}.bias", (width,))
            state[f"{name}.weight"] = table.take(f"{theirs}.weight", (width, width))
    table.check_none_left(_REST)
    return with_state(encoder, state)


def _config(table: TensorTable, path: Path) -> RandlaConfig:
    widths: list[int] = []
    for level in range(MAX_LEVELS + 1):
        if not any(name.startswith(f"encoder.{level}.") for name in table.names()):
            break
        half, _ = table.matrix_shape(f"encoder.{level}.mlp1.conv.weight")
        widths.append(2 * half)
    first, inputs = table.matrix_shape("fc0.weight")
    with derived_from(path):
        return RandlaConfig(
            inputs=cast("Any", inputs),
            first_width=first,
            widths=tuple(widths),
            ratios=_RATIOS.get(len(widths), (4,) * len(widths)),
            sum_slope=_SUM_SLOPE,
        )


def _name(ours: str) -> str:
    """What one of our layers of a block is called."""
    _, level, layer = ours.split(".", 2)
    return f"encoder.{level}.{_NAMES[layer]}"


def _layer(table: TensorTable, name: str, module: SharedMlp) -> dict[str, Tensor]:
    """The tensors of one of our layers."""
    linear, norm = "fc0", "bn0"
    if name != "start":
        linear, norm = f"{_name(name)}.conv", f"{_name(name)}.batch_norm"
    outputs, inputs = module.linear.weight.shape
    table.leave(f"{norm}.{COUNTER}")
    return {
        "linear.weight": table.take(f"{linear}.weight", (outputs, inputs)),
        "linear.bias": table.take(f"{linear}.bias", (outputs,)),
        "norm.weight": table.take(f"{norm}.weight", (outputs,)),
        "norm.bias": table.take(f"{norm}.bias", (outputs,)),
        "norm.running_mean": table.take(f"{norm}.running_mean", (outputs,)),
        "norm.running_var": table.take_variances(f"{norm}.running_var", outputs),
        f"norm.{COUNTER}": torch.zeros((), dtype=torch.int64),
    }
