"""From single pairs to a first world: focal lengths, resection, a tree of pairs, averages."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core.rigid import best_similarity
from splatseg.errors import InputError
from splatseg.pose._pointmap_pixels import PairSamples

_STEPS = 60
_ROBUST_FROM = 10
_MIN_RESIDUAL = 1e-3  # share of the depth


def resect(
    points: Float[Tensor, "batch n 3"],
    rays: Float[Tensor, "batch n 3"],
    weights: Float[Tensor, "batch n"],
) -> tuple[Float[Tensor, "batch 3 3"], Float[Tensor, "batch 3"]]:
    """Rotation and translation ``cam_from_points`` of each batch.

    Args:
        points: In any frame, any unit.
        rays: Directions of their pixels in the camera's frame, any length.
        weights: Not negative.
    """
    rays = rays / rays.norm(dim=-1, keepdim=True)
    middle = _mean(points, weights)
    size = _mean((points - middle).norm(dim=-1, keepdim=True), weights)
    local = (points - middle) / size
    # As if all were equally far: right to the perspective within the scene.
    rotation = best_similarity(local, rays, weights)[1]
    current = weights
    translation = torch.zeros_like(middle[:, 0])
    for step in range(_STEPS):
        turned = local @ rotation.transpose(1, 2)
        translation = _best_translation(turned, rays, current)
        moved = turned + translation[:, None]
        target = (moved * rays).sum(-1, keepdim=True) * rays
        if step >= _ROBUST_FROM:
            off = (moved - target).norm(dim=-1) / moved.norm(dim=-1).clamp_min(1e-9)
            current = weights / off.clamp_min(_MIN_RESIDUAL)
        rotation = best_similarity(local, target, current)[1]
    translation = _best_translation(local @ rotation.transpose(1, 2), rays, current)
    # What was minimised does not change its sign with the points behind the camera.
    depth = ((local @ rotation.transpose(1, 2) + translation[:, None]) * rays).sum(-1)
    behind = (current * depth.sign()).sum(-1) < 0
    translation = torch.where(behind[:, None], -translation, translation)
    in_unit = size[:, 0] * translation
    return rotation, in_unit - (rotation @ middle[:, 0].unsqueeze(-1)).squeeze(-1)


def _best_translation(turned: Tensor, rays: Tensor, weights: Tensor) -> Tensor:
    r"""The t of which :math:`\sum_i w_i (I - V_i)(R x_i + t) = 0`."""
    weighted = weights.unsqueeze(-1) * rays
    eye = torch.eye(3, dtype=rays.dtype) * weights.sum(dim=1)[:, None, None]
    matrix = eye - weighted.transpose(1, 2) @ rays
    beside = turned - (turned * rays).sum(-1, keepdim=True) * rays
    right = (weights.unsqueeze(-1) * beside).sum(dim=1)
    return -torch.linalg.solve(matrix, right)


def _mean(values: Tensor, weights: Tensor) -> Tensor:
    share = weights / weights.sum(dim=-1, keepdim=True).clamp_min(1e-30)
    return (share.unsqueeze(-1) * values).sum(dim=1, keepdim=True)


# What single pairs say: where their second camera stands, and how deep both see.


_RESECTED = 256
"""Pixels of a pair from which its second camera is found."""

_CHUNK = 256
"""Pairs that are resected together: memory stays that of these."""

_MIN_DEPTH_SHARE = 1e-2
"""Least depth, as a share of the median of its map."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairGeometry:
    """Relative poses and depths of pairs, float64, in the unit of each pair."""

    rotation: Float[Tensor, "pairs 3 3"]
    """``second_from_first``."""

    centre: Float[Tensor, "pairs 3"]
    """Of the second camera, in the first one's frame."""

    levels: Float[Tensor, "pairs 2"]
    """log of the depth that both photographs have, relative to `profiles`."""

    profiles: Float[Tensor, "views samples"]
    """log of each photograph's depths up to a constant: the median over its maps."""


def ray_directions(
    offsets: Float[Tensor, "*batch n 2"], focal: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch n 3"]:
    """Rays of pixels in their camera's frame, z = 1."""
    plane = offsets / focal[..., None, None]
    return torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1)


