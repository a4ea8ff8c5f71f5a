r"""How much of each Gaussian each segment of a view holds: two sparse products a view.

With the pieces of the image that no segment divides (`lift.mass.pieces`) as rows of a sparse
matrix P over its pixels, and the segments as rows of a sparse 0/1 matrix M over the pieces, all
masses are

.. math:: M (P W), \qquad m_{si} = \sum_{p \in s} w_{pi}

The first product costs the entries of W once, however many segments there are and however many
of them lie over each other; the second costs the few Gaussians of each piece once for each of
the segments over it. Weights of pixels are half precision and sums double, so that a sum of
weights is exact and rounded once: it depends neither on an order nor on how masks overlap.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import Camera, Gaussians, LabelMap, MaskSet
from splatseg.errors import ShapeError
from splatseg.lift.mass.pieces import Pieces, covered_pieces, pieces_of
from splatseg.lift.mass.products import entries_of, sparse_product
from splatseg.render import RenderOptions, SparseWeights, image_weights, options_for, weights
from splatseg.render.warp import undistorted_camera, warp_into_photograph

_BAND = 1 << 19
"""Pixels whose rows of W are held at a time; a pixel of a dense scene has 150 entries of 6 bytes.
Rows of a whole image are made several times faster than those of a part of it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewMasses:
    """The nonzero masses of one view, sorted by segment and then by Gaussian."""

    segment: Int64[Tensor, "m"]
    """Id of a label map, or index of a mask in its set."""

    gaussian: Int64[Tensor, "m"]
    """Row of a Gaussian."""

    weight: Float[Tensor, "m"]
    """Blending weight of the Gaussian summed over the segment's pixels, float32, above 0. One
    fully visible pixel counts 1, or its confidence where the label map has one."""

    visible: Float[Tensor, "n"]
    """Blending weight of every Gaussian summed over all pixels, labelled or not."""

    covered: Float[Tensor, "n"]
    """The same over the pixels that lie in a segment."""


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
    runs = pieces_of(segments)
    # The pieces of a single run say themselves what is covered; of several, those of all together.
    cover = runs[0] if len(runs) == 1 else covered_pieces(runs)
    options = options or options_for(gaussians, backend)
    found, visible = _sums(
        runs if len(runs) == 1 else (*runs, cover),
        gaussians,
        camera,
        options=options,
        backend=backend,
    )
    if visible is None:
        total = np.zeros(len(gaussians))
        for sums in found[-1]:
            total += np.bincount(sums.indices, sums.data, minlength=len(gaussians))
        visible = torch.from_numpy(total.astype(np.float32))
    covered = _covered(cover, found[-1], len(gaussians))
    masses = [_masses(run, sums) for run, sums in zip(runs, found, strict=False)]
    segment, gaussian, weight = (torch.cat(column) for column in zip(*masses, strict=True))
    return ViewMasses(
        segment=segment, gaussian=gaussian, weight=weight, visible=visible, covered=covered
    )


def _masses(pieces: Pieces, sums: list[Any]) -> tuple[Tensor, Tensor, Tensor]:
    """Segments, Gaussians and masses, the sums of pieces being those of each band."""
    import scipy.sparse

    segments = scipy.sparse.hstack([pieces.segments] * len(sums), format="csr", dtype=np.float32)
    piece_masses: Any = scipy.sparse.vstack(sums, format="csr")
    found = sparse_product(segments, entries_of(piece_masses), piece_masses.shape[1])
    return (
        torch.from_numpy(np.repeat(pieces.segment_ids, np.diff(found.indptr))),
        torch.from_numpy(found.indices.astype(np.int64)),
        torch.from_numpy(found.data.astype(np.float32)),
    )


def _covered(pieces: Pieces, sums: Sequence[Any], count: int) -> Float[Tensor, "n"]:
    """What pieces in some segment hold of each Gaussian, each piece once."""
    inside = pieces.covered.astype(np.float64)
    total = np.zeros(count)
    for part in sums:
        total += inside @ part
    return torch.from_numpy(total.astype(np.float32))


