"""Every protocol of `splatseg bench`, end to end on rendered scenes in the benchmarks' layouts.

    .venv/bin/python benchmarks/protocols.py ../shared --out runs/protocols --steps 1500

Scenes are written in each layout by the writers of `scripts/to_layout`, fitted, segmented by
methods of each kind and scored; figures are held to ../shared/score/score.py where it has the
measure: a line a protocol and method. A second call goes on where the first was stopped. Figures
are of these scenes and of a short fit, and no figures of the benchmarks.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

from splatseg.methods import find_method  # noqa: E402
from splatseg_bench.layouts import read_benchmark  # noqa: E402
from splatseg_bench.options import BenchOptions  # noqa: E402
from splatseg_bench.results import load_result  # noqa: E402
from splatseg_bench.run import bench  # noqa: E402
from splatseg_bench.scene import BenchmarkScene  # noqa: E402
from splatseg_bench.tables import write_tables  # noqa: E402
from support.benchmark_layouts import read_source, write_layout  # noqa: E402
from support.benchmark_layouts.evidence import write_evidence  # noqa: E402


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """A protocol on a scene."""

    protocol: str
    layout: str
    scene: str
    methods: tuple[str, ...]
    evidence: tuple[str, ...] = ()
    companions: tuple[str, ...] = ()
    switches: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    published: bool = False

    @property
    def setting(self) -> str:
        """What tells the results of other settings of methods apart; empty for their own."""
        return "-".join((*(("published",) if self.published else ()), *self.options))


_TEXT, _CLASSES, _PANOPTIC, _TRACKED, _MASKS = (
    "features_text", "labels_semantic", "labels_panoptic", "labels_tracked", "masks_sam",
)  # fmt: skip
_ANY = ("scene_list=all",)
_BESIDES = (_MASKS, "features_dino")
_WORDS = ("features", "objects", "voxels")
_ALL_VIEWS = ("view_share=1.0",)


def _spoken(scene: str) -> tuple[Run, ...]:
    """SPIn-NeRF by words, as Table 4 of Prompt SA-GS has it, and by other methods of words."""

    def run(*methods: str, **more: Any) -> Run:
        return Run(
            protocol="spin-nerf-words", layout="spin-nerf", scene=scene, methods=methods,
            companions=(_MASKS,), evidence=(_TEXT,), **more,
        )  # fmt: skip

    by_points = {"protocol": "spin-nerf", "layout": "spin-nerf", "scene": scene}
    return (
        run("prompt", *_WORDS),
        run("prompt", options=("view_share=0.5",)),
        run("prompt", published=True),
        run("prompt", published=True, options=_ALL_VIEWS),
        run("voxels", published=True),
        # SA-GS: points by hand in one view, masks of all views.
        Run(**by_points, methods=("prompt",), evidence=(_MASKS,)),
        Run(**by_points, methods=("prompt",), evidence=(_MASKS,), published=True,
            options=_ALL_VIEWS),
    )  # fmt: skip


RUNS = (
    Run(protocol="nvos", layout="nvos", scene="frontal",
        methods=("uplift", "associate", "saga"), evidence=(_MASKS,)),
    Run(protocol="spin-nerf", layout="spin-nerf", scene="frontal",
        methods=("uplift", "associate", "saga"), evidence=(_MASKS,)),
    Run(protocol="spin-nerf-ludvig", layout="spin-nerf", scene="frontal",
        methods=("uplift", "associate", "saga"), evidence=(_MASKS,)),
    *_spoken("frontal"),
    *_spoken("toys"),
    Run(protocol="lerf-mask", layout="lerf-mask", scene="toys", methods=_WORDS,
        companions=(_MASKS,), evidence=(_TEXT,)),
    Run(protocol="lerf-ovs-2d", layout="lerf-ovs", scene="toys", methods=_WORDS,
        companions=(_MASKS,), evidence=(_TEXT,)),
    Run(protocol="lerf-ovs-3d", layout="lerf-ovs", scene="toys", methods=_WORDS,
        companions=(_MASKS,), evidence=(_TEXT,)),
    Run(protocol="3d-ovs", layout="3d-ovs", scene="toys", methods=_WORDS,
        companions=(_MASKS,), evidence=(_TEXT,)),
    Run(protocol="replica", layout="replica", scene="office", methods=("uplift", "associate"),
        evidence=(_CLASSES, _PANOPTIC)),
    Run(protocol="replica-gaga", layout="replica", scene="office", methods=("associate",),
        evidence=(_PANOPTIC,)),
    Run(protocol="scannet-19", layout="scannet", scene="office", methods=("uplift", "features"),
        evidence=(_CLASSES, _TEXT), switches=("frame_step=1",)),
    Run(protocol="scannet-15", layout="scannet", scene="office", methods=("uplift", "features"),
        evidence=(_CLASSES, _TEXT), switches=("frame_step=1",)),
    Run(protocol="scannet-views", layout="scannet", scene="office",
        methods=("uplift", "associate"), evidence=(_CLASSES, _PANOPTIC)),
    Run(protocol="scannet-gaga", layout="scannet", scene="office", methods=("associate",),
        evidence=(_PANOPTIC,)),
    Run(protocol="scannet-10", layout="scannet", scene="office", methods=("uplift", "features"),
        evidence=(_CLASSES, _TEXT), switches=("frame_step=1",)),
    Run(protocol="scannetpp", layout="scannetpp", scene="office", methods=_WORDS,
        companions=(_MASKS,), evidence=(_TEXT,)),
    Run(protocol="scannetpp", layout="scannetpp", scene="office", methods=("voxels",),
        evidence=(_TEXT,), published=True),
    Run(protocol="cosseg-replica-semantic", layout="replica", scene="office",
        methods=("uplift", "associate", "object-classes", "cosseg"), companions=_BESIDES,
        evidence=(_CLASSES, _PANOPTIC), switches=_ANY),
    Run(protocol="cosseg-replica-panoptic", layout="replica", scene="office",
        methods=("uplift", "associate", "object-classes", "cosseg"), companions=_BESIDES,
        evidence=(_TRACKED, _PANOPTIC), switches=_ANY),
    Run(protocol="cosseg-scannet-semantic", layout="scannet", scene="office",
        methods=("uplift", "associate", "object-classes", "cosseg"), companions=_BESIDES,
        evidence=(_CLASSES, _PANOPTIC), switches=_ANY),
    Run(protocol="cosseg-scannet-panoptic", layout="scannet", scene="office",
        methods=("uplift", "associate", "object-classes", "cosseg"), companions=_BESIDES,
        evidence=(_TRACKED, _PANOPTIC), switches=_ANY),
    Run(protocol="kitti360", layout="kitti360", scene="street",
        methods=("uplift", "vote", "dnmp"), evidence=(_CLASSES,)),
    Run(protocol="waymo", layout="waymo", scene="street", methods=("uplift", "vote", "dnmp"),
        evidence=(_CLASSES,)),
)  # fmt: skip


def main() -> None:
    """Run all protocols, or some."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("shared", type=Path, help="the folder of data/ and score/")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--max-gaussians", type=int, default=100_000)
    parser.add_argument("--protocols", nargs="*", help="names; all without it")
    parser.add_argument("--methods", nargs="*", help="of these only; all without it")
    asked = parser.parse_args()
    for run in RUNS:
        methods = tuple(one for one in run.methods if not asked.methods or one in asked.methods)
        if methods and (not asked.protocols or run.protocol in asked.protocols):
            takes = any(find_method(one).companions for one in methods)
            companions = run.companions if takes else ()
            _do(replace(run, methods=methods, companions=companions), asked)


