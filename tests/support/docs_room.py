"""A tiny room with the things that the pages of docs speak of, and photographs of it.

A mug left of a laptop and a lamp on a desk, two chairs, books on the upper shelf, a window, a plant
in a pot: the phrases of the pages mean something in it, so that they need no other words here.
"""

import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from splatseg.core import ClassInfo, ClassTable, View
from splatseg.synthetic import SyntheticScene, Texture, look_at, render_truth, write_capture
from splatseg.synthetic.builder import Builder, shades
from splatseg.synthetic.solids import TextureName, Vector
from support import recorded

WIDTH, HEIGHT = 64, 48
"""Of the capture."""

VIEWS = (
    "train_0000", "left", "test_0003", "front", "train_0010", "test_0008", "train_0012", "right",
)  # fmt: skip
"""From left to right, under names that the pages have."""

_PHOTOGRAPHS = 8
_PHOTOGRAPH_WIDTH, _PHOTOGRAPH_HEIGHT = 96, 72
"""Of photographs without cameras: with so many pixels structure from motion places all of them."""

_LATER = 2

_HALF_X, _DEPTH, _HEIGHT = 2.6, 5.6, 2.5
_BACK = 2.0
_NAMES = (
    "wall", "floor", "ceiling", "window", "desk", "table", "chair", "sofa", "lamp", "mug",
    "laptop", "shelf", "book", "plant",
)  # fmt: skip
_STUFF = 3
_UPRIGHT = math.pi / 2
_WOOD: Vector = (0.42, 0.28, 0.16)

CLASSES = ClassTable(
    rows=tuple(
        ClassInfo(
            id=i + 1,
            name=name,
            isthing=i >= _STUFF,
            colour=(37 * i % 256, (91 * i + 40) % 256, (151 * i + 90) % 256),
        )
        for i, name in enumerate(_NAMES)
    )
)
"""Walls, floor and ceiling are objects 1 to 3, as `recorded` expects it."""


def documented_room() -> SyntheticScene:
    """The room."""
    b = Builder(rng=np.random.default_rng(0), classes=CLASSES)
    _shell(b)
    _desk(b)
    _chair(b, "red chair", at=(-1.7, -0.2, 0.0), colour=(0.80, 0.15, 0.12))
    _chair(b, "brown chair", at=(1.3, 0.9, 0.0), colour=(0.45, 0.27, 0.12))
    _shelf(b)
    _table(b)
    return SyntheticScene(
        name="room",
        seed=0,
        primitives=tuple(b.primitives),
        objects=tuple(b.objects),
        classes=CLASSES,
        related_classes=(("chair", "sofa"), ("desk", "table"), ("lamp", "plant")),
        bounds=((-_HALF_X, _BACK - _DEPTH, 0.0), (_HALF_X, _BACK, _HEIGHT)),
        sun=(0.2, -1.0, 0.6),
    )


def room_views(
    names: Sequence[str], *, width: int = WIDTH, height: int = HEIGHT, raised: float = 0.0
) -> tuple[View, ...]:
    """Views on an arc before the room that all look at its middle, neighbours at other heights."""
    views = []
    for i, name in enumerate(names):
        angle = math.radians(-28 + 56 * i / (len(names) - 1))
        eye = (4 * math.sin(angle), 0.8 - 4 * math.cos(angle), 1.3 + 0.35 * (i % 3) + raised)
        camera = look_at(eye, (0.0, 0.8, 0.75), width=width, height=height, field_of_view=68.0)
        split = "test" if name.startswith("test") else "train"
        views.append(View(name=name, camera=camera, split=split))
    return tuple(views)


def write_room_capture(folder: Path) -> None:
    """The capture, with evidence of every kind as other programs leave it."""
    scene = documented_room()
    views = room_views(VIEWS)
    truths = write_capture(scene, folder, views=views, points=1500)
    seen = {}
    for view in views:
        if view.split == "train":
            instance = truths[view.name].instance.clamp_min(0).numpy()
            semantic = truths[view.name].semantic.clamp_min(0).numpy()
            seen[view.name] = recorded.Seen(
                semantic=semantic, instance=instance, part=_halves(instance)
            )
    recorded.write_all(folder, scene, seen, text_stride=4)
    shutil.copytree(folder / "labels_semantic", folder / "labels_semantic_hard")
    # Of so few views none lacks a mask, and no group of things has one.
    shutil.rmtree(folder / "masks_sam")
    alone = replace(scene, objects=tuple(replace(one, parent=None) for one in scene.objects))
    recorded.write_nested_masks(folder / "masks_sam", alone, seen)


def _halves(instance: np.ndarray) -> np.ndarray:
    """Of object i the part 2 i - 1 above its middle, and 2 i below."""
    rows = np.broadcast_to(np.arange(len(instance))[:, None], instance.shape)
    parts = np.zeros_like(instance)
    for i in np.unique(instance[instance > 0]):
        own = instance == i
        parts[own] = 2 * i - (rows[own] < rows[own].mean())
    return parts


def write_photographs(folder: Path) -> None:
    """Photographs without cameras, from left to right."""
    names = [f"photo_{i:04d}" for i in range(_PHOTOGRAPHS)]
    _photograph(room_views(names, width=_PHOTOGRAPH_WIDTH, height=_PHOTOGRAPH_HEIGHT), folder)


def write_later_photographs(folder: Path) -> None:
    """Further photographs with the camera of the capture, from a little higher up."""
    _photograph(room_views([f"later_{i:04d}" for i in range(_LATER)], raised=0.2), folder)


def _photograph(views: Sequence[View], folder: Path) -> None:
    folder.mkdir()
    scene = documented_room()
    for view in views:
        image = render_truth(scene, view.camera).image.numpy()
        Image.fromarray(image).save(folder / f"{view.name}.jpg", quality=95)