def _sums(
    runs: Sequence[Pieces],
    gaussians: Gaussians,
    camera: Camera,
    *,
    options: RenderOptions,
    backend: str,
) -> tuple[list[list[Any]], Tensor | None]:
    """Of each run sparse (pieces, Gaussians) of each band; the visibility where pieces lack it."""
    weight = runs[0].weight
    pinhole = undistorted_camera(camera)
    bands = list(_bands(pinhole.height * pinhole.width))
    if len(bands) == 1 and camera.is_pinhole and weight is None:
        return _image_sums(runs, gaussians, camera, options=options, backend=backend), None
    pinhole_pixel = None if camera.is_pinhole else _pinhole_pixels(camera)
    found: list[list[Any]] = [[] for _ in runs]
    visible = torch.zeros(len(gaussians))
    for band in bands:
        rows = _rows(gaussians, pinhole, band, options=options, backend=backend)
        for pieces, sums in zip(runs, found, strict=True):
            sums.append(_piece_sums(_band_pieces(pieces, band, pinhole_pixel), rows))
        if weight is not None:
            visible += _visible(rows, band, pinhole_pixel)
    return found, None if weight is None else visible


def _image_sums(
    runs: Sequence[Pieces],
    gaussians: Gaussians,
    camera: Camera,
    *,
    options: RenderOptions,
    backend: str,
) -> list[list[Any]]:
    """The sums of a whole image, one band: the faster way, without rows of pixels."""
    import scipy.sparse

    image = image_weights(gaussians, camera, options=options, backend=backend)
    found: list[list[Any]] = []
    for pieces in runs:
        sums = image.part_sums(torch.from_numpy(pieces.piece).to(gaussians.device))
        columns = (sums.sums.cpu().numpy(), sums.ids.cpu().numpy(), sums.indptr.cpu().numpy())
        shape = (pieces.segments.shape[1], len(gaussians))
        found.append([scipy.sparse.csr_matrix(columns, shape=shape)])
    return found


def _band_pieces(pieces: Pieces, band: slice, pinhole_pixel: NDArray[np.int64] | None) -> Any:
    """Sparse (pieces, pixels of the band): what each pixel of W counts for each piece."""
    import scipy.sparse

    if pinhole_pixel is None:
        piece, column = pieces.piece[band], np.arange(band.stop - band.start)
        weight = None if pieces.weight is None else pieces.weight[band]
    else:
        within = (pinhole_pixel >= band.start) & (pinhole_pixel < band.stop)
        piece, column = pieces.piece[within], pinhole_pixel[within] - band.start
        weight = None if pieces.weight is None else pieces.weight[within]
    values = np.ones(len(piece), np.float32) if weight is None else weight
    shape = (pieces.segments.shape[1], band.stop - band.start)
    return scipy.sparse.csr_matrix((values, (piece, column)), shape=shape, dtype=np.float32)


def _piece_sums(pixels: Any, rows: SparseWeights) -> Any:
    """Sparse (pieces, Gaussians): weights summed over the pixels of each piece."""
    weights = rows.weights.cpu()
    values = weights.view(torch.uint16) if weights.dtype == torch.float16 else weights.float()
    entries = rows.indptr.cpu().numpy(), rows.ids.cpu().numpy(), values.numpy()
    return sparse_product(pixels, entries, rows.shape[1])


def _visible(
    rows: SparseWeights, band: slice, pinhole_pixel: NDArray[np.int64] | None
) -> Float[Tensor, "n"]:
    """Weights summed over all pixels of the photograph that fall into the band."""
    count = band.stop - band.start
    if pinhole_pixel is None:
        pixels = torch.ones(count, 1)
    else:
        within = (
            pinhole_pixel[(pinhole_pixel >= band.start) & (pinhole_pixel < band.stop)] - band.start
        )
        pixels = torch.from_numpy(np.bincount(within, minlength=count)).float().unsqueeze(1)
    return rows.adjoint(pixels.to(rows.weights.device))[:, 0].cpu()


def _pinhole_pixels(camera: Camera) -> NDArray[np.int64]:
    """The pinhole pixel that each pixel of the photograph falls into, -1 where none."""
    pixels = camera.pixel_centres().reshape(-1, 2).floor().long()
    source, valid = warp_into_photograph(camera, "nearest").nearest_sources(pixels)
    flat = source[:, 1] * undistorted_camera(camera).width + source[:, 0]
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
