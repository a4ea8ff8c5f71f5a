"""Pixels of label maps that tell where things end, and their rows of W."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import scipy.sparse
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import UNLABELLED, Camera, Gaussians, LabelMap
from splatseg.render import RenderOptions, weights

_BORDER = 4
"""Pixels on either side of a border that count as near it."""


def drawn_pixels(
    labels: LabelMap, count: int, border_share: float, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Labelled pixels, numbered row by row, a share of them near borders of labels.

    Args:
        labels: Ids of a view.
        count: How many at most.
        border_share: The share that is drawn near borders, as far as there are as many.
        rng: Draws them.
    """
    ids = labels.ids
    known = (ids != UNLABELLED).reshape(-1).numpy()
    near = _near_borders(ids).reshape(-1).numpy() & known
    parts: list[NDArray[np.int64]] = []
    for pixels, wanted in (
        (np.flatnonzero(near), round(border_share * count)),
        (np.flatnonzero(known & ~near), count - round(border_share * count)),
    ):
        parts.append(rng.choice(pixels, min(len(pixels), wanted), replace=False))
    return np.concatenate(parts)


def _near_borders(ids: Tensor) -> Tensor:
    border = torch.zeros(ids.shape, dtype=torch.bool)
    border[:, 1:] |= ids[:, 1:] != ids[:, :-1]
    border[1:] |= ids[1:] != ids[:-1]
    size = 2 * _BORDER + 1
    grown = torch.nn.functional.max_pool2d(border.float()[None, None], size, 1, _BORDER)
    return grown[0, 0] > 0


def rows_of_pixels(
    gaussians: Gaussians,
    views: Iterable[tuple[Camera, NDArray[np.int64]]],
    *,
    min_weight: float,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
) -> Any:
    """Rows of W of pixels of several views, one view after another, scipy rows of float32.

    Args:
        gaussians: The Gaussians of the scene.
        views: Cameras and the pixels drawn of each.
        min_weight: Blending weights below it are left out, which are most of them and little of
            the light.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.
    """
    parts: list[Any] = []
    for camera, pixels in views:
        flat = torch.from_numpy(pixels)
        where = torch.stack((flat % camera.width, flat // camera.width), dim=1)
        part = weights(gaussians, camera, where, options=render_options, backend=backend).to_scipy()
        part.data[part.data < min_weight] = 0
        part.eliminate_zeros()
        parts.append(part)
    return scipy.sparse.vstack(parts, format="csr", dtype=np.float32)
