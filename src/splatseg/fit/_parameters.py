"""The optimised parameters, unconstrained, and Adam's moments of them."""

from collections.abc import Iterator
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg import _native
from splatseg.core import Camera, Gaussians
from splatseg.core.gaussians import exponential, sigmoid

# 2 ln 255: beyond this Mahalanobis distance squared even an opaque Gaussian's alpha is < 1/255.
_MAX_SIGMAS = 3.34
# More than the square root of the low-pass variance of 0.3 square pixels.
_LOW_PASS_SIGMA = 0.55
# The Jacobian is taken at most this far outside the image, in half image sizes.
_FRUSTUM_MARGIN = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Parameters:
    """Unconstrained parameters of the Gaussians, one row each.

    Scales are exp(log_scales), opacities sigmoid(logits), rotations quaternions / length.
    """

    means: Float[Tensor, "n 3"]
    log_scales: Float[Tensor, "n 3"]
    rotations: Float[Tensor, "n 4"]
    logits: Float[Tensor, "n 1"]
    sh: Float[Tensor, "n coefficients_3"]
    """Spherical harmonics, the three channels of a coefficient side by side."""

    def __len__(self) -> int:
        return self.means.shape[0]

    def tensors(self) -> Iterator[tuple[str, Tensor]]:
        """The tensors by name."""
        for field in fields(self):
            yield field.name, getattr(self, field.name)

    def rows(self, index: Int64[Tensor, "m"]) -> "Parameters":
        """Copies of some rows."""
        return Parameters(
            **{name: tensor.index_select(0, index) for name, tensor in self.tensors()}
        )

    def with_zeros(self, count: int) -> "Parameters":
        """The same with `count` rows of zeros appended."""
        return Parameters(
            **{
                name: torch.cat((tensor, tensor.new_zeros(count, tensor.shape[1])))
                for name, tensor in self.tensors()
            }
        )

    def joined(self, other: "Parameters") -> "Parameters":
        """The same with the rows of `other` appended."""
        mine = dict(self.tensors())
        return Parameters(
            **{name: torch.cat((mine[name], tensor)) for name, tensor in other.tensors()}
        )

    def replaced(self, **columns: Tensor) -> "Parameters":
        """The same with some tensors replaced."""
        return Parameters(**(dict(self.tensors()) | columns))

    def zeros_like(self) -> "Parameters":
        """Zeros of the same shapes: fresh moments."""
        return Parameters(**{name: torch.zeros_like(tensor) for name, tensor in self.tensors()})

    def gaussians(self) -> Gaussians:
        """The Gaussians of these parameters. Differentiable."""
        return Gaussians(
            means=self.means,
            rotations=torch.nn.functional.normalize(self.rotations, dim=1),
            scales=self.log_scales.exp(),
            opacities=self.logits.sigmoid().squeeze(1),
            sh=self.sh.view(len(self), -1, 3),
        )


def final_gaussians(parameters: Parameters) -> Gaussians:
    """The Gaussians, detached and on the CPU; a row's values do not depend on its position.

    `Parameters.gaussians` is differentiable, but the last bits of its opacities depend on the
    number of torch's threads.
    """
    raw = {name: tensor.detach().cpu() for name, tensor in parameters.tensors()}
    return Gaussians(
        means=raw["means"].clone(),
        rotations=torch.nn.functional.normalize(raw["rotations"], dim=1),
        scales=torch.from_numpy(exponential(raw["log_scales"].numpy())),
        opacities=torch.from_numpy(sigmoid(raw["logits"].squeeze(1).numpy())),
        sh=raw["sh"].reshape(len(parameters), -1, 3).clone(),
    )


def rows_in_view(parameters: Parameters, camera: Camera, *, near: float) -> Int64[Tensor, "m"]:
    """Rows that may be visible in a pinhole view, ascending (frustum culling, conservative).

    A Gaussian is bounded by a ball of its largest scale: its projected standard
    deviation along x is at most ``fx / z * s * sqrt(1 + (x / z)^2)`` with x / z clamped as in
    the projection, plus the low-pass.
    """
    if parameters.means.device.type != "cpu":
        return rows_in_view_torch(parameters, camera, near=near)
    rows = torch.empty(len(parameters), dtype=torch.int64)
    found = _native.rows_in_view(
        parameters.means,
        parameters.log_scales,
        camera.width,
        camera.height,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        camera.cam_from_world[:3].to(torch.float32).contiguous(),
        near,
        rows,
    )
    return rows[:found]


def rows_in_view_torch(
    parameters: Parameters, camera: Camera, *, near: float
) -> Int64[Tensor, "m"]:
    """The readable reference of `rows_in_view`."""
    pose = camera.cam_from_world.to(parameters.means)
    x, y, z = (parameters.means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    inside = z > near
    inverse = 1 / torch.where(inside, z, 1.0)
    max_scales = parameters.log_scales.amax(dim=1).exp() * inverse
    for along, focal, centre, size in (
        (x * inverse, camera.fx, camera.cx, camera.width),
        (y * inverse, camera.fy, camera.cy, camera.height),
    ):
        margin = _FRUSTUM_MARGIN * 0.5 * size / focal
        tangent = along.clamp(-centre / focal - margin, (size - centre) / focal + margin)
        radius = _MAX_SIGMAS * (
            max_scales * focal * (1 + tangent * tangent).sqrt() + _LOW_PASS_SIGMA
        )
        at = along * focal + centre
        inside &= (at + radius >= 0) & (at - radius <= size)
    return inside.nonzero().squeeze(1)


def gathered(parameters: Parameters, rows: Int64[Tensor, "m"]) -> Gaussians:
    """The Gaussians of some rows, as leaves of a graph."""
    if parameters.means.device.type != "cpu":
        return _as_leaves(parameters.rows(rows).gaussians())
    count, columns = len(rows), parameters.sh.shape[1]
    out = tuple(torch.empty(count, width) for width in (3, 3, 4, 1, columns))
    raw = tuple(tensor for _, tensor in parameters.tensors())
    _native.gather_gaussians(raw, rows, out)
    means, scales, rotations, opacities, sh = out
    return _as_leaves(
        Gaussians(
            means=means,
            rotations=rotations,
            scales=scales,
            opacities=opacities.squeeze(1),
            sh=sh.view(count, columns // 3, 3),
        )
    )


def _as_leaves(gaussians: Gaussians) -> Gaussians:
    return gaussians.replace(
        means=gaussians.means.detach().requires_grad_(),
        rotations=gaussians.rotations.detach().requires_grad_(),
        scales=gaussians.scales.detach().requires_grad_(),
        opacities=gaussians.opacities.detach().requires_grad_(),
        sh=gaussians.sh.detach().requires_grad_(),
    )
