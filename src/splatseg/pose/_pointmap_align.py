r"""Global alignment (eq. 5), solved by turns in closed form.

.. math::
    \\min_{\\chi, P, \\sigma} \\sum_e \\sum_{v \\in e} \\sum_i w_i^{v,e}
        \frac{\\| \\chi_i^v - \\sigma_e P_e X_i^{v,e} \\|}{D_i^v},
    \\qquad \\prod_e \\sigma_e = 1, \\qquad
    \\chi_i^v = R_v \\, D_i^v (q_i / f_v, 1) + c_v

A network errs in shares of the depth, so each term is divided by it. Norms become squares with
weights (IRLS). For given :math:`\\chi` the best :math:`\\sigma_e P_e` is Umeyama's; for given pairs
the best camera is that whose rays pass the mean of its points nearest, and the best depths follow.
A pair that misses both its photographs by several times what others do loses its weight: a network
that is wrong of a pair is as sure of it as of any.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core.rigid import best_similarity
from splatseg.pose._pointmap_pixels import PairSamples
from splatseg.pose._pointmap_start import (
    PairGeometry,
    World,
    geman_mcclure,
    ray_directions,
    rotation_of_vector,
)

_MIN_RESIDUAL = 3e-3  # share of the depth
_MIN_PAIR_RESIDUAL = 2e-3
_TIMES = 2.5
"""A pair whose residual is so many times the median counts a quarter."""

_MIN_DEPTH_SHARE = 0.02
_STILL = 2e-5
"""Movement of the cameras in a step at which the alignment ends, shares of their depth."""

_NEWTON_STEPS = 2
_DAMPING = 1e-9
_MAX_ZOOM = 0.1
"""Largest change of the logarithm of a focal length in a step."""

_BLOCK = 50
"""Photographs that are aligned together; the others stand still meanwhile."""

_STEPS_A_BLOCK = 12
_CHUNK = 128
"""Pairs that are worked on at once: memory beside the samples stays that of these."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Aligned:
    """Cameras, depths and pairs in one world, float64."""

    rotation: Float[Tensor, "views 3 3"]
    """``world_from_cam``."""

    centre: Float[Tensor, "views 3"]
    focal: Float[Tensor, "views"]
    """Pixels of the photograph."""

    depth: Float[Tensor, "views samples"]
    scale: Float[Tensor, "pairs"]
    pair_rotation: Float[Tensor, "pairs 3 3"]
    pair_translation: Float[Tensor, "pairs 3"]
    """``world_from_pair``: scale * rotation @ x + translation."""

    residual: Float[Tensor, "pairs"]
    """Median distance of a pair's points from the photographs', shares of the depth, in the one
    of its two photographs where it is larger."""

    weight: Float[Tensor, "pairs"]
    """How much each pair is believed, in [0, 1]."""

    def points(self, samples: PairSamples, views: Tensor) -> Float[Tensor, "n samples 3"]:
        """Points of photographs in the world."""
        rays = ray_directions(samples.offsets[views], self.focal[views])
        local = self.depth[views].unsqueeze(-1) * rays
        return local @ self.rotation[views].transpose(1, 2) + self.centre[views, None]


def initial(
    samples: PairSamples, geometry: PairGeometry, world: World, focal: Float[Tensor, "views"]
) -> Aligned:
    """The world of a start, with the depths of the profiles and no pair placed yet."""
    count = len(samples)
    return Aligned(
        rotation=world.rotation,
        centre=world.centre,
        focal=focal,
        depth=(geometry.profiles + world.level[:, None]).exp(),
        scale=torch.ones(count, dtype=torch.float64),
        pair_rotation=torch.eye(3, dtype=torch.float64).repeat(count, 1, 1),
        pair_translation=torch.zeros(count, 3, dtype=torch.float64),
        residual=torch.full((count,), torch.nan, dtype=torch.float64),
        weight=torch.ones(count, dtype=torch.float64),
    )


