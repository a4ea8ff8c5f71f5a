"""What removing a thing leaves of it, and what it does to the rest of the image.

    splatseg fit ../shared/data/toys -o SCENE
    python benchmarks/removal.py SCENE ../shared/data/toys [--split each|off]

A layer `things` that SCENE holds is taken as it is, made for instance by ``splatseg segment SCENE
--method uplift --evidence instance --layer things``.

Things are selected by lifting the truth masks of the training views (`uplift`) and removed, one
after the other, each from the whole scene. Gaussians that straddle a boundary are split before:
`each` at the thing's own masks as `splatseg edit --remove` does it, three passes a thing, with
`--refit` as well; `off` nowhere.

- left: the blending weight W'm of the thing's training masks m that falls on Gaussians which are
  not removed, as a share of all of it. Pixels at the border of a mask show both sides, in the
  photographs as well: a scene drawn perfectly, with square pixels, leaves an eighth of a pixel
  for each pixel of a mask's outline, which is given as `perfect`. So the share is also counted
  on pixels that lie more than one, and more than two, pixels inside.
- outside: mean PSNR against the photographs over the test views that show the thing, of the
  pixels outside its true mask, before and after.
- split: PSNR between images before and after the splits, with nothing removed.
"""

import argparse
import json
import math
import statistics
import time
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from splatseg.core import Gaussians, LabelMap, Labels, Scene, Selection, View
from splatseg.edit import CutBy, Document, Operation, load_document, prepare, remove
from splatseg.evaluate import psnr, render_and_photograph
from splatseg.io.evidence import Evidence, open_evidence
from splatseg.lift import CutOptions, GaussianField, UpliftOptions, uplift
from splatseg.render import back_project
from splatseg.selection import Where

LAYER, FOLDER = "things", "instance"
DEPTHS = (0, 1, 2)
"""How many pixels inside a mask a pixel must lie to count."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Removed:
    """Figures of one thing."""

    id: int
    name: str
    pixels: int
    """Pixels of its masks in all training views."""

    left: tuple[float, ...]
    """Share of its mass that is left, in percent, for each of `DEPTHS`."""

    perfect: float
    before: float
    after: float
    split: float | None

    def line(self) -> str:
        left = " ".join(f"{share:6.2f}" for share in self.left)
        drawn = "" if self.split is None else f", split {self.split:.1f} dB"
        return (
            f"{self.id:3d} {self.pixels:7d} px, left {left} % (perfect {self.perfect:.2f}), "
            f"outside {self.before:.2f} -> {self.after:.2f} dB "
            f"({self.after - self.before:+.3f}){drawn}; {self.name[:48]}"
        )


def inner(mask: Tensor, pixels: int) -> Tensor:
    """Pixels of masks (height, width, n) that lie more than so many pixels inside."""
    outside = (~mask).float().permute(2, 0, 1)
    for _ in range(pixels):
        outside = torch.nn.functional.max_pool2d(outside, 3, stride=1, padding=1)
    return outside.permute(1, 2, 0) == 0


def outline(mask: Tensor) -> float:
    """Length of a mask's outline, pixels: sides of pixels, times pi / 4 as they turn any way."""
    sides = (mask[1:] != mask[:-1]).sum() + (mask[:, 1:] != mask[:, :-1]).sum()
    return float(sides) * math.pi / 4


