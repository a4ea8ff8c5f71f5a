"""How fast label maps are drawn: one after the other, on the machine at hand.

A view is drawn once before anything is timed, so that what is made once (compiled kernels, labels
read out of features) is not counted. The rate is that of the median view: a machine that does
something else for a moment slows a few views, not the figure.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from splatseg.core import Camera, LabelMap, LabelSource, Renderable, View, camera_of_map
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError
from splatseg.evaluate.held_out import Progress, label_map_in


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimedMaps:
    """A label map that was drawn, the true one, and how long the drawing took."""

    view: View
    drawn: LabelMap
    true: LabelMap
    seconds: float
    """From the camera to the ids in memory: projected, sorted, blended, read."""


def timed_label_maps(
    field: Renderable,
    views: Sequence[View],
    layer: str,
    truth: LabelSource,
    *,
    clock: Callable[[], float] = time.perf_counter,
    progress: Progress | None = None,
) -> Iterator[TimedMaps]:
    """Draw a layer in each view, in the pixels of its truth, after the first view was drawn once.

    Args:
        field: What is drawn.
        views: Where; all must have a truth.
        layer: Name of the layer of the field.
        truth: Label maps by view name.
        clock: Seconds since some moment.
        progress: Called with the views done and their number.

    Raises:
        ShapeError: If a truth does not have its photograph's proportions.
    """
    for done, view in enumerate(views, start=1):
        true = truth.label_map(view.name)
        camera = camera_of_map(view, true.height, true.width)
        if done == 1:
            _drawn(field, camera, layer)
        began = clock()
        drawn = _drawn(field, camera, layer)
        yield TimedMaps(view=view, drawn=drawn, true=true, seconds=clock() - began)
        if progress is not None:
            progress(done, len(views))


def _drawn(field: Renderable, camera: Camera, layer: str) -> LabelMap:
    with field.view(camera) as looked_at:
        return label_map_in(looked_at, layer, camera)


@boundary
def frames_per_second(seconds: Sequence[float]) -> float:
    """Views a second, of the median of the times that single views took.

    Args:
        seconds: Of each view, above 0.

    Raises:
        InputError: If there is none.
        RangeError: If one is not above 0, or not finite.

    Example:
        >>> frames_per_second([0.1, 0.5, 0.25])
        4.0
    """
    if not seconds:
        raise InputError("seconds: expected those of at least one view, got none.")
    for one in seconds:
        if not (math.isfinite(one) and one > 0):
            raise RangeError(f"seconds: expected times above 0, got {one}.")
    return 1 / statistics.median(seconds)
