r"""The masks of the initial views: what each shows, and which are masks of one thing.

Masks of two views are of one thing if they hold the same Gaussians. With :math:`m_{ki}` the
blending weight of Gaussian i summed over the pixels of mask k of view u, and :math:`v_{ui}` that
over all of its pixels,

.. math:: I_{kl} = \sum_i \sqrt{m_{ki} m_{li}}, \qquad
          S_{k|v} = \sum_i \sqrt{m_{ki} v_{vi}}, \qquad
          \mathrm{IoU}(k, l) = \frac{I_{kl}}{S_{k|v} + S_{l|u} - I_{kl}}

for mask l of view v: what only one of the views sees counts for neither.

Features of masks are solved for together over the cells of all initial views, with the masks
painted over each other, the smallest last (`lift.words.unmixing`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import FeatureMap, FeatureSource, Gaussians, MaskSet, Rle, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence
from splatseg.lift.voting.features import checked_grid
from splatseg.lift.voting.segment_masses import ViewMasses, view_masses
from splatseg.lift.words import ThingLooks, thing_looks
from splatseg.lift.words.object_features import BLURS, cell_shares
from splatseg.lift.words.unmixing import NormalEquations, blurred

_MIN_PIXELS = 16
"""Masks with fewer are no candidates."""

_RIDGE = 1.0

_MOSTLY = 0.5
"""Share of what a view sees of a Gaussian from which on it is of a mask."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaskTable:
    """All masks of some views, one row each."""

    views: tuple[View, ...]
    masks: tuple[MaskSet, ...]
    """Of each view."""

    view: Int64[Tensor, "m"]
    """Index of the view of each row."""

    index: Int64[Tensor, "m"]
    """Its index in the masks of the view."""

    values: Float[Tensor, "m channels"]
    """Its feature, in the channels of the feature maps."""

    cells: Float[Tensor, "m"]
    """How many cells it covers."""

    iou: Float[Tensor, "m m"]
    """On the Gaussians that both views see, float32; 0 where they see none in common."""

    contained: Float[Tensor, "m m"]
    """Share of what the row's mask holds of these Gaussians that the column's holds, too."""

    looks: ThingLooks | None
    """Colour and place of what each mask holds; None where nobody asks."""

    def __len__(self) -> int:
        return len(self.view)

    def rle(self, row: int) -> Rle:
        """The mask of a row."""
        return self.masks[int(self.view[row])].masks[int(self.index[row])]


@boundary
def mask_table(
    gaussians: Gaussians,
    views: Sequence[View],
    features: FeatureSource,
    masks: Evidence,
    *,
    looks: bool = True,
    up: tuple[float, float, float] | None = None,
    backend: str = "auto",
) -> MaskTable:
    """The masks of some views.

    Args:
        gaussians: The Gaussians of the scene.
        views: The initial views.
        features: Their feature maps.
        masks: Their masks.
        looks: Whether colours and places are asked for: a tenth of the time.
        up: Where up is; None where nobody knows.
        backend: Name of the rendering backend.

    Raises:
        InputError: If a view has no masks or features, none of the views a mask, or a feature is
            not finite.
        ShapeError: If masks or features do not have the photograph's size.
    """
    for name, source in (("features", features), ("masks", masks)):
        lacking = [view.name for view in views if view.name not in source.view_names]
        if lacking:
            raise InputError(f"{name}: expected some of every initial view, {lacking[0]} has none.")
    sets = tuple(masks.masks(view.name) for view in views)
    held = [
        view_masses(gaussians, view.camera, found, backend=backend)
        for view, found in zip(views, sets, strict=True)
    ]
    rows = [
        (at, index)
        for at, found in enumerate(sets)
        for index, rle in enumerate(found.masks)
        if rle.area >= _MIN_PIXELS
    ]
    if not rows:
        raise InputError(
            f"masks: expected a mask in at least one of the {len(views)} initial views, got none."
        )
    view, index = torch.tensor(rows).unbind(dim=1)
    values, cells = _features(views, sets, features, rows)
    iou, contained = mask_overlaps(held, rows, len(gaussians))
    return MaskTable(
        views=tuple(views),
        masks=sets,
        view=view,
        index=index,
        values=values,
        cells=cells,
        iou=iou,
        contained=contained,
        looks=_looks(gaussians, held, rows, up) if looks else None,
    )


