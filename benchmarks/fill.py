"""What a removal shows where a thing was, against the generated room without the thing.

    python benchmarks/fill.py write ROOM CAPTURE
    splatseg fit CAPTURE -o SCENE --minutes 3 --max-gaussians 120000 --seed 1
    python benchmarks/fill.py measure ROOM CAPTURE SCENE [--ids 9 21] [--pictures FOLDER]

ROOM is the seed of `synthetic.room`. Things are selected by lifting the true instance maps of the
training views (`uplift`) and removed as `splatseg edit --remove --cut off` does it, with and
without `--fill`. The truth is the room rendered without the thing, in the test views that show most
of it.

- PSNR and SSIM: of the thing's own pixels (its true mask in the room with it); SSIM is the mean of
  its map over them. `hidden` counts only pixels whose truth no training view saw: the point behind
  lies behind the thing, or another surface, in all of them.
- apart: consistency between views. Points of the true surface behind the thing are looked up in
  every two of these views that show them; mean difference of their colour by the square root of
  two, in levels of 255, over hidden points. `truth` is that of the true pictures.
- front: debris. Share of the light of the thing's pixels that comes from Gaussians more than 5 cm
  in front of what is truly there.
- shadows that the thing cast stay in the scene and are not in the truth.
"""

import argparse
import math
import statistics
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from skimage.metrics import structural_similarity
from torch import Tensor

from splatseg.core import Camera, Gaussians, View
from splatseg.edit import Document, Operation, apply, load_document
from splatseg.edit.document import FillBy
from splatseg.io.evidence import open_evidence
from splatseg.lift import uplift
from splatseg.render import back_project, render
from splatseg.selection import Where
from splatseg.synthetic import SyntheticScene, Truth, cameras, render_truth, room, write_capture

VIEWS, FRONT, SAME = 4, 0.05, 0.05
"""Test views of a thing, and distances in metres."""


@dataclass(frozen=True)
class Behind:
    """A test view of a thing, and what is truly behind it."""

    view: View
    mask: Tensor
    truth: Truth
    hidden: Tensor
    """Pixels of the mask whose truth no training view saw."""


def write(seed: int, folder: Path) -> None:
    scene = room(seed)
    views = cameras(scene, train=48, test=12, width=320, height=240)
    write_capture(scene, folder, views=views, seed=seed)


def without(scene: SyntheticScene, thing: int) -> SyntheticScene:
    kept = tuple(p for p in scene.primitives if p.instance != thing)
    return replace(scene, primitives=kept)


def cropped(camera: Camera, mask: Tensor) -> tuple[Camera, slice, slice]:
    """The part of a camera's image that a mask needs."""
    rows, columns = torch.nonzero(mask.any(1))[:, 0], torch.nonzero(mask.any(0))[:, 0]
    top, left = int(rows[0]), int(columns[0])
    height, width = int(rows[-1]) + 1 - top, int(columns[-1]) + 1 - left
    part = replace(camera, width=width, height=height, cx=camera.cx - left, cy=camera.cy - top)
    return part, slice(top, top + height), slice(left, left + width)


def behind(scene, thing, views, truth, train, depths) -> list[Behind]:
    """The test views that show most of a thing."""
    masks = {view.name: truth.label_map(view.name).ids == thing for view in views}
    order = sorted(views, key=lambda view: (-int(masks[view.name].sum()), view.name))[:VIEWS]
    found = []
    for view in order:
        mask = masks[view.name]
        if int(mask.sum()) < 64:
            continue
        part, rows, columns = cropped(view.camera, mask)
        true = render_truth(without(scene, thing), part)
        small = mask[rows, columns]
        points = part.unproject(part.pixel_centres().double()[small], true.depth.double()[small])
        hidden = torch.zeros_like(small)
        hidden[small] = ~seen(points, train, depths)
        found.append(Behind(replace(view, camera=part), small, true, hidden))
    return found


def seen(points: Tensor, views: list[View], depths: dict[str, Tensor]) -> Tensor:
    """Which points a training view saw."""
    found = torch.zeros(len(points), dtype=torch.bool)
    for view in views:
        at, depth = view.camera.project(points)
        column, row = at[:, 0].floor().long(), at[:, 1].floor().long()
        good = (depth > 0) & (column >= 0) & (column < view.camera.width)
        good &= (row >= 0) & (row < view.camera.height)
        there = depths[view.name][row[good], column[good]].double()
        found[good] |= (there - depth[good]).abs() < SAME
    return found


def scores(image: Tensor, one: Behind, pixels: Tensor) -> tuple[float, float]:
    """Squared error and SSIM over some pixels."""
    true = one.truth.image.double() / 255
    error = float(((image.double() - true) ** 2)[pixels].mean())
    side = min(7, *(n if n % 2 else n - 1 for n in pixels.shape))
    _, full = structural_similarity(
        image.double().numpy(),
        true.numpy(),
        channel_axis=2,
        data_range=1.0,
        full=True,
        win_size=side,
    )
    return error, float(full.mean(-1)[pixels.numpy()].mean())


def front(gaussians: Gaussians, one: Behind) -> float:
    """Share of the light of the thing's pixels from in front of the truth, percent."""
    camera = one.view.camera
    means = gaussians.means.double()
    _, z = camera.project(means)
    at, _ = camera.project(means)
    column = at[:, 0].floor().long().clamp(0, camera.width - 1)
    row = at[:, 1].floor().long().clamp(0, camera.height - 1)
    nearer = z < one.truth.depth.double()[row, column] - FRONT
    sums = back_project(gaussians, camera, one.mask.float()[..., None]).sums[:, 0].double()
    return 100 * float(sums[nearer].sum()) / float(one.mask.sum())


