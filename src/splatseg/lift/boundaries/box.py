"""Cuts along the faces of a box in the world."""

from collections.abc import Sequence

import torch
from torch import Tensor

from splatseg.core import Camera, Edited, Gaussians, Selection
from splatseg.core.boundary import boundary
from splatseg.errors import ShapeError
from splatseg.lift.boundaries.cut import Cut, CutOptions
from splatseg.lift.boundaries.geometry import axes_of, directions_of_normals, line_extent
from splatseg.lift.boundaries.split import split_along
from splatseg.selection import box_corners


@boundary
def cut_box(
    gaussians: Gaussians,
    low: Sequence[float],
    high: Sequence[float],
    *,
    among: Selection | None = None,
    options: CutOptions | None = None,
    cameras: Sequence[Camera] = (),
) -> Cut:
    r"""Split what straddles a face of a box whose sides are along the world's axes.

    A Gaussian's mass beyond a plane at a distance of t of its standard deviations along the
    plane's normal is :math:`\Phi(-|t|)`; the face where its lesser side is largest is the one
    it is split at, as long as it reaches that face itself.

    Args:
        gaussians: The Gaussians of the scene.
        low: Least x, y and z inside, scene units.
        high: Largest x, y and z inside.
        among: Only these are split; None is all.
        options: Which are split, and how.
        cameras: Cameras that rendered images matter for and that sizes in pixels are of; without
            any, size does not count.

    Returns:
        The cut. A Gaussian is inside where its centre is.

    Raises:
        RangeError: If the box is empty or not finite.
        ShapeError: If `among` is of other Gaussians.
    """
    options = options or CutOptions()
    if among is not None and len(among) != len(gaussians):
        raise ShapeError(f"among: expected {len(gaussians)} rows, got {len(among)}.")
    lower, upper = box_corners(low, high)
    edited = Edited.unchanged(gaussians)
    split = 0
    for round_index in range(options.rounds):
        current = edited.gaussians
        mask, directions = _straddling(current, lower, upper, options, cameras)
        straddling = Selection(mask=mask if among is None else mask & among.mask[edited.rows])
        if round_index == 0:
            split = straddling.count
        if not straddling.count:
            break
        further = split_along(
            current, straddling, directions[straddling.mask], parts=options.parts, cameras=cameras
        )
        edited = edited.then(further)
    centres = edited.gaussians.means.double()
    inside = ((centres >= lower) & (centres <= upper)).all(dim=1)
    return Cut(
        edited=edited,
        share=inside.float(),
        evidence=torch.ones(len(edited)),
        inside=Selection(mask=inside),
        split=split,
    )


def _straddling(
    gaussians: Gaussians,
    lower: Tensor,
    upper: Tensor,
    options: CutOptions,
    cameras: Sequence[Camera],
) -> tuple[Tensor, Tensor]:
    """Which Gaussians straddle a face (n,), and the directions to split them along (n, 3)."""
    mass, normals = _nearest_face(gaussians, lower, upper)
    directions = directions_of_normals(gaussians, normals)
    large = line_extent(gaussians, directions, cameras).pixels >= options.min_pixels
    sized = gaussians.scales.amax(dim=1) > 0
    return (mass >= max(options.min_side, 1e-6)) & large & sized, directions


def _nearest_face(gaussians: Gaussians, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Mass of the lesser side at the face that cuts most, and the normal of that face."""
    means = gaussians.means.double()
    deviations = axes_of(gaussians).pow(2).sum(dim=2).sqrt().clamp_min(1e-30)
    below, above = (means - low) / deviations, (high - means) / deviations
    # How much of the mass lies between the two faces of each axis.
    within = torch.special.ndtr(below) + torch.special.ndtr(above) - 1
    largest_mass = torch.zeros(len(gaussians), dtype=torch.float64)
    axis_of = torch.zeros(len(gaussians), dtype=torch.int64)
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        reach = within[:, others].prod(dim=1).clamp_min(0)
        for t in (below[:, axis], above[:, axis]):
            # The face is only as large as the box: what passes beside it is not cut.
            mass = torch.special.ndtr(-t.abs()) * reach
            better = mass > largest_mass
            largest_mass = torch.where(better, mass, largest_mass)
            axis_of = torch.where(better, axis, axis_of)
    return largest_mass, torch.nn.functional.one_hot(axis_of, 3).double()
