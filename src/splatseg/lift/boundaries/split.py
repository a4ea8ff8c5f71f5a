r"""Splitting Gaussians: one becomes several narrower ones that together look like it.

With :math:`x = \mu + L z`, :math:`L = R\,\mathrm{diag}(s)`, and a unit direction e in z, the
parts of a mixture (`mixture`, offsets m, weights w, width r) are

.. math:: \mu_c = \mu + m_c L e, \qquad
          \Sigma_c = L \bigl( I - (1 - r^2)\, e e^\top \bigr) L^\top

so that with the weights w the mass, the mean and the covariance stay exactly what they were:

.. math:: \sum_c w_c = 1, \quad \sum_c w_c \mu_c = \mu, \quad
          \sum_c w_c \bigl(\Sigma_c + (\mu_c - \mu)(\mu_c - \mu)^\top\bigr) = \Sigma

Along the longest axis only that axis' scale changes. Across a plane with normal n, e is
:math:`L^\top n` at unit length: the split that moves the parts farthest from the plane, measured
in their own width.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core import Camera, Edited, Gaussians, Selection
from splatseg.core.boundary import boundary
from splatseg.core.rigid import quaternion_from_rotation
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.boundaries.geometry import (
    axes_of,
    directions_of_normals,
    line_extent,
    main_directions,
    unit_or_main,
)
from splatseg.lift.boundaries.mixture import MIXTURES, opacities_of_parts

_AXIS_TOLERANCE = 1e-9
"""Deviation from an axis, below which a direction is that axis."""


@boundary
def split(
    gaussians: Gaussians,
    selection: Selection,
    *,
    normals: Float[Tensor, "m 3"] | None = None,
    parts: int = 3,
    cameras: Sequence[Camera] = (),
) -> Edited:
    """Replace each selected Gaussian by parts that keep its moments and look like it.

    Colours and extra columns are copied; opacities are those of `opacities_of_parts`, for the
    angles at which `cameras` see the split.

    Args:
        gaussians: The Gaussians.
        selection: Which are to be split. Those of no size stay as they are.
        normals: For each selected one, in the order of rows, the normal of the cut in the
            world, of any length. None splits along the longest axis.
        parts: 2 or 3. Three are narrower and look more like the whole.
        cameras: Cameras that rendered images matter for; without any, all directions do alike.

    Returns:
        The Gaussians that stay, in order, and behind them the parts, those of one Gaussian
        together; rows lead each part to its Gaussian, fractions are the weights.

    Raises:
        ShapeError: If the selection or the normals are of other Gaussians.
        RangeError: If there is no mixture of so many parts, or a normal is not finite.

    Example:
        >>> one = Gaussians(means=torch.zeros(1, 3), rotations=torch.eye(4)[:1],
        ...                 scales=torch.tensor([[1.0, 0.1, 0.1]]), opacities=torch.ones(1),
        ...                 sh=torch.zeros(1, 1, 3))
        >>> split(one, Selection(mask=torch.tensor([True])), parts=2).gaussians.means[:, 0]
        tensor([-0.6000,  0.6000])
    """
    _check(gaussians, selection, parts)
    rows = selection.ids
    if normals is not None:
        check_shape("normals", normals, (len(rows), 3))
        check_finite("normals", normals)
    chosen = gaussians[rows]
    directions = (
        main_directions(chosen) if normals is None else directions_of_normals(chosen, normals)
    )
    return split_along(gaussians, selection, directions, parts=parts, cameras=cameras)


def split_along(
    gaussians: Gaussians,
    selection: Selection,
    directions: Float[Tensor, "m 3"],
    *,
    parts: int = 3,
    cameras: Sequence[Camera] = (),
) -> Edited:
    """As `split`, with directions e in the frames of the selected Gaussians (z, whitened)."""
    _check(gaussians, selection, parts)
    rows = selection.ids
    check_shape("directions", directions, (len(rows), 3))
    sized = gaussians.scales[rows].amax(dim=1) > 0
    rows, directions = rows[sized], directions[sized]
    chosen = gaussians[rows]
    e = unit_or_main(chosen, directions.double())
    mixture = MIXTURES[parts]
    weights = torch.tensor(mixture.weights, dtype=torch.float64)
    offsets = torch.tensor(mixture.offsets, dtype=torch.float64)
    principal = torch.einsum("nij,nj->ni", axes_of(chosen), e)
    means = chosen.means.double().unsqueeze(1) + offsets[None, :, None] * principal.unsqueeze(1)
    rotations, scales = narrowed(chosen, e, mixture.width)
    across = line_extent(chosen, e, cameras).across
    opacities = opacities_of_parts(chosen.opacities, across, mixture)
    of_part = torch.arange(len(rows)).repeat_interleave(parts)
    parts_of_chosen = chosen[of_part].replace(
        means=means.reshape(-1, 3).to(gaussians.means),
        rotations=rotations[of_part].to(gaussians.rotations),
        scales=scales[of_part].to(gaussians.scales),
        opacities=opacities.reshape(-1).to(gaussians.opacities),
    )
    kept = torch.ones(len(gaussians), dtype=torch.bool)
    kept[rows] = False
    unsplit = torch.nonzero(kept).squeeze(1)
    return Edited(
        gaussians=Gaussians.concatenate([gaussians[unsplit], parts_of_chosen]),
        rows=torch.cat((unsplit, rows[of_part])),
        fractions=torch.cat((torch.ones(len(unsplit)), weights.float().repeat(len(rows)))),
    )


def narrowed(
    gaussians: Gaussians, directions: Float[Tensor, "n 3"], width: float
) -> tuple[Float[Tensor, "n 4"], Float[Tensor, "n 3"]]:
    r"""Rotations and scales of :math:`L (I - (1 - r^2) e e^\top) L^\top`.

    It is :math:`M M^\top` with :math:`M = L (I - (1 - r) e e^\top)`, whose singular value
    decomposition has the axes and the scales. Along an axis nothing turns.
    """
    e = directions.double()
    rotations, scales = gaussians.rotations.double(), gaussians.scales.double()
    along = (e.abs().amax(dim=1) - 1).abs() < _AXIS_TOLERANCE
    axis = torch.nn.functional.one_hot(e.abs().argmax(dim=1), 3).double()
    scales_along = scales * (1 - (1 - width) * axis)
    if bool(along.all()):
        return rotations, scales_along
    slanted = torch.nonzero(~along).squeeze(1)
    shrink = torch.eye(3, dtype=torch.float64) - (1 - width) * torch.einsum(
        "ni,nj->nij", e[slanted], e[slanted]
    )
    turned, sizes, _ = torch.linalg.svd(axes_of(gaussians[slanted]) @ shrink)
    # A mirrored frame has the same covariance once one axis is turned round.
    mirrored = torch.linalg.det(turned) < 0
    turned[mirrored, :, 2] *= -1
    rotations = rotations.index_copy(0, slanted, quaternion_from_rotation(turned))
    return rotations, scales_along.index_copy(0, slanted, sizes)


def _check(gaussians: Gaussians, selection: Selection, parts: int) -> None:
    if len(selection) != len(gaussians):
        raise ShapeError(
            f"selection: expected one over {len(gaussians)} Gaussians, "
            f"got one over {len(selection)}."
        )
    if not selection.count:
        raise InputError("selection: expected at least one Gaussian, got none.")
    if parts not in MIXTURES:
        raise RangeError(f"parts: expected one of {', '.join(map(str, MIXTURES))}, got {parts}.")
