"""Layouts whose prompts are words: LERF-Mask, LERF-OVS and 3D-OVS."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from splatseg.core import View
from support.benchmark_layouts.source import Mask, Source, link, save_mask, spread
from support.benchmark_layouts.sparse import write_sparse

PROMPTS = 8
TEST_VIEWS = 4
LABELLED_FRAMES = 5
_LEAST_PIXELS = 12
"""Pieces of a thing with fewer pixels nobody would outline."""


def write_lerf_mask(source: Source, folder: Path) -> None:
    """Masks of named things in four held-out views, which are all that are not trained on."""
    scene = folder / source.name
    tests = spread(source.capture.test_views, TEST_VIEWS)
    names = _photographs(source, scene, [*source.capture.train_views, *tests])
    for view in source.capture.train_views:
        link(view.image, scene / "images_train" / names[view.name])
    things = source.clear_things(tests, views_least=2, most=PROMPTS)
    for i, view in enumerate(sorted(tests, key=lambda view: names[view.name])):
        for thing in things:
            if source.pixels(thing, view):
                save_mask(
                    source.mask(thing, view), scene / "test_mask" / str(i) / f"{thing.name}.png"
                )


def write_lerf_ovs(source: Source, folder: Path) -> None:
    """Outlines of named things in five training views."""
    scene, labels = folder / source.name, folder / "label" / source.name
    names = _photographs(source, scene, source.capture.train_views)
    labels.mkdir(parents=True)
    frames = spread(source.capture.train_views, LABELLED_FRAMES)
    things = source.clear_things(frames, views_least=2, most=PROMPTS)
    for view in frames:
        objects = [
            {"category": thing.name, "group": group, **outline}
            for group, thing in enumerate(things, start=1)
            for outline in outlines(source.mask(thing, view))
        ]
        name, camera = names[view.name], view.camera
        link(view.image, labels / name)
        content = {
            "info": {
                "description": "ISAT",
                "folder": "",
                "name": name,
                "width": camera.width,
                "height": camera.height,
                "depth": 3,
                "note": "",
            },
            "objects": objects,
        }
        (labels / f"{Path(name).stem}.json").write_text(json.dumps(content, indent=1))


def write_ovs3d(source: Source, folder: Path) -> None:
    """Masks of named things in five training views, each in those that show it."""
    scene = folder / source.name
    names = _photographs(source, scene, source.capture.train_views, pattern="{:02d}.jpg", first=0)
    frames = spread(source.capture.train_views, LABELLED_FRAMES)
    things = source.clear_things(frames, views_least=2, most=PROMPTS)
    truth = scene / "segmentations"
    for view in frames:
        for thing in things:
            if source.pixels(thing, view):
                stem = Path(names[view.name]).stem
                save_mask(source.mask(thing, view), truth / stem / f"{thing.name}.png")
    (truth / "classes.txt").write_text("".join(f"{thing.name}\n" for thing in things))


def outlines(mask: Mask) -> list[dict[str, Any]]:
    """Outer outlines of the pieces of a mask; holes are lost, as in the layout."""
    found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    pieces = []
    for corners in (contour[:, 0] for contour in found):
        filled = cv2.fillPoly(np.zeros(mask.shape, np.uint8), [corners], (1,))
        if filled.sum() < _LEAST_PIXELS:
            continue
        low, high = corners.min(0), corners.max(0)
        pieces.append(
            {
                "segmentation": corners.astype(float).tolist(),
                "area": float(filled.sum()),
                "layer": 1.0,
                "bbox": [float(v) for v in (*low, *(high + 1))],
                "iscrowd": False,
                "note": "",
            }
        )
    return pieces


def _photographs(
    source: Source,
    scene: Path,
    views: Sequence[View],
    *,
    pattern: str = "frame_{:05d}.jpg",
    first: int = 1,
) -> dict[str, str]:
    """Photographs as LERF calls them, with a sparse model; names by view.

    Test views come between the others, as where a person walks once around.
    """
    ordered = sorted(views, key=lambda view: (view.name.split("_")[-1], view.name))
    names = {view.name: pattern.format(i) for i, view in enumerate(ordered, start=first)}
    for view in ordered:
        link(view.image, scene / "images" / names[view.name])
    model = [names[view.name] for view in ordered]
    write_sparse(scene / "sparse/0", ordered, model, source.capture.points)
    return names