def apart(images: list[Tensor], found: list[Behind]) -> float:
    """Mean deviation of the colour of a point between views, levels of 255; NaN without any."""
    values = []
    for first, one in enumerate(found):
        camera = one.view.camera
        points = camera.unproject(
            camera.pixel_centres().double()[one.hidden], one.truth.depth.double()[one.hidden]
        )
        for image, other in zip(images[first + 1 :], found[first + 1 :], strict=True):
            at, depth = other.view.camera.project(points)
            column, row = at[:, 0].floor().long(), at[:, 1].floor().long()
            good = (depth > 0) & (column >= 0) & (column < other.view.camera.width)
            good &= (row >= 0) & (row < other.view.camera.height)
            row, column = row[good], column[good]
            same = (other.truth.depth.double()[row, column] - depth[good]).abs() < 0.02
            same &= other.mask[row, column]
            if bool(same.any()):
                here = images[first][one.hidden][good][same]
                there = image[row[same], column[same]]
                values.append((here - there).abs().mean(1) / math.sqrt(2))
    return 255 * float(torch.cat(values).mean()) if values else math.nan


def decibel(error: float) -> float:
    return -10 * math.log10(max(error, 1e-10))


def measure(arguments: argparse.Namespace) -> None:
    scene = room(arguments.room)
    document = load_document(arguments.scene, data=arguments.capture)
    truth = open_evidence(arguments.capture / "instance")
    train, test = list(document.scene.train_views), list(document.scene.test_views)
    depths = {}
    for view in train:
        raw = torch.from_numpy(
            np.array(Image.open(arguments.capture / "depth" / f"{view.name}.png")).astype("f4")
        )
        full = raw.repeat_interleave(2, 0).repeat_interleave(2, 1) / 1000
        depths[view.name] = full[: view.camera.height, : view.camera.width]
    labels = uplift(document.scene.gaussians, train, truth)
    document = Document(scene=document.scene, layers={"things": labels})
    names = tuple(view.name for view in train)
    table: dict[str, list[list[float]]] = {}
    for thing in arguments.ids or [one.id for one in scene.objects if one.id > 3]:
        found = behind(scene, thing, test, truth, train, depths)
        if not found or not bool((labels.ids == thing).any()):
            continue
        name = scene.objects[thing - 1].name
        for how in arguments.how:
            started = time.perf_counter()
            by = FillBy(views=names, inpainter=how) if how != "empty" else None
            where = Where(layer="things", ids=(thing,))
            after = apply(
                document, Operation(kind="remove", where=where, specks=30, fill=by)
            ).scene.gaussians
            seconds = time.perf_counter() - started
            images = [render(after, one.view.camera).image.clamp(0, 1) for one in found]
            every = [scores(i, one, one.mask) for i, one in zip(images, found, strict=True)]
            pairs = [(i, one) for i, one in zip(images, found, strict=True) if one.hidden.any()]
            dark = [scores(i, one, one.hidden) for i, one in pairs]
            row = [
                decibel(statistics.fmean(e for e, _ in every)),
                statistics.fmean(s for _, s in every),
                decibel(statistics.fmean(e for e, _ in dark)) if dark else math.nan,
                statistics.fmean(s for _, s in dark) if dark else math.nan,
                apart(images, found),
                statistics.fmean(front(after, one) for one in found),
            ]
            table.setdefault(how, []).append(row)
            new = len(after)
            print(
                f"{thing:3d} {how:8s} PSNR {row[0]:5.2f} SSIM {row[1]:.3f}, hidden {row[2]:5.2f} "
                f"{row[3]:.3f}, apart {row[4]:5.2f}, front {row[5]:5.2f} %; {new} Gaussians, "
                f"{seconds:.0f} s; {name}",
                flush=True,
            )
            if arguments.pictures:
                save(arguments.pictures, thing, how, images, found)
        real = [one.truth.image.double() / 255 for one in found]
        share = sum(int(one.hidden.sum()) for one in found) / sum(int(o.mask.sum()) for o in found)
        print(f"    hidden {100 * share:.0f} % of its pixels; truth apart {apart(real, found):.2f}")
    for how, rows in table.items():
        middle = [
            statistics.median([r[i] for r in rows if not math.isnan(r[i])] or [math.nan])
            for i in range(6)
        ]
        print(
            f"{how:8s} median of {len(rows)}: PSNR {middle[0]:.2f} SSIM {middle[1]:.3f}, hidden "
            f"{middle[2]:.2f} {middle[3]:.3f}, apart {middle[4]:.2f}, front {middle[5]:.2f} %"
        )


def save(folder: Path, thing: int, how: str, images: list[Tensor], found: list[Behind]) -> None:
    """Each view of the thing: how it is now, and the truth."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, (image, one) in enumerate(zip(images, found, strict=True)):
        pair = torch.cat(((image * 255).round().to(torch.uint8), one.truth.image), dim=1)
        Image.fromarray(pair.numpy()).save(folder / f"{thing:02d}_{number}_{how}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("write", "measure"))
    parser.add_argument("room", type=int)
    parser.add_argument("capture", type=Path)
    parser.add_argument("scene", type=Path, nargs="?")
    parser.add_argument("--ids", type=int, nargs="+", help="only these things")
    parser.add_argument("--how", nargs="+", default=["empty", "opencv", "exemplar"])
    parser.add_argument("--pictures", type=Path)
    arguments = parser.parse_args()
    if arguments.what == "write":
        write(arguments.room, arguments.capture)
    else:
        measure(arguments)


if __name__ == "__main__":
    main()
