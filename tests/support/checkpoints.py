"""Tiny checkpoints of the real classes of transformers, with weights that make answers vary."""

from pathlib import Path
from typing import Any

import torch

from support import (
    checkpoints_hed,
    checkpoints_labels,
    checkpoints_lseg,
    checkpoints_text,
    checkpoints_track,
)

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


def dino_wide() -> Any:
    """DINO of 2021 whose blocks are wider than what `cosseg` reduces them to."""
    from transformers import ViTConfig, ViTModel

    wide = {**_VIT, "hidden_size": 96}
    return ViTModel(ViTConfig(**wide, intermediate_size=64, image_size=64, patch_size=16))


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


_PROMPTS = {"hidden_size": 32, "image_size": 64, "patch_size": 8, "mask_input_channels": 4}
_DECODER: dict[str, Any] = {
    "hidden_size": 32, "mlp_dim": 32, "num_attention_heads": 4, "iou_head_hidden_dim": 32,
    "num_hidden_layers": 2,
}  # fmt: skip
_SAM_VISION: dict[str, Any] = {
    "hidden_size": 32, "output_channels": 32, "num_hidden_layers": 2, "num_attention_heads": 2,
    "image_size": 64, "patch_size": 8, "window_size": 4, "global_attn_indexes": [1], "mlp_dim": 64,
    "initializer_range": 0.3,  # by default 1e-10: all embeddings are nearly 0
}  # fmt: skip


def sam() -> Any:
    """SAM of 64 pixels."""
    from transformers import SamConfig, SamModel

    return SamModel(
        SamConfig(
            vision_config={**_SAM_VISION, "output_channels": 256},
            prompt_encoder_config={**_PROMPTS, "hidden_size": 256},
            mask_decoder_config={**_DECODER, "hidden_size": 256},
            initializer_range=0.3,
        )
    )


def sam_hq() -> Any:
    """SAM-HQ of 64 pixels."""
    from transformers import SamHQConfig, SamHQModel

    return SamHQModel(
        SamHQConfig(
            vision_config={**_SAM_VISION, "output_channels": 256},
            prompt_encoder_config={**_PROMPTS, "hidden_size": 256},
            mask_decoder_config={**_DECODER, "hidden_size": 256, "vit_dim": 32},
            initializer_range=0.3,
        )
    )


def sam2() -> Any:
    """SAM 2 of 64 pixels."""
    from transformers import Sam2Config, Sam2HieraDetConfig, Sam2Model, Sam2VisionConfig

    backbone = Sam2HieraDetConfig(
        hidden_size=16, num_attention_heads=1, image_size=[64, 64],
        blocks_per_stage=[1, 1, 2, 1], embed_dim_per_stage=[16, 32, 64, 128],
        num_attention_heads_per_stage=[1, 2, 4, 8], window_size_per_stage=[4, 4, 4, 4],
        window_positional_embedding_background_size=[4, 4], global_attention_blocks=[3],
        initializer_range=0.3,
    )  # fmt: skip
    vision = Sam2VisionConfig(
        backbone_config=backbone.to_dict(), backbone_channel_list=[128, 64, 32, 16],
        backbone_feature_sizes=[[16, 16], [8, 8], [4, 4]], fpn_hidden_size=32,
        initializer_range=0.3,
    )  # fmt: skip
    return Sam2Model(
        Sam2Config(
            vision_config=vision.to_dict(),
            prompt_encoder_config={**_PROMPTS, "patch_size": 16},
            mask_decoder_config=_DECODER,
            initializer_range=0.3,
        )
    )


_MAKERS = {
    "sam": sam,
    "sam_hq": sam_hq,
    "sam2": sam2,
    "dino": dino,
    "dino_wide": dino_wide,
    "dinov2": dinov2,
    "dinov2_with_registers": dinov2_with_registers,
    "dinov3": dinov3,
    **checkpoints_labels.MAKERS,
    **checkpoints_text.MAKERS,
    **checkpoints_track.MAKERS,
    **checkpoints_lseg.MAKERS,
    **checkpoints_hed.MAKERS,
}
