"""Labels that contradict each other, by every method, scored on the test views.

    python benchmarks/cosseg.py SCENE ../shared/data/office --evidence labels_semantic_hard \\
        --rows majority uplift object_vote object-classes cosseg

Every row is a process of its own, so that its seconds and its peak of memory are its own. Rows:

- `majority`: `uplift` without relabelling and completion; `uplift`: by default.
- `object_vote`: the instances of `masks_sam` (`associate`), each with the majority class of its
  Gaussians.
- `object-classes`: classes of the objects of `masks_sam`, in closed form; no part of
  CoSSegGaussians.
- `identity`, `cosseg`: by default, `cosseg` with features;
  `published`: `cosseg --published`. `--set OPTION=VALUE` changes options of the method.
- `associate`: of tracks.
- `joint`: `cosseg` with Gaussians that learn along (`--joint`); with the mean PSNR of test views,
  before and after.

Label maps of classes are scored by ``score.py semantic``; of tracks by ``instances`` and
``panoptic``, with the class of each instance.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from scored import _SCORE, ScoredScene

from splatseg.core import Features, InstanceTree, Labels, Layer, Scene
from splatseg.evaluate import psnr, render_and_photograph
from splatseg.io.scene import load_scene
from splatseg.lift import (
    GaussianField,
    label_map,
)
from splatseg.lift.label_maps import ClassifierHead
from splatseg.methods import find_method
from splatseg.tasks.segment import SegmentOptions, segment

_NEW = Path(tempfile.gettempdir()) / "splatseg-joint"
"""Named, and never written."""

METHODS = {
    "majority": ("uplift", {"correct_confusion": False}, {"complete": False}),
    "uplift": ("uplift", {}, {}),
    "associate": ("associate", {}, {}),
    "identity": ("identity", {}, {}),
    "object-classes": (
        "object-classes", {"features": "features_dino", "masks": "masks_sam"}, {},
    ),
    "cosseg": ("cosseg", {"features": "features_dino"}, {}),
    "published": ("cosseg", {}, {"published": True}),
    "joint": ("cosseg", {"features": "features_dino", "joint": _NEW}, {}),
}  # fmt: skip


def made(
    scene: Scene, row: str, evidence: str, changes: dict[str, Any], seed: int
) -> tuple[Layer, Scene]:
    """The layer of a row, and the scene that it belongs to."""
    if row == "object_vote":
        return object_vote(scene, evidence), scene
    name, own, shared = METHODS[row]
    method = find_method(name)
    base = method.published_options if shared.get("published") else method.options()
    known = {each.name for each in fields(base)}
    chosen = replace(base, **{k: v for k, v in {**own, **changes}.items() if k in known})
    if row == "joint":
        inner = {k: v for k, v in changes.items() if k not in known}
        chosen = replace(chosen, joint_training=replace(chosen.joint_training, **inner))
    options = SegmentOptions(evidence=evidence, layer="bench", seed=seed, **shared)
    found = segment(scene, name, options=options, method_options=chosen)
    return found.layer, found.refined or scene


def quality(scene: Scene) -> float:
    """Mean PSNR of renders against the photographs of test views, dB."""
    field = GaussianField(scene.gaussians)
    return float(np.mean([psnr(*render_and_photograph(field, v)) for v in scene.test_views]))


def object_vote(scene: Any, evidence: str) -> Labels:
    """Each instance of `masks_sam` with the majority class of its Gaussians."""
    votes, _ = made(scene, "majority", evidence, {}, 0)
    tree = segment(scene, "associate", options=SegmentOptions(evidence="masks_sam")).layer
    if not isinstance(votes, Labels) or not isinstance(tree, InstanceTree):
        raise TypeError
    objects, ids = tree.cut("object").ids.long(), votes.ids.long()
    out = ids.clone()
    for one in torch.unique(objects[objects >= 0]).tolist():
        inside = objects == one
        own = ids[inside & (ids >= 0)]
        if len(own):
            out[inside] = int(torch.bincount(own).argmax())
    return Labels(ids=out.int(), confidence=torch.ones(len(out)), info=votes.info)


def drawn(bench: ScoredScene, layer: Layer, row: str) -> Path:
    """Label maps of the test views: of features by their classifier."""
    flat = layer.cut("object") if isinstance(layer, InstanceTree) else layer
    if isinstance(flat, Labels):
        return bench.draw(flat, row)
    if not isinstance(flat, Features):
        raise TypeError
    head, folder = ClassifierHead.of(flat), bench.work / row
    folder.mkdir(parents=True, exist_ok=True)
    for view in bench.scene.test_views:
        ids = head.label_map(bench.scene.gaussians, view.camera, flat).ids
        Image.fromarray(ids.clamp_min(0).numpy().astype(np.uint16)).save(
            folder / f"{view.name}.png"
        )
    return folder


def frames_per_second(bench: ScoredScene, layer: Layer) -> float:
    """Label maps of test views a second, by the median."""
    flat = layer.cut("object") if isinstance(layer, InstanceTree) else layer
    gaussians, seconds = bench.scene.gaussians, list[float]()
    for view in bench.scene.test_views[:5]:
        began = time.perf_counter()
        if isinstance(flat, Features):
            ClassifierHead.of(flat).label_map(gaussians, view.camera, flat)
        elif isinstance(flat, Labels):
            label_map(gaussians, view.camera, flat)
        seconds.append(time.perf_counter() - began)
    return 1 / float(np.median(seconds))


def classes_of(bench: ScoredScene, layer: Layer, row: str) -> Path:
    """Maps of the class of each instance."""
    flat = layer.cut("object") if isinstance(layer, InstanceTree) else layer
    if not isinstance(flat, Labels):
        raise TypeError
    most = max([int(flat.ids.max()), *flat.info.class_of])
    kinds = torch.zeros(most + 2, dtype=torch.int64)
    for id, kind in flat.info.class_of.items():
        kinds[id] = kind
    folder = bench.work / f"{row}_classes"
    folder.mkdir(parents=True, exist_ok=True)
    for view in bench.scene.test_views:
        ids = label_map(bench.scene.gaussians, view.camera, flat).ids.long()
        ids = torch.where(ids < 0, len(kinds) - 1, ids)
        Image.fromarray(kinds[ids].numpy().astype(np.uint16)).save(folder / f"{view.name}.png")
    return folder


def panoptic(bench: ScoredScene, instances: Path, classes: Path) -> dict[str, Any]:
    """Scene-level panoptic quality by the independent scorer."""
    said = subprocess.run(
        [sys.executable, str(_SCORE), "panoptic", "--pred-instance", str(instances),
         "--pred-semantic", str(classes), "--truth-instance", str(bench.data / "instance"),
         "--truth-semantic", str(bench.data / "semantic"), "--metadata",
         str(bench.data / "metadata.json"), "--views", "test_*"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return json.loads(said.stdout)


def run_row(arguments: argparse.Namespace, row: str) -> None:
    """Make, draw and score one row, and print a line."""
    scene = load_scene(arguments.scene)
    changes = {k: eval_value(v) for k, v in (one.split("=", 1) for one in arguments.set)}
    began = time.monotonic()
    layer, new = made(scene, row, arguments.evidence, changes, arguments.seed)
    seconds = time.monotonic() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    with tempfile.TemporaryDirectory() as temporary:
        bench = ScoredScene(new, arguments.data, arguments.work or Path(temporary))
        folder = drawn(bench, layer, row)
        if "tracked" not in arguments.evidence:
            said = bench.score("semantic", [folder], "semantic")
            text = f"mIoU {said['mIoU']:.4f}  accuracy {said['accuracy']:.4f}"
        else:
            said = bench.score("instances", [folder], "instance")
            more = panoptic(bench, folder, classes_of(bench, layer, row))
            keys = [key for key in more if isinstance(more[key], float)]
            text = f"instance mIoU {said['mIoU']:.4f}  " + "  ".join(
                f"{key} {more[key]:.4f}" for key in keys
            )
        if new is not scene:
            text += f"  PSNR {quality(scene):.2f} -> {quality(new):.2f} dB"
        text += f"  {frames_per_second(bench, layer):.2f} fps"
    learned = layer.info.details.get("learned_bytes", "")
    what = f"{arguments.data.name:7s} {arguments.evidence:22s} {row:14s}"
    print(
        f"{what} {' '.join(arguments.set):40s} {text}  {seconds:6.1f} s  {peak:.2f} GB  {learned}",
        flush=True,
    )


def eval_value(text: str) -> Any:
    """A number, a list of numbers, or a word."""
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        return text
    return tuple(value) if isinstance(value, list) else value


def main() -> None:
    """Run each row in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--evidence", default="labels_semantic_hard")
    parser.add_argument("--rows", nargs="+", choices=[*METHODS, "object_vote"], required=True)
    parser.add_argument("--set", nargs="*", default=[], metavar="OPTION=VALUE")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, help="keep label maps here")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.here:
        run_row(arguments, arguments.rows[0])
        return
    own = sys.argv[1:]
    start = own.index("--rows")
    for row in arguments.rows:
        kept = own[:start] + own[start + 1 + len(arguments.rows) :]
        subprocess.run([sys.executable, __file__, *kept, "--rows", row, "--here"], check=False)


if __name__ == "__main__":
    main()
