"""Files as other implementations write them, and what their networks answer, by loops.

Tensors have the names, shapes and meanings of those programs, and are evaluated in their order:
what is read of them is held to that.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from .reference import Dialect, Layer, encoder_levels, squared_ten

FIRST, WIDTHS = 8, (6, 8, 4, 10)
"""Channels after the first layer, and d of each block."""


@dataclass(frozen=True)
class Writer:
    """How a program names what it has."""

    start: str
    start_norm: str
    start_sides: int
    block: str
    layers: dict[str, str]
    scores: dict[str, str]
    linear: str
    norm: str
    dialect: Dialect
    biased: bool = True
    """Whether maps before a batch norm have a bias."""
    score_biased: bool = False
    score_sides: int = 0
    plain: tuple[str, ...] = ()
    copies: bool = False
    decoder: tuple[str, ...] = ()


OPEN3D = {
    "entry": "mlp1", "encode1": "lse1.mlp", "pool1": "pool1.mlp", "encode2": "lse2.mlp",
    "pool2": "pool2.mlp", "exit": "mlp2", "shortcut": "shortcut",
}  # fmt: skip
OPEN3D_2020 = {
    "entry": "mlp1", "encode1": "LFAmlp1", "pool1": "LFAatt_pooling_1mlp", "encode2": "LFAmlp2",
    "pool2": "LFAatt_pooling_2mlp", "exit": "mlp2", "shortcut": "shortcut",
}  # fmt: skip
WU = {
    "entry": "mlp1", "encode1": "lfa.mlp1", "pool1": "lfa.att_pooling_1.mlp",
    "encode2": "lfa.mlp2", "pool2": "lfa.att_pooling_2.mlp", "exit": "mlp2",
    "shortcut": "shortcut",
}  # fmt: skip

WRITERS = {
    "open3d": Writer(
        start="fc0", start_norm="bn0", start_sides=0, block="encoder.{}.", layers=OPEN3D,
        scores={"pool1": "pool1.score_fn.0", "pool2": "pool2.score_fn.0"},
        linear=".conv", norm=".batch_norm", dialect=Dialect(total=0.01), score_biased=True,
        decoder=("mlp.conv.weight", "decoder.0.conv.weight", "fc1.0.conv.bias"),
    ),
    "open3d-2020": Writer(
        start="fc0", start_norm="batch_normalization", start_sides=0,
        block="Encoder_layer_{}", layers=OPEN3D_2020,
        scores={"pool1": "LFAatt_pooling_1fc", "pool2": "LFAatt_pooling_2fc"},
        linear=".conv", norm=".batch_normalization", dialect=Dialect(), score_biased=True,
        copies=True,
        decoder=("decoder_0.conv.weight", "Decoder_layer_3.conv.bias", "fc.biases"),
    ),
    "ari0u": Writer(
        start="fc_start", start_norm="bn_start.0", start_sides=0, block="encoder.{}.",
        layers=OPEN3D, scores={"pool1": "pool1.score_fn.0", "pool2": "pool2.score_fn.0"},
        linear=".conv", norm=".batch_norm", plain=("entry", "exit"),
        dialect=Dialect(
            ten=squared_ten, features_first=False, chained=False, own=True, pooled=False,
            inner=0.0, total=0.01,
        ),
        decoder=("mlp.conv.weight", "decoder.3.batch_norm.weight", "fc_end.3.conv.weight"),
    ),
    "tsunghan-wu": Writer(
        start="fc0.conv", start_norm="fc0.bn.bn", start_sides=1,
        block="dilated_res_blocks.{}.", layers=WU,
        scores={"pool1": "lfa.att_pooling_1.fc", "pool2": "lfa.att_pooling_2.fc"},
        linear=".conv", norm=".bn.bn", dialect=Dialect(), biased=False, score_sides=2,
        decoder=("decoder_0.conv.weight", "decoder_blocks.1.bn.bn.weight", "fc3.conv.bias"),
    ),
}  # fmt: skip


def sides_of(name: str, width: int, inputs: int, chained: bool) -> tuple[int, int]:
    """Outputs and inputs of a layer of a block."""
    half = width // 2
    return {
        "entry": (half, inputs), "encode1": (half, 10), "pool1": (half, width),
        "encode2": (half, half if chained else 10), "pool2": (width, width),
        "exit": (2 * width, width), "shortcut": (2 * width, inputs),
    }[name]  # fmt: skip


def state_dict(writer: Writer, inputs: int, seed: int = 0) -> dict[str, Tensor]:
    """Random tensors of a whole network, in its names."""
    generator = torch.Generator().manual_seed(seed)
    found: dict[str, Tensor] = {}

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    def linear(name: str, outputs: int, channels: int, *, sides: int, biased: bool) -> None:
        weight = draw(outputs, channels) / channels**0.5
        found[f"{name}.weight"] = weight.reshape(outputs, channels, *(1,) * sides)
        if biased:
            found[f"{name}.bias"] = draw(outputs)

    def norm(name: str, channels: int) -> None:
        found[f"{name}.weight"] = 1 + draw(channels) / 3
        found[f"{name}.bias"] = draw(channels) / 3
        found[f"{name}.running_mean"] = draw(channels) / 3
        found[f"{name}.running_var"] = torch.rand(channels, generator=generator) + 0.5
        found[f"{name}.num_batches_tracked"] = torch.tensor(7)

    linear(writer.start, FIRST, inputs, sides=writer.start_sides, biased=writer.biased)
    norm(writer.start_norm, FIRST)
    before = FIRST
    for level, width in enumerate(WIDTHS):
        prefix = writer.block.format(level)
        for ours, theirs in writer.layers.items():
            layer = f"{prefix}{theirs}{writer.linear}"
            shape = sides_of(ours, width, before, writer.dialect.chained)
            linear(layer, *shape, sides=2, biased=writer.biased)
            if ours not in writer.plain:
                norm(f"{prefix}{theirs}{writer.norm}", shape[0])
            if writer.copies:
                found[f"{prefix}{theirs}.weights"] = found[f"{layer}.weight"]
                found[f"{prefix}{theirs}.biases"] = found[f"{layer}.bias"]
        for theirs in writer.scores.values():
            linear(
                f"{prefix}{theirs}", width, width,
                sides=writer.score_sides, biased=writer.score_biased,
            )  # fmt: skip
        before = 2 * width
    found |= {name: draw(3, 2, 1, 1) for name in writer.decoder}
    return found


def answer(writer: Writer, state: dict[str, Tensor], pyramid, inputs: Tensor) -> list[np.ndarray]:
    """What the program's encoder finds, one point and neighbour at a time."""

    def array(name: str) -> np.ndarray:
        return state[name].double().numpy()

    def matrix(name: str) -> np.ndarray:
        values = array(name)
        return values.reshape(values.shape[:2])

    def layer(linear: str, norm: str | None) -> Layer:
        weight = matrix(f"{linear}.weight")
        bias = array(f"{linear}.bias") if f"{linear}.bias" in state else np.zeros(len(weight))
        keys = ("weight", "bias", "running_mean", "running_var")
        statistics = None if norm is None else tuple(array(f"{norm}.{key}") for key in keys)
        return Layer(weight, bias, statistics)

    def layers(level: int) -> Callable[[str], Layer]:
        def named(ours: str) -> Layer:
            theirs = writer.block.format(level) + writer.layers[ours]
            norm = None if ours in writer.plain else f"{theirs}{writer.norm}"
            return layer(f"{theirs}{writer.linear}", norm)

        return named

    def scores(level: int) -> Callable[[str], np.ndarray]:
        prefix = writer.block.format(level)
        return lambda ours: matrix(f"{prefix}{writer.scores[ours]}.weight")

    start = layer(writer.start, writer.start_norm)
    return encoder_levels(pyramid, inputs.double().numpy(), start, layers, scores, writer.dialect)
