"""Rows of one scene matched with those of another: their attributes, and the matching."""

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Gaussians, Similarity
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.neighbours import NeighbourIndex

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

SMALLEST_LOG = -10.0
"""Log scales below this count as this: SPZ ends there, and what is as thin is a disk or a line
however thin it is."""

_SIX = np.array([0, 1, 2, 4, 5, 8])
# Off-diagonal entries stand twice in the matrix.
_TWICE = np.sqrt(np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """Gaussians as the columns that matching looks at."""

    means: Floats
    """(n, 3) scene units."""

    logs: Floats
    """(n, 3) log scales, ascending along a row, so that the order of axes does not matter."""

    covariances: Floats
    """(n, 3, 3) scene units squared."""

    colours: Floats
    """(n, 3) mean colour over directions."""

    opacities: Floats
    """(n,)"""

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, index: Indices | NDArray[np.bool_]) -> "Rows":
        return Rows(
            means=self.means[index],
            logs=self.logs[index],
            covariances=self.covariances[index],
            colours=self.colours[index],
            opacities=self.opacities[index],
        )

    def moved(self, target_from_source: Similarity, *, mirrored: bool) -> "Rows":
        """The rows after ``x -> -x`` where they are mirrored, then the similarity."""
        matrix = target_from_source.rotation.double().numpy().copy()
        if mirrored:
            matrix[:, 0] *= -1
        scale = target_from_source.scale
        return replace(
            self,
            means=scale * self.means @ matrix.T + target_from_source.translation.double().numpy(),
            logs=self.logs + np.log(scale),
            covariances=scale**2 * matrix @ self.covariances @ matrix.T,
        )


def rows_of(gaussians: Gaussians) -> Rows:
    """The columns of Gaussians, in float64 on the CPU."""
    axes = rotation_from_quaternion(gaussians.rotations.detach().cpu().double())
    scales = gaussians.scales.detach().cpu().double().numpy()
    logs = np.maximum(np.log(np.maximum(scales, 1e-30)), SMALLEST_LOG)
    spread = axes.numpy() * np.exp(logs)[:, None, :]
    return Rows(
        means=gaussians.means.detach().cpu().double().numpy(),
        logs=np.sort(logs, axis=1),
        covariances=spread @ spread.transpose(0, 2, 1),
        colours=gaussians.colours.detach().cpu().double().numpy(),
        opacities=gaussians.opacities.detach().cpu().double().numpy(),
    )


def shapes_of(rows: Rows) -> NDArray[np.float32]:
    """Covariances as (n, 6) vectors of length 1: differences are those of the matrices'."""
    flat = rows.covariances.reshape(-1, 9)[:, _SIX] * _TWICE
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    return (flat / np.maximum(length, 1e-300)).astype(np.float32)


def extent_of(rows: Rows) -> float:
    """Half the width of the central 98 %, of the widest axis; at least a tiny number."""
    if not len(rows):
        return 1.0
    low, high = np.quantile(rows.means, (0.01, 0.99), axis=0)
    wide = float((high - low).max()) / 2
    return wide if wide > 0 else max(float(np.abs(rows.means).max()), 1e-6)


NEAREST = 8
"""Candidates of a row at first."""

FURTHER = 64
"""Candidates of a row that found none."""

_BLOCK = 65536
_MAX_POSITION_FACTOR = 30.0
_AMBIGUITY_COST = 1.0

