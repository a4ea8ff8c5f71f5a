"""Pose refinement: the poses of the training views are optimised with the Gaussians."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Camera, Similarity, View
from splatseg.fit._options import FitOptions
from splatseg.fit._view_adam import ViewAdam

_FINAL_RATE = 0.01
"""Factor of the learning rate at progress 1."""

_MAX_POINTS = 5000
"""Number of start points used, about."""

_MAX_COLUMN_RATIO = 1.5
"""Largest ratio of the lengths of two columns of `pixel_twists`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseShift:
    """How far refined poses are from those given, after both were aligned."""

    degrees_mean: float
    degrees_max: float
    """Rotation of a camera."""

    distance_mean: float
    distance_max: float
    """Distance of a camera's centre, scene units."""


class Poses:
    r"""Poses of the training views, each updated by a twist in its own camera axes.

    .. math:: T \leftarrow \exp \begin{pmatrix} [\omega]_\times & v \\ 0 & 0 \end{pmatrix} T

    with T = ``cam_from_world``. Adam's step is taken in coordinates in which a unit moves the
    start points in view by about one pixel in any direction (see `pixel_twists`): a rotation and
    a sideways translation have nearly the same effect on the image, and plain steps do not
    separate them.

    The frame of the whole scene is free and may drift; `aligned` removes the drift.

    Args:
        cameras: The training views' cameras as given.
        points: Start points, for the distances of the surfaces.
        options: The learning rate.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        *,
        points: Float[Tensor, "n 3"],
        options: FitOptions,
    ) -> None:
        given = [camera.cam_from_world.detach().double().cpu() for camera in cameras]
        self._given = torch.stack(given)
        self._poses = self._given.clone()
        chosen = points[:: max(1, len(points) // _MAX_POINTS)].double()
        self._twists = torch.stack([pixel_twists(camera, chosen) for camera in cameras])
        self._rate = options.pose_rate
        self._adam = ViewAdam(len(cameras), 6, shared_scale=True)
        self._leaf: Tensor | None = None

    def camera(self, index: int, camera: Camera) -> Camera:
        """A view's camera at its current pose."""
        return replace(camera, cam_from_world=self._poses[index])

    def leaf(self, index: int, camera: Camera) -> Camera:
        """The same, with a pose that requires a gradient, which `update` uses."""
        self._leaf = self._poses[index].clone().requires_grad_()
        return replace(camera, cam_from_world=self._leaf)

    def update(self, index: int, *, progress: float) -> None:
        """One step of Adam along the gradient of the last camera that `leaf` returned."""
        leaf = self._leaf
        if leaf is None or leaf.grad is None:
            return
        gradient = twist_gradient(leaf.grad, self._poses[index])
        twists = self._twists[index]
        rate = self._rate * _FINAL_RATE**progress
        step = -rate * twists @ self._adam.direction(index, twists.mT @ gradient)
        poses = self._poses.clone()
        poses[index, :3] = (exponential(step) @ poses[index])[:3]
        self._poses = poses
        self._leaf = None

    def aligned(self) -> tuple[Similarity, Float[Tensor, "views 4 4"]]:
        """The similarity from the refined frame to the given one, and the poses in the given one.

        The poses are ``cam_from_world`` of the given world. Gaussians of the fit are mapped into
        it by the same similarity.
        """
        given_from_refined = aligning_similarity(self._given, self._poses)
        rotation = given_from_refined.rotation
        rotated = self._poses.clone()
        rotated[:, :3, :3] = self._poses[:, :3, :3] @ rotation.T
        centres = given_from_refined.apply(centres_of(self._poses))
        rotated[:, :3, 3] = -torch.einsum("nij,nj->ni", rotated[:, :3, :3], centres)
        return given_from_refined, rotated

    def refined(self, views: Sequence[View]) -> tuple[View, ...]:
        """The training views, in the order of the cameras, with their refined poses, aligned."""
        _, poses = self.aligned()
        return tuple(
            replace(view, camera=replace(view.camera, cam_from_world=pose))
            for view, pose in zip(views, poses, strict=True)
        )

    def shift(self) -> PoseShift:
        """How far the refined poses are from those given."""
        _, poses = self.aligned()
        rotations = poses[:, :3, :3] @ self._given[:, :3, :3].mT
        # |R - I| = 2 sqrt 2 sin(angle / 2), exact where the arc cosine of the trace is not.
        chord = torch.linalg.matrix_norm(rotations - torch.eye(3, dtype=rotations.dtype))
        degrees = torch.rad2deg(2 * torch.asin((chord / 8**0.5).clamp_max(1)))
        distance = (centres_of(poses) - centres_of(self._given)).norm(dim=1)
        return PoseShift(
            degrees_mean=float(degrees.mean()),
            degrees_max=float(degrees.max()),
            distance_mean=float(distance.mean()),
            distance_max=float(distance.max()),
        )

    def state(self) -> dict[str, Tensor]:
        """Its tensors by name."""
        return {"poses": self._poses, **self._adam.state()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._poses = tensors["poses"].cpu().clone()
        self._adam.restore(tensors)


def centres_of(poses: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 3"]:
    """Camera centres of ``cam_from_world`` matrices."""
    return -torch.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])


