"""A tiny LSeg in the layout of the published checkpoint, written without our own loading code."""

import json
import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

WIDTH, DECODER, EMBEDDING, TEXT = 128, 32, 24, 64
CHANNELS = (16, 24, 32, 40)
BLOCKS, TEXT_BLOCKS, CONTEXT, GRID = 4, 2, 12, 3
LETTERS = "abcdefghijklmnopqrstuvwxyz"
PIECES = ["ch", "cha", "chai", "chair</w>"]
VOCABULARY = [
    *LETTERS, *(f"{letter}</w>" for letter in LETTERS), *PIECES,
    "<|startoftext|>", "<|endoftext|>",
]  # fmt: skip


def shapes(
    *,
    width: int = WIDTH,
    blocks: int = BLOCKS,
    grid: int = GRID,
    channels: tuple[int, int, int, int] = CHANNELS,
    decoder: int = DECODER,
    embedding: int = EMBEDDING,
    text: int = TEXT,
    text_blocks: int = TEXT_BLOCKS,
    context: int = CONTEXT,
    vocabulary: int = len(VOCABULARY),
) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the published layout: timm's ViT, DPT's own parts, CLIP's text side."""
    w, d, t = width, decoder, text
    found: dict[str, tuple[int, ...]] = {
        "pretrained.model.cls_token": (1, 1, w),
        "pretrained.model.pos_embed": (1, 1 + grid * grid, w),
        "pretrained.model.patch_embed.proj.weight": (w, 3, 16, 16),
        "pretrained.model.patch_embed.proj.bias": (w,),
    }
    for i in range(blocks):
        at = f"pretrained.model.blocks.{i}"
        found |= {
            f"{at}.norm1.weight": (w,), f"{at}.norm1.bias": (w,),
            f"{at}.attn.qkv.weight": (3 * w, w), f"{at}.attn.qkv.bias": (3 * w,),
            f"{at}.attn.proj.weight": (w, w), f"{at}.attn.proj.bias": (w,),
            f"{at}.norm2.weight": (w,), f"{at}.norm2.bias": (w,),
            f"{at}.mlp.fc1.weight": (4 * w, w), f"{at}.mlp.fc1.bias": (4 * w,),
            f"{at}.mlp.fc2.weight": (w, 4 * w), f"{at}.mlp.fc2.bias": (w,),
        }  # fmt: skip
    resampled = {1: (channels[0],) * 2 + (4, 4), 2: (channels[1],) * 2 + (2, 2),
                 4: (channels[3],) * 2 + (3, 3)}  # fmt: skip
    for level, c in enumerate(channels, 1):
        at = f"pretrained.act_postprocess{level}"
        found |= {
            f"{at}.0.project.0.weight": (w, 2 * w), f"{at}.0.project.0.bias": (w,),
            f"{at}.3.weight": (c, w, 1, 1), f"{at}.3.bias": (c,),
            f"scratch.layer{level}_rn.weight": (d, c, 3, 3),
            f"scratch.refinenet{level}.out_conv.weight": (d, d, 1, 1),
            f"scratch.refinenet{level}.out_conv.bias": (d,),
        }  # fmt: skip
        if level in resampled:
            found |= {f"{at}.4.weight": resampled[level], f"{at}.4.bias": (c,)}
        for unit in (1, 2) if level < 4 else (2,):
            for n in (1, 2):
                unit_at = f"scratch.refinenet{level}.resConfUnit{unit}"
                found |= {
                    f"{unit_at}.conv{n}.weight": (d, d, 3, 3),
                    f"{unit_at}.bn{n}.weight": (d,), f"{unit_at}.bn{n}.bias": (d,),
                    f"{unit_at}.bn{n}.running_mean": (d,), f"{unit_at}.bn{n}.running_var": (d,),
                }  # fmt: skip
    found |= {
        "scratch.head1.weight": (embedding, d, 1, 1), "scratch.head1.bias": (embedding,),
        "clip_pretrained.token_embedding.weight": (vocabulary, t),
        "clip_pretrained.positional_embedding": (context, t),
        "clip_pretrained.ln_final.weight": (t,), "clip_pretrained.ln_final.bias": (t,),
        "clip_pretrained.text_projection": (t, embedding),
    }  # fmt: skip
    for i in range(text_blocks):
        at = f"clip_pretrained.transformer.resblocks.{i}"
        found |= {
            f"{at}.ln_1.weight": (t,), f"{at}.ln_1.bias": (t,),
            f"{at}.attn.in_proj_weight": (3 * t, t), f"{at}.attn.in_proj_bias": (3 * t,),
            f"{at}.attn.out_proj.weight": (t, t), f"{at}.attn.out_proj.bias": (t,),
            f"{at}.ln_2.weight": (t,), f"{at}.ln_2.bias": (t,),
            f"{at}.mlp.c_fc.weight": (4 * t, t), f"{at}.mlp.c_fc.bias": (4 * t,),
            f"{at}.mlp.c_proj.weight": (t, 4 * t), f"{at}.mlp.c_proj.bias": (t,),
        }  # fmt: skip
    return found


def published(*, context: int = CONTEXT) -> dict[str, Tensor]:
    """Random weights by published name, such that answers vary; CLIP's halves as half floats."""
    found: dict[str, Tensor] = {}
    for name, shape in shapes(context=context).items():
        if name.endswith("running_var"):
            value = torch.rand(shape) + 0.5
        elif len(shape) == 1:
            value = torch.randn(shape) * 0.1 + float(name.endswith("weight"))
        elif "pos" in name or "token" in name:
            value = torch.randn(shape) * 0.5
        else:
            value = torch.randn(shape) / math.sqrt(math.prod(shape[1:]))
        found[name] = value.half() if name.startswith("clip_pretrained.") else value
    return found


def extras() -> dict[str, Tensor]:
    """What else the published checkpoint holds, and dense features do not need."""
    unit = "scratch.refinenet4.resConfUnit1"
    return {
        "pretrained.model.norm.weight": torch.ones(WIDTH),
        "pretrained.model.head.weight": torch.zeros(10, WIDTH),
        f"{unit}.conv1.weight": torch.zeros(DECODER, DECODER, 3, 3),
        f"{unit}.bn1.num_batches_tracked": torch.tensor(9),
        "scratch.refinenet1.resConfUnit1.bn1.num_batches_tracked": torch.tensor(9),
        "clip_pretrained.visual.conv1.weight": torch.zeros(4, 3, 32, 32),
        "clip_pretrained.logit_scale": torch.tensor(4.6),
    }


class LSegFiles:
    """What is written for a tiny LSeg: the checkpoint, and CLIP's vocabulary beside it.

    Args:
        context: Tokens of a text, at most.
    """

    def __init__(self, context: int = CONTEXT) -> None:
        self._context = context

    def save_pretrained(self, folder: Path) -> None:
        """Write them."""
        folder.mkdir(parents=True)
        state = {
            f"net.{name}": value
            for name, value in (published(context=self._context) | extras()).items()
        }
        content: dict[str, Any] = {"epoch": 200, "state_dict": state, "hyper_parameters": {"a": 1}}
        torch.save(content, folder / "demo_e200.ckpt")
        numbers = {token: i for i, token in enumerate(VOCABULARY)}
        (folder / "vocab.json").write_text(json.dumps(numbers))
        merges = "#version: 0.2\nc h\nch a\ncha i\nchai r</w>\n"
        (folder / "merges.txt").write_text(merges)


MAKERS = {"lseg": LSegFiles}
