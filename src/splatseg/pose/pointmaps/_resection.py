r"""From where a camera sees points whose pixels are known: orthogonal iteration, many at once.

With :math:`V_i = v_i v_i^T` the projector onto the ray of pixel i, the pose minimises

.. math:: \sum_i w_i \left\| (I - V_i)(R x_i + t) \right\|^2 .

For a rotation the best t is known in closed form; for points moved onto their rays,
:math:`q_i = V_i (R x_i + t)`, the best rotation is (Procrustes). The two by turns never make it
worse, and reach the right pose from almost anywhere. Weights are divided by residuals on the way
(IRLS), so that wrong points lose their say.

References:
    Lu, Hager and Mjolsness, Fast and globally convergent pose estimation from video images,
    PAMI 2000.
"""

import torch
from jaxtyping import Float
from torch import Tensor

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
    rotation = procrustes(local, rays, weights)
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
        rotation = procrustes(local, target, current)
    translation = _best_translation(local @ rotation.transpose(1, 2), rays, current)
    # What was minimised does not change its sign with the points behind the camera.
    depth = ((local @ rotation.transpose(1, 2) + translation[:, None]) * rays).sum(-1)
    behind = (current * depth.sign()).sum(-1) < 0
    translation = torch.where(behind[:, None], -translation, translation)
    in_unit = size[:, 0] * translation
    return rotation, in_unit - (rotation @ middle[:, 0].unsqueeze(-1)).squeeze(-1)


def procrustes(
    source: Float[Tensor, "batch n 3"],
    target: Float[Tensor, "batch n 3"],
    weights: Float[Tensor, "batch n"],
) -> Float[Tensor, "batch 3 3"]:
    """The rotation that brings `source` nearest to `target`, about their weighted means."""
    return similarity(source, target, weights)[1]


def similarity(
    source: Float[Tensor, "batch n 3"],
    target: Float[Tensor, "batch n 3"],
    weights: Float[Tensor, "batch n"],
) -> tuple[Float[Tensor, "batch"], Float[Tensor, "batch 3 3"], Float[Tensor, "batch 3"]]:
    """Scale, rotation and translation that bring `source` nearest to `target`.

    References:
        Umeyama, Least-squares estimation of transformation parameters between two point
        patterns, PAMI 1991.
    """
    mean_source, mean_target = _mean(source, weights), _mean(target, weights)
    a, b = source - mean_source, target - mean_target
    left, values, right = torch.linalg.svd(b.transpose(1, 2) @ (weights.unsqueeze(-1) * a))
    sign = torch.ones_like(values)
    sign[:, 2] = torch.linalg.det(left @ right).sign()
    rotation = (left * sign[:, None]) @ right
    spread = (weights * a.square().sum(-1)).sum(-1)
    scale = (values * sign).sum(-1) / spread.clamp_min(1e-30)
    turned = (rotation @ mean_source.transpose(1, 2)).squeeze(-1)
    return scale, rotation, mean_target[:, 0] - scale[:, None] * turned


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
