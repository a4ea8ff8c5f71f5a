"""Ids written on a picture, each where its thing is widest."""

import numpy as np
import torch
from jaxtyping import Int, UInt8
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import UNLABELLED

_SMALLEST, _SHARE = 11, 1 / 30
"""Height of the letters, pixels, and as a share of the longest side; the larger counts."""


def draw_ids(
    image: UInt8[Tensor, "height width 3"], ids: Int[Tensor, "height width"]
) -> UInt8[Tensor, "height width 3"]:
    """A picture with the ids of a label map written on it; too small areas go without."""
    check_shape("ids", ids, image.shape[:2])
    size = max(_SMALLEST, round(_SHARE * max(image.shape[:2])))
    picture = Image.fromarray(image.cpu().numpy())
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(size)
    for id, x, y in _places(ids, radius=0.45 * size):
        draw.text(
            (x, y),
            str(id),
            fill=(255, 255, 255),
            font=font,
            anchor="mm",
            stroke_width=max(1, size // 8),
            stroke_fill=(16, 16, 20),
        )
    return torch.from_numpy(np.array(picture))


def _places(ids: Tensor, *, radius: float) -> list[tuple[int, float, float]]:
    """Id and centre of the largest circle that its area holds, where that is wide enough."""
    present, index = torch.unique(ids, return_inverse=True)
    # Labels of `find_objects` begin with 1.
    numbered = index.cpu().numpy() + 1
    found: list[tuple[int, float, float]] = []
    for k, (id, box) in enumerate(
        zip(present.tolist(), ndimage.find_objects(numbered), strict=True), start=1
    ):
        if id == UNLABELLED or box is None:
            continue
        # A rim, so that the border of the picture is a border of the thing.
        inside = np.pad(numbered[box] == k, 1)
        depth = np.asarray(ndimage.distance_transform_edt(inside))
        row, column = np.unravel_index(int(np.argmax(depth)), depth.shape)
        if depth[row, column] < radius:
            continue
        found.append((id, float(box[1].start + column) - 0.5, float(box[0].start + row) - 0.5))
    return found
