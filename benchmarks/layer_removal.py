"""What removing things by the labels of layers leaves of them, layer against layer.

    splatseg segment SCENE --method object-classes --evidence labels_tracked_hard \\
        --masks masks_sam --features features_dino --layer object-classes
    splatseg segment SCENE --method associate --evidence labels_tracked_hard --layer associate
    python benchmarks/layer_removal.py SCENE ../shared/data/office associate object-classes

Each thing of the truth is removed as a person would who clicks on it: by the one id that most
pixels of it have in the label map of the training view that shows it largest. Nothing is cut.

- left: the blending weight W'm of the thing's training masks m that falls on Gaussians which are
  not removed, as a share of all of it (`removal.Masses`); mean, median and the share of all.
- taken: the weight in pixels outside its mask of what is removed, as a share of the thing's.
- outside: mean change of PSNR against the photographs of the test views, of pixels outside the
  true mask, dB, over things that a test view shows.
"""

import argparse
import math
import statistics
from pathlib import Path

import torch
from removal import Masses, Pictures, things_of

from splatseg.core import Gaussians, InstanceTree, Labels, Selection, View
from splatseg.edit import load_document, remove
from splatseg.io.evidence import Evidence, open_evidence
from splatseg.lift import label_map
from splatseg.render import back_project


def flat(layer: object) -> Labels:
    """Labels of objects."""
    found = layer.cut("object") if isinstance(layer, InstanceTree) else layer
    if not isinstance(found, Labels):
        raise TypeError
    return found


def largest_view(views: list[View], truth: Evidence) -> dict[int, tuple[View, int]]:
    """Of each thing the view that shows most of it, and the pixels there."""
    found: dict[int, tuple[View, int]] = {}
    for view in views:
        ids, counts = torch.unique(truth.label_map(view.name).ids, return_counts=True)
        for thing, pixels in zip(ids.tolist(), counts.tolist(), strict=True):
            if thing > 0 and pixels > found.get(thing, (view, 0))[1]:
                found[thing] = (view, pixels)
    return found


def clicked(
    gaussians: Gaussians, labels: Labels, shown: dict[int, tuple[View, int]], truth: Evidence
) -> dict[int, int]:
    """The id that most pixels of each thing have where it is largest."""
    chosen: dict[int, int] = {}
    by_view: dict[str, list[int]] = {}
    views = {view.name: view for view, _ in shown.values()}
    for thing, (view, _) in shown.items():
        by_view.setdefault(view.name, []).append(thing)
    for name, things in by_view.items():
        ids = label_map(gaussians, views[name].camera, labels).ids
        true = truth.label_map(name).ids
        for thing in things:
            inside = ids[(true == thing) & (ids >= 0)]
            if len(inside):
                chosen[thing] = int(torch.bincount(inside.long()).argmax())
    return chosen


def taken(
    gaussians: Gaussians, views: list[View], truth: Evidence, gone: dict[int, torch.Tensor]
) -> dict[int, float]:
    """Weight in pixels outside its masks of what the removal of each thing takes."""
    things = list(gone)
    of = torch.stack([gone[thing] for thing in things], dim=1).double()
    total = torch.zeros(len(things), dtype=torch.float64)
    for view in views:
        ids = truth.label_map(view.name).ids
        masks = (ids[..., None] != torch.tensor(things)).float()
        sums = back_project(gaussians, view.camera, masks).sums.double()
        total += (sums * of).sum(dim=0)
    return dict(zip(things, total.tolist(), strict=True))


def main() -> None:
    """Print a line a layer."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("layers", nargs="+")
    parser.add_argument("--thin", type=int, default=4, help="measure in every n-th view")
    parser.add_argument("--pixels", type=int, default=2000, help="least of a thing in these views")
    arguments = parser.parse_args()
    document = load_document(arguments.scene, data=arguments.data)
    truth = open_evidence(arguments.data / "instance")
    gaussians, views = document.scene.gaussians, list(document.scene.train_views)
    shown = largest_view(views, truth)
    things = things_of(arguments.data, shown)
    shown = {thing: found for thing, found in shown.items() if thing in things}
    pictures = Pictures(document.scene, truth, arguments.thin)
    for layer in arguments.layers:
        labels = flat(document.layers[layer])
        chosen = clicked(gaussians, labels, shown, truth)
        gone = {thing: (labels.ids == id).cpu() for thing, id in chosen.items()}
        masses = Masses(tuple(gone))
        for view in views[:: arguments.thin]:
            masses.add(gaussians, view, truth.label_map(view.name), gone)
        counted = [thing for thing in gone if masses.pixels[thing] >= arguments.pixels]
        extra = taken(gaussians, views[:: arguments.thin], truth, {t: gone[t] for t in counted})
        left = [masses.left(thing)[0] for thing in counted]
        inside = [masses.left(thing)[1] for thing in counted]
        whole = sum(masses.whole[thing][0] for thing in counted)
        pooled = 100 * sum(masses.stays[thing][0] for thing in counted) / whole
        more = [100 * extra[thing] / masses.whole[thing][0] for thing in counted]
        changes = []
        for thing in counted:
            before, after = pictures.outside(
                thing, remove(gaussians, Selection(mask=gone[thing])).gaussians
            )
            if not math.isnan(after):
                changes.append(after - before)
        print(
            f"{layer:14s} {len(counted)} things: left mean {statistics.fmean(left):.2f} %, median "
            f"{statistics.median(left):.2f} %, of all {pooled:.2f} %, more than 1 px inside median "
            f"{statistics.median(inside):.2f} %; taken median {statistics.median(more):.2f} %, "
            f"mean {statistics.fmean(more):.2f} %; outside mean {statistics.fmean(changes):+.3f} "
            f"dB, median {statistics.median(changes):+.3f}, worst {min(changes):+.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
