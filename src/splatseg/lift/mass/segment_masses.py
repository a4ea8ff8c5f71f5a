r"""How much of each Gaussian each segment of a view holds: one sparse product a view.

With the masks of a view as rows of a sparse 0/1 matrix M over its pixels, all their masses are

.. math:: M W, \qquad m_{si} = \sum_{p \in s} w_{pi}

whose cost is the entries of W once for each mask over their pixel, whatever the number of masks:
a label map costs the same with three ids and with three thousand. Masks may overlap.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import UNLABELLED, Camera, Gaussians, LabelMap, MaskSet
from splatseg.errors import ShapeError
from splatseg.render import RenderOptions, SparseWeights, options_for, weights
from splatseg.render.warp import straightened, warp_into_photograph

_BAND = 1 << 18
"""Pixels whose rows of W are held at a time; a pixel of a dense scene has 150 entries."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewMasses:
    """The nonzero masses of one view, sorted by segment and then by Gaussian."""

    segment: Int64[Tensor, "m"]
    """Id of a label map, or place of a mask in its set."""

    gaussian: Int64[Tensor, "m"]
    """Row of a Gaussian."""

    weight: Float[Tensor, "m"]
    """Blending weight of the Gaussian summed over the segment's pixels, float32, above 0. One
    fully visible pixel counts 1, or its confidence where the label map has one."""

    visible: Float[Tensor, "n"]
    """Blending weight of every Gaussian summed over all pixels, labelled or not."""


def view_masses(
    gaussians: Gaussians,
    camera: Camera,
    segments: LabelMap | MaskSet,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
) -> ViewMasses:
    """Collect every segment of a view on the Gaussians, sparsely and in one pass.

    The same as `render.back_project` of one mask after the other with the nearest warp, to the
    half precision of stored weights (one part in 2000).

    Args:
        gaussians: The Gaussians of the scene.
        camera: The camera of the segments' pixels (see `camera_of_map` for reduced maps).
        segments: A label map, of which -1 is left out, or masks, which may overlap and be empty.
        options: Switches of the blending model; None is what the Gaussians are meant for.
        backend: Name of the rendering backend.

    Returns:
        The masses. Segments that no Gaussian shows have no rows.

    Raises:
        ShapeError: If the segments do not have the camera's size.
    """
    if (segments.height, segments.width) != (camera.height, camera.width):
        raise ShapeError(
            f"segments: expected {camera.width}x{camera.height} pixels, the camera's, "
            f"got {segments.width}x{segments.height}."
        )
    from scipy import sparse

    names, members, pixels, values = _members(segments)
    pinhole = straightened(camera)
    counts = np.ones(pinhole.height * pinhole.width, np.float32)
    if not camera.is_pinhole:
        seen_at = _pinhole_pixels(camera)
        counts = np.bincount(seen_at[seen_at >= 0], minlength=len(counts)).astype(np.float32)
        there = seen_at[pixels] >= 0
        members, pixels, values = members[there], seen_at[pixels][there], values[there]
    shape = (len(names), len(counts))
    table: Any = sparse.csr_matrix((values, (members, pixels)), shape=shape, dtype=np.float32)
    found: Any = sparse.csr_matrix((len(names), len(gaussians)), dtype=np.float32)
    visible = torch.zeros(len(gaussians))
    options = options or options_for(gaussians, backend)
    for band in _bands(len(counts)):
        rows = _rows(gaussians, pinhole, band, options=options, backend=backend)
        matrix: Any = sparse.csr_matrix(
            (
                rows.weights.cpu().float().numpy(),
                rows.ids.cpu().numpy(),
                rows.indptr.cpu().to(torch.int32).numpy(),
            ),
            shape=rows.shape,
        )
        found = found + table[:, band] @ matrix
        here = torch.from_numpy(counts[band]).unsqueeze(1)
        visible += rows.adjoint(here.to(rows.weights.device))[:, 0].cpu()
    found.eliminate_zeros()
    found.sort_indices()
    per_segment = np.diff(found.indptr)
    return ViewMasses(
        segment=torch.from_numpy(np.repeat(names, per_segment)),
        gaussian=torch.from_numpy(found.indices.astype(np.int64)),
        weight=torch.from_numpy(found.data.astype(np.float32)),
        visible=visible,
    )


def _members(
    segments: LabelMap | MaskSet,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Names of the segments, and for each of their pixels: place of the name, pixel, weight."""
    if isinstance(segments, LabelMap):
        ids = segments.ids.cpu().reshape(-1).numpy()
        names, place = np.unique(ids, return_inverse=True)
        pixels = np.flatnonzero(ids != UNLABELLED)
        confidence = segments.confidence
        values = (
            np.ones(len(pixels), np.float32)
            if confidence is None
            else confidence.cpu().float().reshape(-1).numpy()[pixels]
        )
        return names.astype(np.int64), place.reshape(-1)[pixels].astype(np.int64), pixels, values
    # Run lengths go down the columns; pixels are counted along the rows.
    height, width = segments.height, segments.width
    found = [np.zeros(0, np.int64)]
    for mask in segments.masks:
        ends = np.cumsum(mask.counts, dtype=np.int64)
        lengths = mask.counts[1::2].astype(np.int64)
        starts = ends[1::2] - lengths
        within = np.arange(int(lengths.sum())) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        down = np.repeat(starts, lengths) + within
        found.append(down % height * width + down // height)
    pixels = np.concatenate(found)
    names = np.arange(len(segments), dtype=np.int64)
    members = np.repeat(names, [len(part) for part in found[1:]])
    return names, members, pixels, np.ones(len(pixels), np.float32)


def _pinhole_pixels(camera: Camera) -> NDArray[np.int64]:
    """The pinhole pixel that each pixel of the photograph falls into, -1 where none."""
    pixels = camera.pixel_centres().reshape(-1, 2).floor().long()
    source, valid = warp_into_photograph(camera, "nearest").nearest_sources(pixels)
    flat = source[:, 1] * straightened(camera).width + source[:, 0]
    return torch.where(valid, flat, -1).numpy()


def _bands(pixels: int) -> Iterator[slice]:
    for start in range(0, pixels, _BAND):
        yield slice(start, min(start + _BAND, pixels))


def _rows(
    gaussians: Gaussians, camera: Camera, band: slice, *, options: RenderOptions, backend: str
) -> SparseWeights:
    """Rows of W for a run of pixels; the whole image goes by the backend's faster way."""
    pixels = None
    if (band.start, band.stop) != (0, camera.height * camera.width):
        flat = torch.arange(band.start, band.stop)
        pixels = torch.stack((flat % camera.width, flat // camera.width), dim=1)
    return weights(gaussians, camera, pixels, options=options, backend=backend)