# Position, colour, opacity, sizes, orientation.
_DIMENSIONS = np.array([3.0, 3.0, 1.0, 3.0, 2.0])
_MAX_TOLERANCE = np.array([np.inf, 0.03, 0.012, 0.1, 0.1])
"""What counts as agreement before the noise is known, and at most: beyond any format's steps,
and little enough that a neighbour rarely agrees in sizes or orientation by chance."""
_MIN_AGREEMENTS = ((3, 0.02), (2, 0.5))
"""Agreements of four that make a row confident, and the minimum share of confident rows that the
noise is estimated from. A neighbour agrees in three by chance with less than one row in a
hundred."""
_MIN_NOISE = np.array([0.0, 2e-3, 2e-3, 2e-3, 2e-3])
"""Lower bound of noise: rounding of float32 through logs and logits. Of position it goes by the
extent."""
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Noise:
    """Residuals of the same row before and after the edit."""

    sigma: Floats
    """(5,) of position, colour, opacity, sizes and orientation."""

    tolerance: Floats
    """(5,) beyond which they do not agree."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matches:
    """Edited rows and their source rows."""

    rows: Indices
    """(m,) source row of each edited row, -1 for none."""

    copies: NDArray[np.bool_]
    """(m,) true where the source row went to another edited row."""

    ambiguous: NDArray[np.bool_]
    """(m,) true where another source row would have done as well."""

    noise: Noise


def match(edited: Rows, source: Rows, *, free: NDArray[np.bool_] | None = None) -> Matches:
    r"""Find edited rows among source rows that lie in the same place.

    Candidates are the nearest centres. A candidate's cost adds up what position, colour, opacity,
    sizes and orientation differ by, each in units of the noise that the data themselves show:

    .. math:: c = \sum_a d_a \log\bigl(1 + (r_a / \sigma_a)^2\bigr)

    with d_a the number of values. The logarithm keeps one attribute that an editor changed (a tint)
    from outweighing the others. Rows and candidates are then paired so that no row and candidate
    would both rather have each other than what they got (Gale and Shapley 1962), ties to the lower
    row: rows that are equal in everything keep their order.

    Args:
        edited: What is looked for.
        source: Where.
        free: Source rows that are to be had; None for all. Others only count as copies.
    """
    m = len(edited)
    nothing = Matches(
        rows=np.full(m, -1),
        copies=np.zeros(m, bool),
        ambiguous=np.zeros(m, bool),
        noise=Noise(sigma=_MIN_NOISE, tolerance=_MIN_NOISE),
    )
    if not m or not len(source):
        return nothing
    min_noise = _MIN_NOISE.copy()
    min_noise[0] = _ROUNDING * extent_of(source)
    candidates = _Candidates.search(edited, source, np.arange(m), NEAREST)
    noise = _estimated_noise(candidates, min_noise)
    if noise is None:
        return nothing
    costs = candidates.costs(noise)
    order, costs = _sorted(candidates.indices, costs)
    taken = np.zeros(len(source), bool) if free is None else ~free
    rows = _stable_matching(np.where(taken[order], np.inf, costs), order, len(source))
    assigned = taken.copy()
    assigned[rows[rows >= 0]] = True
    unmatched = np.flatnonzero(rows < 0)
    if len(unmatched) and not assigned.all():
        rows[unmatched] = _match_remaining(edited, source, unmatched, ~assigned, noise)
    copies = (rows < 0) & np.isfinite(costs[:, 0])
    rows[copies] = order[copies, 0]
    ambiguous = (rows >= 0) & (costs[:, 1:2] < costs[:, :1] + _AMBIGUITY_COST).any(axis=1)
    return Matches(rows=rows, copies=copies, ambiguous=ambiguous, noise=noise)


def _match_remaining(
    edited: Rows, source: Rows, unmatched: Indices, free: NDArray[np.bool_], noise: Noise
) -> Indices:
    """Rows that found nothing, looked for among more of the source rows that nobody has."""
    pool = np.flatnonzero(free)
    candidates = _Candidates.search(edited, source[pool], unmatched, FURTHER)
    order, costs = _sorted(candidates.indices, candidates.costs(noise))
    rows = _stable_matching(costs, order, len(pool))
    return np.where(rows < 0, -1, pool[rows])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Candidates:
    """Some edited rows with their nearest source rows and how they differ."""

    indices: Indices
    """(m, k) source rows."""

    residuals: NDArray[np.float32]
    """(m, k, 5) of position, colour, opacity, sizes and orientation."""

    @classmethod
    def search(cls, edited: Rows, source: Rows, wanted: Indices, count: int) -> "_Candidates":
        count = min(count, len(source))
        index = NeighbourIndex(torch.from_numpy(source.means))
        found = index.nearest(torch.from_numpy(edited.means[wanted]), count)
        indices = np.sort(found.indices.numpy(), axis=1)
        residuals = np.empty((*indices.shape, len(_DIMENSIONS)), np.float32)
        source_shapes, edited_shapes = shapes_of(source), shapes_of(edited[wanted])
        for part in _blocks(len(wanted), _BLOCK):
            theirs, ours = indices[part], edited[wanted[part]]
            residuals[part, :, 0] = np.linalg.norm(
                source.means[theirs] - ours.means[:, None], axis=2
            )
            residuals[part, :, 1] = np.abs(source.colours[theirs] - ours.colours[:, None]).max(2)
            residuals[part, :, 2] = np.abs(source.opacities[theirs] - ours.opacities[:, None])
            sizes = np.maximum(source.logs[theirs], SMALLEST_LOG)
            residuals[part, :, 3] = np.abs(
                sizes - np.maximum(ours.logs, SMALLEST_LOG)[:, None]
            ).max(2)
            residuals[part, :, 4] = np.linalg.norm(
                source_shapes[theirs] - edited_shapes[part][:, None], axis=2
            )
        return cls(indices=indices, residuals=residuals)

    def costs(self, noise: Noise) -> Floats:
        """(m, k), infinite where a candidate is not the same Gaussian."""
        costs = np.empty(self.indices.shape)
        for part in _blocks(len(costs), _BLOCK):
            residuals = self.residuals[part]
            agree = residuals <= noise.tolerance
            other_agreements = agree[..., 1:].sum(axis=2)
            # Formats that round by chunks are coarse where little is: there a row may lie far
            # from itself, if everything else says that it is the same.
            near_in_position = residuals[..., 0] <= _MAX_POSITION_FACTOR * noise.tolerance[0]
            # Colour and opacity are those of the neighbours often enough.
            shape_agrees = agree[..., 3] | agree[..., 4]
            same = (agree[..., 0] & shape_agrees & (other_agreements >= 2)) | (
                near_in_position & (other_agreements == 4)
            )
            cost = (_DIMENSIONS * np.log1p((residuals / noise.sigma) ** 2)).sum(axis=2)
            costs[part] = np.where(same, cost, np.inf)
        return costs


def keep_order(rows: Indices, exclusive: NDArray[np.bool_], source: Rows) -> Indices:
    """The same pairing with source rows that are equal in everything given out in their order.

    Args:
        rows: (m,) source row of each edited row, -1 for none.
        exclusive: (m,) edited rows that have their source row to themselves.
        source: The source rows.
    """
    columns = (source.means, source.covariances.reshape(-1, 9), source.colours)
    values = np.concatenate((*columns, source.opacities[:, None]), axis=1) + 0.0
    keys = np.ascontiguousarray(values).view(np.dtype((np.void, values.itemsize * values.shape[1])))
    _, group, sizes = np.unique(keys[:, 0], return_inverse=True, return_counts=True)
    shares_values = exclusive & (rows >= 0)
    shares_values[shares_values] = sizes[group[rows[shares_values]]] > 1
    ambiguous = np.flatnonzero(shares_values)
    if not len(ambiguous):
        return rows
    # Places of a group's source rows, ascending, and how many edited rows came before mine.
    members = np.argsort(group, kind="stable")
    starts = np.concatenate(([0], np.cumsum(sizes)))[group[rows[ambiguous]]]
    order = np.argsort(starts, kind="stable")
    first = np.concatenate(([True], np.diff(starts[order]) != 0))
    rank = np.arange(len(order)) - np.maximum.accumulate(np.where(first, np.arange(len(order)), 0))
    out = rows.copy()
    out[ambiguous[order]] = members[starts[order] + rank]
    return out


def _estimated_noise(candidates: _Candidates, min_noise: Floats) -> Noise | None:
    """Noise of the residuals, estimated from confident rows; None if there are few."""
    for min_agreements, min_share in _MIN_AGREEMENTS:
        agree = candidates.residuals[..., 1:] <= _MAX_TOLERANCE[1:]
        confident = agree.sum(axis=2) >= min_agreements
        distance = np.where(confident, candidates.residuals[..., 0], np.inf)
        first = distance.argmin(axis=1)
        rows = np.flatnonzero(np.isfinite(distance.min(axis=1)))
        if len(rows) < max(1.0, min_share * len(distance)):
            continue
        found = candidates.residuals[rows, first[rows]].astype(np.float64)
        # Where an attribute was changed on purpose, most residuals exceed its tolerance.
        sigma = np.clip(
            1.5 * np.median(found, axis=0), min_noise, np.maximum(_MAX_TOLERANCE / 2, min_noise)
        )
        tolerance = np.clip(3 * np.quantile(found, 0.95, axis=0), 4 * min_noise, _MAX_TOLERANCE)
        tolerance[0] = max(2 * float(np.quantile(found[:, 0], 0.99)), 4 * min_noise[0])
        return Noise(sigma=sigma, tolerance=tolerance)
    return None


def _sorted(indices: Indices, costs: Floats) -> tuple[Indices, Floats]:
    """Candidates of each row by cost; equal ones by index."""
    order = np.argsort(costs, axis=1, kind="stable")
    return np.take_along_axis(indices, order, 1), np.take_along_axis(costs, order, 1)


def _stable_matching(costs: Floats, candidates: Indices, count: int) -> Indices:
    """A stable pairing of rows with candidates, each of which goes to one row at most."""
    order = np.argsort(costs, axis=1, kind="stable")  # taken ones became infinite
    candidates = np.take_along_axis(candidates, order, 1)
    costs = np.take_along_axis(costs, order, 1)
    m, k = costs.shape
    next_choice = np.zeros(m, np.int64)
    owner = np.full(count, -1)
    proposers = np.flatnonzero(np.isfinite(costs[:, 0]))
    while len(proposers):
        proposed = candidates[proposers, next_choice[proposers]]
        current_owners = np.unique(owner[proposed])
        rivals = np.concatenate((proposers, current_owners[current_owners >= 0]))
        targets = candidates[rivals, next_choice[rivals]]
        best = np.lexsort((rivals, costs[rivals, next_choice[rivals]], targets))
        winners = best[np.concatenate(([True], np.diff(targets[best]) != 0))]
        owner[targets[winners]] = rivals[winners]
        rejected = np.setdiff1d(rivals, rivals[winners], assume_unique=True)
        next_choice[rejected] += 1
        rejected = rejected[next_choice[rejected] < k]
        proposers = rejected[np.isfinite(costs[rejected, next_choice[rejected]])]
    rows = np.full(m, -1)
    has = np.flatnonzero(owner >= 0)
    rows[owner[has]] = has
    return rows


def _blocks(count: int, size: int) -> Generator[slice]:
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))
