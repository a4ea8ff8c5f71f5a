"""A scene with exact truth, as the rendered scenes and `synthetic.write_capture` have it.

images/ depth/ semantic/ instance/   a file a view, ids of 0 are none
transforms.json metadata.json        cameras, and what ids are called
surface_points.npz                   labelled points, where there are any
"""

import json
import os
import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from splatseg.core import Capture, View
from splatseg.io.captures import read_capture

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Thing:
    """One object that can be asked for."""

    id: int
    name: str


@dataclass(frozen=True)
class Source:
    """A scene to convert."""

    folder: Path

    @cached_property
    def capture(self) -> Capture:
        return read_capture(self.folder, format="nerfstudio")

    @cached_property
    def metadata(self) -> dict[str, Any]:
        return json.loads((self.folder / "metadata.json").read_text(encoding="utf-8"))

    @property
    def name(self) -> str:
        return self.folder.resolve().name

    @property
    def views(self) -> tuple[View, ...]:
        """The views to fit to and those held out; others (test_novel) are left out."""
        return (*self.capture.train_views, *self.capture.test_views)

    def ids(self, kind: str, view: View) -> NDArray[np.int32]:
        """True ids of a view: ``instance``, ``semantic`` or ``part``."""
        with Image.open(self.folder / kind / f"{view.name}.png") as image:
            return np.asarray(image).astype(np.int32)

    def mask(self, thing: Thing, view: View) -> Mask:
        return self.ids("instance", view) == thing.id

    @cached_property
    def _pixels(self) -> dict[str, dict[int, tuple[int, bool]]]:
        """By view and instance: its pixels, and whether it lies inside the image."""
        found = {}
        for view in self.views:
            ids = self.ids("instance", view)
            edge = set(np.concatenate((ids[0], ids[-1], ids[:, 0], ids[:, -1])).tolist())
            present, counts = np.unique(ids, return_counts=True)
            found[view.name] = {
                int(i): (int(n), int(i) not in edge)
                for i, n in zip(present, counts, strict=True)
                if i > 0
            }
        return found

    def pixels(self, thing: Thing, view: View, *, whole: bool = False) -> int:
        """Pixels that show a thing; 0 where it touches the border and `whole` is asked for."""
        count, inside = self._pixels[view.name].get(thing.id, (0, False))
        return count if inside or not whole else 0

    @cached_property
    def things(self) -> tuple[Thing, ...]:
        """Objects whose name tells them from all others, and from stuff."""
        stuff = {row["id"] for row in self.metadata["classes"] if not row.get("isthing", True)}
        rows = self.metadata["instances"]
        names = {row["name"] for row in rows}
        return tuple(
            Thing(id=row["id"], name=row["name"])
            for row in rows
            if row.get("class_id", row.get("class")) not in stuff
            and not row["name"].endswith(")")
            and f"{row['name']} (2)" not in names
        )

    def clear_things(self, views: tuple[View, ...], *, views_least: int, most: int) -> list[Thing]:
        """Things that are clearly seen in these views: those in most of them, the largest first."""
        size = self.views[0].camera.width * self.views[0].camera.height
        seen = {
            thing: sum(0.004 * size <= self.pixels(thing, view) <= 0.3 * size for view in views)
            for thing in self.things
        }
        clear = [thing for thing, count in seen.items() if count >= views_least]
        clear.sort(
            key=lambda thing: (-seen[thing], -sum(self.pixels(thing, view) for view in views))
        )
        return clear[:most]


def read_source(folder: Path) -> Source:
    """A scene to convert; it must have truth.

    Raises:
        FileNotFoundError: If it lacks a file.
    """
    for name in ("transforms.json", "metadata.json", "instance", "semantic"):
        if not (folder / name).exists():
            raise FileNotFoundError(f"{folder / name}: a scene to convert needs it")
    return Source(folder=folder)


def link(source: Path, target: Path) -> None:
    """The same file at another place: a hard link, or a copy where disks differ."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def save_mask(mask: Mask, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(path)


def spread(items: tuple[View, ...], count: int) -> tuple[View, ...]:
    """So many of them, evenly, the first among them."""
    step = max(1, len(items) // count)
    return items[::step][:count]