def _do(run: Run, asked: Any) -> None:
    data, scene = _written(run, asked)
    began = time.monotonic()
    root = _root(run, asked)
    fits = asked.out / "runs" / "scenes" / run.layout / "{scene}"
    done = bench(
        run.protocol,
        data,
        root,
        options=BenchOptions(
            methods=run.methods,
            models=tuple(str(data / "evidence" / "{scene}" / name) for name in run.evidence),
            companions=tuple(str(data / "evidence" / "{scene}" / name) for name in run.companions),
            steps=asked.steps,
            max_gaussians=asked.max_gaussians,
            switches=run.switches,
            method_options=run.options,
            published=run.published,
            fitted=str(fits) if run.setting else None,
        ),
        command=" ".join(sys.argv),
    )
    write_tables(done, root)
    for method in done.methods:
        figures = ", ".join(f"{name} {value:.4f}" for name, value in method.scores.items())
        checks = dict(_checked(run, scene, method.method, asked))
        held = ", ".join(f"{name} {value:.1e}" for name, value in checks.items()) or "none"
        name = f"{method.method} {run.setting}".strip()
        print(
            f"{run.protocol} | {run.scene} | {name} | {figures} | off score.py by: {held}",
            flush=True,
        )
    print(f"{run.protocol}: {time.monotonic() - began:.0f} s", flush=True)


