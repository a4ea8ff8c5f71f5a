"""Label transfer: labels find their Gaussians again after an editor changed the file.

An editor may drop the columns it does not know, reorder rows, crop, move the scene or a part of
it, duplicate a part, tint it, or round values on the way into a compressed format.
`match_gaussians` finds which row of the scene each row of the edited file is;
`GaussianMatches.transfer` takes layers along.

The similarity that a scene, or a part of it, was moved by: opacity, mean colour and the ratios of
the three scales do not change under it. Edited rows are paired with the source rows that are
nearest in these; the log of the ratio of their sizes is the log of the similarity's scale, which
most right pairs share and wrong ones do not. Of the pairs that are left, three make a similarity
(Umeyama 1991); the one with most inliers is refined on them (RANSAC).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

import numpy as np
import torch
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    Features,
    Gaussians,
    InstanceTree,
    Labels,
    Layer,
    Selection,
    Similarity,
    VoxelFeatures,
)
from splatseg.core.boundary import boundary
from splatseg.core.options import Natural, options
from splatseg.errors import ShapeError
from splatseg.lift.gaussian_matching import (
    Floats,
    Indices,
    Matches,
    Rows,
    extent_of,
    keep_order,
    match,
    rows_of,
)
from splatseg.neighbours import NeighbourIndex

_SAMPLE = 6000
_TRIPLES = 60_000
_MAX_FITS = 300
_SCALE_WINDOW = 0.12
"""Width in which logs of scale count as one."""
_SCALE_ERROR = 0.04
_INLIER_SHARE = 0.02
"""Share of the source's extent within which a pair agrees with a similarity, at first."""
_QUANTISATION = np.array([0.01, 0.01, 0.01, 0.01, 0.06, 0.06])
"""What opacity, colour and log ratios of scales differ by after quantisation."""
_MIN_PAIRS = 6
_CLEAR_SHARE = 0.5
"""Share of the pairs whose agreement leaves no question whether the scene was mirrored."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hypothesis:
    """A move that pairs agree with."""

    edited_from_source: Similarity
    mirrored: bool
    pairs: int
    """Number of inliers."""


def find_move(edited: Rows, source: Rows, rng: np.random.Generator) -> Hypothesis | None:
    """The similarity that lays most of some source rows onto edited ones; None if there is none.

    Where no rotation does, a mirrored one is looked for.
    """
    if min(len(edited), len(source)) < 3:
        return None
    edited_index, source_index = _pairs(edited, source, rng)
    if len(edited_index) < 3:
        return None
    target = edited.means[edited_index]
    scale = float(
        np.exp((edited.logs[edited_index] - source.logs[source_index]).mean(axis=1)).mean()
    )
    tolerance = _INLIER_SHARE * scale * extent_of(source)
    best: Hypothesis | None = None
    for mirrored in (False, True):
        origin = source.means[source_index] * (np.array([-1.0, 1.0, 1.0]) if mirrored else 1.0)
        found = _consensus(origin, target, scale, tolerance, rng)
        if found is None:
            continue
        move, pairs = found
        if best is None or pairs > 1.5 * best.pairs:
            best = Hypothesis(edited_from_source=move, mirrored=mirrored, pairs=pairs)
        if pairs >= _CLEAR_SHARE * len(edited_index):
            break
    return best


def fit_similarity(origin: Floats, target: Floats) -> Similarity | None:
    """The least-squares similarity target_from_origin (Umeyama 1991); None of one point."""
    origin_centre, target_centre = origin.mean(axis=0), target.mean(axis=0)
    a, b = origin - origin_centre, target - target_centre
    u, values, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    rotation = (u * sign) @ vt
    spread = float((a**2).sum())
    scale = float((values * sign).sum()) / spread if spread > 0 else 0.0
    if not 0 < scale < np.inf:
        return None
    return Similarity(
        rotation=torch.from_numpy(rotation),
        translation=torch.from_numpy(target_centre - scale * rotation @ origin_centre),
        scale=scale,
    )


def _pairs(edited: Rows, source: Rows, rng: np.random.Generator) -> tuple[Indices, Indices]:
    """Edited rows and the source rows like them, of the one change of size that most have."""
    rows = np.arange(len(edited))
    if len(rows) > _SAMPLE:
        rows = np.sort(rng.permutation(len(rows))[:_SAMPLE])
    index = NeighbourIndex(torch.from_numpy(_descriptors(source)))
    nearest = index.nearest(torch.from_numpy(_descriptors(edited[rows])), 1)
    found = nearest.indices[:, 0].numpy()
    logs = (edited.logs[rows] - source.logs[found]).mean(axis=1)
    order = np.sort(logs)
    count = np.searchsorted(order, order + _SCALE_WINDOW, side="right") - np.arange(len(order))
    start = order[int(count.argmax())]
    keep = (logs >= start) & (logs <= start + _SCALE_WINDOW)
    return rows[keep], found[keep]


def _descriptors(rows: Rows) -> Floats:
    ratios = np.diff(rows.logs, axis=1)
    return np.concatenate((rows.opacities[:, None], rows.colours, ratios), axis=1) / _QUANTISATION


def _consensus(
    origin: Floats, target: Floats, scale: float, tolerance: float, rng: np.random.Generator
) -> tuple[Similarity, int] | None:
    """The similarity of three pairs with which most pairs agree, refined on those."""
    triples = rng.integers(0, len(origin), (_TRIPLES, 3))
    origin_sides = _side_lengths(origin, triples) * scale
    target_sides = _side_lengths(target, triples)
    longest = origin_sides.max(axis=1)
    error = np.abs(origin_sides - target_sides).max(axis=1)
    well_spread = (origin_sides.min(axis=1) > 0) & (longest > tolerance)
    good = triples[well_spread & (error <= np.maximum(_SCALE_ERROR * longest, tolerance / 4))]
    best: Similarity | None = None
    max_inliers = 0
    for triple in good[:_MAX_FITS]:
        move = fit_similarity(origin[triple], target[triple])
        if move is None:
            continue
        inliers = int((_residuals(move, origin, target) <= tolerance).sum())
        if inliers > max_inliers:
            best, max_inliers = move, inliers
    if best is None or max_inliers < min(_MIN_PAIRS, len(origin)):
        return None
    return _refined(best, origin, target, tolerance)


def _refined(
    move: Similarity, origin: Floats, target: Floats, tolerance: float
) -> tuple[Similarity, int] | None:
    inliers = _residuals(move, origin, target) <= tolerance
    for _ in range(8):
        if inliers.sum() < 3:
            return None
        better = fit_similarity(origin[inliers], target[inliers])
        if better is None:
            return None
        move = better
        distances = _residuals(move, origin, target)
        tolerance = min(tolerance, max(4 * float(np.median(distances[inliers])), 1e-9))
        inliers = distances <= tolerance
    return move, int(inliers.sum())


def _side_lengths(points: Floats, triples: NDArray[np.int64]) -> Floats:
    corners = points[triples]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)


def _residuals(move: Similarity, origin: Floats, target: Floats) -> Floats:
    moved = move.scale * origin @ move.rotation.numpy().T + move.translation.numpy()
    return np.linalg.norm(moved - target, axis=1)


_Layer = TypeVar("_Layer", bound=Layer)

_ROUNDS = 3
_MIN_SHARE = 0.02
_PROBE = 2000
"""Rows that a move is tried on before all are."""


_MIN_PART = 20
"""Gaussians at least that may have been moved on their own."""


@options(
    removed={
        "min_part": "parts of 20 Gaussians or more may have been moved on their own",
        "seed": "moves are found from the same triples every time",
    }
)
class MatchOptions:
    """How Gaussians are found again."""

    moves: Natural = 8
    """Upper bound of similarities to look for: one for the whole scene, or one for each part that
    was moved. 0 takes it that nothing was moved."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Move:
    """Where some of the Gaussians went."""

    edited_from_source: Similarity
    mirrored: bool
    """Whether x became -x in the source's frame before the similarity."""

    gaussians: int
    """How many went this way."""

    @property
    def stayed(self) -> bool:
        """Whether this is no move at all."""
        return not self.mirrored and bool(
            torch.equal(self.edited_from_source.matrix, torch.eye(4, dtype=torch.float64))
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GaussianMatches:
    """Which Gaussian of a scene each Gaussian of an edited copy is."""

    rows: Int[Tensor, "m"]
    """int64 source row of each edited row, -1 where it is none of them."""

    move_of: Int[Tensor, "m"]
    """Which of `moves` took it there; -1 where it was not found."""

    moves: tuple[Move, ...]
    """The most common one first."""

    report: Mapping[str, Any]
    """Figures that JSON holds: rows found, copies, ambiguous ones, noise, moves."""

    @property
    def share(self) -> float:
        """Share of the edited rows that were found."""
        return float((self.rows >= 0).double().mean()) if len(self.rows) else 0.0

    @property
    def similarity(self) -> Similarity | None:
        """How most of what was found moved; None where nothing was, or it was mirrored."""
        if not self.moves or self.moves[0].mirrored:
            return None
        return self.moves[0].edited_from_source

    def transfer(self, layer: _Layer) -> _Layer:
        """A layer of the source as one of the edited Gaussians.

        What was not found gets no label (confidence and evidence 0), features of zeros, and is
        not selected. Background, names and the rest of the info stay.

        Raises:
            ShapeError: If the layer has not one row a Gaussian of the source.
        """
        count = int(self.report["source_gaussians"])
        if len(layer) != count:
            raise ShapeError(
                f"layer: expected {count} rows, one a Gaussian of the source, got {len(layer)}."
            )
        return cast("_Layer", _transferred(layer, self.rows))

    def transfer_columns(self, columns: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Further columns of the source, one row an edited Gaussian; 0 where it was not found."""
        return {name: _gathered(column, self.rows, 0) for name, column in columns.items()}


@boundary
def match_gaussians(
    source: Gaussians, edited: Gaussians, *, options: MatchOptions | None = None
) -> GaussianMatches:
    """Find the Gaussians of a scene again in an edited copy of it.

    Rows are compared in position, mean colour, opacity, sizes and orientation; how far each may
    be off is estimated from the data, so that rounded files match as exact ones do. What does
    not lie where it was is looked for elsewhere: a similarity is estimated from what it does not
    change, for the whole scene or for one part after another. Each source row is given away
    once, to the row most like it; only rows that find nothing else share one (parts that were
    duplicated). Rows equal in everything keep their order.

    Args:
        source: The scene whose layers are to be carried.
        edited: What an editor made of it.
        options: Limits of the search.

    Returns:
        The rows, the moves, and a report.

    Raises:
        RangeError: If a row of either cannot be rendered.

    Example:
        >>> g = Gaussians(means=torch.arange(12.).reshape(4, 3), scales=torch.ones(4, 3),
        ...               rotations=torch.eye(4)[:1].expand(4, 4), opacities=torch.ones(4),
        ...               sh=torch.rand(4, 1, 3))
        >>> match_gaussians(g, g[torch.tensor([2, 0])]).rows
        tensor([2, 0])
    """
    options = options or MatchOptions()
    source.check_values()
    edited.check_values()
    edited_rows, source_rows = rows_of(edited), rows_of(source)
    search = _Search(edited_rows, source_rows, np.random.default_rng(0), options)
    search.run()
    return search.result()


class _Search:
    """Rows found so far."""

    def __init__(
        self, edited: Rows, source: Rows, rng: np.random.Generator, options: MatchOptions
    ) -> None:
        self._edited = edited
        self._source = source
        self._rng = rng
        self._options = options
        self._rows = np.full(len(edited), -1)
        self._move_of = np.full(len(edited), -1)
        self._copies = np.zeros(len(edited), bool)
        self._ambiguous = np.zeros(len(edited), bool)
        self._free = np.ones(len(source), bool)
        self._moves: list[tuple[Similarity, bool]] = []
        self._noise: list[list[float]] = []

    def run(self) -> None:
        """Where it was first, then elsewhere, then where it was for what a move explains worse."""
        min_found = _MIN_SHARE * len(self._edited)
        stays = (Similarity.identity(), False)
        in_place = self._match_left(stays, min_found=max(1.0, min_found))
        for _ in range(self._options.moves):
            unmatched = np.flatnonzero(self._rows < 0)
            if len(unmatched) < min(_MIN_PART, len(self._edited)):
                break
            if not (
                self._find_further(unmatched, self._free) or self._find_further(unmatched, None)
            ):
                break
        if not in_place and (self._rows < 0).any():
            self._match_left(stays, min_found=1.0)
        if self._ambiguous.any():
            self._rows = keep_order(self._rows, ~self._copies, self._source)

    def _find_further(self, unmatched: NDArray[np.int64], free: NDArray[np.bool_] | None) -> bool:
        """Look for a move of what is left from free source rows, or from any (copies)."""
        pool = np.arange(len(self._source)) if free is None else np.flatnonzero(free)
        found = find_move(self._edited[unmatched], self._source[pool], self._rng)
        if found is None:
            return False
        min_found = min(_MIN_PART, len(self._edited))
        return self._match_left(
            (found.edited_from_source, found.mirrored), min_found=min_found, copies=free is None
        )

    def _match_left(
        self, move: tuple[Similarity, bool], *, min_found: float, copies: bool = False
    ) -> bool:
        """Match what is left under a move, refine it, and keep both if they find enough."""
        unmatched = np.flatnonzero(self._rows < 0)
        edited = self._edited[unmatched]
        if len(unmatched) > _PROBE:
            probe = edited[np.sort(self._rng.permutation(len(unmatched))[:_PROBE])]
            if (self._match(probe, move, copies).rows < 0).all():
                return False
        found = self._match(edited, move, copies)
        for _ in range(_ROUNDS):
            better = self._refitted(edited, move, found)
            if better is None:
                break
            again = self._match(edited, better, copies)
            if (again.rows >= 0).sum() < (found.rows >= 0).sum():
                break
            move, found = better, again
        hit = found.rows >= 0
        if hit.sum() < min_found:
            return False
        rows = unmatched[hit]
        self._rows[rows] = found.rows[hit]
        self._move_of[rows] = len(self._moves)
        self._copies[rows] = found.copies[hit] | ~self._free[found.rows[hit]]
        self._ambiguous[rows] = found.ambiguous[hit]
        self._free[found.rows[hit]] = False
        self._moves.append(move)
        self._noise.append(found.noise.sigma.tolist())
        return True

    def _match(self, edited: Rows, move: tuple[Similarity, bool], copies: bool) -> Matches:
        moved = self._source.moved(move[0], mirrored=move[1])
        return match(edited, moved, free=None if copies else self._free)

    def _refitted(
        self, edited: Rows, move: tuple[Similarity, bool], found: Matches
    ) -> tuple[Similarity, bool] | None:
        """The similarity of all rows found, if it is nearer to them than the one they came by."""
        sure = (found.rows >= 0) & ~found.ambiguous
        if sure.sum() < 4:
            return None
        origin = self._source.means[found.rows[sure]] * _mirror(move[1])
        target = edited.means[sure]
        before = _offsets(move[0], origin, target)
        close = before <= 4 * np.median(before)
        fitted = fit_similarity(origin[close], target[close])
        if fitted is None:
            return None
        after = _offsets(fitted, origin, target)
        better = np.median(after) < 0.7 * np.median(before) - 1e-7 * extent_of(edited)
        return (fitted, move[1]) if better else None

    def result(self) -> GaussianMatches:
        counts = np.bincount(self._move_of[self._move_of >= 0], minlength=len(self._moves))
        order = np.argsort(-counts, kind="stable")
        rank_of = np.empty(len(order) + 1, np.int64)
        rank_of[order], rank_of[-1] = np.arange(len(order)), -1
        moves = tuple(
            Move(
                edited_from_source=self._moves[i][0],
                mirrored=self._moves[i][1],
                gaussians=int(counts[i]),
            )
            for i in order
        )
        found = self._rows >= 0
        report = {
            "gaussians": len(self._rows),
            "found": int(found.sum()),
            "share": float(found.mean()) if len(found) else 0.0,
            "source_gaussians": len(self._source),
            "source_gone": int(len(self._source) - len(np.unique(self._rows[found]))),
            "copies": int(self._copies.sum()),
            "ambiguous": int(self._ambiguous.sum()),
            "moves": [
                _described(move, self._noise[i]) for move, i in zip(moves, order, strict=True)
            ],
        }
        return GaussianMatches(
            rows=torch.from_numpy(self._rows),
            move_of=torch.from_numpy(rank_of[self._move_of]),
            moves=moves,
            report=report,
        )


def _mirror(mirrored: bool) -> NDArray[np.float64]:
    return np.array([-1.0 if mirrored else 1.0, 1.0, 1.0])


def _offsets(
    move: Similarity, origin: NDArray[np.float64], target: NDArray[np.float64]
) -> NDArray[np.float64]:
    moved = move.apply(torch.from_numpy(origin)).numpy()
    return np.linalg.norm(moved - target, axis=1)


def _described(move: Move, noise: list[float]) -> dict[str, Any]:
    similarity = move.edited_from_source
    trace = float(similarity.rotation.double().diagonal().sum())
    return {
        "gaussians": move.gaussians,
        "stayed": move.stayed,
        "mirrored": move.mirrored,
        "degrees": float(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))),
        "scale": similarity.scale,
        "edited_from_source": similarity.matrix.tolist(),
        "noise": dict(
            zip(("position", "colour", "opacity", "sizes", "orientation"), noise, strict=True)
        ),
    }


_COLUMNS: dict[type[Any], tuple[str, ...]] = {
    Labels: (
        "ids", "confidence", "candidates", "shares", "evidence", "effective_views", "inferred",
    ),
    Features: ("values", "weights"),
    VoxelFeatures: ("rows", "shares"),
    Selection: ("mask", "confidence"),
}  # fmt: skip
"""What layers have of each Gaussian."""


def _transferred(layer: Layer, rows: Tensor) -> Layer:
    """The layer's rows in a new order; where there is none -1, 0 or false."""
    if isinstance(layer, InstanceTree):
        return replace(layer, labels=cast("Labels", _transferred(layer.labels, rows)))
    columns: dict[str, Tensor | None] = {n: getattr(layer, n) for n in _COLUMNS[type(layer)]}
    moved = {
        name: _gathered(column, rows, UNLABELLED if _is_integer(column) else 0)
        for name, column in columns.items()
        if column is not None
    }
    return replace(layer, **cast("dict[str, Any]", moved))


def _is_integer(column: Tensor) -> bool:
    return not column.dtype.is_floating_point and column.dtype != torch.bool


def _gathered(column: Tensor, rows: Tensor, fill: float) -> Tensor:
    out = column.new_full((len(rows), *column.shape[1:]), fill)
    found = rows >= 0
    out[found] = column[rows[found]]
    return out
