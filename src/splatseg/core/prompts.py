"""What a person points at in an image."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prompt:
    """What a person points at in an image: points, a box, a rough mask, or several of them."""

    points: Float[Tensor, "p 2"] = field(default_factory=lambda: torch.zeros(0, 2))
    """x to the right and y down, in pixels; the centre of the top-left pixel is (0.5, 0.5)."""

    positive: Bool[Tensor, "p"] | None = None
    """Whether each point is on the thing (True) or not; None means that all are."""

    box: Float[Tensor, "4"] | None = None
    """x0, y0, x1, y1 in pixels: the thing lies inside."""

    mask: Bool[Tensor, "height width"] | None = None
    """A rough mask of the thing, of the image's size."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("points", self.points, (None, 2))
        check_finite("points", self.points)
        count = len(self.points)
        if self.positive is None:
            object.__setattr__(self, "positive", torch.ones(count, dtype=torch.bool))
        else:
            check_shape("positive", self.positive, (count,))
            object.__setattr__(self, "positive", self.positive.to(torch.bool))
        if self.box is not None:
            check_shape("box", self.box, (4,))
            check_finite("box", self.box)
            x0, y0, x1, y1 = self.box.tolist()
            if not (x0 < x1 and y0 < y1):
                raise RangeError(
                    f"box: expected x0 < x1 and y0 < y1, got ({x0:g}, {y0:g}, {x1:g}, {y1:g})."
                )
        if self.box is None and self.mask is None and not bool(self.signs.any()):
            raise InputError("prompt: expected a positive point, a box or a mask, got none.")

    @property
    def signs(self) -> Bool[Tensor, "p"]:
        """`positive`, never None."""
        return (
            torch.ones(len(self.points), dtype=torch.bool)
            if self.positive is None
            else (self.positive)
        )

    @boundary
    def check_size(self, height: int, width: int) -> None:
        """Raise `InputError` unless the prompt lies in an image of this size.

        Raises:
            RangeError: If a point lies outside, or the box does not meet the image.
            ShapeError: If the mask has another size.
        """
        limits = torch.tensor([width, height])
        outside = ((self.points < 0) | (self.points > limits)).any(1)
        if bool(outside.any()):
            x, y = self.points[outside][0].tolist()
            raise RangeError(
                f"points: expected pixels of an image of {width}x{height}, got ({x:g}, {y:g})."
            )
        if self.box is not None:
            x0, y0, x1, y1 = self.box.tolist()
            if x0 >= width or y0 >= height or x1 <= 0 or y1 <= 0:
                raise RangeError(
                    f"box: expected one that meets the image of {width}x{height}, "
                    f"got ({x0:g}, {y0:g}, {x1:g}, {y1:g})."
                )
        if self.mask is not None:
            check_shape("mask", self.mask, (height, width))
