"""Cameras from a spanning tree of pairs: those on which other pairs agree, or the surest.

Going around a cycle of pairs that are right turns nothing: with :math:`R_{ba}` the rotation of
pair (a, b), :math:`R_{ca} = R_{cb} R_{ba}` up to noise. A wrong pair closes no triangle, however
sure the network was of it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.pose.pointmaps._geometry import PairGeometry
from splatseg.pose.pointmaps._samples import PairSamples

_AGREEING = math.radians(5.0)
"""Angle at which a cycle of pairs counts e times less."""

_CONFIDENCE_SHARE = 1e-3
"""What a pair's confidence adds to its triangles: it decides between pairs that have none."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World:
    """Cameras and depths in one frame, float64."""

    rotation: Float[Tensor, "views 3 3"]
    """``world_from_cam``."""

    centre: Float[Tensor, "views 3"]
    level: Float[Tensor, "views"]
    """log of each photograph's depth over its profile, see `PairGeometry`."""


def agreement(samples: PairSamples, geometry: PairGeometry) -> Float[Tensor, "pairs"]:
    """How much other pairs agree with each: a count of cycles of two and three pairs."""
    ways: dict[tuple[int, int], list[Tensor]] = {}
    ends = list(zip(samples.first.tolist(), samples.second.tolist(), strict=True))
    for (a, b), rotation in zip(ends, geometry.rotation, strict=True):
        ways.setdefault((a, b), []).append(rotation)
        ways.setdefault((b, a), []).append(rotation.T)
    near: dict[int, set[int]] = {}
    for a, b in ways:
        near.setdefault(a, set()).add(b)
    scores = torch.zeros(len(samples), dtype=torch.float64)
    for e, (a, b) in enumerate(ends):
        own = geometry.rotation[e]
        others = [way for way in ways[a, b] if not torch.equal(way, own)]
        cycles = [torch.stack(others)[:, None]] if others else []
        for c in sorted(near[a] & near[b]):
            one, two = torch.stack(ways[a, c]), torch.stack(ways[c, b])
            cycles.append((two[:, None] @ one[None]).reshape(1, -1, 3, 3))
        for turns in cycles:
            angles = rotation_angle(turns @ own.T)
            scores[e] += (-(angles.amin() / _AGREEING).square()).exp()
    sure = samples.weights.double().mean(dim=(1, 2))
    return scores + _CONFIDENCE_SHARE * sure / sure.max().clamp_min(1e-12)


def confidence_score(samples: PairSamples) -> Float[Tensor, "pairs"]:
    """DUSt3R's score of a pair: the mean confidence of one map times that of the other."""
    return samples.weights.double().exp().mean(dim=2).prod(dim=1)


def spanning_tree(samples: PairSamples, score: Float[Tensor, "pairs"]) -> list[int]:
    """Pairs of the tree with the highest scores, each reaching one photograph more (Prim).

    The graph must hang together.
    """
    ends = list(zip(samples.first.tolist(), samples.second.tolist(), strict=True))
    order: list[int] = score.argsort(descending=True, stable=True).tolist()
    reached = set(ends[order[0]])
    tree = [order[0]]
    count = len(set(samples.views.flatten().tolist()))
    while len(reached) < count:
        best = next(e for e in order if (ends[e][0] in reached) != (ends[e][1] in reached))
        tree.append(best)
        reached |= set(ends[best])
    return tree


def tree_world(samples: PairSamples, geometry: PairGeometry, tree: Sequence[int]) -> World:
    """Cameras along the tree: each pair brings one more, in the scale of the one that is known."""
    count = len(geometry.profiles)
    rotation = torch.eye(3, dtype=torch.float64).repeat(count, 1, 1)
    centre = torch.zeros(count, 3, dtype=torch.float64)
    level = torch.zeros(count, dtype=torch.float64)
    known = {int(samples.first[tree[0]])}
    for e in tree:
        a, b = int(samples.first[e]), int(samples.second[e])
        turn, base = geometry.rotation[e], geometry.centre[e]
        old, new, slot = (a, b, 0) if a in known else (b, a, 1)
        log_scale = level[old] - geometry.levels[e, slot]
        level[new] = log_scale + geometry.levels[e, 1 - slot]
        rotation[new] = rotation[old] @ (turn.T if old == a else turn)
        first = rotation[a]
        step = log_scale.exp() * (first @ base)
        centre[new] = centre[old] + (step if old == a else -step)
        known.add(new)
    return World(rotation=rotation, centre=centre, level=level)


def rotation_angle(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """How far rotations turn, radians."""
    return rotation_vector(rotation).norm(dim=-1)


def rotation_vector(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Axis times angle of rotations, in [0, pi]; at pi the axis is without meaning."""
    skew = rotation - rotation.transpose(-1, -2)
    axis = torch.stack((skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]), dim=-1) / 2
    sine = axis.norm(dim=-1)
    cosine = (rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    angle = torch.atan2(sine, cosine)
    small = sine < 1e-9
    straight = torch.where(cosine < 0, angle, 1.0)
    factor = torch.where(small, straight, angle / torch.where(small, 1.0, sine))
    unit = axis.new_tensor([1.0, 0.0, 0.0]).expand_as(axis)
    axis = torch.where((small & (cosine < 0)).unsqueeze(-1), unit, axis)
    return factor.unsqueeze(-1) * axis


def rotation_of_vector(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotations about axes by their length, radians. Inverse of `rotation_vector`."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = (zero, -z, y, z, zero, -x, -y, x, zero)
    return torch.linalg.matrix_exp(torch.stack(rows, dim=-1).reshape(*x.shape, 3, 3))
