"""What a person gives to select by: pixels of views, solids in the world, and things alike.

Pixels have x to the right and y down; the centre of the top-left pixel is (0.5, 0.5).
"""

from dataclasses import dataclass, field
from typing import TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg._check import check_finite
from splatseg.core import JSON, Gaussians, Selection, View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.models import signs_of_points
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.neighbours import NeighbourIndex
from splatseg.selection.where import box_corners, check_ball

_CORNERS = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewPrompt:
    """What a person shows in one view: points, a box, a mask, strokes, or several of them.

    Raises:
        RangeError: If a point lies outside the view's pixels, or the box does not meet them.
        ShapeError: If a mask or strokes have another size than the view.
        InputError: If there is nothing, or a mask or strokes without a pixel.
    """

    view: View

    points: Float[Tensor, "p 2"] = field(default_factory=lambda: torch.zeros(0, 2))
    """x and y of clicks, in pixels of the view."""

    positive: Bool[Tensor, "p"] | None = None
    """Whether each point is on the thing (True) or not; None means that all are."""

    box: Float[Tensor, "4"] | None = None
    """x0, y0, x1, y1 in pixels: the thing lies inside."""

    mask: Bool[Tensor, "height width"] | None = None
    """The thing, as far as this view shows it."""

    scribble: Bool[Tensor, "height width"] | None = None
    """Strokes on the thing."""

    negative_scribble: Bool[Tensor, "height width"] | None = None
    """Strokes on what it is not."""

    def __post_init__(self) -> None:
        convert_fields(self)
        object.__setattr__(self, "positive", signs_of_points(self.points, self.positive))
        self._check_points()
        self._check_box()
        given = False
        for name in ("mask", "scribble", "negative_scribble"):
            pixels: Tensor | None = getattr(self, name)
            if pixels is not None:
                self._check_pixels(name, pixels)
                given = True
        if not (given or len(self.points) or self.box is not None):
            raise InputError(
                f"prompt: expected a point, a box, a mask or strokes in view {self.view.name}, "
                "got none."
            )

    @property
    def signs(self) -> Bool[Tensor, "p"]:
        """`positive`, never None."""
        return torch.ones(0, dtype=torch.bool) if self.positive is None else self.positive

    def _check_points(self) -> None:
        width, height = self.view.camera.width, self.view.camera.height
        size = torch.tensor([width, height])
        outside = ((self.points < 0) | (self.points >= size)).any(dim=1)
        if bool(outside.any()):
            x, y = self.points[outside][0].tolist()
            raise RangeError(
                f"points: expected pixels of view {self.view.name}, {width}x{height}, "
                f"got ({x:g}, {y:g})."
            )

    def _check_box(self) -> None:
        if self.box is None:
            return
        check_finite("box", self.box)
        x0, y0, x1, y1 = self.box.tolist()
        width, height = self.view.camera.width, self.view.camera.height
        shown = f"({x0:g}, {y0:g}, {x1:g}, {y1:g})"
        if not (x0 < x1 and y0 < y1):
            raise RangeError(f"box: expected x0 < x1 and y0 < y1, got {shown}.")
        if not bool(pixels_in_box(self.box, height, width).any()):
            raise RangeError(
                f"box: expected one with pixels of view {self.view.name}, {width}x{height}, "
                f"in it, got {shown}."
            )

    def _check_pixels(self, name: str, pixels: Tensor) -> None:
        size = (self.view.camera.height, self.view.camera.width)
        if tuple(pixels.shape) != size:
            got = "x".join(str(side) for side in reversed(pixels.shape))
            raise ShapeError(
                f"{name}: expected {size[1]}x{size[0]} pixels as view {self.view.name} has, "
                f"got {got}."
            )
        if not bool(pixels.any()):
            raise InputError(
                f"{name}: expected pixels that are set in view {self.view.name}, got none."
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AxisBox:
    """A box along the axes of the world: what has its centre inside, or on a face.

    Raises:
        RangeError: If a number is not finite, or there is nothing between the corners.
    """

    low: tuple[float, float, float]
    """Least x, y, z, scene units."""

    high: tuple[float, float, float]
    """Largest x, y, z, scene units."""

    def __post_init__(self) -> None:
        convert_fields(self)
        box_corners(self.low, self.high)

    @boundary
    def contains(self, gaussians: Gaussians) -> Bool[Tensor, "n"]:
        """Which Gaussians have their centre in it."""
        means = gaussians.means.double()
        low, high = (corner.to(means) for corner in box_corners(self.low, self.high))
        return ((means >= low) & (means <= high)).all(dim=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ball:
    """A ball in the world: what has its centre inside, or on its surface.

    Raises:
        RangeError: If a number is not finite, or the radius is not positive.
    """

    centre: tuple[float, float, float]
    """x, y, z, scene units."""

    radius: float
    """Scene units."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_ball("sphere", (*self.centre, self.radius))

    @boundary
    def contains(self, gaussians: Gaussians) -> Bool[Tensor, "n"]:
        """Which Gaussians have their centre in it."""
        means = gaussians.means.double()
        away = means - torch.tensor(self.centre).to(means)
        return torch.linalg.vector_norm(away, dim=1) <= self.radius


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Balls:
    """Balls of one size, such as a brush leaves along its way: what has its centre in one of them.

    Raises:
        ShapeError: If there is no ball.
        RangeError: If a number is not finite, or the radius is not positive.
    """

    centres: Float[Tensor, "balls 3"]
    """x, y, z of each, scene units."""

    radius: float
    """Scene units."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_finite("centres", self.centres)
        if not len(self.centres):
            raise ShapeError("centres: expected at least one ball, got none.")
        check_ball("sphere", (*self.centres[0].tolist(), self.radius))

    @boundary
    def contains(self, gaussians: Gaussians) -> Bool[Tensor, "n"]:
        """Which Gaussians have their centre in one of them, or on its surface."""
        index = NeighbourIndex(self.centres.double().cpu())
        nearest = index.nearest(gaussians.means.double().cpu(), 1).distances[:, 0]
        return (nearest <= self.radius).to(gaussians.device)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lasso:
    """All that lies behind a polygon of a view, near and far: a prism of sight.

    Raises:
        ShapeError: If it has fewer than three corners.
        RangeError: If a number is not finite.
    """

    view: View

    polygon: Float[Tensor, "corners 2"]
    """x and y of its corners in pixels of the view, in order; the last is joined to the first.
    Where lines cross, what they go round an odd number of times is inside. Corners may lie
    outside the picture."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_finite("polygon", self.polygon)
        if len(self.polygon) < _CORNERS:
            raise ShapeError(
                f"polygon: expected at least {_CORNERS} corners, got {len(self.polygon)}."
            )

    @boundary
    def contains(self, gaussians: Gaussians) -> Bool[Tensor, "n"]:
        """Which Gaussians have their centre before the camera and within the polygon."""
        pixels, depth = self.view.camera.project(gaussians.means.double())
        return (depth > 0) & _in_polygon(pixels, self.polygon.to(pixels))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Similar:
    """More like this: all things like one that was selected before."""

    selection: Selection

    def __post_init__(self) -> None:
        convert_fields(self)
        if not self.selection.count:
            raise InputError("similar: expected a selection of something, got an empty one.")


Solid: TypeAlias = AxisBox | Ball | Balls | Lasso
"""Prompts that are places: a Gaussian is in them or not."""

SelectionPrompt: TypeAlias = ViewPrompt | AxisBox | Ball | Balls | Lasso | Similar
"""All that can be selected by."""


def prompt_record(prompt: SelectionPrompt) -> dict[str, JSON]:
    """What a prompt says, in values that JSON holds; of masks and strokes, how many pixels."""
    match prompt:
        case AxisBox():
            return {"kind": "box", "low": list(prompt.low), "high": list(prompt.high)}
        case Ball():
            return {"kind": "sphere", "centre": list(prompt.centre), "radius": prompt.radius}
        case Balls():
            middles: list[JSON] = [[float(v) for v in one] for one in prompt.centres.tolist()]
            return {"kind": "spheres", "centres": middles, "radius": prompt.radius}
        case Lasso():
            corners: list[JSON] = [[float(v) for v in corner] for corner in prompt.polygon.tolist()]
            return {"kind": "lasso", "view": prompt.view.name, "polygon": corners}
        case Similar():
            return {"kind": "similar", "gaussians": prompt.selection.count}
        case _:
            pass
    record: dict[str, JSON] = {"kind": "view", "view": prompt.view.name}
    for name, wanted in (("points", True), ("negative_points", False)):
        chosen = prompt.points[prompt.signs == wanted].tolist()
        if chosen:
            record[name] = [[float(x), float(y)] for x, y in chosen]
    if prompt.box is not None:
        record["box"] = [float(v) for v in prompt.box.tolist()]
    for name in ("mask", "scribble", "negative_scribble"):
        pixels = getattr(prompt, name)
        if pixels is not None:
            record[f"{name}_pixels"] = int(pixels.sum())
    return record


def pixels_in_box(box: Float[Tensor, "4"], height: int, width: int) -> Bool[Tensor, "height width"]:
    """Pixels of an image whose centre lies in a box x0, y0, x1, y1."""
    x0, y0, x1, y1 = box.double().tolist()
    columns = torch.arange(width, dtype=torch.float64) + 0.5
    rows = torch.arange(height, dtype=torch.float64) + 0.5
    across = (columns >= x0) & (columns <= x1)
    down = (rows >= y0) & (rows <= y1)
    return down.unsqueeze(1) & across


def _in_polygon(points: Tensor, polygon: Tensor) -> Tensor:
    """Points from which a ray to the right crosses an odd number of sides."""
    inside = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    x, y = points.unbind(dim=1)
    for start, end in zip(polygon, polygon.roll(-1, dims=0), strict=True):
        (x0, y0), (x1, y1) = start, end
        # A side counts with its upper end alone, so that a ray through a corner meets it once.
        beside = (y0 > y) != (y1 > y)
        rise = torch.where(y1 == y0, torch.ones_like(y0), y1 - y0)
        inside ^= beside & (x < x0 + (y - y0) * (x1 - x0) / rise)
    return inside
