"""A generated building fitted as a whole and in blocks: PSNR, instances, and pictures of seams.

    python benchmarks/blocks.py --work /tmp/building [--rooms 12] [--views 600] [--width 320]
        [--blocks auto] [--steps 12000] [--max-gaussians 500000] [--seed 0]

The capture is written to WORK/capture once; one view in eight is held out. Both fits are those of
`splatseg fit DATA --steps N --max-gaussians G --seed S`, the second with `--blocks B`. Rows:

- PSNR of held-out views (`score.py image` agrees to rounding); of those of their pixels whose true
  surface is within 15 cm of a border of two cells, and of all others.
- instances: true maps through `uplift`; and as segments whose ids are each view's own and of
  which 8 of 100 are missing, through `associate`. Scored by the independent scorer (`labels.py`).

WORK/seams/VIEW.png has the held-out views that show most on both sides of a border: photograph,
whole, blocks, and four times their difference. The border's overlap is brighter in the photograph.
"""

import argparse
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from labels import Bench
from PIL import Image
from torch import Tensor

from splatseg.core import InstanceTree, LabelMap, View
from splatseg.core.partition import Cells
from splatseg.evaluate import render_and_photograph
from splatseg.fit import FitOptions
from splatseg.io.captures import read_capture
from splatseg.io.evidence import Evidence
from splatseg.io.scene import load_scene
from splatseg.lift import GaussianField, complete, uplift
from splatseg.methods.associate import associate
from splatseg.synthetic import building, cameras, write_capture
from splatseg.tasks import MakeSceneOptions, fit_capture

_SEAM = 0.3
_SHOWN = 8
_MISSING = 0.08


