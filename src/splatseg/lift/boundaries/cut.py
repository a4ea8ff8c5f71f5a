r"""Cuts: Gaussians that reach over a boundary are split, so that each side can go its own way.

A boundary is that of masks in the photographs (`cut_masks`) or a box in the world (`cut_box`). A
Gaussian straddles it if its lesser side has at least `CutOptions.min_side`: of the evidence that
masks give, or of the Gaussian's mass beyond a plane. It is split in the direction that separates
the two sides best, its parts are held against the same boundary, and those that still straddle are
split again.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float, Int
from msgspec import Meta
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    Camera,
    Edited,
    Gaussians,
    LabelMap,
    LabelSource,
    Selection,
    View,
    camera_of_map,
)
from splatseg.core.boundary import boundary
from splatseg.core.options import NonNegative, Share, options
from splatseg.errors import InputError, ShapeError
from splatseg.lift.boundaries.split import (
    axes_of,
    directions_of_normals,
    line_extent,
    split_along,
    unit_or_main,
)
from splatseg.lift.voting.uplift import voting_views
from splatseg.render import RenderOptions, options_for, prepare
from splatseg.selection import box_corners

MIN_VIEW_WEIGHT = 1e-4
"""Blending weight in one view, below which a mean position is not used."""

INSIDE, OUTSIDE = 1, 2
"""Ids of label maps of one mask."""

_ROUNDS = 2
"""How often what still straddles is split again."""

_PARTS = 3
"""Parts that a Gaussian is split into."""

_MIN_WEIGHT = 0.5
"""Evidence that a Gaussian must have to be split at a mask, in pixels that show it fully."""

BORDER_WEIGHT = 0.1
"""Weight of a pixel at the border of a mask: it shows both sides."""


@options(
    removed={
        "parts": "Gaussians are split into three parts",
        "rounds": "what still straddles is split a second time; `--cut off` splits nothing",
        "min_weight": "a Gaussian needs half a pixel of evidence to be split",
        "border_weight": "pixels at a border have a tenth of the weight",
    }
)
class CutOptions:
    """Which Gaussians are split at a cut."""

    min_side: Annotated[float, Meta(ge=0, le=0.5)] = 0.1
    """Minimum share, in [0, 0.5], of the lesser side for a Gaussian to straddle the cut."""

    min_pixels: NonNegative = 0.5
    """Minimum standard deviation, pixels, that a Gaussian must have across the cut in some view;
    smaller ones are not split. 0 splits all."""

    keep_share: Share = 0.5
    """Share of its evidence, in [0, 1], that must lie inside for a Gaussian to count as inside.
    Less takes more of what is near the boundary."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cut:
    """Gaussians that were split at a boundary, and which of them are inside."""

    edited: Edited
    """The Gaussians after the splits; rows lead each part to what it is a part of."""

    share: Float[Tensor, "n"]
    """How much of each lies inside, in [0, 1]; 0 where nothing is known of it."""

    evidence: Float[Tensor, "n"]
    """What the share rests on: evidence in fully visible pixels, or 1 for a box."""

    inside: Selection
    """Those that count as inside."""

    split: int
    """How many Gaussians of before were split."""


