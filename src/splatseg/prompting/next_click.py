r"""Where the next click would help most.

Two signals are rendered in a few views, the membership p of every Gaussian and the probability
that its side is wrong,

.. math:: P = W p, \qquad U = W \min(p, 1 - p)

U is small where sure things of either side meet, though P is near 0.5 there: what a click can
settle is what Gaussians are unsure of, not where the border runs. Three kinds of connected regions
are worth a click:

    uncertain   U is large
    detached    selected, but apart in the view from what was clicked: is it the same thing?
    hole        not selected and surrounded by what is: does it belong?

A region is worth the wrong pixels that are to be expected in it, the sum of U, and of a prior in
detached regions and holes, where sources of membership err more than they say. The best region
of all views is asked for, at its pixel farthest from its rim (Sofiiuk et al., Reviving Iterative
Training with Mask Guidance for Interactive Segmentation, 2021).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_shape, check_values
from splatseg.core import Camera, Gaussians, Selection, View, camera_of_map
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.render import render

Mask = NDArray[np.bool_]
RegionKind = Literal["uncertain", "detached", "hole"]

_MAX_VIEWS = 20
"""Most views that are rendered, those that show most of what is unsure, spread apart."""

_LONGEST = 192
"""Longest side that views are rendered at, pixels; a smaller view is not enlarged."""

_MIN_UNCERTAINTY = 0.2
"""Minimum U of a pixel that is uncertain: a membership of 0.2 to 0.8."""

_HOLE_ERROR = 0.1
"""Probability that a pixel of a hole is wrong however sure its Gaussians are: 0.12 was measured."""

_DETACHED_ERROR = 0.02
"""The same of a detached region: most are parts behind something."""

_MIN_AREA = 20.0
"""Minimum area of a region, pixels of the view; smaller ones are not asked for."""

_NEAR = 1e-6
_MAX_POINTS = 5_000
"""Points that are projected to find out what a view looks at."""

_MIN_ASKED = 0.25
"""Weight in a pixel of Gaussians that were pointed at, with which the pixel was asked already."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NextClick:
    """A pixel of which a person should say whether it belongs."""

    view: View

    point: tuple[float, float]
    """Column and row in the view, pixels; the centre of the top-left pixel is (0.5, 0.5)."""

    kind: RegionKind
    """Why it is asked for."""

    probability: float
    """Probability in [0, 1] that the pixel belongs, as far as is known."""

    area: float
    """Area of the region around it, pixels of the view."""

    expected_error: float
    """Wrong pixels to be expected in that region."""


@boundary
def next_click(
    gaussians: Gaussians,
    views: Sequence[View],
    membership: Float[Tensor, "n"],
    *,
    clicked: Selection | None = None,
    rejected: Selection | None = None,
    backend: str = "auto",
    stop: Callable[[], bool] | None = None,
) -> NextClick | None:
    """The pixel where a click would settle most.

    Args:
        gaussians: The Gaussians of the scene.
        views: Where may be clicked, best the training views.
        membership: p, the probability in [0, 1] that a Gaussian belongs.
        clicked: Gaussians that positive prompts pointed at. What is selected but apart from them
            in a view is detached; None takes the largest region of each view for the thing.
        rejected: Gaussians that negative prompts pointed at. Of a hole or a detached region that
            shows one of either was asked already, so it is not asked again.
        backend: Name of the rendering backend.
        stop: Is asked before each view whether something more urgent waits.

    Returns:
        The click, or None where nothing is uncertain, or it was stopped.
    """
    if not views:
        raise InputError("views: expected at least one that may be clicked in, got none.")
    check_shape("membership", membership, (len(gaussians),))
    check_values("membership", membership, 0.0, 1.0)
    p = membership.detach().to(gaussians.means)
    wrong = torch.minimum(p, 1 - p)
    signal = torch.stack((p, wrong, torch.zeros_like(p), torch.zeros_like(p)), dim=1)
    for channel, pointed_at in ((2, clicked), (3, rejected)):
        if pointed_at is not None:
            check_shape("clicked or rejected", pointed_at.mask, (len(gaussians),))
            signal[:, channel] = pointed_at.mask.to(signal)
    # A signal is rendered without colours; none are evaluated or checked then.
    plain = gaussians.replace(sh=gaussians.sh[:, :1])
    best: NextClick | None = None
    doubtful = torch.maximum(wrong, max(_HOLE_ERROR, _DETACHED_ERROR) * p)
    # What is surely out makes no pixel uncertain, and what holes show lies between what is in.
    likely = p >= _MIN_UNCERTAINTY
    doubtful = torch.where(likely, doubtful, 0.0)
    shown = gaussians[torch.nonzero(likely).squeeze(1)]
    for view in choose_views(gaussians, views, doubtful, most=_MAX_VIEWS):
        if stop is not None and stop():
            return None
        window = _window(view, shown)
        if window is None:
            continue
        image = render(plain, window.camera, signal, backend=backend).image.detach().cpu().numpy()
        for click in _regions(window, image):
            if best is None or click.expected_error > best.expected_error:
                best = click
    return best


