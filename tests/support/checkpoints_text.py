"""Tiny checkpoints of the networks that understand words, with their tokenizers."""

import json
import string
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

COLOURS = {"image_mean": [0.4, 0.5, 0.6], "image_std": [0.2, 0.25, 0.3]}
"""Of preprocessor_config.json: no network's own, so a test sees whether it is read."""

_TOWER: dict[str, Any] = {
    "hidden_size": 32,
    "intermediate_size": 64,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
}


@dataclass(frozen=True, kw_only=True)
class WithWords:
    """A network and its tokenizer, saved into one folder."""

    model: Any
    tokenizer: Any
    about_images: dict[str, Any]

    def save_pretrained(self, folder: Path) -> None:
        self.model.save_pretrained(folder)
        self.tokenizer.save_pretrained(folder)
        (folder / "preprocessor_config.json").write_text(json.dumps(COLOURS | self.about_images))


def letters() -> Any:
    """CLIP's tokenizer with single letters as tokens; the end is the highest number."""
    from transformers import CLIPTokenizer

    characters = [*string.ascii_lowercase, *string.digits, *".,-{}"]
    tokens = [*characters, *(f"{one}</w>" for one in characters)]
    tokens += ["<|startoftext|>", "<|endoftext|>"]
    return CLIPTokenizer(vocab={token: i for i, token in enumerate(tokens)}, merges=[])


def lowercase() -> Any:
    """SigLIP 2's tokenizer with single letters as tokens."""
    from transformers import Siglip2Tokenizer

    tokens = ["<pad>", "<eos>", "<bos>", "<unk>", "<mask>"]
    tokens += [f"<0x{byte:02X}>" for byte in range(256)]
    tokens += ["▁", *string.ascii_lowercase, *string.digits, *".,-"]
    return Siglip2Tokenizer(vocab={token: i for i, token in enumerate(tokens)}, merges=[])


def _clip_text(tokenizer: Any, **more: Any) -> dict[str, Any]:
    return {
        **_TOWER,
        "vocab_size": len(tokenizer),
        "max_position_embeddings": 40,
        "bos_token_id": tokenizer.bos_token_id,
        "eos_token_id": tokenizer.eos_token_id,
        "pad_token_id": tokenizer.pad_token_id,
        "projection_dim": 24,
        **more,
    }


def clip() -> WithWords:
    """CLIP of 4 x 4 patches of 16 pixels."""
    from transformers import CLIPConfig, CLIPModel

    tokenizer = letters()
    config = CLIPConfig(
        text_config=_clip_text(tokenizer),
        vision_config={**_TOWER, "image_size": 64, "patch_size": 16, "projection_dim": 24},
        projection_dim=24,
        initializer_factor=3.0,
    )
    return WithWords(model=CLIPModel(config), tokenizer=tokenizer, about_images={})


