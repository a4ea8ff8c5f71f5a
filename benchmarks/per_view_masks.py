"""The slow way to an object that selections by a tree or by features replace (SAGA's Table 3).

As SA3D has it (Cen et al. 2023): from the clicked view to the farthest, what is selected so far is
rendered, the recorded mask that fits best is taken for the view's own answer where it fits well
enough (the stand-in for Segment Anything prompted with what was rendered), and Gaussians gain what
the view shows of them inside it and lose what it shows outside.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from click_targets import ClickTarget
from numpy.typing import NDArray

from splatseg.core import LabelMap, Scene, Selection, View
from splatseg.io.evidence import open_evidence
from splatseg.lift.label_maps import ViewRenderer
from splatseg.lift.voting.segment_masses import view_masses
from splatseg.render import prepare

_FITS = 0.5
"""IoU below which a view's mask is not taken, SA3D's threshold of rejection."""


class PerViewMasks:
    """Selects a thing by one mask a view.

    Args:
        scene: The scene.
        evidence: Recorded masks.
    """

    def __init__(self, scene: Scene, evidence: Path) -> None:
        self._scene = scene
        self._masks = open_evidence(evidence)

    def select(self, target: ClickTarget, *, known: bool = False) -> Selection:
        """By a click, or by the true mask of the clicked view.

        Args:
            target: What is looked for.
            known: Whether the mask of the first view is the true one instead of the recorded mask
                at the click that fits it best.
        """
        gaussians = self._scene.gaussians
        inside, seen = torch.zeros(len(gaussians)), torch.zeros(len(gaussians))
        first = target.mask if known else self._at_click(target)
        for view in self._ordered(target.view):
            mask = first if view is target.view else self._fitting(view, inside > 0.5 * seen)
            if mask is None:
                continue
            ids = torch.from_numpy(np.where(mask, 1, 0).astype(np.int32))
            found = view_masses(gaussians, view.camera, LabelMap(ids=ids))
            own = found.segment == 1
            inside[found.gaussian[own]] += found.weight[own]
            seen += found.visible
        return Selection(mask=(inside > 0.5 * seen) & (inside > 0))

    def _ordered(self, start: View) -> list[View]:
        """From the nearest in place and direction to the farthest."""
        pose = start.camera.world_from_cam
        reach = self._scene.gaussians.means.std(dim=0).norm()

        def apart(view: View) -> float:
            other = view.camera.world_from_cam
            turned = 1 - float(pose[:3, 2] @ other[:3, 2])
            return float((pose[:3, 3] - other[:3, 3]).norm() / reach) + turned

        return sorted(self._scene.train_views, key=apart)

    def _at_click(self, target: ClickTarget) -> NDArray[np.bool_]:
        column, row = int(target.point[0]), int(target.point[1])
        at_click = self._best(target.view, target.mask, where=lambda mask: bool(mask[row, column]))
        return target.mask if at_click is None else at_click[0]

    def _fitting(self, view: View, selected: torch.Tensor) -> NDArray[np.bool_] | None:
        """The recorded mask of a view that what is selected fits."""
        with prepare(self._scene.gaussians, view.camera) as prepared:
            renderer = ViewRenderer(self._scene.gaussians, prepared)
            drawn = renderer.scores(selected.float()[:, None])[0][..., 0] > 0.5
        best = self._best(view, drawn.numpy(), where=lambda mask: True)
        return best[0] if best is not None and best[1] > _FITS else None

    def _best(
        self, view: View, wanted: NDArray[np.bool_], *, where: Callable[[NDArray[np.bool_]], bool]
    ) -> tuple[NDArray[np.bool_], float] | None:
        masks = self._masks.masks(view.name)
        best: tuple[NDArray[np.bool_], float] | None = None
        for index in range(len(masks) if wanted.any() else 0):
            mask = masks.dense(index).numpy()
            fit = float((mask & wanted).sum() / (mask | wanted).sum())
            if where(mask) and (best is None or fit > best[1]):
                best = (mask, fit)
        return best
