"""Do labels find their Gaussians again after another program had the splats?

    npm install --prefix FOLDER @playcanvas/splat-transform
    python benchmarks/round_trips.py SCENE --tool FOLDER/node_modules/.bin/splat-transform

SCENE is fitted and has a layer of labels (``--layer NAME``). Each case takes its Gaussians
without any column of labels through PlayCanvas's splat-transform, or through a simulated editor,
and then through ``splatseg attach SCENE edited -o labelled.ply --layer NAME``. Printed for each:

- ``share``: Gaussians that survived;
- ``labels``: share of the survivors that have the label they had;
- ``rows``: share of the survivors that were taken for the very Gaussian they are, whatever the
  layer, so that finely divided layers are served as well;
- ``seconds`` that attach took, reading and writing included.

Who a survivor truly is does not come from geometry. The simulated editor knows it. splat-transform
keeps columns of PLY files that it does not know, so the same actions on a file with the column
``row`` say which rows survive and in which order. PLY, SPZ and glTF keep that order; compressed
PLY and SOG are in the order of ``--morton-order``, which is applied to the other file as well.
``off`` is how far the survivors' centres are from those of the rows they are said to be, once the
similarity that fits best is undone (glTF has its own axes): the 99.9th percentile in thousandths
of the scene's extent. Were an order wrong, it would be hundreds.
Exit status 1 where less than 99 % of the survivors keep their label.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from splatseg.core import Gaussians, Labels, Similarity
from splatseg.core.rigid import normalised, rotation_from_quaternion
from splatseg.io.scene import load_scene, load_scene_layer, save_scene_layer
from splatseg.io.splats import read_splats, write_splats

_FLOOR = 0.99
_ROW = "row"


@dataclass(frozen=True)
class Edited:
    """What a program wrote, and the source rows of its Gaussians."""

    path: Path
    truth: torch.Tensor
    off: float = float("nan")


@dataclass(frozen=True)
class Bench:
    """The scene under test."""

    root: Path
    layer: str
    labels: Labels
    gaussians: Gaussians
    folder: Path
    tool: Path | None
    strangers: Gaussians = field(repr=False)


def crop_of(bench: Bench) -> tuple[list[float], list[float]]:
    """A box around the middle of the scene, which keeps about half of it."""
    low = bench.gaussians.means.double().quantile(0.1, dim=0)
    high = bench.gaussians.means.double().quantile(0.9, dim=0)
    return low.tolist(), high.tolist()


# --- splat-transform ------------------------------------------------------------------------


def transformed(bench: Bench, name: str, actions: list[str], flags: list[str]) -> Edited:
    """The scene after `actions`, written as `name`, with the rows that the tool itself tells."""
    out = bench.folder / name
    sorts = name.endswith((".compressed.ply", ".sog"))
    source = "plain.ply"
    if sorts and actions:  # else the order would be that of the places before a move
        source = "acted.ply"
        _tool(bench, bench.folder / "plain.ply", *actions, bench.folder / source)
    _tool(bench, bench.folder / source, *([] if sorts else actions), out, *flags)
    rows = bench.folder / "rows.ply"
    _tool(bench, bench.folder / "tagged.ply", *actions, rows)
    if sorts:
        _tool(bench, rows, "-M", bench.folder / "sorted.ply")
        rows = bench.folder / "sorted.ply"
    tagged, got = read_splats(rows), read_splats(out)
    if len(got) != len(tagged):
        raise SystemExit(f"{name}: {len(got)} Gaussians, but {len(tagged)} by the tagged file")
    return Edited(
        path=out,
        truth=tagged.extra[_ROW].long().reshape(-1),
        off=1000 * _off(got.means.double(), tagged.means.double()) / extent(tagged),
    )


def _off(got: torch.Tensor, want: torch.Tensor) -> float:
    """99.9th percentile of the distances after the best similarity (Umeyama 1991)."""
    a, b = want - want.mean(dim=0), got - got.mean(dim=0)
    u, values, vt = torch.linalg.svd(b.T @ a)
    sign = torch.ones(3, dtype=torch.float64)
    sign[2] = torch.linalg.det(u @ vt).sign()
    rotation = (u * sign) @ vt
    scale = (values * sign).sum() / a.square().sum()
    distance = (b / scale - a @ rotation.T).norm(dim=1)
    return float(distance.quantile(0.999))


def extent(gaussians: Gaussians) -> float:
    """Width of the middle 98 % along the widest axis."""
    sample = gaussians.means[:: max(1, len(gaussians) // 100_000)].double()
    return float((sample.quantile(0.99, dim=0) - sample.quantile(0.01, dim=0)).max())


def _tool(bench: Bench, *words: object) -> None:
    command = [str(bench.tool), "-q", "-w", "-g", "cpu", *(str(word) for word in words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: {done.stderr[-500:]}")


def tool_cases(bench: Bench) -> dict[str, Callable[[], Edited]]:
    """Conversions, filters, moves, and all of them."""
    low, high = crop_of(bench)
    # Its box is in its own axes, which have x and y the other way round.
    corners = (-high[0], -high[1], low[2], -low[0], -low[1], high[2])
    box = ["-B", ",".join(f"{v:.4f}" for v in corners)]
    move = ["-r", "20,130,-50", "-t", "3,-7,2", "-s", "2.5"]
    every = [*box, "-V", "opacity,gt,0.1", *move]
    cases: dict[str, tuple[str, list[str], list[str]]] = {
        "ply": ("a.ply", [], []),
        "compressed ply": ("a.compressed.ply", [], []),
        "spz 4": ("a.spz", [], []),
        "spz 3": ("a.spz", [], ["--spz-version", "3"]),
        "glb": ("a.glb", [], []),
        # Its palette of harmonics takes half an hour on a CPU.
        "sog, no harmonics": ("a.sog", ["-H", "0"], []),
        "ply, box": ("a.ply", box, []),
        "ply, opacity over 0.1": ("a.ply", ["-V", "opacity,gt,0.1"], []),
        "ply, Morton order, no harmonics": ("a.ply", ["-M", "-H", "0"], []),
        "ply, moved": ("a.ply", move, []),
        "compressed ply, moved": ("a.compressed.ply", move, []),
        "spz, moved": ("a.spz", move, []),
        "ply, all of these": ("a.ply", [*every, "-M"], []),
        "compressed ply, all": ("a.compressed.ply", every, []),
        "spz, all": ("a.spz", [*every, "-M"], []),
        "sog, all": ("a.sog", [*every, "-H", "0"], []),
    }
    return {name: lambda case=case: transformed(bench, *case) for name, case in cases.items()}


# --- a simulated editor ----------------------------------------------------------------------


def simulated(bench: Bench, *steps: str, name: str = "b.ply", seed: int = 0) -> Edited:
    """An editor's steps, one after the other, on Gaussians without columns or comments."""
    rng = np.random.default_rng(seed)
    g = bench.gaussians.replace(extra={}, antialiased=False, low_pass=0.3)
    truth = torch.arange(len(g))
    for step in steps:
        n = len(g)
        if step == "crop":
            low, high = (torch.tensor(v) for v in crop_of(bench))
            keep = ((g.means >= low) & (g.means <= high)).all(dim=1).nonzero().squeeze(1)
        elif step == "thin":
            keep = torch.from_numpy(np.sort(rng.permutation(n)[: n // 2]))
        elif step == "shuffle":
            keep = torch.from_numpy(rng.permutation(n))
        else:
            keep = torch.arange(n)
        g, truth = g[keep], truth[keep]
        if step == "move":
            g = g.transformed(_move(rng))
        elif step == "part":
            g = _part_moved(g, rng)
        elif step == "halves":
            g = _halves(g)
        elif step == "bytes":
            g = _bytes(g)
        elif step == "tint":
            g = g.replace(sh=g.sh * torch.tensor([1.1, 1.0, 0.8]) + 0.05)
        elif step == "copy":
            picked = _ball(g)
            g = Gaussians.concatenate([g, g[picked].transformed(_move(rng))])
            truth = torch.cat((truth, truth[picked]))
        elif step == "merge":
            g = Gaussians.concatenate([g, bench.strangers])
            truth = torch.cat((truth, torch.full((len(bench.strangers),), -1)))
    path = bench.folder / name
    write_splats(g, path)
    return Edited(path=path, truth=truth)


def _move(rng: np.random.Generator) -> Similarity:
    return Similarity(
        rotation=rotation_from_quaternion(torch.from_numpy(rng.normal(0, 1, 4))),
        translation=torch.from_numpy(rng.normal(0, 5, 3)),
        scale=float(np.exp(rng.uniform(-1, 1))),
    )


def _ball(g: Gaussians) -> torch.Tensor:
    """The twentieth of the Gaussians that is nearest to one of them, as a thing would be."""
    distance = (g.means - g.means[len(g) // 3]).norm(dim=1)
    return distance.argsort()[: len(g) // 20].sort().values


def _part_moved(g: Gaussians, rng: np.random.Generator) -> Gaussians:
    picked = _ball(g)
    moved = g[picked].transformed(_move(rng))
    means, rotations, scales, sh = (
        column.clone() for column in (g.means, g.rotations, g.scales, g.sh)
    )
    means[picked], rotations[picked] = moved.means, moved.rotations
    scales[picked], sh[picked] = moved.scales, moved.sh
    return g.replace(means=means, rotations=rotations, scales=scales, sh=sh)


def _halves(g: Gaussians) -> Gaussians:
    """Float16 for everything, logs of scales included."""

    def half(values: torch.Tensor) -> torch.Tensor:
        return values.half().float()

    return g.replace(
        means=half(g.means),
        rotations=normalised(half(g.rotations)),
        scales=half(g.scales.clamp(min=1e-12).log()).exp(),
        opacities=half(g.opacities),
        sh=half(g.sh),
    )


def _bytes(g: Gaussians) -> Gaussians:
    """16 bits a coordinate over the box of all; a byte for everything else, no harmonics."""
    low, high = g.means.amin(dim=0), g.means.amax(dim=0)
    step = (high - low) / 65535
    logs = g.scales.clamp(min=float(np.exp(-10.0))).log()
    return g.replace(
        means=low + ((g.means - low) / step).round() * step,
        rotations=normalised((g.rotations * 127).round() / 127),
        scales=((logs * 16).round() / 16).exp(),
        opacities=(g.opacities * 255).round() / 255,
        sh=(g.sh[:, :1] * 64).round() / 64,
    )


def editor_cases(bench: Bench) -> dict[str, Callable[[], Edited]]:
    """Each step alone, and several."""
    cases = {
        "drops columns": (),
        "crops": ("crop",),
        "reorders": ("shuffle",),
        "crops, reorders": ("crop", "shuffle"),
        "leaves out every other": ("thin",),
        "moves": ("move",),
        "moves a part": ("part",),
        "copies a part elsewhere": ("copy",),
        "merges with another scene": ("merge", "shuffle"),
        "rounds to float16": ("halves",),
        "rounds to 16 and 8 bits": ("bytes",),
        "tints": ("tint",),
        "crops, reorders, moves, float16": ("crop", "shuffle", "move", "halves"),
        "crops, reorders, moves, 16 and 8 bits": ("crop", "shuffle", "move", "bytes"),
        "thins, tints, moves, 16 and 8 bits": ("thin", "shuffle", "tint", "move", "bytes"),
    }
    return {name: lambda steps=steps: simulated(bench, *steps) for name, steps in cases.items()}


# --- attach -----------------------------------------------------------------------------------


def scored(bench: Bench, edited: Edited) -> tuple[float, float, float, float, float]:
    """Shares of right labels, right rows, strangers without label, survivors; seconds."""
    out = bench.folder / "attached.ply"
    command = [sys.executable, "-m", "splatseg", "attach", str(bench.root), str(edited.path)]
    options = ["--layer", bench.layer, "--instances", _ROW, "-o", str(out), "--min-found", "0"]
    begun = time.perf_counter()
    done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - begun
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: {done.stderr}")
    back = read_splats(out)
    ids, rows = (back.extra[name].long().reshape(-1) for name in ("class_id", "instance_id"))
    ours = edited.truth >= 0
    truth = edited.truth[ours]
    want = bench.labels.ids.long()[truth].clamp(min=0)
    label = float((ids[ours] == want).double().mean())
    row = float((rows[ours] == truth + 1).double().mean())
    blank = float((rows[~ours] == 0).double().mean()) if bool((~ours).any()) else float("nan")
    return label, row, blank, len(truth.unique()) / len(bench.gaussians), seconds


def main() -> None:
    """Print a line a case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--layer", default="labels_semantic")
    parser.add_argument("--strangers", type=Path, help="a scene to merge with")
    parser.add_argument("--tool", type=Path, help="splat-transform; without it, the editor alone")
    parser.add_argument("--only", default="", help="names of cases begin so")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        bench = prepared(arguments, folder)
        cases = {f"editor: {k}": v for k, v in editor_cases(bench).items()}
        if bench.tool is not None:
            cases |= {f"splat-transform: {k}": v for k, v in tool_cases(bench).items()}
        if arguments.strangers is None:
            del cases["editor: merges with another scene"]
        print(f"{len(bench.gaussians)} Gaussians, {len(bench.labels.present)} labels")
        print("| case | share | labels | rows | off | seconds |\n|---|---|---|---|---|---|")
        least = 1.0
        for name, case in cases.items():
            if not name.startswith(arguments.only):
                continue
            edited = case()
            label, row, blank, share, seconds = scored(bench, edited)
            off = "" if np.isnan(edited.off) else f"{edited.off:.3f}"
            note = "" if np.isnan(blank) else f" ({100 * blank:.2f} % of strangers without label)"
            print(
                f"| {name}{note} | {100 * share:.1f} % | {100 * label:.3f} % | {100 * row:.3f} % | "
                f"{off} | {seconds:.1f} |",
                flush=True,
            )
            least = min(least, label)
    print(f"least share of survivors that keep their label: {100 * least:.3f} %")
    sys.exit(least < _FLOOR)


def prepared(arguments: argparse.Namespace, folder: Path) -> Bench:
    """A copy of the scene with one more layer, the number of each row, and files of it."""
    scene = load_scene(arguments.scene)
    labels = load_scene_layer(arguments.scene, arguments.layer)
    if not isinstance(labels, Labels):
        raise SystemExit(f"{arguments.layer}: expected a layer of labels")
    root = folder / "scene"
    root.mkdir()
    for name in ("scene.json", "gaussians.ply", "cameras"):
        (root / name).symlink_to((arguments.scene / name).resolve())
    (root / "layers").mkdir()
    (root / "layers" / f"{arguments.layer}.npz").symlink_to(
        (arguments.scene / "layers" / f"{arguments.layer}.npz").resolve()
    )
    n = len(scene.gaussians)
    numbered = Labels(ids=torch.arange(1, n + 1, dtype=torch.int32), confidence=torch.ones(n))
    save_scene_layer(numbered, root, _ROW)
    bare = scene.gaussians.replace(extra={}, antialiased=False, low_pass=0.3)
    write_splats(bare, folder / "plain.ply")
    tagged = bare.replace(extra={_ROW: torch.arange(n, dtype=torch.int32)})
    write_splats(tagged, folder / "tagged.ply")
    strangers = bare[:0]
    if arguments.strangers is not None:
        strangers = load_scene(arguments.strangers).gaussians
        strangers = strangers.replace(extra={}, antialiased=False, low_pass=0.3)
    return Bench(
        root=root,
        layer=arguments.layer,
        labels=labels,
        gaussians=scene.gaussians,
        folder=folder,
        tool=arguments.tool,
        strangers=strangers,
    )


if __name__ == "__main__":
    main()
