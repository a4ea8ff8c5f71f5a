"""Scenes, and what tests of rendering need to know of them."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatseg import render as splat
from splatseg.core import Camera, Gaussians
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.render import RenderOptions
from splatseg.render._values import ALPHA_MIN, MEDIAN_TRANSMITTANCE, TRANSMITTANCE_MIN
from splatseg.render.blending import project


@dataclass(frozen=True, slots=True)
class Bench:
    """A backend under test, with the options that it takes and the accuracy it promises."""

    name: str
    isa: str | None = None
    defaults: dict[str, Any] = field(default_factory=dict)
    image_tolerance: float = 2e-5
    adjoint_tolerance: float = 1e-5
    sum_tolerance: float = 0.0
    """How far two runs may be apart, of the largest: 0 where sums have one order."""

    def same(self, one: Tensor, other: Tensor) -> bool:
        """Whether two runs of one product gave the same."""
        if self.sum_tolerance == 0 or not one.is_floating_point():
            return torch.equal(one, other)
        if one.shape != other.shape:
            return False
        bound = self.sum_tolerance * other.abs().amax() if other.numel() else 0
        return bool(((one - other).abs() <= bound).all())

    def options(self, **changes: Any) -> RenderOptions:
        return RenderOptions(**(self.defaults | changes))

    def render(self, gaussians: Gaussians, camera: Camera, signal=None, **changes: Any):
        return splat.render(
            gaussians, camera, signal, options=self.options(**changes), backend=self.name
        )

    def back_project(self, gaussians: Gaussians, camera: Camera, image: Tensor, **changes: Any):
        return splat.back_project(
            gaussians, camera, image, options=self.options(**changes), backend=self.name
        )

    def contributors(self, gaussians: Gaussians, camera: Camera, pixels: Tensor, k: int):
        return splat.contributors(
            gaussians, camera, pixels, k, options=self.options(), backend=self.name
        )

    def weights(self, gaussians: Gaussians, camera: Camera, pixels=None, k=None):
        return splat.weights(
            gaussians, camera, pixels, k, options=self.options(), backend=self.name
        )


def random_camera(rng: np.random.Generator, *, width: int = 50, height: int = 40) -> Camera:
    """A camera near the origin that looks along z, slightly turned, off-centre."""
    quaternion = torch.tensor([1.0, *rng.uniform(-0.15, 0.15, 3)], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation_from_quaternion(quaternion)
    pose[:3, 3] = torch.from_numpy(rng.uniform(-0.3, 0.3, 3))
    longest = max(width, height)
    return Camera(
        width=width,
        height=height,
        fx=longest * rng.uniform(0.7, 1.3),
        fy=longest * rng.uniform(0.7, 1.3),
        cx=width * rng.uniform(0.3, 0.7),
        cy=height * rng.uniform(0.3, 0.7),
        cam_from_world=pose,
    )


def random_gaussians(rng: np.random.Generator, count: int, *, sh_degree: int = 3) -> Gaussians:
    """Balls, needles and specks before, beside and behind `random_camera`, some opaque."""
    means = rng.uniform((-3, -3, -1), (3, 3, 7), (count, 3))
    scales = np.exp(rng.normal(-2.2, 0.9, (count, 3)))
    scales[rng.random(count) < 0.1] = 0.0
    opacities = rng.random(count)
    opacities[rng.random(count) < 0.2] = 1.0
    coefficients = (sh_degree + 1) ** 2
    return Gaussians(
        means=float32(means),
        rotations=float32(rng.normal(size=(count, 4))),
        scales=float32(scales),
        opacities=float32(opacities),
        sh=float32(rng.normal(0, 0.4, (count, coefficients, 3))),
    )


def float32(values: Any) -> Tensor:
    return torch.as_tensor(np.asarray(values), dtype=torch.float32)


def axis_camera(*, width: int = 9, height: int = 9, focal: float = 10.0, **changes: Any) -> Camera:
    """At the origin, looking along z; the axis meets the centre of the middle pixel."""
    values: dict[str, Any] = {
        "fx": focal,
        "fy": focal,
        "cx": width // 2 + 0.5,
        "cy": height // 2 + 0.5,
        "cam_from_world": torch.eye(4, dtype=torch.float64),
    }
    return Camera(width=width, height=height, **(values | changes))


def gaussians_of(
    means: Any,
    *,
    scales: Any = 0.0,
    opacities: Any = 0.5,
    rotations: Any = (1.0, 0.0, 0.0, 0.0),
    sh: Any = None,
) -> Gaussians:
    """Gaussians from short lists; one scale, opacity or quaternion stands for all."""
    points = float32(means).reshape(-1, 3)
    n = len(points)
    size = float32(scales)
    if size.ndim == 1 and size.shape != (3,):
        size = size[:, None]
    return Gaussians(
        means=points,
        rotations=float32(rotations).expand(n, 4),
        scales=size.expand(n, 3),
        opacities=float32(opacities).expand(n),
        sh=torch.zeros(n, 1, 3) if sh is None else float32(sh),
    )


@dataclass(frozen=True)
class Bands:
    """Pixels where rounding may decide otherwise. All (height, width), bool."""

    threshold: Tensor
    """An alpha is close to 1/255, or the transmittance to where a pixel stops: a small flip."""

    swap: Tensor
    """Two Gaussians seen there are equally deep up to rounding: their order may change."""

    median: Tensor
    """The transmittance passes close to 0.5."""


def bands(gaussians: Gaussians, camera: Camera, options: RenderOptions) -> Bands:
    """Where a float32 backend and the float64 reference may take different branches.

    A relative error of 2e-4 in an alpha is far more than float32 makes in these scenes, and far
    less than what separates one branch from the other in most pixels.
    """
    wide = gaussians.to(dtype=torch.float64)
    p = project(wide, camera, options=options)
    offset = camera.pixel_centres().reshape(-1, 1, 2) - p.centres
    a, b, c = p.covariances.unbind(-1)
    du, dv = offset.unbind(-1)
    q = (c * du**2 - 2 * b * du * dv + a * dv**2) / p.determinants
    raw = p.opacities * torch.exp(-q / 2)
    alpha = torch.where(raw < ALPHA_MIN, 0.0, raw.clamp_max(options.alpha_max))
    behind = torch.cumprod(1 - alpha, dim=1)
    # A stop decided by a hair counts only for pixels that came so far.
    reached = torch.cat((torch.ones_like(behind[:, :1]), behind[:, :-1]), dim=1) > (
        TRANSMITTANCE_MIN * (1 - 1e-3)
    )
    close_alpha = ((raw / ALPHA_MIN - 1).abs() < 2e-4) & reached
    close_stop = (behind / TRANSMITTANCE_MIN - 1).abs() < 1e-3
    tie = torch.zeros(len(p), dtype=torch.bool)
    if len(p) > 1:
        gap = p.depths.diff() / p.depths[1:]
        tie[1:] = gap < 1e-6
    seen = alpha > 0
    swapped = seen.new_zeros(len(seen))
    for second in torch.nonzero(tie)[:, 0].tolist():
        swapped |= seen[:, second] & seen[:, second - 1]
    close_median = ((behind / MEDIAN_TRANSMITTANCE - 1).abs() < 1e-4) & seen
    size = (camera.height, camera.width)
    return Bands(
        threshold=(close_alpha | (close_stop & seen)).any(dim=1).reshape(size),
        swap=swapped.reshape(size),
        median=close_median.any(dim=1).reshape(size),
    )


def dense_weights(bench: Bench, gaussians: Gaussians, camera: Camera) -> Tensor:
    """W as a matrix, pixels x Gaussians: what a view shows of the unit signals."""
    n = len(gaussians)
    columns = [
        bench.render(gaussians, camera, part).image.reshape(-1, part.shape[1])
        for part in torch.eye(n).split(1000, dim=1)
    ]
    return torch.cat(columns, dim=1)


def assert_close(actual: Tensor, expected: Tensor, *, atol: float, rtol: float = 0.0) -> None:
    """Compare in float64, naming how far and where the worst is."""
    torch.testing.assert_close(
        actual.detach().double(), expected.detach().double(), atol=atol, rtol=rtol
    )
