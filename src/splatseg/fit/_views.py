"""Optional modules of a fit with data per training view: exposure and pose."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Camera, Gaussians, Similarity, View
from splatseg.core.boundary import convert_fields
from splatseg.core.rigid import nearest_rotation
from splatseg.errors import RangeError
from splatseg.fit._checkpoint import StatefulModule
from splatseg.fit._options import FitOptions
from splatseg.fit.depth import DepthMaps


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseShift:
    """How far refined poses are from those given, after both were aligned."""

    degrees_mean: float
    degrees_max: float
    """Rotation of a camera."""

    distance_mean: float
    distance_max: float
    """Distance of a camera's centre, scene units."""


class PoseRefinement:
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
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        *,
        points: Float[Tensor, "n 3"],
    ) -> None:
        given = [camera.cam_from_world.detach().double().cpu() for camera in cameras]
        self._given = torch.stack(given)
        self._poses = self._given.clone()
        chosen = points[:: max(1, len(points) // _MAX_POINTS)].double()
        self._twists = torch.stack([pixel_twists(camera, chosen) for camera in cameras])
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
        rate = _POSE_RATE * _FINAL_POSE_RATE**progress
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Exposure:
    """The colours of one photograph: ``gain * colour + alpha * bias``."""

    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factor of red, green and blue, greater than 0."""

    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Offset of red, green and blue, in [0, 1] units of the colour."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if not all(math.isfinite(value) and value > 0 for value in self.gain):
            raise RangeError(f"gain: expected positive numbers, got {self.gain}.")
        if not all(math.isfinite(value) for value in self.bias):
            raise RangeError(f"bias: expected finite numbers, got {self.bias}.")


class Exposures:
    r"""Gain and bias of each training view.

    .. math:: I' = e^{g} I + \alpha b

    with one g and one b per channel, both 0 unless `start` is given. The means of g and of b over
    the views stay at their initial values: the scene has the colours of a photograph of mean
    exposure, and held-out views are rendered without either. A regulariser
    :math:`p (|g|^2 + |b|^2)` in the loss keeps them small.

    Args:
        views: Number of training views.
        start: Initial exposure of each view; None is gain 1 and bias 0.
    """

    def __init__(self, views: int, *, start: Sequence[Exposure] | None = None) -> None:
        self._values = torch.zeros(views, 6, dtype=torch.float64)
        for i, exposure in enumerate(start or ()):
            logs = [math.log(gain) for gain in exposure.gain]
            self._values[i] = torch.tensor([*logs, *exposure.bias], dtype=torch.float64)
        self._mean = self._values.mean(dim=0)
        self._adam = ViewAdam(views, 6)
        self._leaf: Tensor | None = None

    @property
    def gains(self) -> Float[Tensor, "views 3"]:
        """Factor of each channel in each view; the geometric mean over views is 1."""
        return self._values[:, :3].exp()

    @property
    def biases(self) -> Float[Tensor, "views 3"]:
        """Offset of each channel in each view; the mean over views is 0."""
        return self._values[:, 3:].clone()

    def applied(
        self,
        index: int,
        image: Float[Tensor, "height width 3"],
        alpha: Float[Tensor, "height width"],
    ) -> Float[Tensor, "height width 3"]:
        """The image in a view's exposure, differentiable in image, alpha and exposure."""
        leaf = self._values[index].to(image).requires_grad_()
        self._leaf = leaf
        return _apply(image, alpha, leaf[:3].exp(), leaf[3:])

    def update(self, index: int, *, progress: float) -> None:
        """One step of Adam along the gradient of the last image that `applied` returned."""
        leaf = self._leaf
        if leaf is None or leaf.grad is None:
            return
        gradient = leaf.grad.double().cpu() + 2 * _EXPOSURE_PRIOR * self._values[index]
        rate = _EXPOSURE_RATE * _FINAL_EXPOSURE_RATE**progress
        values = self._values.clone()
        step = rate * self._adam.direction(index, gradient)
        step[3:] *= _BIAS_SHARE
        values[index] -= step
        self._values = values - (values.mean(dim=0) - self._mean)
        self._leaf = None

    def learned(self) -> tuple[Exposure, ...]:
        """The exposures of all views, in their order."""
        rows = torch.cat((self.gains, self.biases), dim=1).tolist()
        return tuple(Exposure(gain=(r, g, b), bias=(x, y, z)) for r, g, b, x, y, z in rows)

    def state(self) -> dict[str, Tensor]:
        """Its tensors by name."""
        return {"values": self._values, **self._adam.state()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._values = tensors["values"].cpu().clone()
        self._adam.restore(tensors)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewModules:
    """The optional modules of a fit with data per view; None is one that is switched off."""

    views: tuple[View, ...]
    """The training views."""

    exposures: Exposures | None
    depths: DepthMaps | None
    poses: PoseRefinement | None

    @classmethod
    def of(
        cls,
        views: Sequence[View],
        *,
        points: Float[Tensor, "n 3"] | None,
        options: FitOptions,
        where: str,
        exposures: Mapping[str, Exposure] | None = None,
    ) -> "ViewModules":
        """The modules that the options ask for.

        Args:
            views: The training views.
            points: Points on the surfaces, for their distances.
            options: Which modules, and their learning rates.
            where: Prefix of messages.
            exposures: Initial exposures, by name of the view.

        Raises:
            InputError: If depth is asked for and there are no depth maps.
        """
        poses = None
        if options.refine_poses:
            surface_points = torch.zeros(0, 3) if points is None else points
            poses = PoseRefinement([view.camera for view in views], points=surface_points)
        learned = None
        if options.exposure:
            known = exposures or {}
            start = [known.get(view.name, Exposure()) for view in views]
            learned = Exposures(len(views), start=start)
        depths = None
        if options.depth != "off":
            depths = DepthMaps(views, points=points, options=options, where=where)
        return cls(views=tuple(views), exposures=learned, depths=depths, poses=poses)

    def stateful_modules(self) -> dict[str, StatefulModule]:
        """Modules with state, by name."""
        found: dict[str, StatefulModule] = {}
        if self.exposures is not None:
            found["exposures"] = self.exposures
        if self.poses is not None:
            found["poses"] = self.poses
        return found

    def camera(self, index: int, camera: Camera) -> Camera:
        """A view's camera at its current pose."""
        return camera if self.poses is None else self.poses.camera(index, camera)

    def differentiable_camera(self, index: int, camera: Camera) -> Camera:
        """The same, with a pose that requires a gradient."""
        return camera if self.poses is None else self.poses.leaf(index, camera)

    def view(self, index: int) -> View:
        """A view at its current pose."""
        view = self.views[index]
        return view if self.poses is None else replace(view, camera=self.camera(index, view.camera))

    def update(self, index: int, *, progress: float) -> None:
        """One step along the gradients of the last view."""
        if self.exposures is not None:
            self.exposures.update(index, progress=progress)
        if self.poses is not None:
            self.poses.update(index, progress=progress)

    def in_capture_frame(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians of the fit in the world frame of the capture."""
        return gaussians if self.poses is None else gaussians.transformed(self.poses.aligned()[0])

    def refined(self, views: Sequence[View]) -> tuple[View, ...]:
        """The given views, training views with their refined poses."""
        if self.poses is None:
            return tuple(views)
        moved = {view.name: view for view in self.poses.refined(self.views)}
        return tuple(moved.get(view.name, view) for view in views)

    def learned_exposures(self) -> dict[str, Exposure]:
        """Exposures by name of the view; empty where they are not optimised."""
        if self.exposures is None:
            return {}
        names = (view.name for view in self.views)
        return dict(zip(names, self.exposures.learned(), strict=True))

    def notes(self) -> tuple[str, ...]:
        """Sentences on exposures and poses."""
        found: list[str] = []
        if self.exposures is not None:
            gains = self.exposures.gains.mean(dim=1)
            found.append(
                f"Exposure: gains of {float(gains.min()):.3f} to {float(gains.max()):.3f} "
                f"over {len(gains)} training views."
            )
        if self.poses is not None:
            shift = self.poses.shift()
            found.append(
                f"Poses: {len(self.views)} training views turned by {shift.degrees_mean:.3f} "
                f"degrees (at most {shift.degrees_max:.3f}) and moved by "
                f"{shift.distance_mean:.4g} scene units (at most {shift.distance_max:.4g}) "
                "on average, against those given."
            )
        return tuple(found)


# Exposure compensation: a gain and a bias for each training photograph.
#
# The 3DGS code has an affine map of the colour for each training view as an option (Kerbl et al.
# 2023, ``exposure`` in its repository). Here it is diagonal: gain and bias of each channel, which
# is what automatic exposure and white balance change.


_EXPOSURE_RATE = 2e-2
"""Learning rate of log gains at progress 0: some tenths of a stop within a view's ten steps."""

_FINAL_EXPOSURE_RATE = 0.1
"""Factor of the learning rate at progress 1."""

_EXPOSURE_PRIOR = 0.01
"""Weight p of the squares of log gains and biases of a view in the loss."""

_BIAS_SHARE = 0.1
"""Learning rate of the biases over that of the gains: cameras change gains, and where a view has
little contrast the two cannot be distinguished."""


class _ApplyExposure(torch.autograd.Function):
    """gain * image + bias * alpha, in half the time of autograd.

    Rows of pixels are multiplied as rows of numbers: a broadcast over an axis of three is slow.
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, alpha: Tensor, gain: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(image, alpha, gain, bias)
        exposed = (image.flatten(1) * gain.repeat(image.shape[1])).view_as(image)
        exposed += alpha.unsqueeze(-1) * bias
        return exposed

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        image, alpha, gain, bias = ctx.saved_tensors
        rows = gradients[0].flatten(1)
        pixels = rows.reshape(-1, 3)
        v_image = (rows * gain.repeat(image.shape[1])).view_as(image)
        v_alpha = (pixels @ bias).view_as(alpha)
        v_gain = (rows * image.flatten(1)).sum(dim=0).view(-1, 3).sum(dim=0)
        return v_image, v_alpha, v_gain, pixels.T @ alpha.flatten()


_apply: Callable[..., Tensor] = _ApplyExposure.apply  # pyright: ignore[reportAssignmentType]


# Pose refinement: the poses of the training views are optimised with the Gaussians.


_POSE_RATE = 0.1
"""Learning rate at progress 0, pixels."""

_FINAL_POSE_RATE = 0.01
"""Factor of the learning rate at progress 1."""

_MAX_POINTS = 5000
"""Number of start points used, about."""

_MAX_COLUMN_RATIO = 1.5
"""Largest ratio of the lengths of two columns of `pixel_twists`."""


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
    rotation, _ = nearest_rotation(correlation)
    rotated = source @ rotation.mT
    scale = 1.0 if degenerate else float((rotated * target).sum()) / spread
    return Similarity(
        rotation=rotation, translation=target_mean - scale * rotation @ source_mean, scale=scale
    )


# Adam for a few parameters of each training view, one view a step.


_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-15


class ViewAdam:
    """Adam's moments (Kingma and Ba 2015, algorithm 1), one row per view.

    The moments of a row decay only in steps of its view: if they decayed in all steps, each step
    of a view after many others would be too large.

    Args:
        views: Number of rows.
        width: Parameters of each view.
        shared_scale: Divide all parameters of a view by one root mean square, so that the
            direction of the gradient is kept; else each by its own.
    """

    def __init__(self, views: int, width: int, *, shared_scale: bool = False) -> None:
        self._shared_scale = shared_scale
        self._first = torch.zeros(views, width, dtype=torch.float64)
        self._second = torch.zeros(views, width, dtype=torch.float64)
        self._step_counts = torch.zeros(views, dtype=torch.int64)

    def direction(self, index: int, gradient: Float[Tensor, "width"]) -> Float[Tensor, "width"]:
        """What to subtract from a view's parameters, in units of the learning rate."""
        gradient = gradient.double()
        self._step_counts[index] += 1
        steps = int(self._step_counts[index])
        self._first[index] += (1 - _BETA1) * (gradient - self._first[index])
        self._second[index] += (1 - _BETA2) * (gradient.square() - self._second[index])
        mean = self._first[index] / (1 - _BETA1**steps)
        second = self._second[index] / (1 - _BETA2**steps)
        root = (second.mean() if self._shared_scale else second).sqrt()
        return mean / (root + _EPSILON)

    def state(self) -> dict[str, Tensor]:
        """Its tensors by name."""
        return {"first": self._first, "second": self._second, "seen": self._step_counts}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._first = tensors["first"].cpu().clone()
        self._second = tensors["second"].cpu().clone()
        self._step_counts = tensors["seen"].cpu().clone()