@boundary
def cut_masks(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    ids: Sequence[int],
    *,
    among: Selection | None = None,
    options: CutOptions | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Cut:
    """Split what straddles the boundary between the pixels of some ids and all others.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those that vote, best all that the layer was lifted from.
        evidence: Label maps of them; pixels at -1 do not count.
        ids: The ids that are inside.
        among: Only these are split; None is all.
        options: Which are split.
        backend: Name of the rendering backend.
        progress: Called with the views done and all there are to do.

    Returns:
        The cut. A Gaussian is inside where its share of the evidence is more than
        `CutOptions.keep_share`.

    Raises:
        InputError: If there are no views or ids, or no view shows any of the ids.
        ShapeError: If `among` is of other Gaussians.
    """
    options = options or CutOptions()
    _check_among(gaussians, among)
    voting_views(views, evidence, "a label map")
    if not ids:
        raise InputError("ids: expected at least one, got none.")
    cameras = [view.camera for view in views]
    measured: list[tuple[Gaussians, Sides]] = []
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, (_ROUNDS + 1) * len(views))

    def sides(current: Gaussians) -> Sides:
        found = sides_of(
            current,
            views,
            evidence,
            ids,
            border_weight=BORDER_WEIGHT,
            backend=backend,
            step=step,
        )
        measured.append((current, found))
        return found

    def straddling(current: Gaussians) -> tuple[Tensor, Tensor]:
        found = sides(current)
        mask = torch.minimum(found.share, 1 - found.share) >= max(options.min_side, 1e-6)
        mask &= found.inside + found.outside >= _MIN_WEIGHT
        mask &= current.scales.amax(dim=1) > 0
        rows = torch.nonzero(mask).squeeze(1)
        if options.min_pixels > 0 and len(rows):
            chosen = current[rows]
            directions = unit_or_main(chosen, found.direction[rows])
            mask[rows] = line_extent(chosen, directions, cameras).pixels >= options.min_pixels
        return mask, found.direction

    edited, count = _split_in_rounds(gaussians, among, straddling, cameras)
    if not measured or measured[-1][0] is not edited.gaussians:
        sides(edited.gaussians)
    found = measured[-1][1]
    if not bool((found.inside > 0).any()):
        shown = ", ".join(map(str, ids))
        raise InputError(f"ids: none of {len(views)} views shows a Gaussian with id {shown}.")
    return Cut(
        edited=edited,
        share=found.share,
        evidence=found.inside + found.outside,
        inside=Selection(mask=found.share > options.keep_share),
        split=count,
    )


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
        options: Which are split.
        cameras: Cameras that rendered images matter for and that sizes in pixels are of; without
            any, size does not count.

    Returns:
        The cut. A Gaussian is inside where its centre is.

    Raises:
        RangeError: If the box is empty or not finite.
        ShapeError: If `among` is of other Gaussians.
    """
    options = options or CutOptions()
    _check_among(gaussians, among)
    lower, upper = box_corners(low, high)

    def straddling(current: Gaussians) -> tuple[Tensor, Tensor]:
        mass, normals = _nearest_face(current, lower, upper)
        directions = directions_of_normals(current, normals)
        large = line_extent(current, directions, cameras).pixels >= options.min_pixels
        sized = current.scales.amax(dim=1) > 0
        return (mass >= max(options.min_side, 1e-6)) & large & sized, directions

    edited, split = _split_in_rounds(gaussians, among, straddling, cameras)
    centres = edited.gaussians.means.double()
    inside = ((centres >= lower) & (centres <= upper)).all(dim=1)
    return Cut(
        edited=edited,
        share=inside.float(),
        evidence=torch.ones(len(edited)),
        inside=Selection(mask=inside),
        split=split,
    )


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


def _check_among(gaussians: Gaussians, among: Selection | None) -> None:
    if among is not None and len(among) != len(gaussians):
        raise ShapeError(f"among: expected {len(gaussians)} rows, got {len(among)}.")


def _split_in_rounds(
    gaussians: Gaussians,
    among: Selection | None,
    straddling: Callable[[Gaussians], tuple[Tensor, Tensor]],
    cameras: Sequence[Camera],
) -> tuple[Edited, int]:
    """Split what straddles, and what still does of its parts; how many were split at first.

    Args:
        gaussians: The Gaussians.
        among: Only these are split; None is all.
        straddling: Which straddle (n,), and the directions to split them along (n, 3).
        cameras: Cameras that rendered images matter for.
    """
    edited, count = Edited.unchanged(gaussians), 0
    for index in range(_ROUNDS):
        mask, directions = straddling(edited.gaussians)
        if among is not None:
            mask = mask & among.mask[edited.rows]
        selected = Selection(mask=mask)
        if index == 0:
            count = selected.count
        if not selected.count:
            break
        edited = edited.then(
            split_along(edited.gaussians, selected, directions[mask], parts=_PARTS, cameras=cameras)
        )
    return edited, count


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sides:
    """Mass of each Gaussian on the pixels inside and outside of a boundary."""

    inside: Float[Tensor, "n"]
    """Blending weight summed over pixels and views that show the inside."""

    outside: Float[Tensor, "n"]
    """The same for the outside."""

    direction: Float[Tensor, "n 3"]
    """g, in the Gaussian's own frame; its length has no meaning. Zero where no view sees both."""

    @property
    def share(self) -> Float[Tensor, "n"]:
        """The share of the inside, 0 where nothing was seen."""
        both = self.inside + self.outside
        return self.inside / torch.where(both > 0, both, 1.0)


