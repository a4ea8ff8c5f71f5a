"""Files as Open3D-ML writes them, and what its network answers, by loops.

Tensors have the names, shapes and meanings of that program.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from .reference import Layer, encoder_levels

FIRST, WIDTHS = 8, (6, 8, 4, 10)
"""Channels after the first layer, and d of each block."""


LAYERS = {
    "entry": "mlp1", "encode1": "lse1.mlp", "pool1": "pool1.mlp", "encode2": "lse2.mlp",
    "pool2": "pool2.mlp", "exit": "mlp2", "shortcut": "shortcut",
}  # fmt: skip
SCORES = {"pool1": "pool1.score_fn.0", "pool2": "pool2.score_fn.0"}
DECODER = ("mlp.conv.weight", "decoder.0.conv.weight", "fc1.0.conv.bias")
SUM_SLOPE = 0.01


def sides_of(name: str, width: int, inputs: int) -> tuple[int, int]:
    """Outputs and inputs of a layer of a block."""
    half = width // 2
    return {
        "entry": (half, inputs), "encode1": (half, 10), "pool1": (half, width),
        "encode2": (half, half), "pool2": (width, width),
        "exit": (2 * width, width), "shortcut": (2 * width, inputs),
    }[name]  # fmt: skip


def state_dict(inputs: int, seed: int = 0) -> dict[str, Tensor]:
    """Random tensors of a whole network, in its names."""
    generator = torch.Generator().manual_seed(seed)
    found: dict[str, Tensor] = {}

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    def linear(name: str, outputs: int, channels: int, *, sides: int) -> None:
        weight = draw(outputs, channels) / channels**0.5
        found[f"{name}.weight"] = weight.reshape(outputs, channels, *(1,) * sides)
        found[f"{name}.bias"] = draw(outputs)

    def norm(name: str, channels: int) -> None:
        found[f"{name}.weight"] = 1 + draw(channels) / 3
        found[f"{name}.bias"] = draw(channels) / 3
        found[f"{name}.running_mean"] = draw(channels) / 3
        found[f"{name}.running_var"] = torch.rand(channels, generator=generator) + 0.5
        found[f"{name}.num_batches_tracked"] = torch.tensor(7)

    linear("fc0", FIRST, inputs, sides=0)
    norm("bn0", FIRST)
    before = FIRST
    for level, width in enumerate(WIDTHS):
        for ours, theirs in LAYERS.items():
            shape = sides_of(ours, width, before)
            linear(f"encoder.{level}.{theirs}.conv", *shape, sides=2)
            norm(f"encoder.{level}.{theirs}.batch_norm", shape[0])
        for theirs in SCORES.values():
            linear(f"encoder.{level}.{theirs}", width, width, sides=0)
        before = 2 * width
    return found | {name: draw(3, 2, 1, 1) for name in DECODER}


def answer(state: dict[str, Tensor], pyramid, inputs: Tensor) -> list[np.ndarray]:
    """What the program's encoder finds, one point and neighbour at a time."""

    def array(name: str) -> np.ndarray:
        return state[name].double().numpy()

    def matrix(name: str) -> np.ndarray:
        values = array(name)
        return values.reshape(values.shape[:2])

    def layer(linear: str, norm: str) -> Layer:
        statistics = [
            array(f"{norm}.{key}") for key in ("weight", "bias", "running_mean", "running_var")
        ]
        return Layer(matrix(f"{linear}.weight"), array(f"{linear}.bias"), tuple(statistics))

    def layers(level: int) -> Callable[[str], Layer]:
        def named(ours: str) -> Layer:
            theirs = f"encoder.{level}.{LAYERS[ours]}"
            return layer(f"{theirs}.conv", f"{theirs}.batch_norm")

        return named

    def scores(level: int) -> Callable[[str], np.ndarray]:
        return lambda ours: matrix(f"encoder.{level}.{SCORES[ours]}.weight")

    start = layer("fc0", "bn0")
    return encoder_levels(pyramid, inputs.double().numpy(), start, layers, scores, SUM_SLOPE)
