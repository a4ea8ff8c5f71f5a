r"""Lens models: distortion on the normalised image plane, and its inverse.

Points are on the normalised image plane: :math:`(x, y) = (X / Z, Y / Z)`, before focal length
and principal point.

opencv (k1 k2 p1 p2 k3 k4 k5 k6), :math:`r^2 = x^2 + y^2`:

.. math::
    x' = x \frac{1 + k_1 r^2 + k_2 r^4 + k_3 r^6}{1 + k_4 r^2 + k_5 r^4 + k_6 r^6}
         + 2 p_1 x y + p_2 (r^2 + 2 x^2)

(y' alike with p1 and p2 exchanged). fisheye (k1 k2 k3 k4), :math:`\theta = \arctan r`:

.. math:: (x', y') = \theta (1 + k_1 \theta^2 + k_2 \theta^4 + k_3 \theta^6 + k_4 \theta^8)
          \, (x, y) / r

thin_prism_fisheye (k1 k2 p1 p2 k3 k4 s1 s2), with :math:`(u, v) = \theta \, (x, y) / r`:

.. math::
    x' = u (1 + k_1 \theta^2 + k_2 \theta^4 + k_3 \theta^6 + k_4 \theta^8)
         + 2 p_1 u v + p_2 (\theta^2 + 2 u^2) + s_1 \theta^2

(y' alike with p1 and p2 exchanged and s2). mei (xi k1 k2 p1 p2), the unified model of Mei and
Rives, a sphere seen from a point at the distance xi behind its centre, then OpenCV's polynomial of

.. math:: (m_x, m_y) = \frac{(x, y)}{1 + \xi \sqrt{x^2 + y^2 + 1}}

A plane holds what lies less than 90 degrees from the axis.

References: OpenCV documentation, calib3d and fisheye modules; COLMAP's ThinPrismFisheyeCameraModel;
Mei and Rives, Single View Point Omnidirectional Camera Calibration from Planar Grids, ICRA 2007.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.errors import InputError

_EQUIDISTANT = (0.0, 0.0, 0.0, 0.0)
_NEWTON_STEPS = 50
_TOLERANCE = 1e-10
_MAX_RADIUS = 1e4


def distort_opencv(
    plane: Float[Tensor, "*batch 2"], parameters: Sequence[float]
) -> Float[Tensor, "*batch 2"]:
    """Distort points of the normalised plane with OpenCV's rational and tangential model."""
    k1, k2, p1, p2, k3, k4, k5, k6 = parameters
    x, y = plane.unbind(-1)
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return torch.stack(
        (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ),
        dim=-1,
    )


def distort_fisheye(
    plane: Float[Tensor, "*batch 2"], parameters: Sequence[float]
) -> Float[Tensor, "*batch 2"]:
    """Distort points of the normalised plane with the equidistant polynomial model."""
    radius = torch.linalg.vector_norm(plane, dim=-1, keepdim=True)
    theta = torch.atan(radius)
    stretched = theta * _theta_polynomial(theta, parameters)
    # The limit at the centre is 1, where the quotient would be 0 / 0.
    factor = torch.where(radius > 1e-12, stretched / radius.clamp_min(1e-12), 1.0)
    return plane * factor


def _theta_polynomial(theta: Tensor, parameters: Sequence[float]) -> Tensor:
    k1, k2, k3, k4 = parameters
    t2 = theta * theta
    return 1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))


def distort_thin_prism_fisheye(
    plane: Float[Tensor, "*batch 2"], parameters: Sequence[float]
) -> Float[Tensor, "*batch 2"]:
    """Distort points of the normalised plane with COLMAP's thin prism fisheye model."""
    return _thin_prism(distort_fisheye(plane, _EQUIDISTANT), parameters)


