"""Tiny checkpoints of the real classes of transformers, with weights that make answers vary."""

from pathlib import Path
from typing import Any

import torch

SEED = 7
_VIT: dict[str, Any] = {
    "hidden_size": 32,
    "num_hidden_layers": 4,
    "num_attention_heads": 2,
    "initializer_range": 0.3,
}


def saved(kind: str, folder: Path) -> Path:
    """The checkpoint of a kind below a folder, written when it is not there."""
    path = folder / kind
    if not path.is_dir():
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(SEED)
            model = _MAKERS[kind]()
        model.save_pretrained(path)
    return path


def dino() -> Any:
    """DINO of 2021."""
    from transformers import ViTConfig, ViTModel

    return ViTModel(ViTConfig(**_VIT, intermediate_size=64, image_size=64, patch_size=16))


def dinov2() -> Any:
    """DINOv2."""
    from transformers import Dinov2Config, Dinov2Model

    return Dinov2Model(Dinov2Config(**_VIT, image_size=56, patch_size=14, mlp_ratio=2))


def dinov2_with_registers() -> Any:
    """DINOv2 with four registers."""
    from transformers import Dinov2WithRegistersConfig, Dinov2WithRegistersModel

    return Dinov2WithRegistersModel(
        Dinov2WithRegistersConfig(
            **_VIT, image_size=56, patch_size=14, mlp_ratio=2, num_register_tokens=4
        )
    )


def dinov3() -> Any:
    """DINOv3 with four registers."""
    from transformers import DINOv3ViTConfig, DINOv3ViTModel

    return DINOv3ViTModel(
        DINOv3ViTConfig(
            **_VIT, intermediate_size=64, image_size=64, patch_size=16, num_register_tokens=4
        )
    )


_MAKERS = {
    "dino": dino,
    "dinov2": dinov2,
    "dinov2_with_registers": dinov2_with_registers,
    "dinov3": dinov3,
}
