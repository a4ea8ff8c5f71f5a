"""Tiny trackers: SAM 2 and SAM 3 for videos, with a short memory, so that few frames fill it."""

from pathlib import Path
from typing import Any

import torch

PRESENCE = 1.0
"""Added to the logit of an object's being there: most are, and not all."""

_SIDE = 64
_WIDTH = 128  # above the width of the memories, 64, and a multiple of it
_PROMPTS: dict[str, Any] = {
    "hidden_size": _WIDTH, "image_size": _SIDE, "patch_size": 16, "mask_input_channels": 4,
}  # fmt: skip
_DECODER: dict[str, Any] = {
    "hidden_size": _WIDTH, "mlp_dim": 32, "num_attention_heads": 4, "iou_head_hidden_dim": 32,
    "num_hidden_layers": 2,
}  # fmt: skip
_MEMORY: dict[str, Any] = {
    "num_maskmem": 3, "max_object_pointers_in_encoder": 4,
    "memory_attention_hidden_size": _WIDTH, "memory_attention_num_layers": 1,
    "memory_attention_feed_forward_hidden_size": 32, "memory_attention_rope_feat_sizes": [4, 4],
    "memory_encoder_hidden_size": _WIDTH, "memory_encoder_output_channels": 64,
    "mask_downsampler_embed_dim": _WIDTH, "memory_fuser_embed_dim": _WIDTH,
    "memory_fuser_intermediate_dim": 64, "memory_fuser_num_layers": 1,
    "initializer_range": 0.1,
}  # fmt: skip


def sam2_video() -> Any:
    """SAM 2 of 64 pixels as a tracker."""
    from transformers import (
        Sam2HieraDetConfig,
        Sam2VideoConfig,
        Sam2VideoModel,
        Sam2VisionConfig,
    )

    backbone = Sam2HieraDetConfig(
        hidden_size=16, num_attention_heads=1, image_size=[_SIDE, _SIDE],
        blocks_per_stage=[1, 1, 2, 1], embed_dim_per_stage=[16, 32, 64, 128],
        num_attention_heads_per_stage=[1, 2, 4, 8], window_size_per_stage=[4, 4, 4, 4],
        window_positional_embedding_background_size=[4, 4], global_attention_blocks=[3],
        initializer_range=0.3,
    )  # fmt: skip
    vision = Sam2VisionConfig(
        backbone_config=backbone.to_dict(), backbone_channel_list=[128, 64, 32, 16],
        backbone_feature_sizes=[[16, 16], [8, 8], [4, 4]], fpn_hidden_size=_WIDTH,
        initializer_range=0.3,
    )  # fmt: skip
    config = Sam2VideoConfig(
        vision_config=vision.to_dict(),
        prompt_encoder_config=_PROMPTS,
        mask_decoder_config=_DECODER,
        image_size=_SIDE,
        **_MEMORY,
    )
    return _spread(Sam2VideoModel(config))


def sam3_tracker_video() -> Any:
    """SAM 3's tracker of 64 pixels."""
    from transformers import Sam3TrackerVideoModel

    return _spread(Sam3TrackerVideoModel(_sam3_config()))


class _AsPublished:
    """SAM 3 whole, with its weights under the names that the hub's have.

    The library writes those of the tracker under a prefix twice, and reads them so again; the
    published ones have it once.
    """

    def __init__(self, model: Any) -> None:
        self._model = model

    def save_pretrained(self, folder: Path) -> None:
        from safetensors.torch import load_file, save_file

        self._model.save_pretrained(folder)
        path = folder / "model.safetensors"
        twice = "tracker_model.tracker_model."
        tensors = {key.replace(twice, twice[14:]): t.clone() for key, t in load_file(path).items()}
        save_file(tensors, path, metadata={"format": "pt"})


def sam3_video() -> Any:
    """SAM 3 of 64 pixels: a detector, and the tracker that shares its backbone."""
    from transformers import Sam3Config, Sam3VideoConfig, Sam3VideoModel

    tracker = _sam3_config()
    part = {"hidden_size": _WIDTH, "num_attention_heads": 4}
    layer = {**part, "num_layers": 1, "intermediate_size": 32}
    detector = Sam3Config(
        vision_config=tracker.vision_config.to_dict(),
        text_config={
            "hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 1,
            "num_attention_heads": 2, "projection_dim": 32, "vocab_size": 64,
        },
        geometry_encoder_config=layer,
        detr_encoder_config=layer,
        detr_decoder_config={**layer, "num_queries": 5},
        mask_decoder_config=part,
    )  # fmt: skip
    config = Sam3VideoConfig(
        detector_config=detector.to_dict(), tracker_config=tracker.to_dict(), low_res_mask_size=16
    )
    return _AsPublished(_spread(Sam3VideoModel(config)))


def _sam3_config() -> Any:
    from transformers import Sam3TrackerVideoConfig, Sam3VisionConfig, Sam3ViTConfig

    backbone = Sam3ViTConfig(
        hidden_size=32, intermediate_size=64, num_hidden_layers=2, num_attention_heads=2,
        image_size=_SIDE, pretrain_image_size=_SIDE, patch_size=16, window_size=2,
        global_attn_indexes=[1], initializer_range=0.3,
    )  # fmt: skip
    vision = Sam3VisionConfig(
        backbone_config=backbone.to_dict(), fpn_hidden_size=_WIDTH, initializer_range=0.3
    )
    return Sam3TrackerVideoConfig(
        vision_config=vision.to_dict(),
        prompt_encoder_config=_PROMPTS,
        mask_decoder_config=_DECODER,
        image_size=_SIDE,  # otherwise the parts are reset to 1008
        **_MEMORY,
    )


def _spread(model: Any) -> Any:
    """Parameters that start at zero take part: embeddings of absence, of time, of no memory."""
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if not bool(parameter.any()) and "bias" not in name:
                parameter.normal_(std=0.1)
            if name.endswith("pred_obj_score_head.proj_out.bias"):
                parameter.fill_(PRESENCE)
    return model


MAKERS = {
    "sam2_video": sam2_video,
    "sam3_tracker_video": sam3_tracker_video,
    "sam3_whole": sam3_video,
}