def _siglip_parts(tokenizer: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    text = {
        **_TOWER,
        "vocab_size": len(tokenizer),
        "max_position_embeddings": 40,
        "projection_size": 32,
        "pad_token_id": tokenizer.pad_token_id,
        "bos_token_id": tokenizer.bos_token_id,
        "eos_token_id": tokenizer.eos_token_id,
    }
    return text, {**_TOWER, "patch_size": 16}


def siglip() -> WithWords:
    """SigLIP of 4 x 4 patches of 16 pixels."""
    from transformers import SiglipConfig, SiglipModel

    tokenizer = lowercase()
    text, vision = _siglip_parts(tokenizer)
    model = SiglipModel(SiglipConfig(text_config=text, vision_config={**vision, "image_size": 64}))
    return WithWords(model=model, tokenizer=tokenizer, about_images={})


def siglip2() -> WithWords:
    """SigLIP 2 of 16 patches of 16 pixels, in any proportions."""
    from transformers import Siglip2Config, Siglip2Model

    tokenizer = lowercase()
    text, vision = _siglip_parts(tokenizer)
    model = Siglip2Model(
        Siglip2Config(text_config=text, vision_config={**vision, "num_patches": 16})
    )
    return WithWords(model=model, tokenizer=tokenizer, about_images={})


def clipseg() -> WithWords:
    """CLIPSeg of 4 x 4 patches of 16 pixels."""
    from transformers import CLIPSegConfig, CLIPSegForImageSegmentation

    tokenizer = letters()
    config = CLIPSegConfig(
        text_config=_clip_text(tokenizer),
        vision_config={
            **_TOWER, "num_hidden_layers": 4, "image_size": 64, "patch_size": 16,
            "projection_dim": 24,
        },
        projection_dim=24, extract_layers=[0, 1, 2], reduce_dim=16, decoder_num_attention_heads=2,
        decoder_intermediate_size=32, initializer_factor=3.0,
    )  # fmt: skip
    model = CLIPSegForImageSegmentation(config)
    with torch.no_grad():
        # Of new weights words make no difference, and every pixel is sure.
        model.decoder.film_mul.weight.mul_(60)
        model.decoder.transposed_convolution.weight.mul_(0.3)
    size = {"size": {"height": 64, "width": 64}}
    return WithWords(model=model, tokenizer=tokenizer, about_images=size)


def word_pieces() -> Any:
    """BERT's tokenizer with a few words and single letters; separators have their own numbers."""
    from transformers import BertTokenizer

    tokens = [f"[unused{i}]" for i in range(1030)]
    for i, token in {0: "[PAD]", 100: "[UNK]", 101: "[CLS]", 102: "[SEP]", 103: "[MASK]",
                     1012: ".", 1029: "?"}.items():  # fmt: skip
        tokens[i] = token
    for i, letter in enumerate(string.ascii_lowercase):
        tokens[200 + i], tokens[300 + i] = letter, f"##{letter}"
    for i, word in enumerate(("chair", "table", "red", "mug")):
        tokens[400 + i] = word
    return BertTokenizer(vocab={token: i for i, token in enumerate(tokens)})


def _detector(config_class: Any, model_class: Any) -> WithWords:
    tokenizer = word_pieces()
    config = config_class(
        backbone_config={
            "model_type": "swin", "image_size": 64, "patch_size": 4, "embed_dim": 16,
            "depths": [1, 1, 1, 1], "num_heads": [2, 2, 2, 2], "window_size": 4,
            "out_features": ["stage2", "stage3", "stage4"], "initializer_range": 0.3,
        },
        text_config={
            "model_type": "bert", **_TOWER, "vocab_size": len(tokenizer),
            "max_position_embeddings": 64, "initializer_range": 0.3,
        },
        d_model=32, encoder_layers=1, encoder_ffn_dim=32, encoder_attention_heads=2,
        decoder_layers=2, decoder_ffn_dim=32, decoder_attention_heads=2, num_queries=12,
        max_text_len=48, num_feature_levels=4, encoder_n_points=2, decoder_n_points=2,
        init_std=0.3,
    )  # fmt: skip
    size = {"size": {"shortest_edge": 64, "longest_edge": 96}}
    model = model_class(config)
    with torch.no_grad():
        for name, values in model.named_parameters():
            if name.endswith("bias") and "class_embed" in name:
                values.zero_()  # as it begins to learn, nothing fits any word
    return WithWords(model=model, tokenizer=tokenizer, about_images=size)


def grounding_dino() -> WithWords:
    """Grounding DINO with 12 queries."""
    from transformers import GroundingDinoConfig, GroundingDinoForObjectDetection

    return _detector(GroundingDinoConfig, GroundingDinoForObjectDetection)


def mm_grounding_dino() -> WithWords:
    """Grounding DINO of MMDetection with 12 queries."""
    from transformers import MMGroundingDinoConfig, MMGroundingDinoForObjectDetection

    return _detector(MMGroundingDinoConfig, MMGroundingDinoForObjectDetection)


_SAM3_VISION: dict[str, Any] = {
    "backbone_config": {
        "model_type": "sam3_vit_model", "hidden_size": 32, "intermediate_size": 64,
        "num_hidden_layers": 2, "num_attention_heads": 2, "image_size": 112, "patch_size": 14,
        "window_size": 4, "global_attn_indexes": [1], "pretrain_image_size": 56,
        "initializer_range": 0.3,
    },
    "fpn_hidden_size": 32, "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]],
    "initializer_range": 0.3,
}  # fmt: skip
_SAM3_PART: dict[str, Any] = {
    "hidden_size": 32, "intermediate_size": 32, "num_attention_heads": 2, "initializer_range": 0.3,
}  # fmt: skip


def _sam3_config(tokenizer: Any) -> Any:
    from transformers import Sam3Config

    return Sam3Config(
        vision_config=_SAM3_VISION,
        text_config={"model_type": "clip_text_model", **_clip_text(tokenizer)}
        | {"max_position_embeddings": 32, "initializer_factor": 3.0},
        geometry_encoder_config={**_SAM3_PART, "num_layers": 1},
        detr_encoder_config={**_SAM3_PART, "num_layers": 1},
        detr_decoder_config={**_SAM3_PART, "num_layers": 2, "num_queries": 10},
        mask_decoder_config={"hidden_size": 32, "num_attention_heads": 2, "initializer_range": 0.3},
        initializer_range=0.3,
    )


def sam3() -> WithWords:
    """SAM 3's detector of 112 pixels with 10 queries."""
    from transformers import Sam3Model

    tokenizer = letters()
    return WithWords(model=Sam3Model(_sam3_config(tokenizer)), tokenizer=tokenizer, about_images={})


_SAM3_TRACKER: dict[str, Any] = {
    "vision_config": _SAM3_VISION,
    "prompt_encoder_config": {
        "hidden_size": 32, "image_size": 112, "patch_size": 14, "mask_input_channels": 4,
    },
    "mask_decoder_config": {
        "hidden_size": 32, "mlp_dim": 32, "num_attention_heads": 4, "iou_head_hidden_dim": 32,
        "num_hidden_layers": 2,
    },
    "initializer_range": 0.3,
}  # fmt: skip


def sam3_tracker() -> Any:
    """SAM 3's tracker of 112 pixels."""
    from transformers import Sam3TrackerConfig, Sam3TrackerModel

    return Sam3TrackerModel(Sam3TrackerConfig(**_SAM3_TRACKER))


def sam3_video() -> WithWords:
    """SAM 3 as it is published: detector and tracker in one file."""
    from transformers import Sam3VideoConfig, Sam3VideoModel

    tokenizer = letters()
    memory = {
        "image_size": 112, "memory_attention_hidden_size": 32, "memory_attention_num_layers": 1,
        "memory_attention_num_attention_heads": 1, "memory_attention_feed_forward_hidden_size": 32,
        "memory_attention_rope_feat_sizes": [8, 8], "memory_encoder_hidden_size": 32,
        "memory_encoder_output_channels": 16, "mask_downsampler_embed_dim": 32,
        "memory_fuser_num_layers": 1, "memory_fuser_embed_dim": 32,
        "memory_fuser_intermediate_dim": 32,
    }  # fmt: skip
    config = Sam3VideoConfig(
        detector_config=_sam3_config(tokenizer).to_dict(),
        tracker_config={**_SAM3_TRACKER, **memory},
    )
    return WithWords(model=Sam3VideoModel(config), tokenizer=tokenizer, about_images={})


MAKERS = {
    "clip": clip,
    "siglip": siglip,
    "siglip2": siglip2,
    "clipseg": clipseg,
    "grounding_dino": grounding_dino,
    "mm_grounding_dino": mm_grounding_dino,
    "sam3": sam3,
    "sam3_tracker": sam3_tracker,
    "sam3_video": sam3_video,
}
