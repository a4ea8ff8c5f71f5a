"""Checkpoints of networks of points: ours, and another program's."""

from pathlib import Path

import torch

from splatseg.methods.cosseg.checkpoint import load_point_encoder
from splatseg.methods.cosseg.network import RandlaEncoder
from splatseg.methods.cosseg.pyramid import PointInputs, RandlaConfig
from splatseg_bench.point_network import save_point_encoder
from support.fuzz.targets.base import Target, target

CONFIG = RandlaConfig(inputs=3, first_width=2, widths=(2,), neighbours=2, ratios=(2,), classes=2)
INPUTS = PointInputs(grid_size=0.1)


@target("point-encoder")
def ours(folder: Path) -> Target:
    file = folder / "a.safetensors"
    save_point_encoder(RandlaEncoder(CONFIG), file, inputs=INPUTS, facts={"a": 1})
    return Target(file=file, read=lambda: load_point_encoder(file))


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