def undistort_thin_prism_fisheye(
    plane: Float[Tensor, "*batch 2"], parameters: Sequence[float]
) -> Float[Tensor, "*batch 2"]:
    """Invert `distort_thin_prism_fisheye`.

    Raises:
        InputError: If a point lies beyond 90 degrees from the axis, or has no inverse.
    """
    angles = _inverted(plane, lambda at: _thin_prism(at, parameters))
    return undistort_fisheye(angles, _EQUIDISTANT).to(plane)


def _thin_prism(angles: Tensor, parameters: Sequence[float]) -> Tensor:
    """The polynomial of `distort_thin_prism_fisheye` of equidistant coordinates (u, v)."""
    k1, k2, p1, p2, k3, k4, s1, s2 = parameters
    u, v = angles.unbind(-1)
    t2 = u * u + v * v
    radial = 1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))
    return torch.stack(
        (
            u * radial + 2 * p1 * u * v + p2 * (t2 + 2 * u * u) + s1 * t2,
            v * radial + p1 * (t2 + 2 * v * v) + 2 * p2 * u * v + s2 * t2,
        ),
        dim=-1,
    )


def undistort_opencv(
    plane: Float[Tensor, "*batch 2"], parameters: Sequence[float]
) -> Float[Tensor, "*batch 2"]:
    """Invert `distort_opencv` by damped Newton steps from the distorted point.

    Raises:
        InputError: If a point has no inverse: the polynomial folds over inside the image.
    """
    return _inverted(plane, lambda at: distort_opencv(at, parameters)).to(plane)


def _inverted(plane: Tensor, distort: Callable[[Tensor], Tensor]) -> Tensor:
    """Where `distort` leads to these points from, float64, by damped Newton steps from them."""
    target = plane.double()
    guess = target.clone()
    eye = torch.eye(2, dtype=torch.float64, device=plane.device)

    def residual(at: Tensor) -> Tensor:
        return distort(at) - target

    error = residual(guess)
    for _ in range(_NEWTON_STEPS):
        if not error.numel() or float(error.abs().max()) < _TOLERANCE:
            break
        jacobian = _numerical_jacobian(distort, guess)
        step = torch.linalg.solve(jacobian + 1e-15 * eye, error.unsqueeze(-1)).squeeze(-1)
        # A full step may jump over the fold of the polynomial; halve it until it helps.
        fraction = torch.ones_like(error[..., :1])
        before = torch.linalg.vector_norm(error, dim=-1, keepdim=True)
        for _ in range(8):
            after = torch.linalg.vector_norm(residual(guess - fraction * step), dim=-1)
            worse = after.unsqueeze(-1) > before
            if not bool(worse.any()):
                break
            fraction = torch.where(worse, fraction / 2, fraction)
        guess = guess - fraction * step
        error = residual(guess)
    # Beyond the fold of the polynomial lie solutions that no lens has: there the image is
    # mirrored, or lies on the other side of the axis.
    jacobian = _numerical_jacobian(distort, guess)
    folded = (torch.linalg.det(jacobian) <= 0) | ((guess * target).sum(-1) < 0)
    _require_converged(torch.where(folded.unsqueeze(-1), torch.inf, error))
    return guess