def _looks(
    gaussians: Gaussians,
    held: Sequence[ViewMasses],
    rows: Sequence[tuple[int, int]],
    up: tuple[float, float, float] | None,
) -> ThingLooks:
    """Of the Gaussians that masks hold for the most part."""
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    for at, found in enumerate(held):
        row_of = torch.full((int(found.segment.max()) + 1 if len(found.segment) else 0,), -1)
        for row, (view, index) in enumerate(rows):
            if view == at and index < len(row_of):
                row_of[index] = row
        row = row_of[found.segment]
        mostly = (row >= 0) & (found.weight >= _MOSTLY * found.visible[found.gaussian])
        parts.append((row[mostly], found.gaussian[mostly], found.weight[mostly]))
    things, of, weights = (torch.cat(columns) for columns in zip(*parts, strict=True))
    return thing_looks(gaussians, things, of, weights, count=len(rows), up=up)


def painted(masks: MaskSet) -> NDArray[np.int64]:
    """The smallest mask at each pixel (height, width), -1 where there is none."""
    found = np.full((masks.height, masks.width), -1, np.int64)
    areas = [mask.area for mask in masks.masks]
    for index in sorted(range(len(masks)), key=lambda one: (-areas[one], one)):
        found[masks.dense(index).numpy()] = index
    return found


def _features(
    views: Sequence[View],
    sets: Sequence[MaskSet],
    features: FeatureSource,
    rows: Sequence[tuple[int, int]],
) -> tuple[Tensor, Tensor]:
    """Feature of each mask: the mean over its pixels of those of the painted masks there."""
    starts = np.cumsum([0, *(len(one) for one in sets)])
    rest = int(starts[-1])
    maps = [painted(one) for one in sets]
    grids = [checked_grid(view, features.features(view.name)) for view in views]
    solved = _unmixed(grids, maps, starts, rest)
    values: list[Tensor] = []
    cells: list[float] = []
    for at, index in rows:
        inside = maps[at][sets[at].dense(index).numpy()]
        # A mask that is painted over at every pixel is of what lies over it.
        local, counts = np.unique(inside, return_counts=True)
        weights = counts / counts.sum()
        values.append(torch.from_numpy(weights @ solved[local + starts[at]]))
        cells.append(float(counts.sum()) / grids[at].stride ** 2)
    return torch.stack(values).float(), torch.tensor(cells, dtype=torch.float32)


def _unmixed(
    grids: Sequence[FeatureMap],
    maps: Sequence[NDArray[np.int64]],
    starts: NDArray[np.int64],
    rest: int,
) -> NDArray[np.float64]:
    """Features of all painted masks and, behind them, of what no mask has."""
    systems = [NormalEquations(rest + 1, grids[0].channels) for _ in BLURS]
    for at, (grid, found) in enumerate(zip(grids, maps, strict=True)):
        columns, shares = cell_shares(np.where(found < 0, rest, found + starts[at]), grid)
        features = grid.features.double().cpu().flatten(0, 1).numpy()
        for blur, system in zip(BLURS, systems, strict=True):
            system.add(columns, blurred(shares, blur), features)
    solved = [system.solved(_RIDGE) for system in systems]
    return min(solved, key=lambda one: one[1])[0]


def mask_overlaps(
    held: Sequence[ViewMasses], rows: Sequence[tuple[int, int]], gaussians: int
) -> tuple[Float[Tensor, "m m"], Float[Tensor, "m m"]]:
    """IoU and containment of all pairs of masks, see `MaskTable`.

    Args:
        held: The masses of the masks of each view.
        rows: View and mask of each row, by their indices; views ascend.
        gaussians: How many Gaussians there are.
    """
    import scipy.sparse

    roots: list[Any] = []
    sights: list[Any] = []
    for at, found in enumerate(held):
        own = np.array([index for view, index in rows if view == at], dtype=np.int64)
        segment, gaussian = found.segment.numpy(), found.gaussian.numpy()
        count = max(int(own.max(initial=-1)), int(segment.max(initial=-1))) + 1
        entries = (found.weight.double().sqrt().numpy(), (segment, gaussian))
        roots.append(scipy.sparse.csr_matrix(entries, shape=(count, gaussians))[own])
        sights.append(scipy.sparse.csr_matrix(found.visible.double().sqrt().numpy()[None]))
    masks: Any = scipy.sparse.vstack(roots, format="csr")
    shared = np.asarray((masks @ masks.T).todense())
    seen = np.asarray((masks @ scipy.sparse.vstack(sights, format="csr").T).todense())
    # Of each mask, what the view of each other mask sees.
    size = seen[:, [view for view, _ in rows]]
    iou = shared / np.maximum(size + size.T - shared, 1e-9)
    contained = shared / np.maximum(size, 1e-9)
    return torch.from_numpy(iou).float(), torch.from_numpy(contained).float()