class Masses:
    """Adds up over views how much of each thing's masks falls on Gaussians, and how much stays."""

    def __init__(self, things: Sequence[int]) -> None:
        self.things = tuple(things)
        self.whole = {thing: [0.0] * len(DEPTHS) for thing in things}
        self.stays = {thing: [0.0] * len(DEPTHS) for thing in things}
        self.pixels = dict.fromkeys(things, 0)
        self.outlines = dict.fromkeys(things, 0.0)

    def add(self, gaussians: Gaussians, view: View, label_map: LabelMap, gone: dict[int, Tensor]):
        """Count one view; `gone` says which Gaussians each thing's removal takes."""
        shown = set(torch.unique(label_map.ids).tolist())
        here = [thing for thing in self.things if thing in shown]
        if not here:
            return
        masks = label_map.ids[..., None] == torch.tensor(here)
        image = torch.cat([inner(masks, pixels) for pixels in DEPTHS], dim=-1).float()
        sums = back_project(gaussians, view.camera, image).sums.double()
        for column, thing in enumerate(here):
            self.pixels[thing] += int(masks[..., column].sum())
            self.outlines[thing] += outline(masks[..., column])
            for depth in range(len(DEPTHS)):
                own = sums[:, depth * len(here) + column]
                self.whole[thing][depth] += float(own.sum())
                self.stays[thing][depth] += float(own[~gone[thing]].sum())

    def left(self, thing: int) -> tuple[float, ...]:
        pairs = zip(self.stays[thing], self.whole[thing], strict=True)
        return tuple(100 * stays / whole if whole else math.nan for stays, whole in pairs)

    def perfect(self, thing: int) -> float:
        return 100 * self.outlines[thing] / 8 / max(1, self.pixels[thing])


class Pictures:
    """Images of the scene before, and scores outside things."""

    def __init__(self, scene: Scene, truth: Evidence, thin: int) -> None:
        self.views = scene.test_views[::thin]
        self.masks = {view.name: truth.label_map(view.name).ids for view in self.views}
        self.before = {
            view.name: render_and_photograph(GaussianField(scene.gaussians), view)
            for view in self.views
        }

    def outside(self, thing: int, after: Gaussians) -> tuple[float, float]:
        """Mean PSNR before and after; NaN where no test view shows the thing."""
        scores: list[tuple[float, float]] = []
        for view in self.views:
            mask = self.masks[view.name] == thing
            if bool(mask.any()):
                drawn, photograph = self.before[view.name]
                now, _ = render_and_photograph(GaussianField(after), view)
                pair = psnr(drawn, photograph, ~mask), psnr(now, photograph, ~mask)
                scores.append(pair)
        if not scores:
            return math.nan, math.nan
        first, second = zip(*scores, strict=True)
        return statistics.fmean(first), statistics.fmean(second)

    def apart(self, after: Gaussians) -> float:
        """PSNR between images before and after, all pixels of the test views pooled."""
        errors = []
        for view in self.views:
            now, _ = render_and_photograph(GaussianField(after), view)
            drawn = self.before[view.name][0]
            errors.append(float(((now.double() - drawn.double()) / 255).square().mean()))
        return -10 * math.log10(max(statistics.fmean(errors), 1e-12))


def things_of(data: Path, present: Container[int]) -> dict[int, str]:
    """Names of those ids that are of things."""
    table = json.loads((data / "metadata.json").read_text())
    return {
        row["id"]: row["name"]
        for row in table["instances"]
        if row["isthing"] and row["id"] in present
    }


def lifted(scene: Scene, truth: Evidence) -> Labels:
    """The layer of things, with the candidates that a cut at all boundaries needs."""
    labels = uplift(scene.gaussians, scene.train_views, truth, options=UpliftOptions(candidates=4))
    return replace(labels, info=replace(labels.info, evidence=FOLDER))


def together(document: Document, things: dict[int, str], truth: Evidence, thin: int):
    """All things of one scene as it is."""
    scene, labels = document.scene, document.layers[LAYER]
    pictures = Pictures(scene, truth, thin)
    gaussians = scene.gaussians
    gone = {thing: labels.ids == thing for thing in things}
    masses = Masses(tuple(things))
    for view in scene.train_views[::thin]:
        masses.add(gaussians, view, truth.label_map(view.name), gone)
    for thing, name in things.items():
        after = remove(gaussians, Selection(mask=gone[thing])).gaussians
        yield figures(thing, name, masses, pictures.outside(thing, after), None)


