"""What a page knows of a scene and its document: the whole of it, and what changed."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Scene, View
from splatseg.viewer import _messages as messages
from splatseg.viewer._state import Document, Edit, Mask, Object, Suggestion

_SHARE = 90.0
"""Percentile of the distances from the centre that a radius is."""

_MAX_KEPT = 8192
_MEMBER = 128
_SAMPLE = 200_000
_HOME_WIDTH, _HOME_HEIGHT = 720, 600


@dataclass(frozen=True, slots=True)
class _Extent:
    centre: tuple[float, float, float]
    radius: float
    confidence: float


class Mirror:
    """Describes documents of one scene; what masks extend over is computed once.

    Args:
        confidence: The confidences of a mask, u8 per Gaussian.
        centres: Where the scene's Gaussians are now, (n, 3), world: the same array while nothing
            else is moved.
    """

    def __init__(
        self,
        confidence: Callable[[Mask], NDArray[np.uint8]],
        centres: Callable[[], NDArray[np.float32]],
    ) -> None:
        self._confidence = confidence
        self._centres = centres
        self._means = centres()
        self._kept: dict[str, tuple[Mask, _Extent]] = {}

    def document(self, document: Document) -> messages.DocumentInfo:
        """The whole document."""
        self._follow_moves()
        return messages.DocumentInfo(
            revision=document.revision,
            objects=[self._object(one) for one in document.objects],
            selection=self.selection(document.selection),
            suggestions=[self._suggestion(one) for one in document.suggestions],
            edits=[_edit(one) for one in document.edits],
            isolated=list(document.isolated),
        )

    def patch(
        self, old: Document, new: Document, *, undo: str | None, redo: str | None, author: str
    ) -> messages.Patch:
        """What changed from one document to another."""
        moved = self._follow_moves()
        before = {one.id: one for one in old.objects}
        after = {one.id: one for one in new.objects}
        same_order = list(before) == list(after)
        return messages.Patch(
            from_=old.revision,
            to=new.revision,
            objects=[
                self._object(one)
                for one in new.objects
                if before.get(one.id) != one or one.mask.id in moved
            ],
            gone=[id for id in before if id not in after],
            order=None if same_order else list(after),
            suggestions=(
                None
                if old.suggestions == new.suggestions
                and not any(one.mask.id in moved for one in new.suggestions)
                else [self._suggestion(one) for one in new.suggestions]
            ),
            selection=self.selection(new.selection),
            edits=None if old.edits == new.edits else [_edit(one) for one in new.edits],
            isolated=None if old.isolated == new.isolated else list(new.isolated),
            undo=undo,
            redo=redo,
            author=author,
        )

    def selection(self, mask: Mask | None) -> messages.SelectionInfo | None:
        """How much is selected; None where nothing is."""
        if mask is None:
            return None
        extent = self._extent(mask)
        return messages.SelectionInfo(
            count=mask.count,
            confidence=extent.confidence,
            centre=extent.centre,
            radius=extent.radius,
        )

    def centre(self, mask: Mask | None) -> tuple[tuple[float, float, float], float]:
        """The centre and the radius of a mask; of the scene without one."""
        self._follow_moves()
        if mask is None:
            return extent_of(self._means)
        extent = self._extent(mask)
        return extent.centre, extent.radius

    def middle(self, mask: Mask) -> tuple[float, float, float]:
        """The centre of a mask."""
        return self.centre(mask)[0]

    def _follow_moves(self) -> set[str]:
        """Forget extents of masks of which something was moved; gives their ids."""
        means = self._centres()
        if means is self._means:
            return set()
        rows = np.flatnonzero((means != self._means).any(axis=1))
        self._means = means
        moved = {
            id
            for id, (mask, _) in self._kept.items()
            if (self._confidence(mask)[rows] >= _MEMBER).any()
        }
        for id in moved:
            del self._kept[id]
        return moved

    def _object(self, one: Object) -> messages.ObjectInfo:
        extent = self._extent(one.mask)
        return messages.ObjectInfo(
            id=one.id,
            name=one.name,
            class_name=one.class_name,
            colour=one.colour,
            visible=one.visible,
            locked=one.locked,
            count=one.mask.count,
            confidence=one.confidence,
            source=one.source,
            centre=extent.centre,
            radius=extent.radius,
        )

    def _suggestion(self, one: Suggestion) -> messages.SuggestionInfo:
        extent = self._extent(one.mask)
        return messages.SuggestionInfo(
            id=one.id,
            name=one.name,
            count=one.mask.count,
            score=float(one.score),
            centre=extent.centre,
            radius=extent.radius,
        )

    def _extent(self, mask: Mask) -> _Extent:
        if mask.id not in self._kept:
            confidence = self._confidence(mask)
            rows = np.flatnonzero(confidence >= _MEMBER)
            centre, radius = extent_of(self._means[rows])
            sure = float(confidence[rows].mean()) / 255 if len(rows) else 0.0
            while len(self._kept) >= _MAX_KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[mask.id] = mask, _Extent(centre, radius, round(sure, 4))
        return self._kept[mask.id][1]


def _edit(one: Edit) -> messages.EditInfo:
    return messages.EditInfo(kind=one.kind, count=one.mask.count)


def extent_of(means: NDArray[np.float32]) -> tuple[tuple[float, float, float], float]:
    """The median of points, and how far nine of ten of them are from it, scene units."""
    if not len(means):
        return (0.0, 0.0, 0.0), 1.0
    some = means[:: max(1, len(means) // _SAMPLE)].astype(np.float64)
    centre = np.median(some, axis=0)
    away = float(np.percentile(np.linalg.norm(some - centre, axis=1), _SHARE))
    x, y, z = (round(float(value), 6) for value in centre)
    return (x, y, z), max(away, 1e-6)


def scene_info(scene: Scene, name: str) -> messages.SceneInfo:
    """What is looked at, and from where to begin."""
    solid = scene.gaussians.opacities.detach().cpu().numpy() > 0.1  # faint ones float far away
    means = scene.gaussians.means.detach().cpu().numpy()
    centre, radius = extent_of(means[solid] if solid.any() else means)
    up = scene.up or (0.0, 0.0, 1.0)
    return messages.SceneInfo(
        name=name,
        count=len(scene.gaussians),
        up=up,
        centre=centre,
        radius=radius,
        home=_home(scene, centre, radius, up),
        low_pass=scene.gaussians.low_pass,
        antialiased=scene.gaussians.antialiased,
    )


def _home(
    scene: Scene,
    centre: tuple[float, float, float],
    radius: float,
    up: tuple[float, float, float],
) -> messages.HomeInfo:
    """The camera of the first training view; without views, one from outside."""
    for view in (*scene.train_views, *scene.views)[:1]:
        camera = view.camera
        return messages.HomeInfo(
            matrix=_matrix(view), focal=camera.fx, width=camera.width, height=camera.height
        )
    down = -np.array(up) / np.linalg.norm(up)
    side = np.cross(down, np.eye(3)[int(np.abs(down).argmin())])
    side /= np.linalg.norm(side)
    forward = np.cross(side, down)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack((side, down, forward), axis=1)
    matrix[:3, 3] = np.array(centre) - 2.5 * radius * forward
    return messages.HomeInfo(
        matrix=[float(v) for v in matrix.ravel()],
        focal=0.9 * _HOME_WIDTH,
        width=_HOME_WIDTH,
        height=_HOME_HEIGHT,
    )


def view_infos(scene: Scene) -> list[messages.ViewInfo]:
    """The views of the scene."""
    return [
        messages.ViewInfo(
            name=view.name,
            matrix=_matrix(view),
            width=view.camera.width,
            height=view.camera.height,
            fx=view.camera.fx,
            fy=view.camera.fy,
            cx=view.camera.cx,
            cy=view.camera.cy,
            split=view.split,
            photograph=view.image is not None,
        )
        for view in scene.views
    ]


def _matrix(view: View) -> list[float]:
    """world_from_camera, row by row."""
    return [float(v) for v in view.camera.world_from_cam.flatten().tolist()]