def pair_geometry(samples: PairSamples, focal: Float[Tensor, "views"]) -> PairGeometry:
    """Resect the second camera of each pair, and compare depths of photographs over their pairs."""
    rays = ray_directions(samples.offsets, focal)
    count = samples.offsets.shape[1]
    some = torch.linspace(0, count - 1, min(count, _RESECTED)).round().long()
    rotations: list[Tensor] = []
    translations: list[Tensor] = []
    for begin in range(0, len(samples), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        rotation, translation = resect(
            samples.points[part, 1][:, some].double(),
            rays[samples.second[part]][:, some],
            samples.weights[part, 1][:, some].double(),
        )
        rotations.append(rotation)
        translations.append(translation)
    rotation, translation = torch.cat(rotations), torch.cat(translations)
    depth = torch.stack(
        (
            samples.points[:, 0, :, 2].double(),
            (samples.points[:, 1].double() @ rotation[:, 2].unsqueeze(-1)).squeeze(-1)
            + translation[:, 2:],
        ),
        dim=1,
    )
    typical = depth.median(dim=-1, keepdim=True).values.clamp_min(1e-12)
    logs = torch.maximum(depth, _MIN_DEPTH_SHARE * typical).log()
    profiles, levels = _profiles(logs, samples)
    return PairGeometry(
        rotation=rotation,
        centre=-(rotation.transpose(1, 2) @ translation.unsqueeze(-1)).squeeze(-1),
        levels=levels,
        profiles=profiles,
    )


def _profiles(logs: Tensor, samples: PairSamples) -> tuple[Tensor, Tensor]:
    """Median log depths of each photograph, and how far each of its maps lies above."""
    about = logs - logs.median(dim=-1, keepdim=True).values
    profiles = torch.zeros(samples.offsets.shape[:2], dtype=torch.float64)
    levels = torch.zeros(logs.shape[:2], dtype=torch.float64)
    views = samples.views
    for view in range(len(profiles)):
        pairs, slots = (views == view).nonzero(as_tuple=True)
        profiles[view] = about[pairs, slots].median(dim=0).values
        levels[pairs, slots] = (logs[pairs, slots] - profiles[view]).median(dim=-1).values
    return profiles, levels


# Focal lengths from pointmaps in their own camera's frame (eq. 4), by Weiszfeld's algorithm.
#
# .. math:: f^* = \arg\min_f \sum_i w_i \left\| q_i - f \, (X_i, Y_i) / Z_i \right\|
#
# with :math:`q_i` the pixel's offset from the middle of the image. It is a geometric median in one
# unknown: each step is a least squares fit whose weights are divided by the residuals before it.


_FOCAL_STEPS = 20
_MIN_PIXELS = 1e-2  # pixels; a residual of 0 would take all the weight
_MIN_FOCAL_DEPTH = 1e-3


def weiszfeld_focal(
    offsets: Float[Tensor, "*batch n 2"],
    points: Float[Tensor, "*batch n 3"],
    weights: Float[Tensor, "*batch n"],
) -> Float[Tensor, "*batch"]:
    """The focal length of each batch in the pixels of `offsets`; NaN where nothing tells it.

    Points on or behind the camera's plane take no part.

    Args:
        offsets: Pixels right and down from the middle of the image.
        points: In the camera's frame, any unit.
        weights: Not negative.
    """
    points = points.double()
    depth = points[..., 2]
    typical = depth.median(dim=-1, keepdim=True).values
    ahead = depth > _MIN_FOCAL_DEPTH * typical.clamp_min(0)
    weights = torch.where(ahead, weights.double(), 0.0)
    plane = torch.where(
        ahead.unsqueeze(-1), points[..., :2] / depth.unsqueeze(-1), torch.zeros_like(offsets)
    )
    squares = plane.square().sum(-1)
    products = (plane * offsets).sum(-1)
    step = weights
    focal = torch.full(weights.shape[:-1], torch.nan, dtype=torch.float64)
    for _ in range(_FOCAL_STEPS):
        focal = (step * products).sum(-1) / (step * squares).sum(-1)
        residual = (offsets - focal[..., None, None] * plane).norm(dim=-1)
        step = weights / residual.clamp_min(_MIN_PIXELS)
    return torch.where(focal > 0, focal, torch.nan)


def lens_focals(samples: PairSamples) -> Float[Tensor, "views"]:
    """Focal length of each photograph in its own pixels: the median over the maps of its lens.

    A map is worth one estimate, however sure it is of itself: pairs that are wrong are few.

    Raises:
        InputError: If photographs of a lens are the first of no pair.
    """
    own = samples.points[:, 0]
    found = weiszfeld_focal(samples.offsets[samples.first], own, samples.weights[:, 0])
    lens_of_pair = samples.lenses[samples.first]
    focals = torch.empty(len(samples.lenses), dtype=torch.float64)
    for lens in samples.lenses.unique().tolist():
        of_lens = found[(lens_of_pair == lens) & torch.isfinite(found)]
        members = (samples.lenses == lens).nonzero()[:, 0]
        if not len(of_lens):
            raise InputError(
                f"pointmaps: expected a pair with photograph {int(members[0]) + 1} of "
                f"{len(focals)}, or another with its lens, as the first, from which its focal "
                "length can be told, got none."
            )
        focals[members] = of_lens.median()
    return focals


# Cameras from a spanning tree of pairs: those on which other pairs agree, or the surest.
#
# Going around a cycle of pairs that are right turns nothing: with :math:`R_{ba}` the rotation of
# pair (a, b), :math:`R_{ca} = R_{cb} R_{ba}` up to noise. A wrong pair closes no triangle, however
# sure the network was of it.


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
    return torch.linalg.matrix_exp(cross_matrix(vector))


def cross_matrix(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix of the cross product with a vector."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = (zero, -z, y, z, zero, -x, -y, x, zero)
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


# All pairs at once: rotations, depths and centres by averaging over the graph.
#
# Each is a least squares problem on the graph of pairs, with weights that leave out pairs that
# contradict the others (Geman and McClure's). With :math:`R_n` of camera n, :math:`R_{mn}` of pair
# (n, m), levels :math:`l`, logarithms of scale :math:`s` and baselines :math:`b`:
#
# .. math::
#     \delta_{mn} = \log(R_m R_{mn} R_n^T) &\approx \omega_n - \omega_m \\
#     L_n - L_m &= l_{n,e} - l_{m,e}, \qquad s_e = L_n - l_{n,e} \\
#     c_m - c_n &= e^{s_e} R_n b_e
#
# References:
#     Chatterjee and Govindu, Robust relative rotation averaging, PAMI 2018.
#     Wilson and Snavely, Robust global translations with 1DSfM, ECCV 2014.


_AVERAGING_STEPS = 20
_MIN_ANGLE = math.radians(0.2)
_MIN_LEVEL = 0.005
_MIN_BASE = 0.005
"""Residuals of pairs that count as none: angle, logarithm of scale, share of the baseline."""

_LEAST_WEIGHT = 1e-9


def average(samples: PairSamples, geometry: PairGeometry, start: World) -> World:
    """Improve a world that a tree of pairs gave by all pairs."""
    first, second = samples.first, samples.second
    rotation, trust = _rotations(samples, geometry, start.rotation)
    level, trust = _levels(samples, geometry, start.level, trust)
    log_scale = 0.5 * (level[samples.views] - geometry.levels).sum(dim=1)
    base = (rotation[first] @ geometry.centre.unsqueeze(-1)).squeeze(-1)
    steps = log_scale.exp().unsqueeze(-1) * base
    centre = start.centre
    length = steps.norm(dim=-1).clamp_min(1e-12)
    # A short baseline is as uncertain as the depths are, not as it is short.
    length = torch.maximum(length, 0.1 * length.median())
    for _ in range(_AVERAGING_STEPS):
        residual = (centre[second] - centre[first] - steps).norm(dim=-1) / length
        weights = _held(trust * geman_mcclure(residual, _MIN_BASE)) / length.square()
        centre = graph_solve(first, second, steps, weights, len(centre))
    return World(rotation=rotation, centre=centre, level=level)


def geman_mcclure(
    residual: Float[Tensor, "pairs"], least: float, *, times: float = 3.0
) -> Float[Tensor, "pairs"]:
    """Weights of residuals: 1 of none, a quarter at `times` the median, little far beyond."""
    scale = times * max(float(residual.median()), least)
    return (1 + (residual / scale).square()).square().reciprocal()


def graph_solve(
    first: Tensor,
    second: Tensor,
    differences: Float[Tensor, "pairs channels"],
    weights: Float[Tensor, "pairs"],
    count: int,
) -> Float[Tensor, "views channels"]:
    """Values of which the second's minus the first's are nearest to `differences`; mean 0.

    Pairs with weights must connect all of them.
    """
    laplacian = torch.zeros(count, count, dtype=torch.float64)
    flat = laplacian.view(-1)
    flat.index_add_(0, first * count + first, weights)
    flat.index_add_(0, second * count + second, weights)
    flat.index_add_(0, first * count + second, -weights)
    flat.index_add_(0, second * count + first, -weights)
    right = torch.zeros(count, differences.shape[1], dtype=torch.float64)
    right.index_add_(0, second, weights.unsqueeze(-1) * differences)
    right.index_add_(0, first, -weights.unsqueeze(-1) * differences)
    # Adding 1 1^T fixes what differences leave open, the mean, at 0.
    return torch.linalg.solve(laplacian + weights.mean() / count, right)


def _held(weights: Tensor) -> Tensor:
    """A pair without weight still holds its ends together where nothing else does."""
    return weights.clamp_min(_LEAST_WEIGHT)


def _rotations(
    samples: PairSamples, geometry: PairGeometry, rotation: Tensor
) -> tuple[Tensor, Tensor]:
    first, second = samples.first, samples.second
    weights = torch.ones(len(samples), dtype=torch.float64)
    for _ in range(_AVERAGING_STEPS):
        between = rotation[second] @ geometry.rotation @ rotation[first].transpose(1, 2)
        delta = rotation_vector(between)
        weights = geman_mcclure(delta.norm(dim=-1), _MIN_ANGLE)
        step = graph_solve(first, second, -delta, _held(weights), len(rotation))
        rotation = rotation_of_vector(step) @ rotation
    return rotation, weights


def _levels(
    samples: PairSamples, geometry: PairGeometry, level: Tensor, trust: Tensor
) -> tuple[Tensor, Tensor]:
    first, second = samples.first, samples.second
    wanted = geometry.levels[:, 1] - geometry.levels[:, 0]
    weights = trust
    for _ in range(_AVERAGING_STEPS):
        residual = (level[second] - level[first] - wanted).abs()
        weights = trust * geman_mcclure(residual, _MIN_LEVEL)
        level = graph_solve(first, second, wanted[:, None], _held(weights), len(level))[:, 0]
    return level, weights
