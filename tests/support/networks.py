"""Every family of networks with a tiny checkpoint, and one question to what is loaded from it."""

import json
import shutil
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

from splatseg.core import LabelMap
from splatseg.models import LoadOptions, find_family, find_model
from support.checkpoints import saved
from support.checkpoints_labels import save_tokenizer

KINDS = {
    "clip": ("clip", "clip"), "clipseg": ("clipseg", "clipseg"),
    "depth-anything": ("depth-anything", "depth_anything"), "dino": ("dino", "dino"),
    "dinov2": ("dinov2", "dinov2"), "dinov2-registers": ("dinov2", "dinov2_with_registers"),
    "dinov3": ("dinov3", "dinov3"), "dpt": ("dpt", "dpt"),
    "dpt-semantic": ("dpt-semantic", "dpt_semantic"), "eomt": ("eomt", "eomt"),
    "eomt-dinov3": ("eomt", "eomt_dinov3"), "grounding-dino": ("grounding-dino", "grounding_dino"),
    "mask2former": ("mask2former", "mask2former"), "maskformer": ("maskformer", "maskformer"),
    "mm-grounding-dino": ("grounding-dino", "mm_grounding_dino"),
    "oneformer": ("oneformer", "oneformer"), "sam": ("sam", "sam"), "sam-hq": ("sam-hq", "sam_hq"),
    "sam2": ("sam2", "sam2"), "sam2-video": ("sam2-video", "sam2_video"),
    "sam3": ("sam3", "sam3_tracker"),
    "sam3-text": ("sam3-text", "sam3"), "sam3-video": ("sam3-video", "sam3_tracker_video"),
    "segformer": ("segformer", "segformer"), "siglip": ("siglip2", "siglip"),
    "siglip2": ("siglip2", "siglip2"),
}  # fmt: skip
"""Family and tiny checkpoint by name."""

IMAGE = (torch.arange(64 * 96 * 3) % 251).reshape(64, 96, 3).to(torch.uint8)


def checkpoint(family: str, kind: str, folder: Path) -> Path:
    """A tiny checkpoint below a folder, whole."""
    path = saved(kind, folder)
    if family == "oneformer":
        save_tokenizer(path)
    return path


def copied(family: str, made: Path, folder: Path) -> Path:
    """A copy of a tiny checkpoint below a folder, whole, which a test may change."""
    path = Path(shutil.copytree(made, folder / made.name))
    if family == "oneformer":
        save_tokenizer(path)
    return path


def in_parts(folder: Path) -> list[Path]:
    """Give weights in one file as two with an index; the two files."""
    whole = folder / "model.safetensors"
    tensors = sorted(load_file(whole).items())
    index: dict[str, str] = {}
    parts = [folder / f"model-0000{i + 1}-of-00002.safetensors" for i in range(2)]
    for i, part in enumerate(parts):
        held = dict(tensors[i::2])
        save_file(held, part, metadata={"format": "pt"})
        index |= dict.fromkeys(held, part.name)
    content = {"metadata": {"total_size": whole.stat().st_size}, "weight_map": index}
    whole.unlink()
    (folder / f"{whole.name}.index.json").write_text(json.dumps(content))
    return parts


def asked(family: str, weights: Path) -> object:
    """What a model says of a picture, after it was loaded from weights."""
    known = find_family(family)
    words = {"words": ("chair",)} if hasattr(known.options, "words") else {}
    loading = LoadOptions(weights=str(weights), device="cpu")
    model = find_model(family, known.options(**words), loading=loading)
    if hasattr(model, "track"):
        seeds = {"a": LabelMap(ids=torch.ones(64, 96, dtype=torch.int32))}
        return list(model.track([("a", IMAGE), ("b", IMAGE)], seeds))
    if hasattr(model, "boxes"):
        return model.boxes(IMAGE, ["chair"])
    if hasattr(model, "encode_text"):
        return model.text_features(IMAGE), model.encode_text(["chair"])
    for question in ("features", "depth_map", "label_map", "panoptic", "masks"):
        if hasattr(model, question):
            return getattr(model, question)(IMAGE)
    raise ValueError(family)
