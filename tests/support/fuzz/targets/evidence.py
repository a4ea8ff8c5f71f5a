"""What 2D models saw."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from splatseg.core import DeepFeatures, FeatureMap, Rle
from splatseg.io.evidence import load_text_embeddings, open_evidence, save_features
from support.fuzz.targets.base import (
    HEIGHT,
    WIDTH,
    Target,
    label_png,
    target,
)


def _evidence(folder: Path, file: Path, ask: str = "label_map") -> Target:
    def read() -> None:
        evidence = open_evidence(folder)
        _ = evidence.classes, evidence.source_ids, evidence.view_names
        for view in evidence.view_names:
            getattr(evidence, ask)(view)

    return Target(file=file, read=read)


@target("labels-8.png")
def labels_8(folder: Path) -> Target:
    """A label map of 8 bits."""
    return _evidence(folder, label_png(folder, 8))


@target("labels-16.png")
def labels_16(folder: Path) -> Target:
    """A label map of 16 bits."""
    return _evidence(folder, label_png(folder, 16), "masks")


@target("labels.npy")
def labels_npy(folder: Path) -> Target:
    """A label map as an array."""
    np.save(folder / "a.npy", np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) % 5)
    return _evidence(folder, folder / "a.npy")


@target("soft-labels.npz")
def soft_labels(folder: Path) -> Target:
    """Scores of classes."""
    scores = np.random.default_rng(0).normal(size=(3, HEIGHT, WIDTH)).astype(np.float16)
    np.savez(folder / "a.npz", logits=scores)
    return _evidence(folder, folder / "a.npz")


@target("soft-labels.npy")
def soft_labels_npy(folder: Path) -> Target:
    """The same as a bare array."""
    np.save(folder / "a.npy", np.full((HEIGHT, WIDTH, 2), 0.5, np.float32))
    return _evidence(folder, folder / "a.npy")


_COLOURS = {"classes": [{"id": i, "name": f"n{i}", "colour": [i, 0, 0]} for i in range(3)]}


def _coloured(name: str, damaged: str) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        table = folder / "table.json"
        table.write_text(json.dumps(_COLOURS))
        (folder / "maps").mkdir()
        pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        pixels[..., 0] = np.arange(WIDTH) % 3
        Image.fromarray(pixels).save(folder / "maps" / "a.png")

        def read() -> None:
            open_evidence(folder / "maps", classes=str(table)).label_map("a")

        return Target(file=folder / damaged, read=read)


_coloured("labels-colours.png", "maps/a.png")
_coloured("label-table.json", "table.json")


@target("evidence.json")
def evidence_json(folder: Path) -> Target:
    """The header of evidence that splatseg wrote."""
    label_png(folder, 8)
    rows = [{"id": i, "name": f"n{i}", "isthing": False} for i in range(1, 5)]
    header = {"format": "splatseg-evidence", "version": 1, "kind": "labels", "classes": rows}
    header |= {"source_ids": {"1": 0, "2": 1, "3": 2, "4": 7}, "metadata": {"complete": True}}
    (folder / "evidence.json").write_text(json.dumps(header))
    return _evidence(folder, folder / "evidence.json")


@target("segments.json")
def segments(folder: Path) -> Target:
    """The table of panoptic evidence."""
    label_png(folder, 8)
    rows = [{"id": i, "category_id": 1, "isthing": True, "score": 0.5} for i in range(1, 5)]
    (folder / "segments.json").write_text(json.dumps({"a": {"segments_info": rows}}))
    return _evidence(folder, folder / "segments.json")


@target("tracks.json")
def tracks(folder: Path) -> Target:
    """The table of tracked evidence."""
    label_png(folder, 8)
    rows = {str(i): {"category_votes": {"cup": i, "2": 1}} for i in range(1, 5)}
    (folder / "tracks.json").write_text(json.dumps({"order": ["a"], "tracks": rows}))
    return _evidence(folder, folder / "tracks.json")


@target("masks.json")
def masks_json(folder: Path) -> Target:
    """COCO run lengths, compressed and not."""
    mask = torch.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) % 7 < 2
    rle = Rle.encode(mask)
    size = [HEIGHT, WIDTH]
    rows: list[dict[str, Any]] = [
        {"segmentation": {"size": size, "counts": rle.to_coco()}, "score": 0.5, "level": 1},
        {"segmentation": {"size": size, "counts": rle.counts.tolist()}, "predicted_iou": 1},
    ]
    for row in rows:
        row["objectness"] = 0.5
    content = {"height": HEIGHT, "width": WIDTH, "masks": rows}
    (folder / "a.json").write_text(json.dumps(content))
    return _evidence(folder, folder / "a.json", "masks")


@target("masks.npz")
def masks_npz(folder: Path) -> Target:
    """Masks as an array."""
    np.savez(folder / "a.npz", masks=np.ones((2, HEIGHT, WIDTH), bool), scores=np.ones(2))
    return _evidence(folder, folder / "a.npz", "masks")


@target("masks-metadata.csv")
def masks_csv(folder: Path) -> Target:
    """Pictures of masks with the table of SAM's tool."""
    (folder / "a").mkdir()
    for i in range(2):
        Image.new("L", (WIDTH, HEIGHT), 255 * i).save(folder / "a" / f"{i}.png")
    (folder / "a" / "metadata.csv").write_text("id,area,predicted_iou\n0,1,0.9\n1,2,0.8\n")
    return _evidence(folder, folder / "a" / "metadata.csv", "masks")


@target("features.npz")
def features(folder: Path) -> Target:
    """Features in our own layout."""
    size = np.array([HEIGHT, WIDTH])
    np.savez(folder / "a.npz", features=np.ones((3, 4, 2), "f2"), stride=np.int64(2), size=size)
    return _evidence(folder, folder / "a.npz", "features")


@target("features-blocks.npz")
def feature_blocks(folder: Path) -> Target:
    """Our own layout of features at several depths, with a class token."""
    one = FeatureMap(features=torch.ones(3, 4, 2), stride=2, height=HEIGHT, width=WIDTH)
    deep = DeepFeatures(maps=(one, one), depths=("block1", "block2"), class_token=torch.ones(2))
    save_features(deep, folder, "a")
    return _evidence(folder, folder / "a.npz", "deep_features")


@target("quant.npz")
def quantised(folder: Path) -> Target:
    """Scales of several blocks of a network."""
    tables = {"scale": np.ones((2, 3), "f4"), "offset": np.zeros((2, 3), "f4")}
    np.savez(folder / "quant.npz", **tables, stride=2, blocks=np.array(["a", "b"]))
    np.savez(folder / "a.npz", f=np.ones((2, 3, 4, 3), np.uint8))
    return _evidence(folder, folder / "quant.npz", "features")


@target("depth.npz")
def depth(folder: Path) -> Target:
    """A depth map in our own layout."""
    values = np.linspace(0, 5, WIDTH * HEIGHT, dtype=np.float16).reshape(HEIGHT, WIDTH)
    sure = np.full_like(values, 0.5)
    np.savez(folder / "a.npz", depth=values, kind=np.array("metric"), confidence=sure)
    return _evidence(folder, folder / "a.npz", "depth_map")


@target("text_embeddings.npz")
def text(folder: Path) -> Target:
    """Vectors of words."""
    file = folder / "text_embeddings.npz"
    columns = {"labels": np.array(["cup", "a"]), "kind": np.array(["class", "synonym"])}
    np.savez(file, **columns, vectors=np.eye(2, 4, dtype="f4"), target_id=np.array([1, 2]))
    return Target(file=file, read=lambda: load_text_embeddings(file))
