r"""The unified lens model of Mei and Rives: a sphere, seen from a point behind its centre.

Parameters are xi, the distance of that point from the centre, then k1 k2 p1 p2. A point of the
normalised plane :math:`(x, y)` is projected to the unit sphere, seen from there, and distorted as
by OpenCV's polynomial:

.. math:: (m_x, m_y) = \frac{(x, y)}{1 + \xi \sqrt{x^2 + y^2 + 1}}

A xi of 0 is OpenCV's model. A plane holds what lies in front of the camera, less than 90 degrees
from the axis; pixels that see further have no place on it.

References: Mei and Rives, Single View Point Omnidirectional Camera Calibration from Planar Grids,
ICRA 2007.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float

from splatseg.core._distortion import distort_opencv, undistort_opencv
from splatseg.errors import InputError

MEI_PARAMETERS = 5
_MAX_RADIUS = 1e4


def distort_mei(
    plane: Float[torch.Tensor, "*batch 2"], parameters: Sequence[float]
) -> Float[torch.Tensor, "*batch 2"]:
    """Distort points of the normalised plane."""
    xi, *polynomial = parameters
    length = torch.sqrt((plane * plane).sum(-1, keepdim=True) + 1)
    return distort_opencv(plane / (1 + xi * length), (*polynomial, 0, 0, 0, 0))


def undistort_mei(
    plane: Float[torch.Tensor, "*batch 2"], parameters: Sequence[float]
) -> Float[torch.Tensor, "*batch 2"]:
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
