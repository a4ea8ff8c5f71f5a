"""GrabCut: a mask for a box, points or a rough mask, from the colours of one image."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import MaskSet
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.models import Prompt
from splatseg.errors import InputError, ShapeError
from splatseg.models.classical._boundary import one_thread

_SEED = 20240817


@dataclass(frozen=True, slots=True, kw_only=True)
class GrabCutOptions:
    """How GrabCut works."""

    cut_rounds: int = 5
    """Rounds of fitting colour mixtures and cutting the graph."""

    point_radius: float = 0.012
    """Radius of the disc that a point stands for, as a share of the image's longest side."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.cut_rounds < 1:
            raise InputError(f"cut_rounds: expected at least 1, got {self.cut_rounds}.")
        if not 0 < self.point_radius < 0.5:
            raise InputError(
                f"point_radius: expected a share in (0, 0.5), got {self.point_radius}."
            )


@boundary
def grab_cut(
    image: NDArray[np.uint8],
    prompt: Prompt,
    *,
    size: tuple[int, int],
    options: GrabCutOptions | None = None,
) -> MaskSet:
    """The mask that a prompt means. A stand-in for a learned promptable segmenter.

    What lies outside the box is background. A positive point's disc is foreground, a negative
    one's background. With points alone, a region around them is taken as probable foreground
    and the rest of the image as probable background. Of the cut, the parts that hold a positive
    point stay; without points, parts of at least a tenth of the largest one.

    Args:
        image: The image at the working size.
        prompt: What is meant, in pixels of the photograph.
        size: Height and width of the photograph, which the mask has too.
        options: Rounds and the size of a point.

    Returns:
        One mask, or none where nothing is left of it.
    """
    import cv2

    options = GrabCutOptions() if options is None else options
    height, width = size
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise ShapeError(f"image: expected shape (any, any, 3), got {image.shape}.")
    prompt.check_size(height, width)
    trimap = _trimap(image.shape[:2], prompt, size=size, options=options)
    sure = np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if not sure.any() or sure.all():
        return _mask_set([], height, width)
    with one_thread():
        cv2.setRNGSeed(_SEED)  # the mixtures start from k-means with cv2's own generator
        background, foreground = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(
            np.ascontiguousarray(image[..., ::-1]),
            trimap,
            (0, 0, 1, 1),  # not looked at: the trimap says all
            background,
            foreground,
            options.cut_rounds,
            cv2.GC_INIT_WITH_MASK,
        )
    cut = np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD))
    points = _scaled_points(image.shape[:2], prompt, size)[prompt.signs.cpu().numpy()]
    cut = _parts_meant(cut, points)
    if not cut.any():
        return _mask_set([], height, width)
    full = np.asarray(
        cv2.resize(cut.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    )
    return _mask_set([torch.from_numpy(full >= 0.5)], height, width)


def _mask_set(masks: list[Bool[Tensor, "height width"]], height: int, width: int) -> MaskSet:
    dense = torch.stack(masks) if masks else torch.zeros(0, height, width, dtype=torch.bool)
    # Half: GrabCut does not say how sure it is.
    return MaskSet.from_dense(dense, scores=torch.full((len(dense),), 0.5))


def _trimap(
    shape: tuple[int, ...], prompt: Prompt, *, size: tuple[int, int], options: GrabCutOptions
) -> NDArray[np.uint8]:
    import cv2

    h, w = shape
    height, width = size
    rows, columns = np.mgrid[:h, :w] + 0.5
    trimap = np.full((h, w), cv2.GC_PR_BGD, np.uint8)
    points = _scaled_points(shape, prompt, size)
    radius = max(1.0, options.point_radius * max(h, w))
    if prompt.mask is not None:
        rough = prompt.mask.cpu().numpy().astype(np.uint8)
        small = np.asarray(cv2.resize(rough, (w, h), interpolation=cv2.INTER_NEAREST))
        _mark_rough(trimap, small > 0)
    elif prompt.box is not None:
        trimap[:] = cv2.GC_PR_FGD
    else:
        for x, y in points[prompt.signs.cpu().numpy()]:
            near = (columns - x) ** 2 + (rows - y) ** 2 <= (4 * radius) ** 2
            trimap[near] = cv2.GC_PR_FGD
    if prompt.box is not None:
        scale = np.array([w / width, h / height, w / width, h / height])
        x0, y0, x1, y1 = prompt.box.double().cpu().numpy() * scale
        inside = (columns > x0) & (columns < x1) & (rows > y0) & (rows < y1)
        trimap[~inside] = cv2.GC_BGD
    for (x, y), positive in zip(points, prompt.signs.tolist(), strict=True):
        disc = (columns - x) ** 2 + (rows - y) ** 2 <= radius**2
        trimap[disc] = cv2.GC_FGD if positive else cv2.GC_BGD
    return trimap


def _mark_rough(trimap: NDArray[np.uint8], rough: NDArray[np.bool_]) -> None:
    """The core of a rough mask is foreground, what is as far outside as it is thick background."""
    import cv2

    if not rough.any() or rough.all():
        trimap[rough] = cv2.GC_PR_FGD
        return
    inside = np.asarray(cv2.distanceTransform(rough.astype(np.uint8), cv2.DIST_L2, 5))
    outside = np.asarray(cv2.distanceTransform((~rough).astype(np.uint8), cv2.DIST_L2, 5))
    trimap[rough] = cv2.GC_PR_FGD
    trimap[inside > 0.6 * inside.max()] = cv2.GC_FGD
    trimap[outside > inside.max()] = cv2.GC_BGD


def _scaled_points(
    shape: tuple[int, ...], prompt: Prompt, size: tuple[int, int]
) -> NDArray[np.float64]:
    """Points of the prompt in pixels at the working size."""
    scale = np.array([shape[1] / size[1], shape[0] / size[0]])
    return prompt.points.double().cpu().numpy() * scale


def _parts_meant(cut: NDArray[np.bool_], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Connected parts that hold a positive point; without points, all but small ones."""
    import cv2

    _, parts = cv2.connectedComponents(cut.astype(np.uint8), connectivity=8)
    areas = np.bincount(parts.reshape(-1))
    areas[0] = 0
    if len(points):
        rows = np.minimum(points[:, 1].astype(int), cut.shape[0] - 1)
        columns = np.minimum(points[:, 0].astype(int), cut.shape[1] - 1)
        keep = np.setdiff1d(np.unique(parts[rows, columns]), 0)
    else:
        keep = np.flatnonzero(areas >= max(1, 0.1 * areas.max()))
    return np.isin(parts, keep)
