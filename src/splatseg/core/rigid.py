"""Rotations, quaternions and similarity transforms.

Quaternions are (w, x, y, z) with the Hamilton product; transforms are named
``target_from_source``, see ``docs/conventions.md``.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import RangeError


def normalised(quaternions: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Scale quaternions to unit length.

    Raises:
        RangeError: If one has zero length or is not finite.
    """
    length = torch.linalg.vector_norm(quaternions, dim=-1, keepdim=True)
    if not bool((length > 0).all()) or not bool(torch.isfinite(length).all()):
        raise RangeError("quaternions: expected finite, non-zero quaternions, got one that is not.")
    return quaternions / length


def rotation_from_quaternion(
    quaternions: Float[Tensor, "*batch 4"],
) -> Float[Tensor, "*batch 3 3"]:
    r"""Rotation matrices of quaternions, which need not have unit length.

    .. math:: R = I + 2 w [v]_\times + 2 [v]_\times^2, \quad q = (w, v) / |q|

    Differentiable; a zero quaternion gives NaN (see `normalised` for the check).
    """
    q = quaternions / torch.linalg.vector_norm(quaternions, dim=-1, keepdim=True)
    w, x, y, z = q.unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )
    return torch.stack(rows, dim=-1).reshape(*q.shape[:-1], 3, 3)


def quaternion_from_rotation(
    rotation: Float[Tensor, "*batch 3 3"],
) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions of rotation matrices, with w >= 0.

    The largest of the four components is found from the diagonal and the others are divided
    by it, so that no small number is ever a divisor (Shepperd 1978).
    """
    r = rotation
    d0, d1, d2 = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    squares = torch.stack(
        (1 + d0 + d1 + d2, 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2), dim=-1
    )
    wx, wy, wz = (
        r[..., 2, 1] - r[..., 1, 2],
        r[..., 0, 2] - r[..., 2, 0],
        r[..., 1, 0] - r[..., 0, 1],
    )
    xy, xz, yz = (
        r[..., 0, 1] + r[..., 1, 0],
        r[..., 0, 2] + r[..., 2, 0],
        r[..., 1, 2] + r[..., 2, 1],
    )
    # Row k is 4 q_k (w, x, y, z): whichever k is largest gives the best-conditioned answer.
    candidates = torch.stack(
        (
            torch.stack((squares[..., 0], wx, wy, wz), -1),
            torch.stack((wx, squares[..., 1], xy, xz), -1),
            torch.stack((wy, xy, squares[..., 2], yz), -1),
            torch.stack((wz, xz, yz, squares[..., 3]), -1),
        ),
        dim=-2,
    )
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    q = candidates.gather(-2, best).squeeze(-2)
    q = q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def quaternion_multiply(
    left: Float[Tensor, "*batch 4"], right: Float[Tensor, "*batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """Hamilton product: the rotation `right` followed by the rotation `left`."""
    aw, ax, ay, az = left.unbind(-1)
    bw, bx, by, bz = right.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def check_rotation(name: str, rotation: Tensor, *, tolerance: float = 1e-3) -> None:
    """Raise `RangeError` unless `rotation` (3, 3) is orthonormal with determinant +1."""
    check_shape(name, rotation, (3, 3))
    check_finite(name, rotation)
    r = rotation.detach().double()
    error = float((r @ r.T - torch.eye(3, dtype=torch.float64, device=r.device)).abs().max())
    determinant = float(torch.linalg.det(r))
    if error > tolerance or determinant < 0:
        raise RangeError(
            f"{name}: expected a rotation, got a matrix with |R R^T - I| = {error:.3g} "
            f"and determinant {determinant:.3g}."
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Similarity:
    """A similarity transform ``target_from_source``: x -> scale * rotation @ x + translation."""

    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]
    scale: Annotated[float, Meta(gt=0)] = 1.0

    def __post_init__(self) -> None:
        convert_fields(self)
        check_rotation("rotation", self.rotation)
        check_finite("translation", self.translation)

    @classmethod
    def identity(cls) -> "Similarity":
        """The transform that changes nothing."""
        return cls(
            rotation=torch.eye(3, dtype=torch.float64),
            translation=torch.zeros(3, dtype=torch.float64),
        )

    @property
    def matrix(self) -> Float[Tensor, "4 4"]:
        """The homogeneous matrix, float64."""
        out = torch.eye(4, dtype=torch.float64)
        out[:3, :3] = self.rotation.double() * self.scale
        out[:3, 3] = self.translation.double()
        return out

    @boundary
    def apply(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Move points from the source frame to the target frame, in their own dtype."""
        rotation = self.rotation.to(points)
        return self.scale * (points @ rotation.T) + self.translation.to(points)

    def inverse(self) -> "Similarity":
        """The transform ``source_from_target``."""
        rotation = self.rotation.T
        return Similarity(
            rotation=rotation,
            translation=-(rotation @ self.translation) / self.scale,
            scale=1 / self.scale,
        )

    @boundary
    def compose(self, inner: "Similarity") -> "Similarity":
        """``target_from_source @ source_from_inner``: first `inner`, then this."""
        return Similarity(
            rotation=self.rotation.double() @ inner.rotation.double(),
            translation=self.apply(inner.translation.double()),
            scale=self.scale * inner.scale,
        )


