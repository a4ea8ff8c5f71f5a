"""Labelled points of a drive from above."""

import math

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import ClassTable
from splatseg.report.legend import Colour, colour_of

_LONG, _SHORT = 1200, 160
"""Longest side of a picture, and the least that the other may be, pixels."""

_PAPER: Colour = (28, 29, 34)
_DIM: Colour = (62, 63, 70)
_OUTLIERS = 0.002
"""Share of the points at either end of an axis that the picture may leave out."""


class LabelledPoints:
    """Some of the points of many scans, evenly, with their ids: as many as a picture needs.

    Which points are kept depends on their numbers alone.

    Args:
        limit: How many are kept, at most.
    """

    def __init__(self, limit: int = 400_000) -> None:
        self._limit, self._step, self._seen = limit, 1, 0
        self._rows: list[Tensor] = []
        self._points: list[Tensor] = []
        self._ids: list[Tensor] = []
        self._truth: list[Tensor] = []

    def add(
        self,
        points: Float[Tensor, "n 3"],
        ids: Int[Tensor, "n"],
        *,
        truth: Int[Tensor, "n"] | None = None,
    ) -> None:
        """Take the points of a scan, world, with their ids and true ids, -1 where they have none.

        Without `truth` no point of the scan has one.
        """
        check_shape("ids", ids, (len(points),))
        true = torch.full((len(points),), -1, dtype=torch.int32) if truth is None else truth
        check_shape("truth", true, (len(points),))
        rows = torch.arange(self._seen, self._seen + len(points))
        self._seen += len(points)
        kept = rows % self._step == 0
        self._rows.append(rows[kept])
        self._points.append(points.detach().cpu()[kept].double())
        self._ids.append(ids.detach().cpu()[kept].int())
        self._truth.append(true.detach().cpu()[kept].int())
        while sum(map(len, self._rows)) > self._limit:
            self._step *= 2
            stays = [part % self._step == 0 for part in self._rows]
            for held in (self._rows, self._points, self._ids, self._truth):
                held[:] = [part[some] for part, some in zip(held, stays, strict=True)]

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """Those that were kept."""
        return torch.cat(self._points) if self._points else torch.zeros(0, 3, dtype=torch.float64)

    @property
    def ids(self) -> Int[Tensor, "n"]:
        """Their ids."""
        return torch.cat(self._ids) if self._ids else torch.zeros(0, dtype=torch.int32)

    @property
    def truth(self) -> Int[Tensor, "n"]:
        """Their true ids, -1 where scans brought none."""
        return torch.cat(self._truth) if self._truth else torch.zeros(0, dtype=torch.int32)


def point_map(
    points: Float[Tensor, "n 3"],
    ids: Int[Tensor, "n"],
    colours: ClassTable | None,
    *,
    up: tuple[float, float, float],
) -> UInt8[Tensor, "height width 3"]:
    """Points in the colours of their ids from above, the highest over those below.

    The longer way of the drive runs across. Points without a label are dim, and under all others.

    Args:
        points: World, scene units; at least one.
        ids: Of each, -1 for none.
        colours: Of the ids.
        up: Away from the ground, of any length but 0.
    """
    check_shape("points", points, (None, 3))
    check_shape("ids", ids, (len(points),))
    places: NDArray[np.float64] = points.detach().cpu().double().numpy()
    right, deep, above = _axes(places, np.array(up, np.float64))
    flat = np.stack((places @ right, places @ deep), axis=1)
    low, high = np.quantile(flat, (_OUTLIERS, 1 - _OUTLIERS), axis=0)
    # Room for the points at the rim, and for a drive of one point.
    span = np.maximum(high - low, 1e-6) * 1.04
    middle = (low + high) / 2
    scale = _LONG / max(float(span.max()), 1e-6)
    width, height = (max(_SHORT, min(_LONG, math.ceil(scale * side))) for side in span.tolist())
    at = np.floor((flat - middle) * (scale, -scale) + (width / 2, height / 2)).astype(np.int64)
    canvas = np.full((height, width, 3), _PAPER, np.uint8)
    known = ids.detach().cpu().numpy() >= 0
    order = np.lexsort((places @ above, known))
    present, index = np.unique(ids.detach().cpu().numpy(), return_inverse=True)
    palette = np.array([_colour(int(id), colours) for id in present], np.uint8)
    tones = palette[index.reshape(-1)][order]
    # Few points are drawn larger.
    dot = min(5, max(1, round(0.8 * (width * height / max(len(places), 1)) ** 0.5)))
    for across, downwards in np.ndindex(dot, dot):
        x, y = at[order, 0] + across - dot // 2, at[order, 1] + downwards - dot // 2
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        canvas[y[inside], x[inside]] = tones[inside]
    return torch.from_numpy(canvas)


def _colour(id: int, colours: ClassTable | None) -> Colour:
    return _DIM if id < 0 else colour_of(id, colours)


def _axes(
    places: NDArray[np.float64], up: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Right, deep and up: the points lie along the first as widely as they can."""
    length = float(np.linalg.norm(up))
    above = up / length if length > 1e-9 else np.array((0.0, 0.0, 1.0))
    flat = places[:: max(1, len(places) // 20_000)] @ (np.eye(3) - np.outer(above, above))
    flat = flat - flat.mean(axis=0)
    # Of a single point any direction on the ground will do.
    flat = np.vstack((flat, 1e-6 * (np.eye(3) - np.outer(above, above))))
    right: NDArray[np.float64] = np.linalg.svd(flat, full_matrices=False)[2][0]
    right = right * (1.0 if right[np.abs(right).argmax()] > 0 else -1.0)
    deep: NDArray[np.float64] = np.cross(above, right)
    return right, deep, above
