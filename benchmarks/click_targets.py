"""What `benchmarks/clicks.py` clicks at: things of a scene of known truth, and where."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy.ndimage
import torch
from numpy.typing import NDArray
from PIL import Image

from splatseg.core import Gaussians, LabelMap, Scene, Selection, View
from splatseg.io.evidence import open_evidence
from splatseg.lift.field import selection_labels
from splatseg.lift.label_maps import label_map

MIN_PIXELS = 400
MIN_TEST_VIEWS = 3
RIM = 5
NOISY_CLICKS = 5

Mask = NDArray[np.bool_]
Point = tuple[float, float]
Level = Literal["instance", "part"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClickTarget:
    """A thing, and how it is shown in one train view."""

    id: int
    name: str
    view: View
    mask: Mask
    point: Point
    """The pixel of its largest region that is farthest from the rim."""

    noisy: tuple[Point, ...]
    """Pixels of it up to 5 pixels from the rim, drawn by chance."""

    @property
    def box(self) -> tuple[float, float, float, float]:
        """x0, y0, x1, y1 of the mask."""
        rows, columns = np.nonzero(self.mask)
        return (
            float(columns.min()),
            float(rows.min()),
            float(columns.max() + 1),
            float(rows.max() + 1),
        )

    @property
    def stroke(self) -> Mask:
        """Straight strokes from the middle to the farthest of the inner pixels, 3 pixels wide."""
        depth = _depth(self.mask)
        inner = np.argwhere(depth >= min(3.0, 0.5 * depth.max()))
        middle = np.array([int(self.point[1]), int(self.point[0])])
        drawn = np.zeros(self.mask.shape, bool)
        ends = [inner[np.argmax(np.abs(inner - middle).sum(axis=1))]]
        ends.append(inner[np.argmax(np.abs(inner - ends[0]).sum(axis=1))])
        for end in ends:
            steps = int(np.abs(end - middle).max()) + 1
            path = np.round(middle + np.linspace(0, 1, steps)[:, None] * (end - middle)).astype(int)
            drawn[path[:, 0], path[:, 1]] = True
        return scipy.ndimage.binary_dilation(drawn, np.ones((3, 3))) & self.mask


class Targets:
    """Things that at least three test views show, each with its click.

    Args:
        scene: The scene.
        data: Its capture, with true maps.
        seed: Draws the views.
        limit: So many things, evenly through all; None takes all.
        level: instance: whole things; part: the parts of things that have several.
    """

    def __init__(
        self,
        scene: Scene,
        data: Path,
        *,
        seed: int = 0,
        limit: int | None = None,
        level: Level = "instance",
    ) -> None:
        self._data = data
        self._scene = scene
        self._level = level
        names = _names(json.loads((data / "metadata.json").read_text()), level)
        tests = [view for view in scene.views if view.split == "test"]
        shown = np.zeros(max(names) + 1, np.int64)
        for view in tests:
            ids = np.unique(self.truth(view))
            shown[ids[ids < len(shown)]] += 1
        wanted = [id for id in sorted(names) if shown[id] >= MIN_TEST_VIEWS]
        self._areas = np.stack(
            [
                np.bincount(self.truth(view).ravel(), minlength=65536)[wanted]
                for view in scene.train_views
            ]
        )
        self._column = {id: index for index, id in enumerate(wanted)}
        rng = np.random.default_rng(seed)
        noise = np.random.default_rng((seed, 1))
        found = [self._target(id, names[id], rng, noise) for id in wanted]
        if limit is not None and limit < len(found):
            found = [found[i] for i in np.linspace(0, len(found) - 1, limit).round().astype(int)]
        self.objects: Sequence[ClickTarget] = found

    def truth(self, view: View) -> NDArray[np.int64]:
        """True ids of a view."""
        return _map(self._data / self._level / f"{view.name}.png")

    def best_views(self, id: int, count: int) -> Sequence[View]:
        """Train views that show most of a thing."""
        areas = self._areas[:, self._column[id]]
        order = np.argsort(-areas, kind="stable")[:count]
        return [self._scene.train_views[i] for i in order if areas[i] > 0]

    def largest_error(
        self, gaussians: Gaussians, selection: Selection, id: int, views: Sequence[View]
    ) -> tuple[View, Point, bool] | None:
        """Middle of the largest wrong region in some views, and whether it is the thing."""
        best, found = 0.0, None
        labels = selection_labels(selection)
        for view in views:
            drawn = label_map(gaussians, view.camera, labels).ids.numpy() == 1
            true = self.truth(view) == id
            for wrong, positive in ((true & ~drawn, True), (drawn & ~true, False)):
                regions, count = scipy.ndimage.label(wrong)
                if not count:
                    continue
                sizes = np.bincount(regions.ravel())[1:]
                if sizes.max() > best:
                    best = float(sizes.max())
                    found = view, _middle(regions == sizes.argmax() + 1), positive
        return found

    def _target(
        self, id: int, name: str, rng: np.random.Generator, noise: np.random.Generator
    ) -> ClickTarget:
        areas = self._areas[:, self._column[id]]
        enough = np.flatnonzero(areas >= MIN_PIXELS)
        index = int(rng.choice(enough)) if len(enough) else int(areas.argmax())
        view = self._scene.train_views[index]
        mask = self.truth(view) == id
        regions, _ = scipy.ndimage.label(mask)
        largest = regions == np.bincount(regions.ravel())[1:].argmax() + 1
        depth = _depth(largest)
        rim = np.argwhere(largest & (depth <= RIM))
        drawn = rim[noise.integers(len(rim), size=NOISY_CLICKS)]
        return ClickTarget(
            id=id,
            name=name,
            view=view,
            mask=mask,
            point=_middle(largest),
            noisy=tuple((float(column) + 0.5, float(row) + 0.5) for row, column in drawn),
        )


class GroupedParts:
    """Label maps of the recorded masks that are of parts, as truth tells: id + 1, all else 1.

    Args:
        evidence: Recorded masks.
        truth: What each of them is, a file a view.
    """

    def __init__(self, evidence: Path, truth: Path) -> None:
        self._masks = open_evidence(evidence)
        self._truth = truth

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have masks."""
        return self._masks.view_names

    def label_map(self, name: str) -> LabelMap:
        """Of one view; smaller masks lie over larger ones."""
        masks = self._masks.masks(name)
        said = json.loads((self._truth / f"{name}.json").read_text())
        ids = torch.ones(masks.height, masks.width, dtype=torch.int32)
        areas = [int(masks.dense(index).sum()) for index in range(len(masks))]
        for index in sorted(range(len(masks)), key=lambda index: -areas[index]):
            if said[index]["level"] == "part":
                ids[masks.dense(index)] = said[index]["part"] + 1
        return LabelMap(ids=ids)


def _names(facts: dict[str, Any], level: Level) -> dict[int, str]:
    """What things, or their parts, are called, by id."""
    things = {row["id"]: row for row in facts["instances"] if row["isthing"]}
    if level == "instance":
        return {id: row["name"] for id, row in things.items()}
    return {
        row["id"]: f"{row['name']} of {things[row['instance']]['name']}"
        for row in facts["parts"]
        if row["instance"] in things and len(things[row["instance"]]["parts"]) > 1
    }


def _middle(region: Mask) -> Point:
    row, column = np.unravel_index(int(_depth(region).argmax()), region.shape)
    return float(column) + 0.5, float(row) + 0.5


def _depth(mask: Mask) -> NDArray[np.float64]:
    """Distance to the rim; the border of the picture is one."""
    return scipy.ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]


@lru_cache(maxsize=512)
def _map(path: Path) -> NDArray[np.int64]:
    return np.asarray(Image.open(path)).astype(np.int64)


def as_mask(pixels: Mask) -> torch.Tensor:
    """As prompts want it."""
    return torch.from_numpy(np.ascontiguousarray(pixels))
