"""Tiny checkpoints of the networks that understand words, with their tokenizers."""

import json
import string
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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


MAKERS = {
    "clip": clip,
    "siglip": siglip,
    "siglip2": siglip2,
}
