r"""Gaussian decomposition at masks, as SAGD has it: what reaches over a rim becomes two Gaussians.

A Gaussian is taken for the piece of its longest axis a between :math:`\mu \pm 1.5 \sigma a`, with
:math:`\sigma` its largest scale. Where exactly one end falls into the mask of a view, r is the part
of the piece inside, and the Gaussian becomes one on each side (Hu et al. 2024, section 4.4),

.. math:: \mu_{in} = \mu \pm \tfrac{1}{2}(1 - r)\, 3 \sigma a, \quad s_{in} = 0.8\, r\, s, \qquad
          \mu_{out} = \mu \mp \tfrac{1}{2} r\, 3 \sigma a, \quad s_{out} = 0.8\, (1 - r)\, s

The public code keeps the inner one alone, and differs in what are mistakes: it projects the axis as
if it were a point, mixes up rows and columns of the eigenvectors, and has one branch twice. Here
both ends are projected as the points that they are.

Unlike `split`, it changes what the Gaussians look like: their mass is not kept.

References:
    Hu et al., Semantic Anything in 3D Gaussians (SA-GS / SAGD, 2024), section 4.4.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core import Edited, Gaussians, Selection, View
from splatseg.core.boundary import boundary
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.errors import InputError, ShapeError
from splatseg.lift.mass.centres import centres_in, unoccluded
from splatseg.render import options_for, prepare

_REACH = 1.5
_SHRINK = 0.8
_SAMPLES = 32
_DEPTH_TOLERANCE = 0.05
_LEAST_PART = 0.05
"""Parts of the axis on either side that are left as they are: nearly all lies on the other."""


@boundary
def decompose_at_masks(
    gaussians: Gaussians,
    among: Selection,
    masks: Sequence[tuple[View, Bool[Tensor, "height width"]]],
    *,
    backend: str = "auto",
) -> tuple[Edited, Selection]:
    """Decompose the Gaussians of a selection at the rims of its masks, view after view.

    Args:
        gaussians: The Gaussians of the scene.
        among: Which may be decomposed: those of the object.
        masks: Views with the object's masks; SA-GS takes every 20th view, its authors say that
            four or five are enough.
        backend: Name of the rendering backend.

    Returns:
        The Gaussians, of which parts follow those that stay, and the selection of these: what is
        outside of a mask is no longer in it.

    Raises:
        ShapeError: If the selection or a mask is of another size.
        InputError: If there are no masks.
    """
    if len(among) != len(gaussians):
        raise ShapeError(f"among: expected {len(gaussians)} rows, got {len(among)}.")
    if not masks:
        raise InputError("masks: expected those of at least one view, got none.")
    edited = Edited.unchanged(gaussians)
    inside = among.mask.clone()
    for view, mask in masks:
        if mask.shape != (view.camera.height, view.camera.width):
            raise ShapeError(
                f"masks: expected {view.camera.width}x{view.camera.height} pixels as view "
                f"{view.name} has, got {mask.shape[1]}x{mask.shape[0]}."
            )
        current = edited.gaussians
        rows = _visible(current, inside, view, backend)
        share, sign = _inner_share(current[rows], view, mask)
        crossing = (sign != 0) & (share > _LEAST_PART) & (share < 1 - _LEAST_PART)
        if not bool(crossing.any()):
            continue
        further = _decomposed(current, rows[crossing], share[crossing], sign[crossing])
        kept = inside[further.rows]
        # The parts come in pairs behind those that stay: inner, outer.
        parts = torch.arange(len(kept)) >= len(current) - int(crossing.sum())
        outer = (torch.arange(len(kept)) - (len(current) - int(crossing.sum()))) % 2 == 1
        inside = kept & ~(parts & outer)
        edited = edited.then(further)
    return edited, Selection(mask=inside)


def _visible(gaussians: Gaussians, inside: Tensor, view: View, backend: str) -> Tensor:
    """Rows of the selection whose centres the view shows."""
    options = options_for(gaussians, backend)
    centres = centres_in(gaussians.means, view.camera, near=options.near)
    with prepare(gaussians, view.camera, options=options, backend=backend) as prepared:
        seen = unoccluded(centres, gaussians, prepared, tolerance=_DEPTH_TOLERANCE)
    rows = centres.gaussians[seen]
    return rows[inside[rows]]


def _axes(gaussians: Gaussians) -> Float[Tensor, "n 3"]:
    """Longest axes in the world, as long as the largest scale, float64."""
    scales = gaussians.scales.double()
    rotations = rotation_from_quaternion(gaussians.rotations.double())
    longest = scales.argmax(dim=1)
    axis = rotations.gather(2, longest[:, None, None].expand(-1, 3, 1)).squeeze(2)
    return axis * scales.amax(dim=1, keepdim=True)


def _inner_share(
    gaussians: Gaussians, view: View, mask: Tensor
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Share of each axis inside the mask, and which end is: 1, -1, or 0 for both or none."""
    axes = _REACH * _axes(gaussians)
    places = torch.linspace(-1, 1, _SAMPLES, dtype=torch.float64)
    points = gaussians.means.double()[:, None] + places[None, :, None] * axes[:, None]
    pixels, depth = view.camera.project(points)
    column, row = pixels.floor().long().unbind(dim=-1)
    height, width = mask.shape
    shown = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    hit = shown & mask[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    sign = hit[:, -1].double() - hit[:, 0].double()
    return hit.double().mean(dim=1), sign


def _decomposed(gaussians: Gaussians, rows: Tensor, share: Tensor, sign: Tensor) -> Edited:
    """Each row as its inner and its outer part, behind all that stays."""
    axes = _axes(gaussians[rows]) * sign[:, None]
    ends = 2 * _REACH * axes
    inner, outer = 0.5 * (1 - share), -0.5 * share
    moves = torch.stack((inner, outer), dim=1)[:, :, None] * ends[:, None]
    sizes = _SHRINK * torch.stack((share, 1 - share), dim=1)
    twice = rows.repeat_interleave(2)
    chosen = gaussians[twice]
    parts = chosen.replace(
        means=(chosen.means.double() + moves.reshape(-1, 3)).to(gaussians.means),
        scales=(chosen.scales.double() * sizes.reshape(-1, 1)).to(gaussians.scales),
    )
    stays = torch.ones(len(gaussians), dtype=torch.bool)
    stays[rows] = False
    kept = torch.nonzero(stays).squeeze(1)
    return Edited(
        gaussians=Gaussians.concatenate([gaussians[kept], parts]),
        rows=torch.cat((kept, twice)),
        fractions=torch.cat(
            (torch.ones(len(kept)), torch.stack((share, 1 - share), 1).reshape(-1).float())
        ),
    )