def align(
    samples: PairSamples,
    start: Aligned,
    *,
    iterations: int,
    progress: Callable[[int, int], None],
) -> Aligned:
    """Improve cameras, depths and pairs by turns until nothing moves.

    Args:
        samples: The pairs.
        start: Where to begin; its pairs are placed first.
        iterations: Most steps for each photograph.
        progress: Told of steps.
    """
    count = len(start.centre)
    every = torch.arange(len(samples))
    state = place_pairs(samples, place_pairs(samples, start, every), every)
    blocks = [torch.arange(i, min(i + _BLOCK, count)) for i in range(0, count, _BLOCK)]
    inner = iterations if len(blocks) == 1 else min(_STEPS_A_BLOCK, iterations)
    total, done = iterations * len(blocks), 0
    for _ in range(-(-iterations // inner)):
        moved = 0.0
        for views in blocks:
            touching = torch.isin(samples.views, views).any(dim=1).nonzero()[:, 0]
            for _ in range(inner):
                before = state.centre
                state = place_pairs(
                    samples, _place_views(samples, state, views, touching), touching
                )
                state = normalised(state)
                depth = float(state.depth.median())
                step = float((state.centre - before).norm(dim=1).max()) / depth
                moved = max(moved, step)
                done += 1
                progress(min(done, total), total)
                if step < _STILL:
                    break
        if moved < _STILL:
            break
    return normalised(place_pairs(samples, state, every))


def place_pairs(samples: PairSamples, state: Aligned, pairs: Int64[Tensor, "n"]) -> Aligned:
    """The best similarity of each of these pairs for the points of the photographs."""
    fields = {
        name: getattr(state, name).clone()
        for name in ("scale", "pair_rotation", "pair_translation")
    }
    for chunk in pairs.split(_CHUNK):
        views = samples.views[chunk]
        points = samples.points[chunk].double().flatten(1, 2)
        target = state.points(samples, views.flatten()).reshape(points.shape)
        depth = state.depth[views].flatten(1, 2)
        weights = samples.weights[chunk].double().flatten(1, 2) / depth.square()
        if not bool(state.residual[chunk].isnan().any()):
            off = _distance(state, chunk, points, target) / depth
            weights = weights / off.clamp_min(_MIN_RESIDUAL)
        # The noise is the network's: the world explains its points, not they the world, or every
        # pair would shrink about its middle.
        inverse, turn, shift = best_similarity(target, points, weights)
        fields["scale"][chunk] = inverse.reciprocal()
        fields["pair_rotation"][chunk] = turn.transpose(1, 2)
        back = (turn.transpose(1, 2) @ shift.unsqueeze(-1)).squeeze(-1)
        fields["pair_translation"][chunk] = -back / inverse[:, None]
    state = replace(state, **fields)
    residual = state.residual.clone()
    residual[pairs] = pair_residuals(samples, state, pairs)
    weight = geman_mcclure(residual, _MIN_PAIR_RESIDUAL, times=_TIMES)
    return replace(state, residual=residual, weight=weight)


def pair_residuals(
    samples: PairSamples, state: Aligned, pairs: Int64[Tensor, "n"]
) -> Float[Tensor, "n"]:
    """`Aligned.residual` of these pairs."""
    found: list[Tensor] = []
    for chunk in pairs.split(_CHUNK):
        views = samples.views[chunk]
        points = samples.points[chunk].double().flatten(1, 2)
        target = state.points(samples, views.flatten()).reshape(points.shape)
        off = _distance(state, chunk, points, target) / state.depth[views].flatten(1, 2)
        # Of the worse of the two: an outlier may be right of one of its photographs.
        found.append(off.unflatten(1, (2, -1)).median(dim=2).values.amax(dim=1))
    return torch.cat(found)


def _place_views(
    samples: PairSamples, state: Aligned, views: Int64[Tensor, "n"], pairs: Int64[Tensor, "m"]
) -> Aligned:
    """The best camera and depths of each of these photographs for the points of its pairs."""
    size = (len(state.centre), samples.offsets.shape[1])
    total = torch.zeros(*size, 3, dtype=torch.float64)
    sums = torch.zeros(size, dtype=torch.float64)
    for chunk in pairs.split(_CHUNK):
        ends = samples.views[chunk]
        points = samples.points[chunk].double().flatten(1, 2)
        target = state.points(samples, ends.flatten()).reshape(points.shape)
        depth = state.depth[ends].flatten(1, 2)
        placed = _placed(state, chunk, points)
        off = (target - placed).norm(dim=-1) / depth
        weights = samples.weights[chunk].double().flatten(1, 2) / depth.square()
        weights = state.weight[chunk, None] * weights / off.clamp_min(_MIN_RESIDUAL)
        weighted = weights.unsqueeze(-1) * placed
        flat = ends.flatten()
        total.index_add_(0, flat, weighted.reshape(-1, size[1], 3))
        sums.index_add_(0, flat, weights.reshape(-1, size[1]))
    mean = total[views] / sums[views].clamp_min(1e-300).unsqueeze(-1)
    rotation, centre, focal = _cameras(samples, state, views, mean, sums[views])
    rays = ray_directions(samples.offsets[views], focal[views])
    local = (mean - centre[:, None]) @ rotation
    depth = (local * rays).sum(-1) / rays.square().sum(-1)
    typical = depth.median(dim=1, keepdim=True).values.clamp_min(1e-12)
    fields = {name: getattr(state, name).clone() for name in ("rotation", "centre", "depth")}
    fields["rotation"][views] = rotation
    fields["centre"][views] = centre
    fields["depth"][views] = torch.maximum(depth, _MIN_DEPTH_SHARE * typical)
    return replace(state, focal=focal, **fields)


def _cameras(
    samples: PairSamples, state: Aligned, views: Tensor, points: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    r"""Steps of Gauss and Newton that bring the rays of cameras nearer to points.

    The residual of a point p in its camera's frame is :math:`(I - d d^T) p` with d its unit ray.
    Turning the camera by :math:`\omega` and moving it by :math:`\tau` changes p by
    :math:`[p]_\times \omega - \tau`; a focal length longer by :math:`1 + \phi` moves the point of
    the ray, at depth D, by :math:`-\phi D (d_x, d_y, 0) / d_z`. (Moving p instead, by its own x
    and y, would reward whatever makes its noise smaller.) Poses are eliminated first (Schur),
    since photographs of one lens share :math:`\phi`.

    Returns:
        Rotations and centres of these views, focal lengths of all.
    """
    rotation, centre, focal = state.rotation[views], state.centre[views], state.focal
    lenses = samples.lenses[views]
    for _ in range(_NEWTON_STEPS):
        rays = ray_directions(samples.offsets[views], focal[views])
        local = (points - centre[:, None]) @ rotation
        depth = (local * rays).sum(-1, keepdim=True) / rays.square().sum(-1, keepdim=True)
        residual = local - depth * rays
        jacobian = _jacobian(local, rays, depth).flatten(1, 2)
        weighted = jacobian * weights.repeat_interleave(3, dim=1).unsqueeze(-1)
        normal = weighted.transpose(1, 2) @ jacobian
        right = weighted.transpose(1, 2) @ residual.flatten(1, 2).unsqueeze(-1)
        # Where points do not tell something, it stays as it is.
        normal = normal + torch.diag_embed(_DAMPING * normal.diagonal(dim1=1, dim2=2) + 1e-30)
        solved = torch.linalg.solve(
            normal[:, :6, :6], torch.cat((normal[:, :6, 6:], right[:, :6]), dim=-1)
        )
        left = normal[:, 6:, :6] @ solved
        top = torch.zeros(len(focal), dtype=torch.float64)
        bottom = torch.zeros_like(top)
        top.index_add_(0, lenses, (right[:, 6:] - left[..., 1:])[:, 0, 0])
        bottom.index_add_(0, lenses, (normal[:, 6:, 6:] - left[..., :1])[:, 0, 0])
        zooms = -torch.where(bottom > 0, top / bottom.clamp_min(1e-300), 0.0)
        step = -solved[..., 1] - solved[..., 0] * zooms[lenses, None]
        focal = focal * torch.exp(zooms.clamp(-_MAX_ZOOM, _MAX_ZOOM))[samples.lenses]
        rotation = rotation @ rotation_of_vector(step[:, :3])
        centre = centre + (rotation @ step[:, 3:].unsqueeze(-1)).squeeze(-1)
    return rotation, centre, focal


def _jacobian(local: Tensor, rays: Tensor, depth: Tensor) -> Tensor:
    """Of residuals by turning, moving and zooming, (views, samples, 3, 7); see `_cameras`."""
    x, y, z = local.unbind(-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    zoom = depth * rays
    rows = (
        (zero, -z, y, -one, zero, zero, zoom[..., 0]),
        (z, zero, -x, zero, -one, zero, zoom[..., 1]),
        (-y, x, zero, zero, zero, -one, zero),
    )
    full = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    unit = rays / rays.norm(dim=-1, keepdim=True)
    along = (unit.unsqueeze(-1) * full).sum(dim=-2, keepdim=True)
    return full - unit.unsqueeze(-1) * along


def normalised(state: Aligned) -> Aligned:
    """The same world in the unit in which the product of the pairs' scales is one."""
    unit = state.scale.log().mean().exp()
    return replace(
        state,
        centre=state.centre / unit,
        depth=state.depth / unit,
        scale=state.scale / unit,
        pair_translation=state.pair_translation / unit,
    )


def _placed(state: Aligned, pairs: Tensor, points: Tensor) -> Tensor:
    turned = points @ state.pair_rotation[pairs].transpose(1, 2)
    return state.scale[pairs, None, None] * turned + state.pair_translation[pairs, None]


def _distance(state: Aligned, pairs: Tensor, points: Tensor, target: Tensor) -> Tensor:
    return (target - _placed(state, pairs, points)).norm(dim=-1)
