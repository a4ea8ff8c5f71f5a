"""Peak memory, time and size on disk of `splatseg see`, each model in a process of its own.

    python benchmarks/see_models.py                          every model, 100 images of 256x192
    python benchmarks/see_models.py --models sam2-video dino --images 20

Weights are the tiny ones of the tests (`tests/support/checkpoints.py`), so times say what `see`
itself takes, and how it grows with the images, not what a network takes. Each model looks first at
a tenth of the images and then at all: what the second run needs more memory than the first is what
grows with their number. The scene is generated: a red, a green and a blue box that drift over a
textured ground, with masks of them as the seeds of trackers.

A model that is not in `RUNS` is named below the table. A row for it says its name, the kind of
checkpoint that it takes, and what else it is to be told; `{KIND}` in a flag stands for the folder
of another checkpoint.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch

from splatseg.core import Camera, Gaussians, MaskSet, Scene, View
from splatseg.io.evidence import create_evidence, save_masks
from splatseg.io.images import save_png
from splatseg.io.scene import save_scene
from splatseg.models import model_names

ROOT = Path(__file__).resolve().parent.parent
WIDTH, HEIGHT = 256, 192
SEEDS = "seeds"
COLUMNS = ("model", "what", "images", "s", "s CPU", "s/image", "peak MB", "peak MB of a tenth",
           "evidence MB", "or why not")  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """A model, and how it is asked."""

    model: str
    kind: str = ""
    """Of the tiny checkpoint; empty where the model has no weights."""

    flags: tuple[str, ...] = ()


_GRID = ("--points-per-side", "8")
_WORDS = ("--words", "wall", "box")
_LOOSE = ("--box-threshold", "0", "--text-threshold", "0")
_FOLLOWED = ("--seeds", SEEDS)
RUNS = (
    Run(model="classical"),
    Run(model="hed", kind="hed"),
    Run(model="sam", kind="sam", flags=_GRID),
    Run(model="sam-hq", kind="sam_hq", flags=_GRID),
    Run(model="sam2", kind="sam2", flags=_GRID),
    Run(model="sam3", kind="sam3_whole", flags=_GRID),
    Run(model="sam2-video", kind="sam2_video", flags=_FOLLOWED),
    Run(model="sam3-video", kind="sam3_whole", flags=_FOLLOWED),
    Run(model="dino", kind="dino"),
    Run(model="dinov2", kind="dinov2"),
    Run(model="dinov3", kind="dinov3"),
    Run(model="clip", kind="clip", flags=_WORDS),
    Run(model="siglip2", kind="siglip2", flags=_WORDS),
    Run(model="lseg", kind="lseg", flags=("--size", "256")),
    Run(model="clipseg", kind="clipseg", flags=_WORDS),
    Run(
        model="langsam",
        kind="grounding_dino",
        flags=(*_WORDS, *_LOOSE, "--sam-model", "sam2", "--sam-weights", "{sam2}"),
    ),
    Run(model="sam3-text", kind="sam3", flags=(*_WORDS, "--threshold", "0")),
    Run(model="mask2former", kind="mask2former"),
    Run(model="maskformer", kind="maskformer"),
    Run(model="oneformer", kind="oneformer"),
    Run(model="eomt", kind="eomt"),
    Run(model="segformer", kind="segformer"),
    Run(model="dpt-semantic", kind="dpt_semantic"),
    Run(model="depth-anything", kind="depth_anything"),
    Run(model="dpt", kind="dpt"),
)


class Checkpoints(dict[str, Path]):
    """Folders of tiny checkpoints by kind, written when first asked for."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder

    def __missing__(self, kind: str) -> Path:
        """The folder of a kind."""
        sys.path.insert(0, str(ROOT / "tests"))
        from support.checkpoints import saved
        from support.checkpoints_labels import save_tokenizer

        self[kind] = saved(kind, self._folder)
        if kind == "oneformer":
            save_tokenizer(self[kind])
        return self[kind]


