"""Selections rendered into test views, many at a time, and scored there."""

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.ndimage
import torch
from click_targets import ClickTarget, Level
from numpy.typing import NDArray
from PIL import Image

from splatseg.core import Scene, Selection
from splatseg.lift.label_maps import ViewRenderer
from splatseg.render import prepare

_CHANNELS = 32
_SCORER = Path(__file__).parents[2] / "shared" / "score" / "score.py"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scores:
    """One value a selection, as `score.py binary` has them."""

    iou: NDArray[np.float64]
    """Mean over views; a view in which neither is anything counts 1."""

    pooled: NDArray[np.float64]
    """Intersection over union of all views together."""

    accuracy: NDArray[np.float64]
    """Share of pixels that are right, mean over views."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cause:
    """Why a selection is not its thing, as far as pixels tell."""

    precision: float
    recall: float
    rim: float
    """Share of the wrong pixels that lie within 2 pixels of the true rim."""

    @staticmethod
    def of(pairs: Sequence[tuple[NDArray[np.bool_], NDArray[np.bool_]]]) -> "Cause":
        """Of masks that are selected and that are true."""
        both = sum(int((mask & true).sum()) for mask, true in pairs)
        wrong, near = 0, 0
        for mask, true in pairs:
            inner = scipy.ndimage.binary_erosion(true, iterations=2)
            band = scipy.ndimage.binary_dilation(true, iterations=2) & ~inner
            wrong += int((mask ^ true).sum())
            near += int(((mask ^ true) & band).sum())
        return Cause(
            precision=both / max(1, sum(int(mask.sum()) for mask, _ in pairs)),
            recall=both / max(1, sum(int(true.sum()) for _, true in pairs)),
            rim=near / max(1, wrong),
        )

    @property
    def words(self) -> str:
        """One of: nothing of it, rim, holds more, holds less, both."""
        if self.recall < 0.1:
            return "another thing"
        if self.rim > 0.6:
            return "only its rim"
        if self.precision < 0.8 and self.recall < 0.8:
            return "part of it, and more"
        return "more than it" if self.precision < self.recall else "part of it"


class TestViews:
    """The test views of a scene with their true instances; views stay prepared.

    Args:
        scene: The scene.
        data: Its capture.
        level: Which true maps selections are held against.
    """

    __test__ = False

    def __init__(self, scene: Scene, data: Path, *, level: Level = "instance") -> None:
        self._truth_folder = data / level
        self._views = [view for view in scene.views if view.split == "test"]
        self._prepared = [prepare(scene.gaussians, view.camera) for view in self._views]
        self._renderers = [ViewRenderer(scene.gaussians, view) for view in self._prepared]
        self._truth = [
            np.asarray(Image.open(self._truth_folder / f"{view.name}.png")).astype(np.int64)
            for view in self._views
        ]

    def masks(self, selections: Sequence[Selection]) -> list[NDArray[np.bool_]]:
        """(height, width, selections) of each view: where most of the light is selected."""
        columns = [
            one.mask.float() if one.confidence is None else one.confidence.float()
            for one in selections
        ]
        found: list[NDArray[np.bool_]] = []
        for renderer in self._renderers:
            parts = [
                (
                    renderer.scores(torch.stack(columns[i : i + _CHANNELS], 1), warp="nearest")[0]
                    > 0.5
                )
                for i in range(0, len(columns), _CHANNELS)
            ]
            found.append(torch.cat(parts, dim=2).numpy())
        return found

    def scores(self, selections: Sequence[Selection], ids: Sequence[int]) -> Scores:
        """How well selections agree with things of these ids."""
        views = len(self._views)
        both, either = np.zeros((len(ids), views)), np.zeros((len(ids), views))
        right = np.zeros((len(ids), views))
        for start in range(0, len(ids), _CHANNELS):
            part = slice(start, start + _CHANNELS)
            drawn = self.masks(selections[part])
            for place, (masks, truth) in enumerate(zip(drawn, self._truth, strict=True)):
                for index, id in enumerate(ids[part], start):
                    mask, true = masks[..., index - start], truth == id
                    both[index, place] = (mask & true).sum()
                    either[index, place] = (mask | true).sum()
                    right[index, place] = (mask == true).mean()
        by_view = np.where(either > 0, both / np.maximum(either, 1), 1.0)
        return Scores(
            iou=by_view.mean(axis=1),
            pooled=both.sum(axis=1) / np.maximum(either.sum(axis=1), 1),
            accuracy=right.mean(axis=1),
        )

    def agreement(
        self, ours: Sequence[Selection], theirs: Sequence[Selection]
    ) -> NDArray[np.float64]:
        """IoU of pairs of selections, all views together."""
        both, either = np.zeros(len(ours)), np.zeros(len(ours))
        for one, other in zip(self.masks(ours), self.masks(theirs), strict=True):
            both += (one & other).sum(axis=(0, 1))
            either += (one | other).sum(axis=(0, 1))
        return both / np.maximum(either, 1)

    def picture(self, selection: Selection, target: ClickTarget, file: Path) -> Cause:
        """Draw the test view with most errors: right green, missed blue, too much red.

        Returns:
            What went wrong, by pixels of all test views.
        """
        drawn = self.masks([selection])
        pairs = [
            (masks[..., 0], true == target.id)
            for masks, true in zip(drawn, self._truth, strict=True)
        ]
        worst = int(np.argmax([(mask ^ true).sum() for mask, true in pairs]))
        mask, true = pairs[worst]
        photograph = self._views[worst].image
        if photograph is None:
            raise SystemExit(f"{target.name}: the view has no photograph to draw on")
        with Image.open(photograph) as image:
            colours = np.asarray(image.convert("RGB").resize(mask.shape[::-1])) // 2
        for where, channel in ((mask & true, 1), (mask & ~true, 0), (true & ~mask, 2)):
            colours[where, channel] += 127
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(colours).save(file)
        return Cause.of(pairs)

    def check(
        self,
        selections: Sequence[Selection],
        targets: Sequence[ClickTarget],
        folder: Path,
        count: int,
        scores: Scores,
    ) -> None:
        """Hold the first few against the independent scorer, and say the largest difference."""
        apart = 0.0
        drawn = self.masks(selections[:count])
        for index, target in enumerate(targets[:count]):
            own = folder / str(target.id)
            own.mkdir(parents=True, exist_ok=True)
            for view, masks in zip(self._views, drawn, strict=True):
                picture = np.where(masks[..., index], 255, 0).astype(np.uint8)
                Image.fromarray(picture).save(own / f"{view.name}.png")
            words = [sys.executable, str(_SCORER), "binary", "--pred", str(own), "--truth"]
            words += [str(self._truth_folder), "--views", "test_*", "--id", str(target.id)]
            said = json.loads(subprocess.run(words, check=True, capture_output=True).stdout)
            pairs = (
                (said["IoU_mean_over_views"], scores.iou),
                (said["IoU_pooled"], scores.pooled),
                (said["accuracy"], scores.accuracy),
            )
            apart = max(apart, *(abs(float(one) - float(ours[index])) for one, ours in pairs))
        print(f"    score.py: largest difference of {min(count, len(targets))} objects {apart:.1e}")