@dataclass(frozen=True, slots=True, kw_only=True)
class _Window:
    """The part of a view that shows what may belong, with fewer pixels."""

    view: View
    camera: Camera
    left: int
    top: int
    across: float
    """Pixels of the view from one pixel of the window to the next."""

    down: float


def _window(view: View, shown: Gaussians) -> _Window | None:
    """The window of some Gaussians, three standard deviations around each; None without any."""
    whole = view.camera
    factor = min(1.0, _LONGEST / max(whole.width, whole.height))
    height, width = (max(1, round(side * factor)) for side in (whole.height, whole.width))
    camera = camera_of_map(view, height, width)
    pixels, depth = camera.project(shown.means.detach().double())
    ahead = depth > _NEAR
    radius = 3 * shown.scales.detach().double().amax(dim=1) * max(camera.fx, camera.fy)
    radius = (radius / depth.clamp_min(_NEAR)).unsqueeze(1) + 1
    limits = torch.tensor([width, height], dtype=torch.float64, device=pixels.device)
    inside = ahead & (pixels + radius > 0).all(1) & (pixels - radius < limits).all(1)
    if not bool(inside.any()):
        return None
    low = (pixels - radius)[inside].amin(dim=0).clamp_min(0).floor()
    high = torch.minimum((pixels + radius)[inside].amax(dim=0), limits).ceil()
    (left, top), (right, bottom) = (map(int, corner.tolist()) for corner in (low, high))
    part = replace(
        camera,
        width=max(1, right - left),
        height=max(1, bottom - top),
        cx=camera.cx - left,
        cy=camera.cy - top,
    )
    return _Window(
        view=view,
        camera=part,
        left=left,
        top=top,
        across=whole.width / width,
        down=whole.height / height,
    )


