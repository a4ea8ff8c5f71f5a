"""What a page says that a person showed, as prompts of the library."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Camera, Scene, Selection, View
from splatseg.errors import InputError
from splatseg.prompting.prompts import Balls, Lasso, SelectionPrompt, Similar, ViewPrompt
from splatseg.viewer import _messages as messages

_NO_NAME = "page"
"""Name of a view that is no photograph's."""

_APART = 0.25
"""Least distance of the middles of two balls of a brush, as a share of their radius."""

Surface = Callable[[Camera, Sequence[messages.Point]], Sequence[NDArray[np.float64] | None]]
"""The points of what is shown under pixels of a camera; None where nothing is."""


def prompts_of(
    request: messages.SelectRequest,
    scene: Scene,
    *,
    surface: Surface,
    selection: Selection | None,
) -> Sequence[SelectionPrompt]:
    """The prompts of a request that shows something.

    Args:
        request: What was shown.
        scene: Has the views with photographs.
        surface: Knows how deep a pixel is.
        selection: What is selected: others like it are meant by similar.

    Raises:
        InputError: If the request does not show what its kind needs.
    """
    if request.kind == "similar":
        if selection is None:
            raise InputError("similar: expected a selection that others are like; click first.")
        return [Similar(selection=selection)]
    view = _view(request, scene)
    match request.kind:
        case "sphere":
            return [_balls(request, view, surface)]
        case "lasso" | "polygon":
            return [Lasso(view=view, polygon=_points(request.points))]
        case "stroke":
            return [_stroke(request, view)]
        case "box":
            return [ViewPrompt(view=view, box=_box(request))]
        case _:
            positive = [True] * len(request.points) + [False] * len(request.negative)
            return [
                ViewPrompt(
                    view=view,
                    points=_points([*request.points, *request.negative]),
                    positive=torch.tensor(positive, dtype=torch.bool),
                    box=_box(request),
                )
            ]


def _view(request: messages.SelectRequest, scene: Scene) -> View:
    if request.view is not None:
        return scene.view(request.view)
    if request.camera is None:
        raise InputError(f"{request.kind}: expected a camera or a view, got neither.")
    return View(name=_NO_NAME, camera=request.camera.camera())


def _box(request: messages.SelectRequest) -> torch.Tensor | None:
    return None if request.box is None else torch.tensor(request.box, dtype=torch.float32)


def _balls(request: messages.SelectRequest, view: View, surface: Surface) -> Balls:
    """The balls of a brush along its way; where nothing is under it, it leaves none."""
    if not request.points or request.radius is None:
        raise InputError("sphere: expected a point and a radius.")
    centres = np.empty((0, 3))
    for point in surface(view.camera, request.points):
        if point is not None:
            away = np.linalg.norm(centres - point, axis=1)
            if (away >= _APART * request.radius).all():
                centres = np.vstack((centres, point))
    if not len(centres):
        raise InputError("sphere: there is nothing of the scene at this pixel; click on it.")
    return Balls(centres=torch.from_numpy(centres), radius=request.radius)


def _points(points: Sequence[messages.Point]) -> torch.Tensor:
    return torch.tensor(points, dtype=torch.float32).reshape(-1, 2)


def _stroke(request: messages.SelectRequest, view: View) -> ViewPrompt:
    """Strokes as the pixels that they cover."""
    drawn = [_covered(points, request.width, view) for points in (request.points, request.negative)]
    positive, negative = (mask if bool(mask.any()) else None for mask in drawn)
    return ViewPrompt(view=view, scribble=positive, negative_scribble=negative)


def _covered(points: Sequence[messages.Point], width: float, view: View) -> torch.Tensor:
    canvas = np.zeros((view.camera.height, view.camera.width), dtype=np.uint8)
    if points:
        # Pixel centres are at +0.5 here, at whole numbers in OpenCV.
        corners = np.round(np.array(points) - 0.5).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(canvas, [corners], isClosed=False, color=1, thickness=max(1, round(width)))
    return torch.from_numpy(canvas > 0)
