"""Points of laser scans and novel views of a street, by every way to label them, in one table.

    python benchmarks/street.py SCENE ../shared/data/street [--rows drive ...] [--json FILE]
    python benchmarks/street.py SCENE ../shared/data/street --field SCENE/fields/street.safetensors

Evidence are the label maps of training views; truth are the labels of all points of all scans and
the maps of `test` and `test_novel` views, scored by the independent scorer. A point without a
label is wrong. Points are scored apart as well by whether a camera saw them: a training view (of
`--field` where one is given, those that it learned from) whose true depth map has the point no
more than 0.1 m and 3 % behind it.

Rows, each a field (`splatseg.core.Renderable`) and a layer of it:

- `published`: region voting as Street Gaussians is compared in the paper of the mesh field: the
  majority of centres in a ball, each of which has one vote, of votes of pixels (`uplift` without
  relabelling). `fair`: centres vote by how much all views saw them, W^T 1; what none sees has none.
- `majority`, `uplift`: labels of Gaussians without and with relabelling and completion; a point
  takes those around it by density. `nearest`: that of the nearest centre. `surface`: by density
  within three standard deviations, and undefined beyond.
- `vote`, `vote_depth`: views vote at centres, without and with occlusion. `object-classes`:
  objects of `masks_sam` vote. `sam`, `panoptic`: objects of `masks_sam` and `labels_panoptic`,
  associated, each with the class that most of its Gaussians have.
- `views`: points take what the views of the field show at them, and nothing else. `shapes`: and
  what is shaped like them, without smoothing; `drive`: with it, the default for drives.

- Of the mesh field of --field, which `splatseg street` makes: `mesh_adjusted`, `mesh_weighed` and
  `mesh_all`: points by its eq. 9 over the vertices of that rule (`--vertex-rule`; adjusted is the
  paper's), and its views; `mesh_completed`: as adjusted, but points that eq. 9 leaves undefined
  take the label of the nearest point that has one; `mesh_views`: points by what its views show at
  them and by their shapes.

`mIoU` is over all classes with points, `seen` and `unseen` over those points that a camera saw and
that none saw, `big` over classes with 1 000 points or more, with 95 %
intervals of a bootstrap over scans. The columns of classes are the paper's 13, nan where the truth
has none: bus counts as others. `test` and `novel` are mIoU of label maps, PSNR and SSIM those of
the test views.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from scored import _SCORE
from torch import Tensor

from splatseg.core import InstanceTree, Labels, PointLabels, Renderable, RenderableLayer, View
from splatseg.io.captures import read_capture
from splatseg.io.scans import read_scans
from splatseg.io.scene import load_scene
from splatseg.lift import GaussianField, PointLabelOptions
from splatseg.lift.viewed_points import ViewedPointOptions, ViewedPoints, points_in_view
from splatseg.methods import find_method
from splatseg.neighbours import NeighbourIndex
from splatseg.street.field import MeshField
from splatseg.street.files import load_mesh_field
from splatseg.tasks.scan_labels import viewed_points
from splatseg.tasks.segment import SegmentOptions, segment
from splatseg_bench.region_voting import region_labels

LAYER = "street"
BIG = 1000
TABLE = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign",
    "vegetation", "terrain", "car", "truck", "other",
)  # fmt: skip
OTHERS = "bus"
METHODS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "majority": ("uplift", {"correct_confusion": False}, {"complete": False}),
    "uplift": ("uplift", {}, {}),
    "vote": ("vote", {}, {}),
    "vote_depth": ("vote", {"occlusion": "depth"}, {}),
    "object-classes": ("object-classes", {"masks": "masks_sam"}, {}),
}


class Region:
    """A field whose points take the label of most centres around them."""

    def __init__(self, field: GaussianField, labels: Labels, bench: "Bench", *, fair: bool) -> None:
        self._field, self._labels, self._bench, self._fair = field, labels, bench, fair
        self.layer_names, self.view = field.layer_names, field.view

    def layer(self, layer: str) -> RenderableLayer:
        """What there is to know of a layer."""
        return self._field.layer(layer)

    def labels_at(self, points: Float[Tensor, "p 3"], layer: str) -> PointLabels:
        """The vote of the ball."""
        del layer
        return region_labels(
            self._bench.scene.gaussians,
            self._labels.ids,
            points,
            weights=self._labels.evidence if self._fair else None,
            radius=self._bench.radius,
        )


class Bench:
    """A scene, its capture, and layers that rows share."""

    def __init__(self, scene: Path, data: Path, radius: float, field: Path | None) -> None:
        self.scene = replace(load_scene(scene), source=data.resolve())
        self.data, self.radius = data, radius
        self._file = field
        self._layers: dict[str, Labels] = {}

    def labels(self, name: str) -> Labels:
        """A layer of classes, made once."""
        if name not in self._layers:
            self._layers[name] = self._made(name)
        return self._layers[name]

    def field(self, name: str, points: PointLabelOptions | None = None) -> GaussianField:
        """Gaussians with one of these layers."""
        return GaussianField(self.scene.gaussians, {LAYER: self.labels(name)}, points=points)

    def viewed(self, name: str, options: ViewedPointOptions) -> ViewedPoints:
        """The same, its points labelled by views."""
        return viewed_points(self.scene, self.field(name), options=options)

    @cached_property
    def mesh(self) -> MeshField:
        """The mesh field, renamed."""
        if self._file is None:
            raise SystemExit("rows of a mesh field: expected --field, got none")
        return load_mesh_field(self._file).with_layer(LAYER)

    @cached_property
    def seen(self) -> np.ndarray:
        """Whether a camera saw each point, by true depth maps."""
        views = read_capture(self.data).train_views
        learned = None if self._file is None else self.mesh.info.views
        if learned is not None:
            views = tuple(view for view in views if view.name in set(learned))
        depths = ((view.camera, self._true_depth(view)) for view in views)
        return points_in_view(self.scans[0], depths).numpy()

    def _true_depth(self, view: View) -> Tensor:
        """z-depth of the nearest of every second pixel, metres."""
        meta = json.loads((self.data / "metadata.json").read_text())["depth"]
        with Image.open(self.data / "depth" / f"{view.name}.png") as image:
            depth = torch.from_numpy(np.array(image).astype(np.float32) * meta["unit_m"])
        for axis in (0, 1):
            depth = depth.repeat_interleave(meta["stride"], dim=axis)
        return depth

    def _made(self, name: str) -> Labels:
        if name in ("sam", "panoptic"):
            found = {"sam": "masks_sam", "panoptic": "labels_panoptic"}[name]
            options = SegmentOptions(evidence=found, layer=LAYER)
            tree = segment(self.scene, "associate", options=options).layer
            objects = tree.cut("object") if isinstance(tree, InstanceTree) else tree
            return with_objects(self.labels("uplift"), objects)
        method, own, shared = METHODS[name]
        chosen = replace(find_method(method).options(), **own)
        options = SegmentOptions(evidence="labels_semantic", layer=LAYER, **shared)
        layer = segment(self.scene, method, options=options, method_options=chosen).layer
        if not isinstance(layer, Labels):
            raise TypeError(name)
        return layer

    @cached_property
    def scans(self) -> tuple[Tensor, np.ndarray, np.ndarray]:
        """Points (p, 3), their true classes, and which scan each is of."""
        source = read_scans(self.data)
        points, truth, scan = [], [], []
        for index, name in enumerate(source.scan_names):
            found = source.scan(name)
            points.append(found.points)
            truth.append(found.labels["semantic"].clamp_min(0).numpy().astype(np.int64))
            scan.append(np.full(len(found), index))
        return torch.cat(points), np.concatenate(truth), np.concatenate(scan)

    @cached_property
    def classes(self) -> dict[int, str]:
        """Names of the capture's classes."""
        meta = json.loads((self.data / "metadata.json").read_text())
        return {row["id"]: row["name"] for row in meta["classes"]}


