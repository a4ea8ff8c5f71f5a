"""What training on rows of W costs, and how good identity, logits and probabilities are.

    python benchmarks/training.py speed SCENE [--pixels 1000] [--batch 8192]
    python benchmarks/training.py quality SCENE ../shared/data/office [--rows NAME ...]
    python benchmarks/training.py published SCENE [--methods cosseg saga] [--views 8]

`speed`: rows drawn per second, memory a row, and a step of identity by part. The gradient step on
all rows that it replaced (torch's fused Adam on a dense gradient) alternates with it in the same
run; medians.

`quality`: methods trained on train views' `labels_tracked` and `labels_semantic`, scored on the
test views by the independent scorer: the hard readout (labels of Gaussians, drawn) and the
rendered one (features or probabilities drawn, then decided). CPU seconds are of training alone.
`--held-out` prints the score on held-out training views only, which is what settings are chosen by.

`published`: a step of published settings, as the difference of two trainings of so many steps on
the first views, so that what is made once is not in it: processor time, products of matrices
(torch's own count), and the share of what a product of two 2048 x 2048 matrices does in that time.
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from street_field import peak
from torch.utils.flop_counter import FlopCounterMode

from splatseg.core import Features, LabelMap, Scene
from splatseg.io.evidence import open_evidence
from splatseg.io.scene import load_scene
from splatseg.lift import label_map
from splatseg.lift.label_maps import ClassifierHead
from splatseg.lift.training import (
    AdamConstants,
    LabelTargets,
    RowAdam,
    RowMoments,
    RowSampler,
    SamplingOptions,
)
from splatseg.methods import find_method
from splatseg.methods.identity import IdentityOptions, TrainingContext, train_identity
from splatseg.tasks.segment import SegmentOptions, segment

SCORER = Path(__file__).resolve().parents[1] / ".." / "shared" / "score" / "score.py"
CHANNELS = 16
PUBLISHED_EVIDENCE = {"cosseg": "labels_semantic_hard", "saga": "masks_sam"}
"""What each method of `published` learns from."""


def cpu_seconds() -> float:
    """User and system time of this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def medians(parts: dict[str, Callable[[], object]], repeats: int) -> dict[str, tuple[float, float]]:
    """Wall and CPU milliseconds of each part; parts alternate."""
    for run in parts.values():
        run()
    wall: dict[str, list[float]] = {name: [] for name in parts}
    cpu: dict[str, list[float]] = {name: [] for name in parts}
    for _ in range(repeats):
        for name, run in parts.items():
            begin, used = time.perf_counter(), cpu_seconds()
            run()
            wall[name].append(1e3 * (time.perf_counter() - begin))
            cpu[name].append(1e3 * (cpu_seconds() - used))
    return {name: (float(np.median(wall[name])), float(np.median(cpu[name]))) for name in parts}


class RandomLabels:
    """Labels of no meaning: speed does not depend on what they say."""

    def __init__(self, scene: Scene, classes: int) -> None:
        self._sizes = {view.name: view.camera for view in scene.train_views}
        self._classes = classes

    @property
    def view_names(self) -> tuple[str, ...]:
        return tuple(self._sizes)

    def label_map(self, name: str) -> LabelMap:
        camera = self._sizes[name]
        rng = np.random.default_rng(len(name))
        ids = rng.integers(1, self._classes + 1, (camera.height, camera.width))
        return LabelMap(ids=torch.from_numpy(ids))


