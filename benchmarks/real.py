"""Labels of real photographs, lifted and scored by the independent scorer.

    python benchmarks/real.py camvid SCENE ../shared/data/real/camvid [--fields street ...]
    python benchmarks/real.py dtu SCENE ../shared/data/real/dtu_scan37
    python benchmarks/real.py replica SCENE ../shared/data/real/replica_office0 --masks masks

`camvid`: a network's class maps of single frames, lifted from all frames and drawn into the same,
and lifted from the train views and drawn into the held-out ones, as are mesh fields of the scene
(`splatseg street`); pooled mean IoU over the eight static classes (`static`; `still`, where nothing
moves) and over all eleven. A scene that was fitted without moving things (`fit --moving-classes`)
is labelled without them. `dtu`: the
object masks of three views, lifted and drawn into all others; the scene must have been fitted
without masks (`fit --masks off`). `replica`: masks that need no weights, as they come (painted
smallest last, with ids of each view's own) and associated (the layer that `segment --method
associate` made), against the reference's instances, which are predictions too.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from splatseg.core import InstanceTree, LabelMap, Labels, Renderable, Scene, View
from splatseg.io.evidence import open_evidence, without_masked
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.lift import (
    UpliftOptions,
    complete,
    correct_confusion,
    label_map,
    uplift,
)
from splatseg.methods import find_method
from splatseg.tasks.segment import SegmentOptions, segment
from splatseg.tasks.work import scene_field

STATIC = 8
"""Classes of camvid from 1 on that stand still; those after them move."""

_SCORE = Path(__file__).resolve().parents[1] / ".." / "shared" / "score" / "score.py"


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """What is scored and where images go."""

    scene: Scene
    data: Path
    work: Path
    masks: str
    object_classes: Sequence[str] = ()
    fields: Sequence[str] = ()

    def draw(self, labels: Labels, views: Sequence[View], name: str, *, binary: int = 0) -> Path:
        """Label maps of views as PNG; with `binary` masks of that id."""
        folder = _fresh(self.work / name)
        for view in views:
            ids = label_map(self.scene.gaussians, view.camera, labels).ids
            if binary:
                image = Image.fromarray((ids == binary).numpy().astype(np.uint8) * 255)
            else:
                image = Image.fromarray(ids.clamp_min(0).numpy().astype(np.uint16))
            image.save(folder / f"{view.name}.png")
        return folder

    def draw_field(self, field: Renderable, views: Sequence[View], name: str) -> Path:
        """Label maps of views of a field with one layer."""
        folder = _fresh(self.work / name)
        for view in views:
            with field.view(view.camera) as shown:
                ids = shown.label_map(field.layer_names[0]).ids
            Image.fromarray(ids.clamp_min(0).numpy().astype(np.uint16)).save(
                folder / f"{view.name}.png"
            )
        return folder


def camvid(job: Job) -> None:
    """Class maps of single frames."""
    found = open_evidence(job.data / "labels_semantic")
    views, held = job.scene.views, job.scene.test_views
    for title, train, scored in (
        ("all frames", views, views),
        ("held-out frames", job.scene.train_views, held),
    ):
        truth = _subset(job.data / "semantic", scored, job.work / "truth")
        came = _subset(job.data / "labels_semantic", scored, job.work / "came")
        _classes(f"{title}, as they came", came, truth)
        begin = time.monotonic()
        used = without_masked(found, train)
        soft = uplift(job.scene.gaussians, train, used, options=UpliftOptions(candidates=8))
        seconds = time.monotonic() - begin
        measured = soft.info.view_correlation
        relabelled = correct_confusion(soft, view_correlation=measured)
        for name, labels in (("uplift", soft), ("confusion corrected", relabelled)):
            hard = complete(job.scene.gaussians, replace(labels, candidates=None, shares=None))
            drawn = job.draw(hard, scored, name)
            _classes(f"{title}, {name}", drawn, truth, seconds)
    truth = _subset(job.data / "semantic", held, job.work / "truth")
    for words in job.object_classes:
        begin = time.monotonic()
        labels = _object_classes(job, words)
        drawn = job.draw(labels, held, "object-classes")
        _classes(f"held-out frames, object-classes {words}", drawn, truth, time.monotonic() - begin)
    for name in job.fields:
        drawn = job.draw_field(scene_field(job.scene, name), held, "field")
        _classes(f"held-out frames, field {name}", drawn, truth)


def _object_classes(job: Job, words: str) -> Labels:
    """The layer of ``object-classes`` with options such as ``masks=masks candidates=3``."""
    base, changes = find_method("object-classes").options(), dict[str, Any]()
    for word in words.split():
        name, value = word.split("=")
        kind = type(getattr(base, name))
        changes[name] = kind(value) if kind in (int, float) else value
        if value.replace(".", "").isdigit() and kind is type(None):
            changes[name] = float(value)
    return segment(
        job.scene,
        "object-classes",
        options=SegmentOptions(evidence="labels_semantic"),
        method_options=replace(base, **changes),
    ).labels


def dtu(job: Job) -> None:
    """The object of three views' masks in all others."""
    views = sorted(job.scene.views, key=lambda view: view.name)
    chosen = [views[len(views) * (2 * k + 1) // 6] for k in range(3)]
    others = [view for view in views if view not in chosen]
    truth = _subset(job.data / "masks", others, job.work / "truth")
    for title, options in (
        ("share", UpliftOptions()),
        ("flashsplat", UpliftOptions(label_rule="flashsplat")),
    ):
        lifted = uplift(job.scene.gaussians, chosen, _Masks(job.data / "masks"), options=options)
        for ending, labels in (
            ("", lifted),
            (", completed", complete(job.scene.gaussians, lifted)),
        ):
            drawn = job.draw(labels, others, "object", binary=_OBJECT)
            said = _score("binary", drawn, truth)
            print(
                f"{title}{ending}, masks of {', '.join(v.name for v in chosen)}: "
                f"IoU {said['IoU_mean_over_views']:.4f} mean of {said['views']} views, "
                f"{said['IoU_pooled']:.4f} pooled",
                flush=True,
            )


def replica(job: Job) -> None:
    """Masks that need no weights, and the layer of them, against the reference's instances."""
    found = open_evidence(job.scene.root / "evidence" / job.masks if job.scene.root else Path())
    labels = load_scene_layer(job.scene.root or Path(), job.masks)
    if isinstance(labels, InstanceTree):
        labels = labels.cut()
    if not isinstance(labels, Labels):
        raise SystemExit(f"{job.masks}: expected a layer of labels")
    known = set(found.view_names)
    train = [view for view in job.scene.views if view.name in known]
    for title, scored in (("views seen", train), ("held-out views", job.scene.test_views)):
        truth = _subset(job.data / "pano_reference", scored, job.work / "truth")
        if title == "views seen":
            came = _fresh(job.work / "came")
            for view in scored:
                _painted(found.masks(view.name)).save(came / f"{view.name}.png")
            _instances(f"{title}, as they come", _score("instances", came, truth))
        drawn = job.draw(labels, scored, "associated")
        _instances(f"{title}, associated", _score("instances", drawn, truth))


_BACKGROUND, _OBJECT = 1, 2


class _Masks:
    """Masks of one object as label maps."""

    def __init__(self, folder: Path) -> None:
        self._files = {path.stem: path for path in sorted(folder.glob("*.png"))}

    @property
    def view_names(self) -> Sequence[str]:
        return tuple(self._files)

    def label_map(self, name: str) -> LabelMap:
        with Image.open(self._files[name]) as image:
            inside = np.asarray(image.convert("L")) > 127
        return LabelMap(ids=torch.from_numpy(np.where(inside, _OBJECT, _BACKGROUND)).int())


def _painted(masks: Any) -> Image.Image:
    """Overlapping masks as one map: large ones first, small ones over them."""
    ids = np.zeros((masks.height, masks.width), np.uint16)
    order = sorted(range(len(masks.masks)), key=lambda index: -masks.masks[index].area)
    for number, index in enumerate(order, start=1):
        ids[masks.masks[index].decode().numpy()] = number
    return Image.fromarray(ids)


def _fresh(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def _subset(folder: Path, views: Sequence[View], target: Path) -> Path:
    """Maps of some views alone: the scorer wants every view that the truth has."""
    _fresh(target)
    names = {view.name for view in views}
    for path in sorted(folder.glob("*.png")):
        if path.stem in names:
            shutil.copy(path, target)
    return target


def _score(command: str, predicted: Path, truth: Path) -> dict[str, Any]:
    said = subprocess.run(
        [sys.executable, str(_SCORE), command, "--pred", str(predicted), "--truth", str(truth)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return json.loads(said.stdout)


def _classes(title: str, drawn: Path, truth: Path, seconds: float | None = None) -> None:
    """Scores of all pixels, and of those that show nothing that moves."""
    said = _score("semantic", drawn, truth)
    still = _score("semantic", drawn, _still(truth))
    of_all, of_still = (
        float(np.mean([one["per_class"][str(k)] for k in range(1, STATIC + 1)]))
        for one in (said, still)
    )
    spent = "" if seconds is None else f"  {seconds:.1f} s"
    print(
        f"{title:36s} static {of_all:.4f}  still {of_still:.4f}  all {said['mIoU']:.4f}  "
        + " ".join(f"{v:.2f}" for v in said["per_class"].values())
        + spent,
        flush=True,
    )


def _still(truth: Path) -> Path:
    """True maps without the pixels of moving classes, beside those with them."""
    target = _fresh(truth.with_name(f"{truth.name}_still"))
    for path in sorted(truth.glob("*.png")):
        ids = np.array(Image.open(path))
        Image.fromarray(np.where(ids > STATIC, 0, ids).astype(ids.dtype)).save(target / path.name)
    return target


def _instances(title: str, said: Mapping[str, Any]) -> None:
    print(
        f"{title:44s} mIoU {said['mIoU']:.4f} recall50 {said['recall50']:.3f} "
        f"precision50 {said['precision50']:.3f} ids {said['predicted_instances']} for "
        f"{said['truth_instances']}",
        flush=True,
    )


def main() -> None:
    """Print one line a row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("camvid", "dtu", "replica"))
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--masks", default="masks", help="replica: evidence and layer of the scene")
    parser.add_argument(
        "--object-classes",
        nargs="*",
        default=[],
        metavar="OPTIONS",
        help='camvid: also this method, such as "masks=masks features=classical_features"',
    )
    parser.add_argument("--fields", nargs="*", default=[], help="camvid: also these of the scene")
    parser.add_argument("--work", type=Path, help="keep label maps here")
    arguments = parser.parse_args()
    temporary = None if arguments.work else tempfile.mkdtemp()
    try:
        job = Job(
            scene=load_scene(arguments.scene),
            data=arguments.data,
            work=arguments.work or Path(temporary or ""),
            masks=arguments.masks,
            object_classes=arguments.object_classes,
            fields=arguments.fields,
        )
        {"camvid": camvid, "dtu": dtu, "replica": replica}[arguments.what](job)
    finally:
        if temporary:
            shutil.rmtree(temporary)


if __name__ == "__main__":
    main()