def _regions(window: _Window, image: NDArray[np.float32]) -> Iterator[NextClick]:
    """The largest region of each kind, as clicks."""
    probability, wrong, clicked, rejected = (
        image[..., i].astype(np.float64) for i in range(image.shape[2])
    )
    selected = probability > 0.5
    asked = np.maximum(clicked, rejected) >= _MIN_ASKED
    kinds: list[tuple[RegionKind, NDArray[np.bool_], NDArray[np.float64]]] = [
        ("uncertain", wrong >= _MIN_UNCERTAINTY, wrong)
    ]
    detached = without_regions(detached_regions(selected, clicked), asked)
    kinds.append(("detached", detached, np.maximum(wrong, _DETACHED_ERROR)))
    enclosed = without_regions(enclosed_regions(selected), asked)
    kinds.append(("hole", enclosed, np.maximum(wrong, _HOLE_ERROR)))
    across, down = window.across, window.down
    for kind, mask, error in kinds:
        found = largest_region(mask, error, min_pixels=_MIN_AREA / (across * down))
        if found is None:
            continue
        row, column = found.pixel
        yield NextClick(
            view=window.view,
            point=((window.left + column + 0.5) * across, (window.top + row + 0.5) * down),
            kind=kind,
            probability=float(np.clip(probability[row, column], 0, 1)),
            area=found.pixels * across * down,
            expected_error=found.total * across * down,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageRegion:
    """A connected region of pixels."""

    pixel: tuple[int, int]
    """Row and column of its pixel farthest from its rim."""

    pixels: int
    """How many it has."""

    total: float
    """Sum of the values in it."""


def label_regions(mask: Mask) -> tuple[NDArray[np.int32], int]:
    """The region of each pixel, from 1, 0 outside the mask; and how many there are."""
    from scipy import ndimage

    return cast("tuple[NDArray[np.int32], int]", ndimage.label(mask))


def detached_regions(selected: Mask, clicked: NDArray[np.float64]) -> Mask:
    """Selected pixels apart from the region that shows most of what was clicked.

    Args:
        selected: (H, W).
        clicked: (H, W), how much each pixel shows of what was clicked, 0 or more. Where no
            region shows any, the largest is the one that the others are apart from.
    """
    regions, count = label_regions(selected)
    if count < 2:
        return np.zeros_like(selected)
    shown = np.bincount(regions.ravel(), weights=clicked.ravel(), minlength=count + 1)
    sizes = np.bincount(regions.ravel(), minlength=count + 1)
    shown[0], sizes[0] = 0, 0
    own = int(shown.argmax()) if shown.any() else int(sizes.argmax())
    return selected & (regions != own)


def enclosed_regions(selected: Mask) -> Mask:
    """Pixels that are not selected and surrounded by selected ones."""
    from scipy import ndimage

    return cast(Mask, ndimage.binary_fill_holes(selected)) & ~selected


def without_regions(mask: Mask, pixels: Mask) -> Mask:
    """The connected regions of a mask that have none of some pixels."""
    regions, _ = label_regions(mask)
    return mask & ~np.isin(regions, np.unique(regions[mask & pixels]))


def largest_region(
    mask: Mask, values: NDArray[np.float64], *, min_pixels: float = 0
) -> ImageRegion | None:
    """The connected region whose values, 0 or more, have the largest sum; None where that is 0.

    Args:
        mask: (H, W).
        values: (H, W).
        min_pixels: Regions of fewer pixels do not count.
    """
    from scipy import ndimage

    regions, count = label_regions(mask)
    sums = np.bincount(regions.ravel(), weights=values.ravel(), minlength=count + 1)
    sizes = np.bincount(regions.ravel(), minlength=count + 1)
    sums[0] = 0
    sums[sizes < min_pixels] = 0
    largest = int(sums.argmax())
    if not sums[largest] > 0:
        return None
    # The edge of the image is a rim too: nobody sees what goes on behind it.
    padded = np.pad(regions == largest, 1)
    depth = cast("NDArray[np.float64]", ndimage.distance_transform_edt(padded))[1:-1, 1:-1]
    row, column = np.unravel_index(int(depth.argmax()), depth.shape)
    return ImageRegion(
        pixel=(int(row), int(column)), pixels=int(sizes[largest]), total=float(sums[largest])
    )


def choose_views(
    gaussians: Gaussians, views: Sequence[View], weights: Float[Tensor, "n"], *, most: int
) -> list[View]:
    """At most `most` views that have Gaussians of positive weight in their image.

    The first is the one with the most weight in its image, occlusion aside. Each further one is
    where that weight, relative to the largest, times the distance to the nearest view chosen
    already is largest. In the order of choice; none where no view has any weight.

    Args:
        gaussians: The Gaussians of the scene.
        views: To choose from.
        weights: How much each Gaussian matters, 0 or more.
        most: At least 1.
    """
    shown = torch.tensor(in_image(gaussians.means.detach().cpu(), views, weights))
    return [views[i] for i in choose_cameras([view.camera for view in views], shown, most=most)]


def choose_cameras(cameras: Sequence[Camera], worth: Float[Tensor, "n"], *, most: int) -> list[int]:
    """At most `most` cameras of positive worth, far from each other, see `choose_views`.

    Args:
        cameras: To choose from.
        worth: What each one shows, 0 or more.
        most: At least 1.

    Returns:
        Their indices, in the order of choice.
    """
    shown = worth.double().cpu()
    candidates = torch.nonzero(shown > 0).squeeze(1)
    if len(candidates) <= most:
        return candidates[torch.argsort(shown[candidates], descending=True, stable=True)].tolist()
    centres = torch.stack([cameras[int(i)].centre.double() for i in candidates])
    share = shown[candidates] / shown.max()
    chosen = [int(share.argmax())]
    distance = torch.linalg.vector_norm(centres - centres[chosen[0]], dim=1)
    while len(chosen) < most:
        score = share * distance
        score[chosen] = -1
        chosen.append(int(score.argmax()))
        further = torch.linalg.vector_norm(centres - centres[chosen[-1]], dim=1)
        distance = torch.minimum(distance, further)
    return candidates[torch.tensor(chosen)].tolist()


def in_image(
    means: Float[Tensor, "n 3"], views: Sequence[View], weights: Float[Tensor, "n"]
) -> list[float]:
    """How much weight of Gaussians at some places is in each view's image, occlusion aside."""
    rows, heavy = _sample(weights.detach().double().cpu())
    points = means[rows].double()
    return [_weight_in_image(view, points, heavy) for view in views]


def _sample(weights: Tensor) -> tuple[Tensor, Tensor]:
    """Rows that stand for all, and their weights: quantiles of the weight, rows in order."""
    rows = torch.nonzero(weights > 0).squeeze(1)
    if len(rows) <= _MAX_POINTS:
        return rows, weights[rows]
    cumulative = torch.cumsum(weights[rows], dim=0)
    share = cumulative[-1] / _MAX_POINTS
    targets = (torch.arange(_MAX_POINTS, dtype=torch.float64) + 0.5) * share
    chosen = torch.searchsorted(cumulative, targets).clamp_max(len(rows) - 1)
    return rows[chosen], share.expand(_MAX_POINTS)


def _weight_in_image(view: View, points: Tensor, weights: Tensor) -> float:
    """Weight of the points in a view's image. Lens distortion is that of the camera's model."""
    camera = view.camera
    pixels, depth = camera.project(points)
    inside = (depth > _NEAR) & (pixels >= 0).all(dim=1)
    inside &= (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    return float(weights[inside].sum())