def speed(arguments: argparse.Namespace) -> None:
    """Drawing, memory, and a step by part."""
    scene = load_scene(arguments.scene)
    source = RandomLabels(scene, arguments.classes)
    names = [view.name for view in scene.train_views]
    print(
        f"{len(scene.gaussians)} Gaussians, {len(names)} views, {torch.get_num_threads()} threads"
    )
    for min_weight in (0.0, arguments.min_weight):
        sampler = RowSampler(
            scene.gaussians,
            scene.train_views,
            LabelTargets(source, names),
            options=SamplingOptions(pixels=arguments.pixels, min_weight=min_weight),
        )
        rng = np.random.default_rng(0)
        used, begin = cpu_seconds(), time.perf_counter()
        drawn = sampler.draw(rng, batch=arguments.batch)
        used, begin = cpu_seconds() - used, time.perf_counter() - begin
        views = drawn._store._views
        rows = sum(len(view) for view in views)
        entries = sum(len(view.rows.ids) for view in views)
        print(
            f"min_weight {min_weight}: {rows} rows in {begin:.1f} s ({used:.1f} s CPU), "
            f"{rows / used:.0f} rows a CPU second; {entries / rows:.0f} entries and "
            f"{sum(view.nbytes for view in views) / rows:.0f} bytes a row"
        )
        step(drawn, len(scene.gaussians), arguments)
        drawn.close()


def step(drawn, count: int, arguments: argparse.Namespace) -> None:
    """A step's parts on one batch of a draw, and the dense step it replaced."""
    batch = drawn.batch(0)
    weights, touched = batch.weights, batch.weights.touched
    features = torch.randn(count, CHANNELS)
    gradient = torch.randn(len(touched), CHANNELS)
    image = torch.randn(len(batch), CHANNELS)
    moments, adam = RowMoments.zeros(features), RowAdam(AdamConstants(), max_steps=10**4)
    dense = features.clone().requires_grad_()
    dense.grad = torch.zeros_like(features)
    dense_adam = torch.optim.Adam([dense], lr=2.5e-3, fused=True)
    head = torch.nn.Linear(CHANNELS, arguments.classes)
    label = batch.target("label")

    def dense_step() -> None:
        dense.grad.zero_()
        dense.grad[touched] = gradient
        dense_adam.step()

    def loss() -> None:
        leaf = image.clone().requires_grad_()
        torch.nn.functional.cross_entropy(head(leaf), label).backward()

    found = medians(
        {
            "cut a batch": lambda: drawn.batch(0),
            "gather": lambda: features[touched],
            "forward": lambda: weights.product(features[touched]),
            "backward": lambda: weights.adjoint(image),
            "loss": loss,
            "row-wise Adam": lambda: adam.step(
                features, moments, rows=touched, gradient=gradient, rate=2.5e-3
            ),
            "dense Adam": dense_step,
        },
        arguments.repeats,
    )
    entries = len(weights.rows.ids)
    print(f"  batch of {len(batch)} pixels, {entries} entries, {len(touched)} Gaussians touched")
    for name, (wall, cpu) in found.items():
        print(f"  {name:14s} {wall:7.1f} ms  {cpu:7.1f} ms CPU")


