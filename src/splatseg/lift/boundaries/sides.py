r"""Mass of each Gaussian on either side of a boundary, and the direction that separates them.

Every Gaussian i has two ids between which it may stand, a (inside) and b (outside). The pixels
of label maps measure how much of it they show with each, and where:

.. math:: A_i = \sum_{views} \sum_p w_{pi} [\mathrm{id}(p) = a_i], \qquad
          c^A_i = \frac{\sum_p w_{pi} [\mathrm{id}(p) = a_i]\, x_p}{\sum_p w_{pi} [\ldots]}

with x the pixel's position on the plane z = 1 of a view. In that view the Gaussian is a 2D normal
distribution of covariance :math:`S = J \Sigma J^\top + \epsilon`, and the line that separates
two groups of its pixels best has the normal :math:`S^{-1} (c^A - c^B)` (Fisher's discriminant).
The plane through the camera and that line, pulled back into the Gaussian's own frame, is
:math:`L^\top J^\top S^{-1} (c^A - c^B)`. Views add up with the weight
:math:`A B / (A + B)` of a difference of two means:

.. math:: g_i = \sum_{views} \frac{A B}{A + B}\, L^\top J^\top S^{-1} (c^A - c^B)

is the direction to split along; it points inside.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    Camera,
    Gaussians,
    LabelMap,
    LabelSource,
    View,
    camera_of_map,
)
from splatseg.lift.boundaries.geometry import axes_of
from splatseg.render import PreparedView, RenderOptions, prepare

_IDS_AT_A_TIME = 10
"""Ids that one back-projection carries, with three channels each."""

_MIN_WEIGHT = 1e-4
"""Blending weight in one view, below which a mean position is not used."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sides:
    """Mass of each Gaussian on the pixels of its two ids."""

    inside: Float[Tensor, "n"]
    """Blending weight summed over pixels and views that show its first id."""

    outside: Float[Tensor, "n"]
    """The same for its second id."""

    other: Float[Tensor, "n"]
    """The same for all other ids."""

    direction: Float[Tensor, "n 3"]
    """g, in the Gaussian's own frame; its length has no meaning. Zero where no view sees both."""

    @property
    def share(self) -> Float[Tensor, "n"]:
        """The first id's share of what was seen with either id, 0 where there is none."""
        both = self.inside + self.outside
        return self.inside / torch.where(both > 0, both, 1.0)


def sides_of(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    first: Int[Tensor, "n"],
    second: Int[Tensor, "n"],
    *,
    border_weight: float = 1.0,
    options: RenderOptions,
    backend: str = "auto",
    step: Callable[[], None] = lambda: None,
) -> Sides:
    """Go through the views once and collect both sides of every Gaussian.

    Args:
        gaussians: The Gaussians.
        views: Those that vote.
        evidence: Label maps of them; pixels at -1 do not count.
        first: The id of each Gaussian that is called inside.
        second: The id called outside, -1 where there is none.
        border_weight: What a pixel counts whose eight neighbours are not all of its id. Such a
            pixel shows both sides, and its id is that of one of them.
        options: Switches of the blending model.
        backend: Name of the rendering backend.
        step: Called after each view.
    """
    count = len(gaussians)
    totals = torch.zeros(count, 3)
    direction = torch.zeros(count, 3, dtype=torch.float64)
    axes = axes_of(gaussians)
    for view in views:
        label_map = evidence.label_map(view.name)
        camera = camera_of_map(view, *label_map.ids.shape)
        weights = _pixel_weights(label_map, border_weight)
        with prepare(gaussians, camera, options=options, backend=backend) as prepared:
            moments, seen = _moments(
                prepared, gaussians.means, label_map.ids, weights, (first, second)
            )
        totals[:, 0] += moments[:, 0]
        totals[:, 1] += moments[:, 3]
        totals[:, 2] += seen - moments[:, 0] - moments[:, 3]
        on_both = (moments[:, 0] > _MIN_WEIGHT) & (moments[:, 3] > _MIN_WEIGHT)
        rows = torch.nonzero(on_both).squeeze(1)
        if len(rows):
            direction[rows] += _view_direction(
                gaussians[rows], axes[rows], camera, moments[rows], options
            )
        step()
    return Sides(
        inside=totals[:, 0],
        outside=totals[:, 1],
        other=totals[:, 2].clamp_min(0),
        direction=direction,
    )


def _pixel_weights(label_map: LabelMap, border_weight: float) -> Float[Tensor, "height width"]:
    """What each pixel counts: its confidence, less at the border of a segment."""
    weights = (label_map.ids != UNLABELLED).float()
    if label_map.confidence is not None:
        weights *= label_map.confidence.float()
    if border_weight < 1:
        weights *= torch.where(on_border(label_map.ids), border_weight, 1.0)
    return weights


def _moments(
    view: PreparedView,
    means: Float[Tensor, "n 3"],
    ids: Int[Tensor, "height width"],
    weights: Float[Tensor, "height width"],
    ids_of_sides: tuple[Int[Tensor, "n"], Int[Tensor, "n"]],
) -> tuple[Float[Tensor, "n 6"], Float[Tensor, "n"]]:
    """Weight and first moments on the plane z = 1 of either side, and the weight of all ids."""
    moments, seen = torch.zeros(len(means), 6), torch.zeros(len(means))
    plane = _plane(view.camera)
    present = [int(i) for i in torch.unique(ids).tolist() if i != UNLABELLED]
    for start in range(0, len(present), _IDS_AT_A_TIME):
        part = torch.tensor(present[start : start + _IDS_AT_A_TIME], dtype=torch.int32)
        image = (ids.unsqueeze(-1) == part).float() * weights.unsqueeze(-1)
        image = (image.unsqueeze(-1) * plane.unsqueeze(2)).flatten(2)
        with torch.no_grad():
            sums = view.back_project(image.to(means), warp="nearest").sums
        sums = sums.cpu().reshape(len(means), len(part), 3)
        seen += sums[:, :, 0].sum(dim=1)
        for side, wanted in enumerate(ids_of_sides):
            for column, id in enumerate(part.tolist()):
                rows = wanted == id
                moments[rows, 3 * side : 3 * side + 3] = sums[rows, column]
    return moments, seen


def on_border(ids: Int[Tensor, "height width"]) -> Tensor:
    """Pixels that have a neighbour, of eight, with another id; the image's edge is none."""
    padded = torch.nn.functional.pad(ids[None, None].double(), (1, 1, 1, 1), mode="replicate")[0, 0]
    height, width = ids.shape
    mixed = torch.zeros(height, width, dtype=torch.bool)
    for down in range(3):
        for right in range(3):
            mixed |= padded[down : down + height, right : right + width] != ids
    return mixed


def _plane(camera: Camera) -> Float[Tensor, "height width 3"]:
    """1, x and y of every pixel's centre on the plane z = 1 of the camera."""
    _, rays = camera.rays()
    rotation = camera.cam_from_world.double()[:3, :3]
    rays = rays.double() @ rotation.T
    z = rays[..., 2:]
    # A fisheye's pixel may look sideways, where there is no point on the plane.
    flat = torch.where(z > 1e-3, rays[..., :2] / z.clamp_min(1e-3), 0.0)
    return torch.cat((torch.ones_like(z), flat), dim=-1).float()


def _view_direction(
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
