r"""Real spherical harmonics to degree 3, as 3DGS files use them, and their rotation.

A colour is :math:`c(d) = \max(0, 0.5 + \sum_k Y_k(d) f_k)` with the unit direction d from the
camera centre to the Gaussian, in world axes (Kerbl et al. 2023, section 4). The basis keeps
the Condon-Shortley signs of the original code.
"""

from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.errors import RangeError, ShapeError

SH_C0 = 0.28209479177387814
SH_C1 = 0.4886025119029199
SH_C2 = (
    1.0925484305920792,
    -1.0925484305920792,
    0.31539156525252005,
    -1.0925484305920792,
    0.5462742152960396,
)
SH_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
MAX_DEGREE = 3


def degree_of(coefficients: int) -> int:
    """Degree of a number of coefficients (1, 4, 9 or 16).

    Raises:
        ShapeError: If it is none of them.
    """
    for degree in range(MAX_DEGREE + 1):
        if (degree + 1) ** 2 == coefficients:
            return degree
    raise ShapeError(f"sh: expected 1, 4, 9 or 16 coefficients a channel, got {coefficients}.")


def sh_basis(
    directions: Float[Tensor, "*batch 3"], degree: int
) -> Float[Tensor, "*batch coefficients"]:
    """Values of the basis functions at unit directions; (degree + 1)^2 columns."""
    if not 0 <= degree <= MAX_DEGREE:
        raise RangeError(f"degree: expected 0 to {MAX_DEGREE}, got {degree}.")
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        values += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        values += [
            SH_C2[0] * x * y,
            SH_C2[1] * y * z,
            SH_C2[2] * (2 * zz - xx - yy),
            SH_C2[3] * x * z,
            SH_C2[4] * (xx - yy),
        ]
    if degree >= 3:
        values += [
            SH_C3[0] * y * (3 * xx - yy),
            SH_C3[1] * x * y * z,
            SH_C3[2] * y * (4 * zz - xx - yy),
            SH_C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            SH_C3[4] * x * (4 * zz - xx - yy),
            SH_C3[5] * z * (xx - yy),
            SH_C3[6] * x * (xx - 3 * yy),
        ]
    return torch.stack(values, dim=-1)


def evaluate_sh(
    sh: Float[Tensor, "n coefficients 3"],
    directions: Float[Tensor, "n 3"],
    *,
    degree: int | None = None,
) -> Float[Tensor, "n 3"]:
    """Colours seen along unit `directions` (camera centre to Gaussian), clamped at 0 from below.

    Args:
        sh: Coefficients; the first is the mean colour's.
        directions: Unit vectors in world axes.
        degree: Highest degree used; None uses all that `sh` holds.
    """
    held = degree_of(sh.shape[1])
    used = held if degree is None else min(degree, held)
    basis = sh_basis(directions, used)
    colours = 0.5 + torch.einsum("nk,nkc->nc", basis, sh[:, : basis.shape[-1]])
    return colours.clamp_min(0)


@cache
def _sample_directions() -> Tensor:
    """Well-spread directions (a Fibonacci sphere), enough to invert the degree-3 basis."""
    count = 64
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * i / count
    angle = torch.pi * (1 + 5**0.5) * i
    ring = torch.sqrt(1 - z * z)
    return torch.stack((ring * torch.cos(angle), ring * torch.sin(angle), z), dim=-1)


def sh_rotation_matrices(rotation: Float[Tensor, "3 3"]) -> list[Float[Tensor, "m m"]]:
    r"""Matrices that turn coefficients with a scene, one a degree 1 to 3, float64.

    If the scene turns by R, the new function is :math:`c'(d) = c(R^\top d)`. Each degree l
    spans its own space, so :math:`f'_l = D_l f_l` with :math:`Y_l(R^\top d) = D_l^\top Y_l(d)`
    as a function of d; D is found by least squares over well-spread directions, which is exact
    to rounding because the basis is a basis.
    """
    directions = _sample_directions()
    basis = sh_basis(directions, MAX_DEGREE)
    turned = sh_basis(directions @ rotation.double(), MAX_DEGREE)
    matrices: list[Tensor] = []
    for degree in range(1, MAX_DEGREE + 1):
        block = slice(degree**2, (degree + 1) ** 2)
        # turned[:, block] @ f == basis[:, block] @ f'
        matrices.append(torch.linalg.lstsq(basis[:, block], turned[:, block]).solution)
    return matrices


def rotate_sh(
    sh: Float[Tensor, "n coefficients 3"], rotation: Float[Tensor, "3 3"]
) -> Float[Tensor, "n coefficients 3"]:
    """Coefficients of the scene turned by `rotation` (world_from_old_world).

    ``evaluate_sh(rotate_sh(f, R), R @ d) == evaluate_sh(f, d)`` for every d.
    """
    degree = degree_of(sh.shape[1])
    parts = [sh[:, :1]]
    for level, matrix in enumerate(sh_rotation_matrices(rotation.cpu())[:degree], start=1):
        block = sh[:, level**2 : (level + 1) ** 2]
        parts.append(torch.einsum("ij,njc->nic", matrix.to(sh), block))
    return torch.cat(parts, dim=1)


def base_colours(sh: Float[Tensor, "n k 3"]) -> Float[Tensor, "n 3"]:
    """What harmonics have of all directions, float32, cut to [0, 1]."""
    return (sh[:, 0].detach().cpu().float() * SH_C0 + 0.5).clamp(0, 1)
