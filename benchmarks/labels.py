"""Recorded evidence of the train views, lifted, scored on the test views by the independent scorer.

    python benchmarks/labels.py SCENE ../shared/data/office [--rows truth semantic ...] [--work DIR]

Rows, each a method on a folder of evidence (`splatseg segment` does the same):

- `truth`: true class maps and true instance maps through `uplift`.
- `semantic`: `labels_semantic` as they came (on the train views), voted for by centres, through
  `uplift`, completed, and relabelled under how the evidence errs.
- `tracked`: `labels_tracked` through `uplift`, repaired by `associate`, and through `identity`.
- `panoptic`: `labels_panoptic` with every segment given its true instance (the ceiling of
  association), and through `associate`.
- `sam`: `masks_sam` through `associate`.

Instances are scored without classes, matched one to one over the scene (`score.py instances`);
classes by pooled mean IoU (`score.py semantic`).
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scored import ScoredScene, run_rows

from splatseg.core import Gaussians, InstanceTree, LabelMap, Labels, View
from splatseg.io.evidence import Evidence, open_evidence
from splatseg.lift import (
    ConfusionOptions,
    EvidenceSegments,
    UpliftOptions,
    complete,
    correct_confusion,
    uplift,
)
from splatseg.methods.associate import associate
from splatseg.methods.identity import identity
from splatseg.methods.vote import VoteOptions, vote


class Bench(ScoredScene):
    """A scene that recorded evidence is lifted onto."""

    @property
    def train(self) -> tuple[View, ...]:
        """The views to learn from."""
        return self.scene.train_views

    def evidence(self, name: str) -> Evidence:
        """A folder of the capture."""
        return open_evidence(self.data / name)

    def row(self, title: str, truth: str, make: Callable[[], Labels]) -> Labels:
        """Make a layer, draw the test views, score them, and print a line."""
        begin = time.monotonic()
        labels = make()
        seconds = time.monotonic() - begin
        folder = self.draw(labels, title.replace(" ", "_").replace("/", "_"))
        command = "semantic" if truth == "semantic" else "instances"
        said = self.score(command, [folder], truth)
        print(f"{title:44s} mIoU {said['mIoU']:.4f}  {_more(said)}  {seconds:5.1f} s", flush=True)
        return labels


def _more(said: dict[str, float]) -> str:
    if "recall50" not in said:
        return f"accuracy {said['accuracy']:.4f}"
    return (
        f"recall50 {said['recall50']:.3f} precision50 {said['precision50']:.3f} "
        f"ids {said['predicted_instances']}/{said['truth_instances']}"
    )


def truth(bench: Bench) -> None:
    """True maps through uplift."""
    for name in ("semantic", "instance"):
        found = bench.evidence(name)
        lifted = bench.row(
            f"true {name}, uplift",
            name,
            lambda found=found: uplift(bench.scene.gaussians, bench.train, found),
        )
        bench.row(
            f"true {name}, completed",
            name,
            lambda lifted=lifted: complete(bench.scene.gaussians, lifted),
        )


def semantic(bench: Bench) -> None:
    """Class maps of a model that errs."""
    said = bench.score("semantic", [bench.data / "labels_semantic"], "semantic", "train_*")
    print(f"{'labels_semantic as they came (train)':44s} mIoU {said['mIoU']:.4f}  {_more(said)}")
    found, gaussians = bench.evidence("labels_semantic"), bench.scene.gaussians
    for title, options in (
        ("vote, no occlusion test", VoteOptions()),
        ("vote, by depth", VoteOptions(occlusion="depth")),
        (
            "vote, by transmittance",
            VoteOptions(occlusion="weight", weight="transmittance"),
        ),
    ):
        bench.row(
            f"labels_semantic, {title}",
            "semantic",
            lambda options=options: vote(gaussians, bench.train, found, options=options),
        )
    soft = bench.row(
        "labels_semantic, soft weights",
        "semantic",
        lambda: uplift(gaussians, bench.train, found, options=UpliftOptions(candidates=8)),
    )
    hard = replace(soft, candidates=None, shares=None)
    bench.row("labels_semantic, uplift", "semantic", lambda: hard)
    bench.row("labels_semantic, completed", "semantic", lambda: complete(gaussians, hard))
    again = correct_confusion(soft, view_correlation=soft.info.view_correlation)
    hard = replace(again, candidates=None, shares=None)
    bench.row("labels_semantic, relabelled", "semantic", lambda: complete(gaussians, hard))


def tracked(bench: Bench) -> None:
    """Ids of a tracker that switches, splits and loses."""
    found, gaussians = bench.evidence("labels_tracked"), bench.scene.gaussians
    soft = uplift(gaussians, bench.train, found, options=UpliftOptions(candidates=8))
    for title, labels in (("uplift", soft), ("uplift, relabelled", correct_confusion(soft))):
        hard = replace(labels, candidates=None, shares=None)
        bench.row(f"labels_tracked, {title}", "instance", lambda hard=hard: hard)
    _associated(bench, "labels_tracked", found)
    bench.row(
        "labels_tracked, identity", "instance", lambda: identity(gaussians, bench.train, found)
    )


def panoptic(bench: Bench) -> None:
    """Segments with ids of each view's own."""
    found = bench.evidence("labels_panoptic")
    given = _TrueInstances(found, bench.data / "instance")
    bench.row(
        "labels_panoptic, true instances (ceiling)",
        "instance",
        lambda: uplift(bench.scene.gaussians, bench.train, given),
    )
    _associated(bench, "labels_panoptic", found)


def sam(bench: Bench) -> None:
    """Overlapping masks of objects, parts and groups."""
    _associated(bench, "masks_sam", bench.evidence("masks_sam"))


def _completed(gaussians: Gaussians, layer: Labels | InstanceTree) -> Labels:
    """What `segment` gives by default; of a tree its objects."""
    if isinstance(layer, InstanceTree):
        return replace(layer, labels=complete(gaussians, layer.labels)).cut()
    return complete(gaussians, layer)


def _associated(bench: Bench, name: str, found: Evidence) -> None:
    gaussians, segments = bench.scene.gaussians, EvidenceSegments(evidence=found)
    for title, confusion in (
        ("associate", ConfusionOptions()),
        ("associate, majority of votes", None),
    ):
        bench.row(
            f"{name}, {title}",
            "instance",
            lambda confusion=confusion: _completed(
                gaussians, associate(gaussians, bench.train, segments, confusion=confusion)
            ),
        )


class _TrueInstances:
    """Every segment of a view's map as the instance that most of its pixels really are."""

    def __init__(self, found: Evidence, truth: Path) -> None:
        self._found = found
        self._truth = truth

    @property
    def view_names(self) -> Sequence[str]:
        return self._found.view_names

    def label_map(self, name: str) -> LabelMap:
        ids = self._found.label_map(name).ids.numpy()
        with Image.open(self._truth / f"{name}.png") as image:
            true = np.asarray(image).astype(np.int64)
        out = np.full(ids.shape, -1)
        for segment in np.unique(ids[ids >= 0]):
            inside = ids == segment
            best = int(np.bincount(true[inside]).argmax())
            out[inside] = best if best > 0 else -1
        return LabelMap(ids=torch.from_numpy(out).int())


ROWS = {
    "truth": truth,
    "semantic": semantic,
    "tracked": tracked,
    "panoptic": panoptic,
    "sam": sam,
}


if __name__ == "__main__":
    run_rows(__doc__, Bench, ROWS)