def _texture(colour: Vector, kind: TextureName = "checker", scale: float = 0.3) -> Texture:
    return Texture(kind=kind, palette=shades(colour), scale=scale)


def _shell(b: Builder) -> None:
    """Walls on three sides, floor, ceiling and a window in the back."""
    middle, half = _BACK - _DEPTH / 2, _HEIGHT / 2
    b.object("wall", "walls")
    back = _texture((0.70, 0.65, 0.60), "dots", 0.4)
    b.solid("plane", (0.0, _BACK, half), (_HALF_X, half, 1.0), back, tilt=_UPRIGHT)
    for side, colour in ((-1.0, (0.60, 0.70, 0.65)), (1.0, (0.65, 0.60, 0.70))):
        b.solid(
            "plane", (side * _HALF_X, middle, half), (_DEPTH / 2, half, 1.0),
            _texture(colour, "stripes", 0.4), yaw=-side * _UPRIGHT, tilt=_UPRIGHT,
        )  # fmt: skip
    b.object("floor", "floor")
    planks = _texture((0.5, 0.4, 0.3), "planks")
    b.solid("plane", (0.0, middle, 0.0), (_HALF_X, _DEPTH / 2, 1.0), planks)
    b.object("ceiling", "ceiling")
    plaster = _texture((0.80, 0.80, 0.75), "checker", 0.8)
    b.solid("plane", (0.0, middle, _HEIGHT), (_HALF_X, _DEPTH / 2, 1.0), plaster)
    b.object("window", "window", at=(1.2, _BACK - 0.03, 1.7), parent=1)
    b.solid("box", (0.0, 0.0, 0.0), (0.6, 0.03, 0.45), _texture((0.5, 0.7, 0.95), "sky", 0.5))


def _desk(b: Builder) -> None:
    """A desk with a red mug, a laptop and a lamp, from left to right, large for so few pixels."""
    wood = _texture(_WOOD, "wood", 0.2)
    desk = b.object("desk", "desk", at=(-0.3, 1.2, 0.0), parent=2)
    b.solid("box", (0.0, 0.0, 0.65), (1.2, 0.45, 0.05), wood)
    b.legs(1.1, 0.35, 0.6, 0.07, wood)
    b.object("mug", "red mug", at=(-1.1, 1.1, 0.7), parent=desk)
    red = Texture(palette=((0.75, 0.05, 0.05),) * 3, glow=1.0)
    b.solid("cylinder", (0.0, 0.0, 0.36), (0.35, 0.35, 0.36), red)
    b.object("laptop", "laptop", at=(-0.25, 1.2, 0.7), parent=desk)
    b.solid("box", (0.0, 0.0, 0.03), (0.36, 0.25, 0.03), _texture((0.20, 0.20, 0.22)))
    b.solid("box", (0.0, 0.25, 0.30), (0.36, 0.03, 0.30), _texture((0.30, 0.35, 0.50)))
    b.object("lamp", "desk lamp", at=(0.6, 1.2, 0.7), parent=desk)
    b.solid("cylinder", (0.0, 0.0, 0.2), (0.07, 0.07, 0.2), _texture((0.3, 0.3, 0.3)))
    shade = _texture((0.95, 0.85, 0.40), "stripes", 0.15)
    b.solid("cylinder", (0.0, 0.0, 0.6), (0.36, 0.36, 0.25), shade, taper=0.7)


def _chair(b: Builder, name: str, *, at: Vector, colour: Vector) -> None:
    b.object("chair", name, at=at, parent=2)
    plain = _texture(colour, "plain")
    b.solid("box", (0.0, 0.0, 0.40), (0.30, 0.30, 0.06), plain)
    b.solid("box", (0.0, 0.27, 0.80), (0.30, 0.05, 0.35), plain)
    b.legs(0.25, 0.25, 0.36, 0.06, plain)


def _shelf(b: Builder) -> None:
    """A shelf at the right wall with two books on the upper board."""
    wood = _texture((0.55, 0.45, 0.30), "wood", 0.2)
    shelf = b.object("shelf", "shelf", at=(2.25, 0.1, 0.0), parent=2)
    for z in (0.05, 0.75, 1.40):
        b.solid("box", (0.0, 0.0, z), (0.22, 0.60, 0.05), wood)
    for y in (-0.6, 0.6):
        b.solid("box", (0.0, y, 0.72), (0.22, 0.04, 0.70), wood)
    blue, green = (0.2, 0.3, 0.8), (0.2, 0.6, 0.3)
    for name, y, colour in (("blue book", -0.35, blue), ("green book", 0.3, green)):
        b.object("book", name, at=(2.2, y, 1.45), parent=shelf)
        b.solid("box", (0.0, 0.0, 0.17), (0.18, 0.17, 0.17), _texture(colour, "plain"))


def _table(b: Builder) -> None:
    """A round table with a plant in a pot."""
    wood = _texture((0.75, 0.60, 0.40), "wood", 0.2)
    table = b.object("table", "round table", at=(0.2, -0.2, 0.0), parent=2)
    b.solid("cylinder", (0.0, 0.0, 0.40), (0.55, 0.55, 0.05), wood)
    b.solid("cylinder", (0.0, 0.0, 0.18), (0.10, 0.10, 0.18), wood)
    b.object("plant", "plant in a pot", at=(0.2, -0.2, 0.45), parent=table)
    b.solid("cylinder", (0.0, 0.0, 0.1), (0.15, 0.15, 0.1), _texture((0.70, 0.40, 0.25)))
    leaves = _texture((0.2, 0.6, 0.2), "dots", 0.1)
    b.solid("sphere", (0.0, 0.0, 0.4), (0.25, 0.25, 0.22), leaves)
