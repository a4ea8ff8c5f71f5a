"""Evidence as other programs leave it, byte by byte and without splatseg's writers.

The folders and tables are those of the shared data (labels, panoptic segments, tracks, masks in
COCO's run lengths, quantised features). What is drawn comes from one seed; errors are those that
the kinds are known for: ids that mean nothing in the next view, tracks that break, masks of any
level, some of them missing.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from splatseg.synthetic import SyntheticScene

STUFF = (1, 2, 3)  # objects that are one wall, floor, ceiling
SMALLEST = 30  # pixels of a mask that is drawn
BLOCKS = ("block3", "block6", "block9", "block12")
WIDTH_OF_WORDS = 32


@dataclass(frozen=True)
class Seen:
    """Truth of one view, (h, w) each, 0 for none."""

    semantic: np.ndarray
    instance: np.ndarray
    part: np.ndarray


def write_all(
    folder: Path, scene: SyntheticScene, seen: Mapping[str, Seen], *, text_stride: int = 8
) -> None:
    """Evidence of every kind for these views into a capture's folder."""
    write_panoptic(folder / "labels_panoptic", scene, seen)
    write_tracked(folder / "labels_tracked", scene, seen)
    write_overlapping_masks(folder / "masks_sam", seen)
    write_nested_masks(folder / "masks_nested", scene, seen)
    write_dino(folder / "features_dino", seen)
    write_text(folder, scene, seen, stride=text_stride)


