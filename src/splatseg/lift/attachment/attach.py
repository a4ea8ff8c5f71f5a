"""Re-attachment: labels are carried onto Gaussians that an editor changed.

An editor may drop the columns it does not know, reorder rows, crop, move the scene or a part of
it, duplicate a part, tint it, or round values on the way into a compressed format. `attach`
finds which row of the scene each row of the edited file is; `Attached.carry` takes layers along.
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
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import RangeError, ShapeError
from splatseg.lift.attachment.match import Matches, keep_order, match
from splatseg.lift.attachment.move import Hypothesis, find_move, fit_similarity
from splatseg.lift.attachment.rows import Rows, extent_of, rows_of

_Layer = TypeVar("_Layer", bound=Layer)

_ROUNDS = 3
_MIN_SHARE = 0.02
_PROBE = 2000
"""Rows that a move is tried on before all are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AttachOptions:
    """How Gaussians are found again."""

    moves: int = 8
    """Upper bound of similarities to look for: one for the whole scene, or one for each part that
    was moved. 0 takes it that nothing was moved."""

    min_part: int = 20
    """Minimum of Gaussians that may have been moved on their own."""

    seed: int = 0
    """Of the random triples that moves are found from."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.moves < 0:
            raise RangeError(f"moves: expected 0 or more, got {self.moves}.")
        if self.min_part < 3:
            raise RangeError(f"min_part: expected at least 3, got {self.min_part}.")


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
class Attached:
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

    def carry(self, layer: _Layer) -> _Layer:
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
        return cast("_Layer", _carried(layer, self.rows))

    def carry_columns(self, columns: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Further columns of the source, one row an edited Gaussian; 0 where it was not found."""
        return {name: _gathered(column, self.rows, 0) for name, column in columns.items()}


@boundary
def attach(
    source: Gaussians, edited: Gaussians, *, options: AttachOptions | None = None
) -> Attached:
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
        >>> attach(g, g[torch.tensor([2, 0])]).rows
        tensor([2, 0])
    """
    options = options or AttachOptions()
    source.check_values()
    edited.check_values()
    edited_rows, source_rows = rows_of(edited), rows_of(source)
    search = _Search(edited_rows, source_rows, np.random.default_rng(options.seed), options)
    search.run()
    return search.result()


class _Search:
    """Rows found so far."""

    def __init__(
        self, edited: Rows, source: Rows, rng: np.random.Generator, options: AttachOptions
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
            if len(unmatched) < min(self._options.min_part, len(self._edited)):
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
        min_found = min(self._options.min_part, len(self._edited))
        return self._match_left(_move(found), min_found=min_found, copies=free is None)

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

    def result(self) -> Attached:
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
        return Attached(
            rows=torch.from_numpy(self._rows),
            move_of=torch.from_numpy(rank_of[self._move_of]),
            moves=moves,
            report=report,
        )


def _move(found: Hypothesis) -> tuple[Similarity, bool]:
    return found.edited_from_source, found.mirrored


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


def _carried(layer: Layer, rows: Tensor) -> Layer:
    """The layer's rows in a new order, blank where there is none."""
    match layer:
        case Labels():
            return replace(
                layer,
                ids=_gathered(layer.ids, rows, UNLABELLED),
                confidence=_gathered(layer.confidence, rows, 0.0),
                candidates=_gathered_if(layer.candidates, rows, UNLABELLED),
                shares=_gathered_if(layer.shares, rows, 0.0),
                evidence=_gathered_if(layer.evidence, rows, 0.0),
                effective_views=_gathered_if(layer.effective_views, rows, 0.0),
                inferred=_gathered_if(layer.inferred, rows, False),  # noqa: FBT003  (a value)
            )
        case Features():
            return replace(
                layer,
                values=_gathered(layer.values, rows, 0.0),
                weights=_gathered_if(layer.weights, rows, 0.0),
            )
        case VoxelFeatures():
            return replace(
                layer,
                rows=_gathered(layer.rows, rows, UNLABELLED),
                shares=_gathered_if(layer.shares, rows, 0.0),
            )
        case Selection():
            return replace(
                layer,
                mask=_gathered(layer.mask, rows, False),  # noqa: FBT003  (a value)
                confidence=_gathered_if(layer.confidence, rows, 0.0),
            )
        case InstanceTree():
            return replace(layer, labels=cast("Labels", _carried(layer.labels, rows)))


def _gathered(column: Tensor, rows: Tensor, fill: float) -> Tensor:
    out = column.new_full((len(rows), *column.shape[1:]), fill)
    found = rows >= 0
    out[found] = column[rows[found]]
    return out


def _gathered_if(column: Tensor | None, rows: Tensor, fill: float) -> Tensor | None:
    return None if column is None else _gathered(column, rows, fill)