def photograph(index: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """A picture, and a mask of each box."""
    rng = np.random.default_rng(index)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    picture = (110 + 30 * np.sin(x / 9) * np.cos(y / 7))[..., None].repeat(3, 2)
    masks = np.zeros((3, HEIGHT, WIDTH), bool)
    along = index / max(1, count - 1)
    for box, (side, top) in enumerate(((40, 20), (56, 70), (30, 140))):
        left = int((WIDTH - side) * (along if box % 2 else 1 - along))
        masks[box, top : top + side, left : left + side] = True
        picture[masks[box]] = np.eye(3)[box] * 180 + 30
    return np.clip(picture + rng.normal(0, 4, picture.shape), 0, 255).astype(np.uint8), masks


def write_scene(folder: Path, count: int) -> Path:
    """A scene of a few Gaussians with photographs, and masks for the trackers."""
    (folder / "images").mkdir(parents=True)
    views: list[View] = []
    masks: list[MaskSet] = []
    for i in range(count):
        picture, dense = photograph(i, count)
        path = folder / "images" / f"{i:04d}.png"
        save_png(torch.from_numpy(picture), path)
        masks.append(MaskSet.from_dense(torch.from_numpy(dense)))
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = -0.01 * i
        camera = Camera(
            width=WIDTH, height=HEIGHT, fx=200.0, fy=200.0, cx=WIDTH / 2, cy=HEIGHT / 2,
            cam_from_world=pose,
        )  # fmt: skip
        views.append(View(name=path.stem, camera=camera, image=path, split="train"))
    n = 100
    generator = torch.Generator().manual_seed(0)
    gaussians = Gaussians(
        means=torch.rand(n, 3, generator=generator) + torch.tensor([-0.5, -0.5, 2.0]),
        rotations=torch.tensor([1.0, 0, 0, 0]).expand(n, 4).contiguous(),
        scales=torch.full((n, 3), 0.05),
        opacities=torch.full((n,), 0.9),
        sh=torch.zeros(n, 1, 3),
    )
    save_scene(Scene(gaussians=gaussians, views=tuple(views)), folder / "scene")
    (folder / "scene" / "evidence").mkdir(exist_ok=True)
    seeds = create_evidence(folder / "scene" / "evidence" / SEEDS, kind="masks")
    for view, one in zip(views, masks, strict=True):
        save_masks(one, seeds, view.name)
    return folder / "scene"


def command(words: list[str], figures: Path) -> int:
    """Run a command in this process, and write down what it took."""
    from splatseg.cli import main as splatseg

    started = time.perf_counter()
    status = splatseg(words)
    used = resource.getrusage(resource.RUSAGE_SELF)
    peak = used.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    own = Path("/proc/self/status")
    if own.is_file():  # what getrusage says here counts the process that started this one
        lines = own.read_text().splitlines()
        peak = 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    told = {
        "peak": peak / 1e6,
        "wall": time.perf_counter() - started,
        "cpu": used.ru_utime + used.ru_stime,
    }
    figures.write_text(json.dumps(told))
    return status


def megabytes(folder: Path) -> str:
    """Size of all files in a folder; nothing where there is none."""
    if not folder.is_dir():
        return ""
    return f"{sum(p.stat().st_size for p in folder.rglob('*') if p.is_file()) / 1e6:.2f}"


def measured(run: Run, work: Path, scene: Path, checkpoints: Checkpoints, count: int) -> list[str]:
    """The row of a model."""
    few = [f"{i:04d}" for i in range(max(1, count // 10))]
    peaks: list[float] = []
    took: dict[str, float] = {}
    row = [run.model, "", str(count)]
    for name, views in (("few", few), ("all", ["train"])):
        figures = work / f"{run.model}-{name}.json"
        words = [sys.executable, __file__, "--command", str(figures), "see", str(scene),
                 "--model", run.model, "--evidence", f"{run.model}-{name}", "--json",
                 "--views", *views]  # fmt: skip
        words += [flag.format_map(checkpoints) for flag in run.flags]
        if run.kind:
            words += ["--weights", str(checkpoints[run.kind]), "--device", "cpu"]
        output = work / f"{run.model}-{name}.txt"
        with output.open("w") as file:
            status = subprocess.run(words, stdout=file, stderr=subprocess.STDOUT).returncode
        if status:
            return [*row, *[""] * (len(COLUMNS) - 4), output.read_text().strip().splitlines()[-1]]
        took = json.loads(figures.read_text())
        peaks.append(took["peak"])
    told = json.loads(output.read_text().strip().splitlines()[-1])
    row[1] = told["kind"]
    row += [f"{took['wall']:.1f}", f"{took['cpu']:.1f}", f"{told['seconds'] / count:.3f}",
            f"{peaks[1]:.0f}", f"{peaks[0]:.0f}", megabytes(Path(told["evidence"])),
            ""]  # fmt: skip
    return row


def about() -> str:
    """The machine, the versions and the commit."""
    said = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True
    )
    commit = said.stdout.strip() or "none"
    names = ", ".join(f"{name} {version(name)}" for name in ("torch", "transformers"))
    threads = os.environ.get("OMP_NUM_THREADS", "all")
    return (
        f"{platform.machine()}, {os.cpu_count()} cores, OMP_NUM_THREADS {threads}; "
        f"Python {platform.python_version()}, {names}; commit {commit}; images {WIDTH}x{HEIGHT}"
    )


def main() -> None:
    """Print a table in Markdown."""
    if sys.argv[1:2] == ["--command"]:
        sys.exit(command(sys.argv[3:], Path(sys.argv[2])))
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=100, help="photographs of the scene")
    parser.add_argument("--models", nargs="*", help="names of rows; all without it")
    arguments = parser.parse_args()
    runs = [run for run in RUNS if not arguments.models or run.model in arguments.models]
    print(about(), end="\n\n")
    print(f"| {' | '.join(COLUMNS)} |")
    print(f"| {' | '.join('---' for _ in COLUMNS)} |", flush=True)
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        scene = write_scene(work / "capture", arguments.images)
        checkpoints = Checkpoints(work / "checkpoints")
        for run in runs:
            row = measured(run, work, scene, checkpoints, arguments.images)
            print(f"| {' | '.join(row)} |", flush=True)
    without = [name for name in model_names() if name not in {run.model for run in RUNS}]
    print(f"\nModels without a row: {', '.join(without) or 'none'}")


if __name__ == "__main__":
    main()
