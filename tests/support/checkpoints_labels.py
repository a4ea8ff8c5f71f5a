"""Tiny checkpoints of networks for classes, segments and depth."""

import json
from pathlib import Path
from typing import Any

import torch

CLASSES = {0: "wall", 1: "floor, ground", 2: "chair", 3: "table ", 4: "lamp", 5: "lamp, desk"}
"""Classes of the segmenters, more than one of a name that starts alike."""


def _swin() -> Any:
    from transformers import SwinConfig

    return SwinConfig(
        image_size=64, embed_dim=16, depths=[1, 1, 1, 1], num_heads=[1, 2, 4, 8], window_size=4,
        out_features=["stage1", "stage2", "stage3", "stage4"], initializer_range=0.3,
    )  # fmt: skip


def _varied(model: Any, *, classes: float) -> Any:
    """The same with queries that differ, and class probabilities of which some are near 1."""
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            last = name.rsplit(".", 2)[-2]
            if last in ("queries_embedder", "queries_features", "query_embed", "query"):
                parameter.normal_()
            elif last in ("class_predictor", "class_embed"):
                parameter.normal_(std=classes)
            elif "decoder" in name and "pixel" not in name and parameter.ndim > 1:
                parameter.normal_(std=0.4)
            elif "mask_embedder" in name and parameter.ndim > 1:
                parameter.normal_(std=0.6)
    return model


_SMALL: dict[str, Any] = {
    "encoder_feedforward_dim": 32, "dim_feedforward": 32, "encoder_layers": 1,
    "decoder_layers": 2, "num_attention_heads": 2, "num_queries": 12, "hidden_dim": 32,
    "id2label": CLASSES,
}  # fmt: skip


def mask2former() -> Any:
    """Mask2Former on a Swin of 64 pixels."""
    from transformers import Mask2FormerConfig, Mask2FormerForUniversalSegmentation

    config = Mask2FormerConfig(
        backbone_config=_swin(), feature_size=32, mask_feature_size=32, init_std=0.5, **_SMALL
    )
    return _varied(Mask2FormerForUniversalSegmentation(config), classes=2.0)


def maskformer() -> Any:
    """MaskFormer on the same."""
    from transformers import DetrConfig, MaskFormerConfig, MaskFormerForInstanceSegmentation

    decoder = DetrConfig(
        d_model=32, encoder_layers=1, decoder_layers=1, encoder_attention_heads=2,
        decoder_attention_heads=2, encoder_ffn_dim=32, decoder_ffn_dim=32, num_queries=12,
    )  # fmt: skip
    config = MaskFormerConfig(
        backbone_config=_swin(), fpn_feature_size=32, mask_feature_size=32,
        decoder_config=decoder, init_std=0.3, id2label=CLASSES,
    )  # fmt: skip
    return _varied(MaskFormerForInstanceSegmentation(config), classes=2.0)


def oneformer() -> Any:
    """OneFormer on the same; its tokenizer is `save_tokenizer`'s."""
    from transformers import OneFormerConfig, OneFormerForUniversalSegmentation

    config = OneFormerConfig(
        backbone_config=_swin(), conv_dim=32, mask_dim=32, query_dec_layers=1, init_std=0.5,
        text_encoder_width=32, text_encoder_num_layers=1, text_encoder_vocab_size=32, **_SMALL,
    )  # fmt: skip
    return _varied(OneFormerForUniversalSegmentation(config), classes=2.0)


_EOMT: dict[str, Any] = {
    "hidden_size": 32, "num_hidden_layers": 3, "num_attention_heads": 2, "image_size": 64,
    "patch_size": 16, "num_blocks": 1, "num_queries": 12, "initializer_range": 0.3,
    "id2label": CLASSES,
}  # fmt: skip


def eomt() -> Any:
    """EoMT of 64 pixels."""
    from transformers import EomtConfig, EomtForUniversalSegmentation

    return _varied(EomtForUniversalSegmentation(EomtConfig(**_EOMT)), classes=2.0)


def eomt_dinov3() -> Any:
    """EoMT on DINOv3."""
    from transformers import EomtDinov3Config, EomtDinov3ForUniversalSegmentation

    config = EomtDinov3Config(**_EOMT, intermediate_size=64)
    return _varied(EomtDinov3ForUniversalSegmentation(config), classes=2.0)