def write(folder: Path, *, rooms: int, views: int, width: int, seed: int) -> None:
    """The capture, unless it is there."""
    if folder.is_dir():
        return
    scene = building(seed, rooms=rooms)
    test = views // 8
    seen = cameras(scene, train=views - test, test=test, width=width, height=width * 3 // 4)
    begin = time.monotonic()
    write_capture(scene, folder, views=seen, points=2000 * rooms, seed=seed)
    print(f"capture of {rooms} rooms, {views} views: {time.monotonic() - begin:.0f} s", flush=True)


def fit(data: Path, folder: Path, options: FitOptions, blocks: int | str) -> Cells | None:
    """Fit, unless it is there; gives the cells of blocks."""
    if not (folder / "scene.json").is_file():
        made = fit_capture(
            data, folder, options=MakeSceneOptions(blocks=blocks, resume=True), fit_options=options
        )
        told = "" if made.blocks is None else "; " + " ".join(made.result.notes)
        print(
            f"{folder.name}: {len(made.result.gaussians)} Gaussians, {made.result.steps} steps, "
            f"{made.result.seconds:.0f} s{told}",
            flush=True,
        )
    record = load_scene(folder).provenance.get("blocks")
    if record is None:
        return None
    low, high = (
        torch.tensor([[end if v is None else v for v in row] for row in record[name]]).double()
        for name, end in (("low", -math.inf), ("high", math.inf))
    )
    axes = torch.tensor(record["axes"]).double()
    return Cells(axes=axes, low=low, high=high, overlap=record["overlap"])


def surface(data: Path, view: View) -> tuple[Tensor, Tensor]:
    """Rows and columns of every second pixel, and the true points there."""
    depth = torch.from_numpy(np.array(Image.open(data / "depth" / f"{view.name}.png"))) * 0.001
    at = (depth > 0).nonzero()
    pixels = 2.0 * at.flip(-1).double() + 0.5
    return 2 * at, view.camera.unproject(pixels, depth[at[:, 0], at[:, 1]].double())


def seams(data: Path, cells: Cells, fields: Mapping[str, GaussianField], out: Path) -> None:
    """PSNR near to borders and away from them, and pictures of views across them."""
    out.mkdir(parents=True, exist_ok=True)
    narrow = replace(cells, overlap=_SEAM)
    views = read_capture(data).test_views
    errors: dict[tuple[str, str], list[Tensor]] = {}
    ranked: list[tuple[float, str]] = []
    for view in views:
        at, points = surface(data, view)
        regions = narrow.regions(points).sum(dim=0) > 1
        of_cell = torch.bincount(cells.cell_of(points), minlength=len(cells)).double()
        second = float((of_cell / of_cell.sum()).sort(descending=True).values[1])
        ranked.append((second, view.name))
        for name, field in fields.items():
            drawn, photograph = _images(field, view)
            squared = ((drawn - photograph) ** 2).mean(dim=-1)
            errors.setdefault((name, "all pixels"), []).append(squared.reshape(-1))
            squared = squared[at[:, 0], at[:, 1]]
            errors.setdefault((name, "near to borders"), []).append(squared[regions])
            errors.setdefault((name, "away from them"), []).append(squared[~regions])
    for (name, where), parts in errors.items():
        if where == "all pixels":
            value = np.mean([-10 * math.log10(float(part.mean())) for part in parts])
            print(f"{name}: PSNR {value:.2f} dB, mean of {len(views)} held-out views")
        elif sum(map(len, parts)):
            value = -10 * math.log10(float(torch.cat(parts).mean()))
            print(f"{name}: {value:.2f} dB of {sum(map(len, parts))} pixels {where}", flush=True)
    by_name = {view.name: view for view in views}
    for _, name in sorted(ranked, reverse=True)[:_SHOWN]:
        _picture(data, by_name[name], narrow, fields).save(out / f"{name}.png")


def _images(field: GaussianField, view: View) -> tuple[Tensor, Tensor]:
    """The render and the photograph, in [0, 1]."""
    drawn, photograph = render_and_photograph(field, view)
    return drawn.float() / 255, photograph.float() / 255


def _picture(
    data: Path, view: View, cells: Cells, fields: Mapping[str, GaussianField]
) -> Image.Image:
    drawn = [_images(field, view) for field in fields.values()]
    marked = drawn[0][1].clone()
    at, points = surface(data, view)
    at = at[cells.regions(points).sum(dim=0) > 1]
    marked[at[:, 0], at[:, 1]] = 0.5 + 0.5 * marked[at[:, 0], at[:, 1]]
    shown = [marked, *(image for image, _ in drawn)]
    shown.append((0.5 + 4 * (drawn[0][0] - drawn[1][0])).clamp(0, 1))
    row = torch.cat([image.clamp(0, 1) for image in shown], dim=1)
    return Image.fromarray((255 * row).round().to(torch.uint8).numpy())


class Unlinked:
    """True instances as segments of each view's own; a `core.SegmentSource`."""

    overlapping, persistent = False, False

    def __init__(self, found: Evidence, names: Sequence[str]) -> None:
        self._found, self.view_names = found, names

    def segments_of(self, name: str) -> LabelMap:
        """A map with other ids, and some of the segments."""
        ids = self._found.label_map(name).ids
        rng = np.random.default_rng([self.view_names.index(name), 17])
        present = ids[ids >= 0].unique()
        new = torch.from_numpy(rng.permutation(len(present)) + 1).int()
        new[torch.from_numpy(rng.random(len(present)) < _MISSING)] = -1
        table = torch.full((int(ids.max()) + 2,), -1, dtype=torch.int32)
        table[present.long()] = new
        return LabelMap(ids=table[ids.long()])

    def categories_of(self, name: str) -> Mapping[int, int]:
        """None is known."""
        return {}


def instances(data: Path, folder: Path, work: Path) -> None:
    """Instances of one fit."""
    bench = Bench(load_scene(folder), data, work / f"maps_{folder.name}")
    gaussians, found = bench.scene.gaussians, bench.evidence("instance")
    segments = Unlinked(found, [view.name for view in bench.train])

    def associated() -> object:
        made = associate(gaussians, bench.train, segments)
        layer = made.cut() if isinstance(made, InstanceTree) else made
        return complete(gaussians, layer)

    bench.row(
        f"{folder.name}: true instances, uplift",
        "instance",
        lambda: complete(gaussians, uplift(gaussians, bench.train, found)),
    )
    bench.row(f"{folder.name}: own ids, associate", "instance", associated)


def main() -> None:
    """Both fits, and what they are worth."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--rooms", type=int, default=12)
    parser.add_argument("--views", type=int, default=600)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--blocks", default="auto")
    parser.add_argument("--steps", type=int, default=12000)
    parser.add_argument("--max-gaussians", type=int, default=500_000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    args.work.mkdir(exist_ok=True)
    data = args.work / "capture"
    write(data, rooms=args.rooms, views=args.views, width=args.width, seed=args.seed)
    options = FitOptions.preset("default").with_length(steps=args.steps)
    options = replace(options, max_gaussians=args.max_gaussians, seed=args.seed)
    folders = {name: args.work / name for name in ("whole", "blocks")}
    fit(data, folders["whole"], options, "off")
    asked = args.blocks if args.blocks == "auto" else int(args.blocks)
    cells = fit(data, folders["blocks"], options, asked)
    if cells is not None:
        fields = {name: GaussianField(load_scene(path).gaussians) for name, path in folders.items()}
        seams(data, cells, fields, args.work / "seams")
    for folder in folders.values():
        instances(data, folder, args.work)


if __name__ == "__main__":
    main()