def one_by_one(
    document: Document,
    things: dict[int, str],
    truth: Evidence,
    cut: CutOptions,
    thin: int,
    refit: int,
):
    """Each thing as the command edit does it."""
    scene = document.scene
    pictures = Pictures(scene, truth, thin)
    names = tuple(view.name for view in scene.train_views)
    for thing, name in things.items():
        operation = Operation(
            kind="remove",
            where=Where(layer=LAYER, ids=(thing,)),
            cut=CutBy(by="masks", evidence=FOLDER, views=names, options=cut),
            refit=refit or None,
        )
        ready = prepare(document, operation)
        gaussians, chosen = ready.document.scene.gaussians, ready.selection
        masses = Masses((thing,))
        for view in scene.train_views[::thin]:
            masses.add(gaussians, view, truth.label_map(view.name), {thing: chosen.mask})
        after = remove(gaussians, chosen).gaussians
        scores = pictures.outside(thing, after)
        yield figures(thing, name, masses, scores, pictures.apart(gaussians))


def figures(
    thing: int, name: str, masses: Masses, scores: tuple[float, float], split: float | None
) -> Removed:
    return Removed(
        id=thing,
        name=name,
        pixels=masses.pixels[thing],
        left=masses.left(thing),
        perfect=masses.perfect(thing),
        before=scores[0],
        after=scores[1],
        split=split,
    )


def summary(found: list[Removed]) -> str:
    """Median and worst of everything, over all things and over those of many pixels."""
    lines: list[str] = []
    for what, part in (
        ("all", found),
        ("1000 px or more", [one for one in found if one.pixels >= 1000]),
    ):
        if not part:
            continue
        words = [f"{what} ({len(part)} things):"]
        for depth, pixels in enumerate(DEPTHS):
            shares = [one.left[depth] for one in part if not math.isnan(one.left[depth])] or [
                math.nan
            ]
            words.append(
                f"left more than {pixels} px inside: median {statistics.median(shares):.2f} %, "
                f"worst {max(shares):.2f} %;"
            )
        words.append(f"perfect {statistics.median(one.perfect for one in part):.2f} %;")
        change = [one.after - one.before for one in part if not math.isnan(one.after)]
        words.append(
            "outside: no test view shows any"
            if not change
            else f"outside: median {statistics.median(change):+.3f} dB, worst {min(change):+.3f}, "
            f"best {max(change):+.3f} ({len(change)} shown in test views);"
        )
        drawn = [one.split for one in part if one.split is not None]
        if drawn:
            words.append(f"split: median {statistics.median(drawn):.1f} dB, worst {min(drawn):.1f}")
        lines.append(" ".join(words))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--split", choices=("each", "off"), default="each")
    parser.add_argument("--every", type=int, default=1, help="only every n-th thing")
    parser.add_argument("--ids", type=int, nargs="+", help="only these things")
    parser.add_argument(
        "--thin", type=int, default=1, help="measure in every n-th view only; cuts use all"
    )
    parser.add_argument("--keep-share", type=float, default=CutOptions().keep_share)
    parser.add_argument("--min-side", type=float, default=CutOptions().min_side)
    parser.add_argument("--refit", type=int, default=0, help="steps, with --split each")
    args = parser.parse_args()
    started = time.perf_counter()
    document = load_document(args.scene, data=args.data)
    truth = open_evidence(args.data / FOLDER)
    labels = document.layers.get(LAYER)
    if not isinstance(labels, Labels):
        labels = lifted(document.scene, truth)
    document = Document(scene=document.scene, layers={LAYER: labels})
    things = dict(list(things_of(args.data, set(labels.present.tolist())).items())[:: args.every])
    if args.ids:
        things = {thing: name for thing, name in things.items() if thing in args.ids}
    cut = CutOptions(keep_share=args.keep_share, min_side=args.min_side)
    if args.split == "each":
        removed = one_by_one(document, things, truth, cut, args.thin, args.refit)
    else:
        removed = together(document, things, truth, args.thin)
    found: list[Removed] = []
    for one in removed:
        if not one.pixels:
            print(f"{one.id:3d} not seen in the views that are counted; left out")
            continue
        found.append(one)
        print(one.line(), flush=True)
    print(summary(found))
    print(f"{time.perf_counter() - started:.0f} s")


if __name__ == "__main__":
    main()