def save_ids(path: Path, ids: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(ids.astype(np.uint16)).save(path)


def class_names(scene: SyntheticScene) -> dict[int, str]:
    return {row.id: row.name for row in scene.classes.rows}


def write_panoptic(folder: Path, scene: SyntheticScene, seen: Mapping[str, Seen]) -> None:
    """Segments whose ids mean something in their own view only."""
    rng = np.random.default_rng(1)
    table = {}
    for name, view in seen.items():
        ids = np.zeros(view.instance.shape, np.int64)
        present = [i for i in np.unique(view.instance) if i]
        rows = []
        for own, i in zip(rng.permutation(len(present)) + 1, present, strict=True):
            where = view.instance == i
            if where.sum() < SMALLEST:
                continue
            ids[where] = own
            rows.append(
                {
                    "id": int(own),
                    "category_id": int(scene.class_of(int(i))),
                    "isthing": int(i) not in STUFF,
                    "area": int(where.sum()),
                    "score": round(float(rng.uniform(0.6, 1)), 3),
                }
            )
        table[name] = {"segments_info": rows}
        save_ids(folder / f"{name}.png", ids)
    (folder / "segments.json").write_text(json.dumps(table))


def write_tracked(folder: Path, scene: SyntheticScene, seen: Mapping[str, Seen]) -> None:
    """Objects under one id through all views, except every fifth: another id from half on."""
    names, votes = class_names(scene), {}
    for index, (name, view) in enumerate(seen.items()):
        broken = (view.instance % 5 == 4) & (2 * index >= len(seen))
        ids = np.where(broken, view.instance + 100, view.instance)
        for i in np.unique(ids[ids > 0]):
            classes, counts = np.unique(view.semantic[ids == i], return_counts=True)
            own = votes.setdefault(int(i), {})
            for c, n in zip(classes.tolist(), counts.tolist(), strict=True):
                own[names[c]] = own.get(names[c], 0) + n
        save_ids(folder / f"{name}.png", ids)
    tracks = {str(i): {"category_votes": votes[i]} for i in sorted(votes)}
    (folder / "tracks.json").write_text(json.dumps({"order": list(seen), "tracks": tracks}))


def run_lengths(mask: np.ndarray) -> dict[str, Any]:
    """COCO's compressed run lengths: column by column, five bits and a flag a character."""
    flat = np.concatenate(([0], mask.T.ravel().astype(np.int8), [1 - int(mask.T.ravel()[-1])]))
    edges = np.flatnonzero(np.diff(flat))
    counts = np.diff(np.concatenate(([0], edges))).tolist()
    text = ""
    for i, count in enumerate(counts):
        value = count - counts[i - 2] if i > 2 else count
        more = True
        while more:
            bits = value & 31
            value >>= 5
            more = value != (-1 if bits & 16 else 0)
            text += chr(bits + 32 * more + 48)
    return {"size": list(mask.shape), "counts": text}


def write_masks(path: Path, masks: list[np.ndarray], rng: np.random.Generator) -> None:
    """As SAM's automatic mode writes them: in no order, without classes."""
    rows = []
    for k in rng.permutation(len(masks)):
        y, x = np.nonzero(masks[k])
        rows.append(
            {
                "segmentation": run_lengths(masks[k]),
                "area": len(x),
                "bbox": [
                    float(x.min()),
                    float(y.min()),
                    float(np.ptp(x) + 1),
                    float(np.ptp(y) + 1),
                ],
                "predicted_iou": round(float(rng.uniform(0.7, 1)), 4),
                "stability_score": round(float(rng.uniform(0.7, 1)), 4),
            }
        )
    height, width = masks[0].shape
    path.parent.mkdir(parents=True, exist_ok=True)
    image = f"images/{path.stem}.jpg"
    content = {"image": image, "height": height, "width": width, "masks": rows}
    path.write_text(json.dumps(content))


def _large(masks: list[np.ndarray]) -> list[np.ndarray]:
    return [mask for mask in masks if mask.sum() >= SMALLEST]


def write_overlapping_masks(folder: Path, seen: Mapping[str, Seen]) -> None:
    """The object, its parts, or both, as drawn for each object and view; one in ten is missing."""
    rng = np.random.default_rng(2)
    for name, view in seen.items():
        masks = []
        for i in np.unique(view.instance[view.instance > 0]):
            level = rng.choice(["object", "parts", "both", "none"], p=[0.5, 0.15, 0.25, 0.1])
            if level in ("object", "both"):
                masks.append(view.instance == i)
            if level in ("parts", "both"):
                masks += [view.part == 2 * i - 1, view.part == 2 * i]
        write_masks(folder / f"{name}.json", _large(masks), rng)


def write_nested_masks(folder: Path, scene: SyntheticScene, seen: Mapping[str, Seen]) -> None:
    """Parts, objects, and objects with what stands on them, all of them in every view."""
    rng = np.random.default_rng(3)
    for name, view in seen.items():
        masks = []
        for item in scene.objects:
            masks += [
                view.instance == item.id,
                view.part == 2 * item.id - 1,
                view.part == 2 * item.id,
            ]
            carried = [other.id for other in scene.objects if other.parent == item.id]
            if carried and item.id not in STUFF:
                masks.append(np.isin(view.instance, [item.id, *carried]))
        write_masks(folder / f"{name}.json", _large(masks), rng)


def _cells(ids: np.ndarray, stride: int) -> np.ndarray:
    """The id in the middle of each cell of `stride` pixels."""
    rows, columns = -(-ids.shape[0] // stride), -(-ids.shape[1] // stride)
    y = np.minimum(np.arange(rows) * stride + stride // 2, ids.shape[0] - 1)
    x = np.minimum(np.arange(columns) * stride + stride // 2, ids.shape[1] - 1)
    return ids[np.ix_(y, x)]


def quantised(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """int8 codes, scale and offset a channel (last axis): value = code * scale + offset."""
    low = values.min(axis=tuple(range(values.ndim - 1)))
    high = values.max(axis=tuple(range(values.ndim - 1)))
    scale = np.maximum((high - low) / 254, 1e-6).astype(np.float32)
    offset = ((low + high) / 2).astype(np.float32)
    codes = np.clip(np.round((values - offset) / scale), -127, 127).astype(np.int8)
    return codes, scale, offset


def write_dino(folder: Path, seen: Mapping[str, Seen]) -> None:
    """Four blocks of vectors a cell of 16 pixels: of the object, of its class, and noise."""
    rng = np.random.default_rng(4)
    of_class, of_object = rng.normal(size=(2, 4, 200, 12))
    blocks = {}
    for name, view in seen.items():
        classes, objects = _cells(view.semantic, 16), _cells(view.instance, 16)
        clean = of_class[:, classes] + 0.5 * of_object[:, objects]
        blocks[name] = clean + rng.normal(scale=0.2, size=clean.shape)
    folder.mkdir()
    together = np.stack(list(blocks.values()))  # views, blocks, rows, columns, channels
    parts = [quantised(together[:, k]) for k in range(len(BLOCKS))]
    scale, offset = np.stack([p[1] for p in parts]), np.stack([p[2] for p in parts])
    np.savez(folder / "quant.npz", scale=scale, offset=offset, stride=16, blocks=np.array(BLOCKS))
    for i, name in enumerate(blocks):
        np.savez_compressed(folder / f"{name}.npz", f=np.stack([p[0][i] for p in parts]))


def write_text(
    folder: Path, scene: SyntheticScene, seen: Mapping[str, Seen], *, stride: int = 8
) -> None:
    """Vectors of words, and pixels' vectors near them as coefficients of a common basis."""
    rng = np.random.default_rng(5)
    names = class_names(scene)
    words = rng.normal(size=(max(names) + 1, WIDTH_OF_WORDS))
    words /= np.linalg.norm(words, axis=1, keepdims=True)
    # Cells of class 0 (nothing) get the vector of row 0, which is no word.
    dense = {}
    for name, view in seen.items():
        clean = words[_cells(view.semantic, stride)]
        noisy = clean + rng.normal(scale=0.05, size=clean.shape)
        dense[name] = noisy / np.linalg.norm(noisy, axis=-1, keepdims=True)
    stacked = np.concatenate([values.reshape(-1, WIDTH_OF_WORDS) for values in dense.values()])
    mean = stacked.mean(axis=0)
    basis = np.linalg.svd(stacked - mean, full_matrices=False)[2][:16].astype(np.float32)
    together = np.stack([(values - mean) @ basis.T for values in dense.values()])
    codes, scale, offset = quantised(together)
    (folder / "features_text").mkdir()
    np.savez(
        folder / "features_text" / "basis.npz",
        mean=mean.astype(np.float32), basis=basis, scale=scale, offset=offset, stride=stride,
    )  # fmt: skip
    for i, name in enumerate(dense):
        np.savez_compressed(folder / "features_text" / f"{name}.npz", f=codes[i])
    rows = [(names[i], words[i], "class", i) for i in sorted(names)]
    # A phrase for an instance says no more than its class.
    things = json.loads((folder / "metadata.json").read_text())["instances"]
    rows += [
        (thing["name"], words[thing["class_id"]], "instance", thing["id"])
        for thing in things
        if thing["name"] not in names.values()
    ]
    for negative in ("object", "things", "stuff", "texture"):
        rows += [(negative, rng.normal(size=WIDTH_OF_WORDS) / 6, "negative", -1)]
    labels, vectors, kinds, targets = zip(*rows, strict=True)
    unit = np.array(vectors) / np.linalg.norm(vectors, axis=1, keepdims=True)
    np.savez(
        folder / "text_embeddings.npz",
        labels=np.array(labels), vectors=unit.astype(np.float16), kind=np.array(kinds),
        target_id=np.array(targets),
    )  # fmt: skip
