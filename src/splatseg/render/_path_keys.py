"""Control poses of a camera path: farthest-point samples of the captured poses in a short tour."""

import math
from itertools import pairwise

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.render._path_poses import Poses, angles_between, radian_length

_MAX_KEYS = 30
# Rounds of averaging each key's orientation with its neighbours: hand-held cameras turn far more
# than a film should.
_SMOOTHING_ROUNDS = 6
# A closed tour is taken if it is at most this many times as long as an open one.
_MAX_CLOSED_RATIO = 1.35
# Cost of the distance from the captured positions, relative to the length of the path.
_DETOUR_WEIGHT = 4.0


def key_poses(captured: Poses) -> tuple[Poses, bool]:
    """Control poses in their order along the path, and whether the path is closed."""
    unit = radian_length(captured)
    chosen = captured[_farthest_poses(captured, unit)]
    if len(chosen) < 3:
        return chosen, False
    costs = _costs(chosen, captured, unit)
    open_tour, open_length = _tour(costs, closed=False)
    closed_tour, closed_length = _tour(costs, closed=True)
    closed = len(chosen) >= 5 and closed_length <= _MAX_CLOSED_RATIO * open_length
    ordered = chosen[closed_tour if closed else open_tour]
    return _smoothed(ordered, closed=closed), closed


def _smoothed(keys: Poses, *, closed: bool) -> Poses:
    """The same positions with orientations smoothed along the path, weights 1 2 1."""
    quaternions = keys.quaternions
    for _ in range(_SMOOTHING_ROUNDS):
        around = (
            torch.cat((quaternions[-1:], quaternions, quaternions[:1]))
            if closed
            else torch.cat((quaternions[:1], quaternions, quaternions[-1:]))
        )
        before, after = (
            torch.where((x * quaternions).sum(dim=1, keepdim=True) < 0, -x, x)
            for x in (around[:-2], around[2:])
        )
        blend = before + 2 * quaternions + after
        quaternions = blend / blend.norm(dim=1, keepdim=True)
    return Poses(centres=keys.centres, quaternions=quaternions)


def _farthest_poses(poses: Poses, unit: float) -> Int64[Tensor, "k"]:
    """Indices of at most 30 poses by farthest-point sampling.

    The first is the one nearest the mean position; repeated poses are not taken.
    """
    centre = poses.centres.mean(dim=0)
    index = int((poses.centres - centre).norm(dim=1).argmin())
    chosen: list[int] = []
    distance = poses.centres.new_full((len(poses),), math.inf)
    while len(chosen) < _MAX_KEYS:
        chosen.append(index)
        distances = (poses.centres - poses.centres[index]).norm(dim=1)
        angles = unit * angles_between(poses.quaternions, poses.quaternions[index])
        distance = torch.minimum(distance, distances + angles)
        index = int(distance.argmax())
        if float(distance[index]) <= 1e-9:
            break
    return torch.tensor(chosen)


def _costs(keys: Poses, captured: Poses, unit: float) -> Float[Tensor, "k k"]:
    """Cost between keys: distance, rotation, and distance of the midpoint from captured positions.

    The last counts beyond the median distance of neighbouring captured positions.
    """
    distances = (keys.centres[:, None] - keys.centres).norm(dim=-1)
    angles = unit * angles_between(keys.quaternions[:, None], keys.quaternions)
    midway = (keys.centres[:, None] + keys.centres) / 2
    detour = torch.cdist(midway.flatten(0, 1), captured.centres).amin(dim=1).view_as(distances)
    apart = torch.cdist(captured.centres, captured.centres).fill_diagonal_(torch.inf)
    detour = (detour - apart.amin(dim=1).median()).clamp_min(0)
    return distances + angles + _DETOUR_WEIGHT * detour


def _tour(costs: Float[Tensor, "k k"], *, closed: bool) -> tuple[Int64[Tensor, "k"], float]:
    """A short tour: cheapest insertion in the order of the keys, improved by 2-opt."""
    table: list[list[float]] = costs.tolist()
    order = [0]
    for key in range(1, len(table)):
        row = table[key]
        best, insert_at = row[order[-1]], len(order)
        if closed:
            best += row[order[0]] - table[order[-1]][order[0]]
        elif row[order[0]] < best:
            best, insert_at = row[order[0]], 0
        for i, (a, b) in enumerate(pairwise(order), start=1):
            if row[a] + row[b] - table[a][b] < best:
                best, insert_at = row[a] + row[b] - table[a][b], i
        order.insert(insert_at, key)
    order = _two_opt(order, table, closed=closed)
    return torch.tensor(order), _length(order, table, closed=closed)


def _length(order: list[int], table: list[list[float]], *, closed: bool) -> float:
    total = sum(table[a][b] for a, b in pairwise(order))
    return total + (table[order[-1]][order[0]] if closed else 0.0)


def _two_opt(order: list[int], table: list[list[float]], *, closed: bool) -> list[int]:
    """2-opt: reverse stretches of the order as long as that makes it shorter."""
    count = len(order)
    improved = True
    while improved:
        improved = False
        for i in range(count - 1):
            for j in range(i + 1, count):
                before = order[i - 1] if i > 0 or closed else None
                after = order[(j + 1) % count] if j + 1 < count or closed else None
                if before == order[j] or after == order[i]:
                    continue
                gain = 0.0
                if before is not None:
                    gain += table[before][order[i]] - table[before][order[j]]
                if after is not None:
                    gain += table[order[j]][after] - table[order[i]][after]
                if gain > 1e-9:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    improved = True
    return order