def segformer() -> Any:
    """SegFormer."""
    from transformers import SegformerConfig, SegformerForSemanticSegmentation

    return SegformerForSemanticSegmentation(
        SegformerConfig(
            hidden_sizes=[8, 16, 32, 32], depths=[1, 1, 1, 1], decoder_hidden_size=16,
            num_attention_heads=[1, 2, 2, 2], initializer_range=0.3, id2label=CLASSES,
        )
    )  # fmt: skip


_DPT: dict[str, Any] = {
    "hidden_size": 32, "num_hidden_layers": 4, "num_attention_heads": 2, "intermediate_size": 64,
    "image_size": 64, "patch_size": 16, "backbone_out_indices": [0, 1, 2, 3],
    "neck_hidden_sizes": [8, 16, 16, 32], "fusion_hidden_size": 16, "initializer_range": 0.3,
}  # fmt: skip


def dpt_semantic() -> Any:
    """DPT with a semantic head."""
    from transformers import DPTConfig, DPTForSemanticSegmentation

    model = DPTForSemanticSegmentation(DPTConfig(**_DPT, id2label=CLASSES))
    with torch.no_grad():  # logits of a few units: of 1e5 not even the first digit of p is exact
        model.head.head[-2].weight.mul_(1e-5)
    return model


def dpt() -> Any:
    """DPT with a head for depth."""
    from transformers import DPTConfig, DPTForDepthEstimation

    model = DPTForDepthEstimation(DPTConfig(**_DPT))
    last = model.head.head[-2]
    with torch.no_grad():  # few values are 0, and all are within float16
        last.weight.mul_(1e-4)
        last.bias.fill_(15.0)
    return model


def _depth_anything(kind: str) -> Any:
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

    backbone = Dinov2Config(
        hidden_size=32, num_hidden_layers=4, num_attention_heads=2, image_size=56, patch_size=14,
        mlp_ratio=2, initializer_range=0.3, out_indices=[1, 2, 3, 4], reshape_hidden_states=False,
    )  # fmt: skip
    model = DepthAnythingForDepthEstimation(
        DepthAnythingConfig(
            backbone_config=backbone, reassemble_hidden_size=32, fusion_hidden_size=16,
            neck_hidden_sizes=[8, 16, 16, 32], head_hidden_size=8, initializer_range=0.3,
            depth_estimation_type=kind, max_depth=10,
        )
    )  # fmt: skip
    with torch.no_grad():  # few values of the relative head are 0, those of the other not all 10
        model.head.conv3.weight.mul_(1e-6 if kind == "metric" else 1e-5)
        model.head.conv3.bias.fill_(0.0 if kind == "metric" else 15.0)
    return model


def depth_anything() -> Any:
    """Depth Anything, relative."""
    return _depth_anything("relative")


def depth_anything_metric() -> Any:
    """Depth Anything, metres."""
    return _depth_anything("metric")


def save_tokenizer(folder: Path) -> None:
    """A tokenizer that knows the words of OneFormer's tasks, as the library saves one."""
    words = ("<pad>", "<unk>", "the", "task", "is", "panoptic", "semantic")
    added = [
        {"id": i, "content": words[i], "single_word": False, "lstrip": False, "rstrip": False,
         "normalized": False, "special": True}
        for i in range(2)
    ]  # fmt: skip
    content = {
        "version": "1.0", "truncation": None, "padding": None, "added_tokens": added,
        "normalizer": None, "pre_tokenizer": {"type": "Whitespace"}, "post_processor": None,
        "decoder": None,
        "model": {"type": "WordLevel", "vocab": {word: i for i, word in enumerate(words)},
                  "unk_token": "<unk>"},
    }  # fmt: skip
    (folder / "tokenizer.json").write_text(json.dumps(content))
    names = {"tokenizer_class": "PreTrainedTokenizerFast", "pad_token": "<pad>"}
    (folder / "tokenizer_config.json").write_text(json.dumps(names | {"unk_token": "<unk>"}))


MAKERS = {
    "mask2former": mask2former,
    "maskformer": maskformer,
    "oneformer": oneformer,
    "eomt": eomt,
    "eomt_dinov3": eomt_dinov3,
    "segformer": segformer,
    "dpt_semantic": dpt_semantic,
    "dpt": dpt,
    "depth_anything": depth_anything,
    "depth_anything_metric": depth_anything_metric,
}