def with_objects(labels: Labels, objects: Labels) -> Labels:
    """Each object with the class that most of its Gaussians have."""
    out = labels.ids.clone().long()
    for one in torch.unique(objects.ids[objects.ids >= 0]).tolist():
        inside = objects.ids == one
        own = labels.ids[inside & (labels.ids >= 0)]
        if len(own):
            out[inside] = int(torch.bincount(own).argmax())
    return replace(labels, ids=out.int(), candidates=None, shares=None)


class Completed:
    """A field whose points without a label take that of the nearest point that has one."""

    def __init__(self, field: MeshField) -> None:
        self._field = field
        self.layer_names, self.view, self.layer = field.layer_names, field.view, field.layer

    def labels_at(self, points: Float[Tensor, "p 3"], layer: str) -> PointLabels:
        """Labels of all points of one call, which are one cloud."""
        found = self._field.labels_at(points, layer)
        known = found.ids >= 0
        if not known.any() or known.all():
            return found
        nearest = NeighbourIndex(points[known]).nearest(points[~known], 1).indices[:, 0]
        ids = found.ids.clone()
        ids[~known] = found.ids[known][nearest]
        return PointLabels(ids=ids, confidence=found.confidence)


Row = Callable[[Bench], Renderable]
PLAIN = {"shapes": False, "smoothing_steps": 0}
ROWS: dict[str, Row] = {
    "published": lambda b: Region(b.field("majority"), b.labels("majority"), b, fair=False),
    "fair": lambda b: Region(b.field("majority"), b.labels("majority"), b, fair=True),
    "majority": lambda b: b.field("majority"),
    "uplift": lambda b: b.field("uplift"),
    "nearest": lambda b: b.field("uplift", PointLabelOptions(rule="nearest")),
    "surface": lambda b: b.field("uplift", PointLabelOptions(max_mahalanobis=3.0)),
    "vote": lambda b: b.field("vote"),
    "vote_depth": lambda b: b.field("vote_depth"),
    "object-classes": lambda b: b.field("object-classes"),
    "sam": lambda b: b.field("sam"),
    "panoptic": lambda b: b.field("panoptic"),
    "views": lambda b: b.viewed("uplift", ViewedPointOptions(**PLAIN)),
    "shapes": lambda b: b.viewed("uplift", ViewedPointOptions(smoothing_steps=0)),
    "drive": lambda b: b.viewed("uplift", ViewedPointOptions()),
    "mesh_adjusted": lambda b: b.mesh.with_layer(vertex_rule="adjusted"),
    "mesh_completed": lambda b: Completed(b.mesh.with_layer(vertex_rule="adjusted")),
    "mesh_weighed": lambda b: b.mesh.with_layer(vertex_rule="weighed"),
    "mesh_all": lambda b: b.mesh.with_layer(vertex_rule="all"),
    "mesh_views": lambda b: viewed_points(b.scene, b.mesh),
}


