"""Checkpoints of networks of points: ours, and another program's."""

from collections.abc import Callable
from pathlib import Path

import torch

from splatseg.methods.cosseg.checkpoint import (
    load_point_encoder,
    load_point_network,
    save_point_encoder,
    save_point_network,
)
from splatseg.methods.cosseg.network import RandlaEncoder, RandlaNet
from splatseg.methods.cosseg.pyramid import PointInputs, RandlaConfig
from support.fuzz.targets.base import Target, target

CONFIG = RandlaConfig(inputs=3, first_width=2, widths=(2,), neighbours=2, ratios=(2,), classes=2)
INPUTS = PointInputs(grid_size=0.1)


def _ours(name: str, save: Callable[[Path], None], load: Callable[[Path], object]) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        file = folder / "a.safetensors"
        save(file)
        return Target(file=file, read=lambda: load(file))


_ours(
    "point-encoder",
    lambda file: save_point_encoder(RandlaEncoder(CONFIG), file, inputs=INPUTS, facts={"a": 1}),
    load_point_encoder,
)
_ours(
    "point-network",
    lambda file: save_point_network(RandlaNet(CONFIG), file, inputs=INPUTS, facts={}),
    load_point_network,
)


@target("point-encoder.pth")
def others(folder: Path) -> Target:
    """Tensors as Open3D-ML names them, in a file of PyTorch."""
    layers = {
        "mlp1": (1, 2), "lse1.mlp": (1, 10), "pool1.mlp": (1, 2), "lse2.mlp": (1, 1),
        "pool2.mlp": (2, 2), "mlp2": (4, 2), "shortcut": (4, 2),
    }  # fmt: skip
    state = {"fc0.weight": torch.ones(2, 3), "fc0.bias": torch.ones(2)}
    norms = {"bn0": 2}
    for name, (outputs, inputs) in layers.items():
        state[f"encoder.0.{name}.conv.weight"] = torch.ones(outputs, inputs, 1, 1)
        state[f"encoder.0.{name}.conv.bias"] = torch.ones(outputs)
        norms[f"encoder.0.{name}.batch_norm"] = outputs
    for name, channels in norms.items():
        for key in ("weight", "bias", "running_mean", "running_var"):
            state[f"{name}.{key}"] = torch.ones(channels)
    for pool in ("pool1", "pool2"):
        state[f"encoder.0.{pool}.score_fn.0.weight"] = torch.ones(2, 2)
        state[f"encoder.0.{pool}.score_fn.0.bias"] = torch.ones(2)
    file = folder / "a.pth"
    torch.save({"epoch": 1, "model_state_dict": state}, file)
    return Target(file=file, read=lambda: load_point_encoder(file))