def _numerical_jacobian(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    step = 1e-6
    columns: list[Tensor] = []
    for axis in range(2):
        shift = torch.zeros(2, dtype=at.dtype, device=at.device)
        shift[axis] = step
        columns.append((function(at + shift) - function(at - shift)) / (2 * step))
    return torch.stack(columns, dim=-1)


def undistort_fisheye(
    plane: Float[Tensor, "*batch 2"], parameters: Sequence[float]
) -> Float[Tensor, "*batch 2"]:
    """Invert `distort_fisheye` by Newton steps on the angle.

    Raises:
        InputError: If a point lies beyond 90 degrees from the axis, which no plane holds, or
            the polynomial has no inverse there.
    """
    target = torch.linalg.vector_norm(plane.double(), dim=-1, keepdim=True)
    theta = target.clone()
    k1, k2, k3, k4 = parameters
    for _ in range(_NEWTON_STEPS):
        error = theta * _theta_polynomial(theta, parameters) - target
        if not error.numel() or float(error.abs().max()) < _TOLERANCE:
            break
        t2 = theta * theta
        derivative = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        theta = theta - error / derivative.clamp_min(1e-6)
    _require_converged(theta * _theta_polynomial(theta, parameters) - target)
    radius = torch.tan(theta)
    if bool(((theta >= torch.pi / 2 - 1e-3) | (theta < 0) | (radius > _MAX_RADIUS)).any()):
        raise InputError(
            "distortion: expected a view narrower than 180 degrees, got pixels at "
            f"{float(theta.max()) * 180 / torch.pi:.1f} degrees from the axis."
        )
    factor = torch.where(target > 1e-12, radius / target.clamp_min(1e-12), 1.0)
    return (plane.double() * factor).to(plane)


def _require_converged(error: Tensor) -> None:
    worst = float(error.abs().max()) if error.numel() else 0.0
    if not worst < 1e-6:
        raise InputError(
            "distortion: the lens model has no inverse at some pixels "
            f"(error {worst:.2g} on the normalised plane); check its parameters."
        )


def distort_mei(
    plane: Float[Tensor, "*batch 2"], parameters: Sequence[float]
) -> Float[Tensor, "*batch 2"]:
    """Distort points of the normalised plane."""
    xi, *polynomial = parameters
    length = torch.sqrt((plane * plane).sum(-1, keepdim=True) + 1)
    return distort_opencv(plane / (1 + xi * length), (*polynomial, 0, 0, 0, 0))


def undistort_mei(
    plane: Float[Tensor, "*batch 2"], parameters: Sequence[float]
) -> Float[Tensor, "*batch 2"]:
    r"""Invert `distort_mei`: the polynomial by Newton steps, the sphere in closed form.

    With :math:`\rho^2 = m_x^2 + m_y^2`, the point of the sphere is
    :math:`(\eta m_x, \eta m_y, \eta - \xi)` where
    :math:`\eta = (\xi + \sqrt{1 + (1 - \xi^2) \rho^2}) / (1 + \rho^2)`.

    Raises:
        InputError: If a pixel sees 90 degrees or more from the axis, or nothing of the sphere, or
            the polynomial has no inverse there.
    """
    xi, *polynomial = parameters
    seen = undistort_opencv(plane.double(), (*polynomial, 0, 0, 0, 0))
    square = (seen * seen).sum(-1, keepdim=True)
    under = 1 + (1 - xi * xi) * square
    eta = (xi + torch.sqrt(under.clamp_min(0))) / (1 + square)
    forward = eta - xi
    radius = torch.sqrt(square) * eta
    beyond = (under < 0) | (forward <= 0) | (radius > _MAX_RADIUS * forward)
    if bool(beyond.any()):
        raise InputError(
            "distortion: expected a view narrower than 180 degrees, got "
            f"{int(beyond.sum())} of {beyond.numel()} pixels that see 90 degrees from the axis or "
            "more, or past the image of the lens."
        )
    return (seen * eta / forward).to(plane)


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens model: how many parameters it has, and its maps of the normalised plane."""

    parameters: int
    distort: Callable[[Tensor, Sequence[float]], Tensor]
    undistort: Callable[[Tensor, Sequence[float]], Tensor]


CameraModel = Literal["pinhole", "opencv", "fisheye", "mei", "thin_prism_fisheye"]

LENSES: dict[CameraModel, Lens] = {
    "pinhole": Lens(0, lambda plane, _: plane, lambda plane, _: plane),
    "opencv": Lens(8, distort_opencv, undistort_opencv),
    "fisheye": Lens(4, distort_fisheye, undistort_fisheye),
    "mei": Lens(5, distort_mei, undistort_mei),
    "thin_prism_fisheye": Lens(8, distort_thin_prism_fisheye, undistort_thin_prism_fisheye),
}