class Bench:
    """A scene, its capture, and a place for label maps."""

    def __init__(self, arguments: argparse.Namespace, work: Path) -> None:
        self.scene = load_scene(arguments.scene)
        self.data = arguments.data
        self.work = work
        self.arguments = arguments

    def row(self, title: str, evidence: str, make: Callable[..., Features]) -> None:
        """Train, score both readouts, print a line."""
        used, begin = cpu_seconds(), time.monotonic()
        context = TrainingContext(seed=self.arguments.seed)
        layer = make(
            self.scene.gaussians,
            self.scene.train_views,
            open_evidence(self.data / evidence),
            context=context,
        )
        used, begin = cpu_seconds() - used, time.monotonic() - begin
        told, head = layer.info.details, ClassifierHead.of(layer)
        held = max((score for _, score in told["scores"]), default=float("nan"))
        text = f"{evidence:20s} {title:34s}"
        if not self.arguments.held_out:
            truth = "semantic" if evidence.startswith("labels_semantic") else "instance"
            labels = head.labels(layer)
            gaussians = self.scene.gaussians
            hard = self.score(truth, lambda camera: label_map(gaussians, camera, labels))
            rendered = self.score(truth, lambda camera: head.label_map(gaussians, camera, layer))
            text += f" hard {hard:.4f} rendered {rendered:.4f}"
        print(
            f"{text} held out {held:.4f} best {told['best_step']}/{told['steps']} "
            f"loss {told['loss']:.4f} {used:.0f} s CPU {begin:.0f} s",
            flush=True,
        )

    def score(self, truth: str, draw: Callable[..., LabelMap]) -> float:
        """Mean IoU on the test views."""
        folder = self.work / "maps"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for view in self.scene.test_views:
            ids = draw(view.camera).ids.clamp_min(0).numpy().astype(np.uint16)
            Image.fromarray(ids).save(folder / f"{view.name}.png")
        command = "semantic" if truth == "semantic" else "instances"
        said = subprocess.run(
            [sys.executable, str(SCORER), command, "--pred", str(folder), "--truth",
             str(self.data / truth), "--views", "test_*"],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        return json.loads(said.stdout)["mIoU"]


def methods(steps: int | None) -> dict[str, Callable[..., Features]]:
    """What is compared, by name."""

    def of(train, options) -> Callable[..., Features]:
        changed = options if steps is None else replace(options, steps=steps)
        return lambda *given, **context: train(*given, options=changed, **context)

    return {
        "published": of(train_identity, IdentityOptions.published()),
        "features": of(train_identity, IdentityOptions(blend="features")),
        "identity": of(train_identity, IdentityOptions()),
    }


def quality(arguments: argparse.Namespace) -> None:
    """One line a method and evidence."""
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(arguments, arguments.work or Path(folder))
        made = methods(arguments.steps)
        for evidence in arguments.evidence:
            for name in arguments.rows or made:
                bench.row(name, evidence, made[name])


def published(arguments: argparse.Namespace) -> None:
    """A line a method."""
    scene = load_scene(arguments.scene)
    views = tuple(view.name for view in scene.train_views[: arguments.views])
    most = peak()
    print(f"{len(scene.gaussians)} Gaussians, peak {most / 1e9:.0f} GFLOP a second of a core")
    for name in arguments.methods:
        method = find_method(name)
        options = SegmentOptions(
            evidence=PUBLISHED_EVIDENCE[name], layer="bench", published=True, views=views
        )

        def train(steps: int, method=method, name=name, options=options) -> float:
            given = replace(method.published_options, steps=steps)
            used = cpu_seconds()
            segment(scene, name, options=options, method_options=given)
            return cpu_seconds() - used

        def counted(steps: int, train=train) -> int:
            with FlopCounterMode(display=False) as counter:
                train(steps)
            return counter.get_total_flops()

        few, many = arguments.steps
        train(few)
        seconds = [(train(many) - train(few)) / (many - few) for _ in range(arguments.repeats)]
        each, flops = float(np.median(seconds)), (counted(many) - counted(few)) / (many - few)
        print(
            f"{name:8s} {1e3 * each:7.1f} ms CPU a step, {flops / 1e9:.2f} GFLOP of products, "
            f"{flops / each / most:.0%} of the peak",
            flush=True,
        )


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    fast = commands.add_parser("speed")
    fast.add_argument("scene", type=Path)
    fast.add_argument("--pixels", type=int, default=1000)
    fast.add_argument("--batch", type=int, default=8192)
    fast.add_argument("--classes", type=int, default=128)
    fast.add_argument("--min-weight", type=float, default=0.01)
    fast.add_argument("--repeats", type=int, default=7)
    fast.set_defaults(run=speed)
    good = commands.add_parser("quality")
    good.add_argument("scene", type=Path)
    good.add_argument("data", type=Path)
    good.add_argument("--rows", nargs="+", choices=list(methods(None)))
    good.add_argument("--evidence", nargs="+", default=["labels_tracked", "labels_semantic"])
    good.add_argument("--steps", type=int)
    good.add_argument("--seed", type=int, default=0)
    good.add_argument("--held-out", action="store_true")
    good.add_argument("--work", type=Path, help="keep label maps here")
    good.set_defaults(run=quality)
    true = commands.add_parser("published")
    true.add_argument("scene", type=Path)
    true.add_argument("--methods", nargs="+", default=list(PUBLISHED_EVIDENCE))
    true.add_argument("--views", type=int, default=8)
    true.add_argument("--steps", type=int, nargs=2, default=[20, 60])
    true.add_argument("--repeats", type=int, default=3)
    true.set_defaults(run=published)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