def sides_of(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    ids: Sequence[int],
    *,
    border_weight: float = 1.0,
    backend: str = "auto",
    step: Callable[[], None] = lambda: None,
) -> Sides:
    r"""Mass of each Gaussian on either side of a boundary, and the direction that separates them.

    The pixels of label maps measure how much of each Gaussian they show inside, on A, and outside,
    on B, and where:

    .. math:: A_i = \sum_{views} \sum_{p \in A} w_{pi}, \qquad
              c^A_i = \frac{\sum_{p \in A} w_{pi} x_p}{\sum_{p \in A} w_{pi}}

    with x the pixel's position on the plane z = 1 of a view. In that view the Gaussian is a 2D
    normal distribution of covariance :math:`S = J \Sigma J^\top + \epsilon`, and the line that
    separates two groups of its pixels best has the normal :math:`S^{-1} (c^A - c^B)` (Fisher's
    discriminant). The plane through the camera and that line, pulled back into the Gaussian's own
    frame, is :math:`L^\top J^\top S^{-1} (c^A - c^B)`. Views add up with the weight :math:`A B / (A
    + B)` of a difference of two means:

    .. math:: g_i = \sum_{views} \frac{A B}{A + B}\, L^\top J^\top S^{-1} (c^A - c^B)

    is the direction to split along; it points inside.

    Args:
        gaussians: The Gaussians.
        views: Those that vote.
        evidence: Label maps of them; pixels at -1 do not count.
        ids: The ids that are inside; all others are outside.
        border_weight: What a pixel counts whose eight neighbours are not all on its side. Such a
            pixel shows both sides, and its id is that of one of them.
        backend: Name of the rendering backend.
        step: Called after each view.
    """
    options = options_for(gaussians, backend)
    inside, outside = torch.zeros(2, len(gaussians))
    direction = torch.zeros(len(gaussians), 3, dtype=torch.float64)
    axes = axes_of(gaussians)
    for view in views:
        label_map = evidence.label_map(view.name)
        camera = camera_of_map(view, *label_map.ids.shape)
        image = _side_image(label_map, ids, border_weight).unsqueeze(-1) * plane_of_pixels(
            camera
        ).unsqueeze(2)
        with (
            torch.no_grad(),
            prepare(gaussians, camera, options=options, backend=backend) as prepared,
        ):
            sums = prepared.back_project(image.flatten(2).to(gaussians.means), warp="nearest").sums
        moments = sums.cpu().float()
        inside += moments[:, 0]
        outside += moments[:, 3]
        on_both = (moments[:, 0] > MIN_VIEW_WEIGHT) & (moments[:, 3] > MIN_VIEW_WEIGHT)
        rows = torch.nonzero(on_both).squeeze(1)
        if len(rows):
            direction[rows] += view_direction(
                gaussians[rows], axes[rows], camera, moments[rows], options
            )
        step()
    return Sides(inside=inside, outside=outside, direction=direction)


def _side_image(
    label_map: LabelMap, ids: Sequence[int], border_weight: float
) -> Float[Tensor, "height width 2"]:
    """What each pixel counts inside and outside: its confidence, less at the boundary."""
    known = label_map.ids != UNLABELLED
    is_inside = torch.isin(label_map.ids, torch.tensor(list(ids), dtype=label_map.ids.dtype))
    weights = known.float()
    if label_map.confidence is not None:
        weights *= label_map.confidence.float()
    if border_weight < 1:
        sides = torch.where(known, is_inside.int(), UNLABELLED)
        weights *= torch.where(on_border(sides), border_weight, 1.0)
    return torch.stack((is_inside * weights, ~is_inside * weights), dim=-1)


def on_border(ids: Int[Tensor, "height width"]) -> Tensor:
    """Pixels that have a neighbour, of eight, with another id; the image's edge is none."""
    padded = torch.nn.functional.pad(ids[None, None].double(), (1, 1, 1, 1), mode="replicate")[0, 0]
    height, width = ids.shape
    mixed = torch.zeros(height, width, dtype=torch.bool)
    for down in range(3):
        for right in range(3):
            mixed |= padded[down : down + height, right : right + width] != ids
    return mixed


def plane_of_pixels(camera: Camera) -> Float[Tensor, "height width 3"]:
    """1, x and y of every pixel's centre on the plane z = 1 of the camera."""
    return torch.nn.functional.pad(camera.plane_of_pixels(), (1, 0), value=1.0).float()


def view_direction(
    gaussians: Gaussians, axes: Tensor, camera: Camera, moments: Tensor, options: RenderOptions
) -> Tensor:
    """One view's term of g."""
    rotation = camera.cam_from_world.double()[:3, :3]
    points = gaussians.means.double() @ rotation.T + camera.cam_from_world.double()[:3, 3]
    x, y, z = points.unbind(1)
    z = z.clamp_min(options.near)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        (torch.stack((1 / z, zero, -x / z**2), -1), torch.stack((zero, 1 / z, -y / z**2), -1)), 1
    )
    whitened = jacobian @ rotation @ axes
    low_pass = torch.tensor([camera.fx, camera.fy], dtype=torch.float64) ** -2 * options.low_pass
    covariance = whitened @ whitened.transpose(1, 2) + torch.diag(low_pass)
    a, b = moments[:, 0].double(), moments[:, 3].double()
    mean_difference = moments[:, 1:3].double() / a[:, None] - moments[:, 4:6].double() / b[:, None]
    normal = torch.linalg.solve(covariance, mean_difference)
    weight = a * b / (a + b)
    return weight[:, None] * torch.einsum("nij,ni->nj", whitened, normal)