def nearest_rotation(
    correlation: Float[Tensor, "*batch 3 3"],
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3"]]:
    """The rotation nearest to a matrix, and the signed singular values (Kabsch 1976)."""
    left, values, right = torch.linalg.svd(correlation)
    sign = torch.ones_like(values)
    sign[..., 2] = torch.linalg.det(left @ right).sign()
    return (left * sign[..., None, :]) @ right, values * sign


def best_similarity(
    source: Float[Tensor, "*batch n 3"],
    target: Float[Tensor, "*batch n 3"],
    weights: Float[Tensor, "*batch n"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3"]]:
    """Scale, rotation and translation that bring `source` nearest to `target`, many at once.

    References:
        Umeyama, Least-squares estimation of transformation parameters between two point
        patterns, PAMI 1991.
    """
    share = weights / weights.sum(dim=-1, keepdim=True).clamp_min(1e-30)
    mean_source, mean_target = (
        (share.unsqueeze(-1) * points).sum(dim=-2, keepdim=True) for points in (source, target)
    )
    a, b = source - mean_source, target - mean_target
    rotation, values = nearest_rotation(b.mT @ (weights.unsqueeze(-1) * a))
    spread = (weights * a.square().sum(-1)).sum(-1)
    scale = values.sum(-1) / spread.clamp_min(1e-30)
    turned = (rotation @ mean_source.mT).squeeze(-1)
    return scale, rotation, mean_target[..., 0, :] - scale[..., None] * turned


def similarity_between(
    source: Float[Tensor, "n 3"],
    target: Float[Tensor, "n 3"],
    *,
    weights: Float[Tensor, "n"] | None = None,
    with_scale: bool = True,
) -> "Similarity | None":
    """The least-squares similarity target_from_source (`best_similarity`), float64.

    None where the points do not determine a positive scale. Without `with_scale` the scale is 1.
    """
    one, two = source.double(), target.double()
    counted = torch.ones(len(one), dtype=torch.float64) if weights is None else weights.double()
    scale, rotation, translation = best_similarity(one, two, counted)
    if with_scale and not 0 < float(scale) < float("inf"):
        return None
    if not with_scale:
        mean = (counted[:, None] * one).sum(dim=0) / counted.sum()
        translation = translation + (scale - 1) * (rotation @ mean)
        scale = torch.ones_like(scale)
    return Similarity(rotation=rotation, translation=translation, scale=float(scale))


def upright(
    points: Float[Tensor, "n 3"], up: tuple[float, float, float] | None
) -> Float[Tensor, "n 3"]:
    """Points turned the shortest way by which `up` becomes z.

    Raises:
        RangeError: If `up` has no direction.
    """
    if up is None:
        return points
    axis = torch.tensor(up, dtype=torch.float64)
    length = float(torch.linalg.vector_norm(axis))
    if not (length > 0 and length < float("inf")):
        raise RangeError(f"up: expected a direction, got {up}.")
    x, y, z = (axis / length).tolist()
    if z < -1 + 1e-9:  # upside down: half a turn about x
        turn = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    else:
        # Rodrigues' rotation from u to z, with its cosine z.
        k = 1 / (1 + z)
        turn = torch.tensor(
            [[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]],
            dtype=torch.float64,
        )
    return (points.double() @ turn.T).to(points.dtype)