def _root(run: Run, asked: Any) -> Path:
    """The folder of results; other settings of methods have one of their own."""
    return asked.out / f"runs-{run.setting}" if run.setting else asked.out / "runs"


def _written(run: Run, asked: Any) -> tuple[Path, BenchmarkScene]:
    """The scene in the layout, with all evidence that its runs take."""
    data = asked.out / "data" / f"{run.layout}-{run.scene}"
    source = asked.shared / "data" / run.scene
    if not data.is_dir():
        write_layout(run.layout, source, data)
    (scene,) = read_benchmark(run.layout, data)
    for name in (*run.evidence, *run.companions):
        if not (data / "evidence" / scene.name / name).is_dir():
            write_evidence(read_source(source), scene.capture, name, data / "evidence" / scene.name)
    return data, scene


def _checked(
    run: Run, scene: BenchmarkScene, method: str, asked: Any
) -> Iterator[tuple[str, float]]:
    """By how much figures differ from the independent scorer's."""
    root = _root(run, asked)
    result = load_result(root / "results" / run.protocol / method / f"{scene.name}.json")
    predicted = root / "predictions" / run.protocol / method / scene.name
    scorer = asked.shared / "score" / "score.py"
    truth = asked.out / "truth" / run.protocol / run.scene / (method + run.setting)
    if scene.tasks and "averaging" in result.switches and predicted.is_dir():
        worst = 0.0
        for task in scene.tasks:
            rows = {row["view"]: row for row in result.rows if row["task"] == task.name}
            rows = {view: row for view, row in rows.items() if row["found"]}
            if not rows:
                continue
            masks = {one.view: one.read().numpy() for one in task.truth if one.view in rows}
            folder = _saved({k: v * np.uint8(255) for k, v in masks.items()}, truth / task.name)
            theirs = _score(scorer, "binary", predicted / task.name, folder)
            mean = sum(row["iou"] for row in rows.values()) / len(rows)
            worst = max(worst, abs(mean - theirs["IoU_mean_over_views"]))
        yield "iou", worst
    for kind, maps, command, ours, name in (
        ("classes", scene.semantic, "semantic", "miou", "mIoU"),
        ("instances", scene.instances, "instances", "pooled_instance_miou", "mIoU"),
    ):
        folder = predicted / kind
        if maps is not None and folder.is_dir() and ours in result.scores:
            views = [path.stem for path in folder.glob("*.png")]
            ids = {v: maps.read[v]().ids.clamp_min(0).numpy().astype(np.uint16) for v in views}
            theirs = _score(scorer, command, folder, _saved(ids, truth / kind))
            yield ours, abs(result.scores[ours] - theirs[name])
    points = predicted.with_suffix(".npz")
    if points.is_file():
        truth.mkdir(parents=True, exist_ok=True)
        np.savez(truth / "points.npz", semantic=np.load(points)["truth"])
        theirs = _score(scorer, "points", points, truth / "points.npz")
        yield "miou of points", abs(result.scores["miou"] - theirs["mIoU"])


def _saved(images: dict[str, np.ndarray], folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in images.items():
        Image.fromarray(image).save(folder / f"{name}.png")
    return folder


def _score(scorer: Path, command: str, predicted: Path, truth: Path) -> dict[str, Any]:
    words = [sys.executable, str(scorer), command, "--pred", str(predicted), "--truth", str(truth)]
    done = subprocess.run(words, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


if __name__ == "__main__":
    main()