def scored(*arguments: str | Path) -> dict[str, Any]:
    """What the independent scorer says."""
    command = [sys.executable, str(_SCORE), *map(str, arguments)]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def points_score(bench: Bench, ids: np.ndarray, work: Path) -> dict[str, Any]:
    """Scores of points, with intervals, and the paper's columns."""
    _, truth, scan = bench.scans
    ids = np.maximum(ids, 0)
    np.savez(work / "p.npz", semantic=ids)
    np.savez(work / "t.npz", semantic=truth)
    said = scored("points", "--pred", work / "p.npz", "--truth", work / "t.npz")
    apart: dict[str, float] = {"share_seen": float(bench.seen[truth > 0].mean())}
    for name, among in (("seen", bench.seen), ("unseen", ~bench.seen)):
        np.savez(work / "p.npz", semantic=ids[among])
        np.savez(work / "t.npz", semantic=truth[among])
        of_these = scored("points", "--pred", work / "p.npz", "--truth", work / "t.npz")
        apart |= {name: of_these["mIoU"], f"undefined_{name}": of_these["unlabelled"]}
    n = max(bench.classes) + 1
    flat = (scan * n + truth) * n + ids
    counts = np.bincount(flat, minlength=(scan.max() + 1) * n * n).reshape(-1, n, n)
    big = counts.sum((0, 2)) >= BIG
    rng = np.random.default_rng(0)
    again = [counts[rng.integers(0, len(counts), len(counts))].sum(0) for _ in range(1000)]
    own = {name: id for id, name in bench.classes.items()}
    merged = counts.sum(0)
    if OTHERS in own and "other" in own:
        for axis in (0, 1):
            merged = np.moveaxis(merged, axis, 0)
            merged[own["other"]] += merged[own[OTHERS]]
            merged[own[OTHERS]] = 0
            merged = np.moveaxis(merged, 0, axis)
    column = np.where(merged.sum(1) > 0, iou(merged), np.nan)
    of_table = {name: float(column[own[name]]) if name in own else np.nan for name in TABLE}
    return {
        "points": said["mIoU"],
        "points_interval": interval([mean_iou(c) for c in again]),
        "big": mean_iou(counts.sum(0), big),
        "big_interval": interval([mean_iou(c, big) for c in again]),
        "undefined": said["unlabelled"],
        **apart,
        "accuracy": said["accuracy"],
        "per_class": of_table,
        "table_1": float(np.nanmean(list(of_table.values()))),
    }


def iou(counts: np.ndarray) -> np.ndarray:
    """IoU of each class of a confusion matrix, true by predicted."""
    hit = np.diag(counts)
    return hit / np.maximum(counts.sum(0) + counts.sum(1) - hit, 1)


def mean_iou(counts: np.ndarray, among: np.ndarray | None = None) -> float:
    """Mean over classes that the truth has."""
    present = counts.sum(1) > 0
    present[0] = False
    return float(iou(counts)[present if among is None else present & among].mean())


