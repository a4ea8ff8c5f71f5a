"""A view with a selection outlined and the prompts that made it."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from splatseg._check import check_shape

_OUTLINE = (255, 214, 10)
_POSITIVE = (52, 199, 89)
_NEGATIVE = (226, 48, 48)
_EDGE = (16, 16, 20)
_DIMMED = 0.45


def selection_picture(
    image: UInt8[Tensor, "height width 3"],
    mask: Bool[Tensor, "height width"],
    *,
    points: Float[Tensor, "p 2"] | None = None,
    positive: Bool[Tensor, "p"] | None = None,
    polygons: tuple[Float[Tensor, "corners 2"], ...] = (),
    strokes: Bool[Tensor, "height width"] | None = None,
    negative_strokes: Bool[Tensor, "height width"] | None = None,
) -> UInt8[Tensor, "height width 3"]:
    """Draw what is selected bright within a yellow outline, the rest dimmed, prompts on top.

    Args:
        image: The view.
        mask: What is selected of it.
        points: Clicks, x and y in pixels: discs, green on the thing and red beside it.
        positive: Whether each click is on the thing; None means that all are.
        polygons: Boxes and lassos, corners in pixels.
        strokes: Pixels of strokes on the thing.
        negative_strokes: Pixels of strokes beside it.

    Raises:
        ShapeError: If the mask has not the image's size.
    """
    check_shape("mask", mask, tuple(image.shape[:2]))
    lit = np.where(mask.numpy()[..., None], 1.0, _DIMMED)
    colours = (image.numpy() * lit + 0.5).astype(np.uint8)
    for pixels, colour in ((strokes, _POSITIVE), (negative_strokes, _NEGATIVE)):
        if pixels is not None:
            colours[pixels.numpy()] = colour
    inner = mask.numpy().astype(np.uint8)
    edge = inner - cv2.erode(inner, np.ones((3, 3), np.uint8), borderValue=0)
    colours[edge > 0] = _OUTLINE
    picture = Image.fromarray(colours)
    draw = ImageDraw.Draw(picture)
    for polygon in polygons:
        corners = [(float(x), float(y)) for x, y in polygon.tolist()]
        draw.line([*corners, corners[0]], fill=_POSITIVE, width=2)
    if points is not None:
        signs = torch.ones(len(points)).bool() if positive is None else positive
        radius = max(3.0, min(image.shape[:2]) / 100)
        for (x, y), sign in zip(points.tolist(), signs.tolist(), strict=True):
            where = (x - radius, y - radius, x + radius, y + radius)
            draw.ellipse(where, fill=_POSITIVE if sign else _NEGATIVE, outline=_EDGE, width=1)
    return torch.from_numpy(np.array(picture))