def pixel_twists(camera: Camera, points: Float[Tensor, "n 3"]) -> Float[Tensor, "6 6"]:
    r"""Twists as columns, each of which moves the points in view by about one pixel.

    They are :math:`(J^\top J / n)^{-1/2}` with J the Jacobian of the pixels of the n points with
    respect to :math:`(\omega, v)`. No column is more than 1.5 times as long as the shortest:
    steps along motions that the points hardly constrain would follow the noise.
    """
    pose = camera.cam_from_world.detach().double().cpu()
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    u, v = x / z, y / z
    seen = (z > 0) & ((camera.fx * u + camera.cx - camera.width / 2).abs() < camera.width / 2)
    seen &= (camera.fy * v + camera.cy - camera.height / 2).abs() < camera.height / 2
    if not bool(seen.any()):
        u, v, z = (torch.tensor(value).double() for value in ([0.0], [0.0], [1.0]))
    else:
        u, v, z = u[seen], v[seen], z[seen]
    none = torch.zeros_like(u)
    # d(x / z) where d(x, y, z) = omega x (x, y, z) + v.
    across = torch.stack((-u * v, 1 + u * u, -v, 1 / z, none, -u / z), dim=1) * camera.fx
    down = torch.stack((-(1 + v * v), u * v, u, none, 1 / z, -v / z), dim=1) * camera.fy
    jacobian = torch.cat((across, down))
    # Lengths are in units of the points' median depth, so that the unit of length does not matter.
    unit = torch.ones(6, dtype=torch.float64)
    unit[3:] = z.median()
    jacobian = jacobian * unit
    values, vectors = torch.linalg.eigh(jacobian.mT @ jacobian / len(u))
    values = values.clamp_min(float(values[-1]) / _MAX_COLUMN_RATIO**2)
    return unit[:, None] * (vectors / values.sqrt()) @ vectors.mT


def twist_gradient(
    gradient: Float[Tensor, "4 4"], pose: Float[Tensor, "4 4"]
) -> Float[Tensor, "6"]:
    r"""Gradient with respect to the twist :math:`(\omega, v)` at 0 of :math:`\exp(\omega, v) T`.

    With :math:`dT = [\omega]_\times T + (0, v)` and G the gradient with respect to T it is
    :math:`(A_{32} - A_{23}, A_{13} - A_{31}, A_{21} - A_{12}, G_{14}, G_{24}, G_{34})` where
    :math:`A = G T^\top` of the upper three rows.
    """
    gradient_rows = gradient[:3].double().cpu()
    a = gradient_rows @ pose[:3].mT
    rotation = torch.stack((a[2, 1] - a[1, 2], a[0, 2] - a[2, 0], a[1, 0] - a[0, 1]))
    return torch.cat((rotation, gradient_rows[:, 3]))


def exponential(twist: Float[Tensor, "6"]) -> Float[Tensor, "4 4"]:
    """The rigid motion of a twist (omega, v), by the matrix exponential."""
    x, y, z = twist[:3].tolist()
    algebra = torch.zeros(4, 4, dtype=torch.float64)
    algebra[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    algebra[:3, 3] = twist[3:]
    motion = torch.linalg.matrix_exp(algebra)
    # The matrix exponential gives this row up to rounding; `Camera` requires it exactly.
    motion[3] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    return motion


def aligning_similarity(
    given: Float[Tensor, "n 4 4"], refined: Float[Tensor, "n 4 4"]
) -> Similarity:
    """The similarity given_from_refined that best aligns refined cameras to the given ones.

    The rotation is the least-squares fit to the cameras' orientations and to their centres, in
    units of the centres' spread; scale and translation then fit the centres in least squares.
    Where all centres coincide, the scale is 1.
    """
    target, source = centres_of(given), centres_of(refined)
    target_mean, source_mean = target.mean(dim=0), source.mean(dim=0)
    target, source = target - target_mean, source - source_mean
    spread = float(source.square().sum())
    # R_given = R_refined rotation^T, so the sum of R_given^T R_refined is nearest to rotation.
    correlation = torch.einsum("nji,njk->ik", given[:, :3, :3], refined[:, :3, :3])
    degenerate = spread <= 1e-12 * float(source_mean.square().sum() + 1)
    if not degenerate:
        correlation = correlation + len(given) * target.mT @ source / spread
    u, _, vt = torch.linalg.svd(correlation)
    sign = torch.ones(3, dtype=correlation.dtype)
    sign[2] = torch.sign(torch.linalg.det(u @ vt))
    rotation = u @ torch.diag(sign) @ vt
    rotated = source @ rotation.mT
    scale = 1.0 if degenerate else float((rotated * target).sum()) / spread
    return Similarity(
        rotation=rotation, translation=target_mean - scale * rotation @ source_mean, scale=scale
    )