def interval(values: list[float]) -> list[float]:
    """The middle 95 % of values."""
    return [float(v) for v in np.percentile(values, (2.5, 97.5))]


def views_score(bench: Bench, field: Renderable, work: Path) -> dict[str, Any]:
    """Scores of label maps and of renders."""
    shown: tuple[View, ...] = tuple(v for v in bench.scene.views if v.split != "train")
    for name in ("ids", "rgb"):
        (work / name).mkdir(exist_ok=True)
    for view in shown:
        with field.view(view.camera) as drawn:
            ids = drawn.label_map(LAYER).ids.clamp_min(0).numpy().astype(np.uint8)
            colour = drawn.signals().colour
        Image.fromarray(ids).save(work / "ids" / f"{view.name}.png")
        if colour is not None:
            rgb = (colour.clamp(0, 1) * 255).round().byte().numpy()
            Image.fromarray(rgb).save(work / "rgb" / f"{view.name}.png")
    out: dict[str, Any] = {}
    for key, views in (("test", "test_*"), ("novel", "testnovel_*")):
        maps = ("--pred", work / "ids", "--truth", bench.data / "semantic")
        said = scored("semantic", *maps, "--views", views)
        out[key] = said["mIoU"]
        names = bench.classes
        out[f"{key}_per_class"] = {names[int(k)]: v for k, v in said["per_class"].items()}
    images = ("--pred", work / "rgb", "--truth", bench.data / "images", "--views", "test_*")
    return out | {key: scored("image", *images)[key] for key in ("PSNR", "SSIM")}


def measured(bench: Bench, row: Row, known: dict[int, dict[str, Any]]) -> dict[str, Any]:
    """One row; views are drawn once for all rows of the same labels."""
    field = row(bench)
    points, _, _ = bench.scans
    begin = time.monotonic()
    field.labels_at(points[:1000], LAYER)
    middle = time.monotonic()
    ids = field.labels_at(points, LAYER).ids.numpy().astype(np.int64)
    seconds = {"first_call": middle - begin, "points": time.monotonic() - middle}
    with tempfile.TemporaryDirectory() as folder:
        found = points_score(bench, ids, Path(folder))
        key = id(shown(field))
        if key not in known:
            known[key] = views_score(bench, field, Path(folder))
    return found | known[key] | {"seconds": seconds}


def shown(field: Renderable) -> object:
    """What views of a field are drawn of: labels of Gaussians, or a field of meshes."""
    inner = field
    while isinstance(inner, Region | ViewedPoints | Completed):
        inner = inner._field
    if isinstance(inner, MeshField):
        return inner.model
    return inner.labels(LAYER) if isinstance(inner, GaussianField) else inner


def main() -> None:
    """Parse the command line and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), help="all that can be run")
    parser.add_argument("--field", type=Path, help="of the rows whose names begin with mesh")
    parser.add_argument("--radius", type=float, default=0.5, help="of regions, metres")
    parser.add_argument("--json", type=Path, help="write all figures here")
    arguments = parser.parse_args()
    with_mesh = arguments.field is not None
    rows = arguments.rows or [row for row in ROWS if with_mesh or not row.startswith("mesh")]
    bench = Bench(arguments.scene, arguments.data, arguments.radius, arguments.field)
    print("| row | mIoU | seen | unseen | big | undefined | of seen | of unseen | test | novel "
          "| PSNR | SSIM | s | 13 classes | " + " | ".join(TABLE) + " |")  # fmt: skip
    print("|" + " --- |" * (14 + len(TABLE)))
    all_found, known = {}, {}
    for name in rows:
        found = all_found[name] = measured(bench, ROWS[name], known)
        whole, big = (f"{v:.3f} ({low:.3f} to {high:.3f})" for v, (low, high) in (
            (found["points"], found["points_interval"]), (found["big"], found["big_interval"]),
        ))  # fmt: skip
        spread = [whole, f"{found['seen']:.3f}", f"{found['unseen']:.3f}", big]
        undefined = [found[key] for key in ("undefined", "undefined_seen", "undefined_unseen")]
        rest = [*(f"{share:.3f}" for share in undefined), f"{found['test']:.4f}",
                f"{found['novel']:.4f}", f"{found['PSNR']:.2f}", f"{found['SSIM']:.3f}",
                f"{found['seconds']['points']:.1f}", f"{100 * found['table_1']:.1f}"]  # fmt: skip
        classes = [f"{100 * v:.1f}" for v in found["per_class"].values()]
        print("| " + " | ".join([name, *spread, *rest, *classes]) + " |", flush=True)
        if arguments.json is not None:
            arguments.json.write_text(json.dumps(all_found, indent=1))


if __name__ == "__main__":
    main()
