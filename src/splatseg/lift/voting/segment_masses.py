"""The pixels of a view divided into pieces that lie in the same segments.

Masks that are nested or overlap share most of their pixels. What is summed over pixels is summed
over every piece once, and a segment is the sum of its pieces: the pixels are read once, however
many segments they lie in.

Where many large masks lie over each other, pieces go with the square of the masks until each pixel
is one, and each lies in many masks: what is saved is lost again. Masks are taken in runs that cover
the image some times over, each with pieces of its own, so that the work goes with the masks.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg import _native
from splatseg.core import UNLABELLED, Camera, Gaussians, LabelMap, MaskSet
from splatseg.errors import ShapeError
from splatseg.render import SparseWeights, prepare, weights
from splatseg.render.warp import undistorted_camera, warp_into_photograph

_LAYERS = 12
"""Masks that lie over a pixel of the image, on average, from which on a run of masks ends. Of 64 to
128 discs of a fifth of an image each the pieces cost least a mask."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pieces:
    """A partition of the pixels, and which segments each piece lies in."""

    segment_ids: NDArray[np.int64]
    """(segments,): id of a label map, or index of a mask in its set."""

    piece: NDArray[np.int32]
    """(pixels,): the piece of each pixel, row by row; pixels in no segment have one too."""

    weight: NDArray[np.float32] | None
    """(pixels,): what each pixel counts, or None where all count 1."""

    segments: Any
    """Sparse (segments, pieces): 1 where a piece lies in a segment."""

    @property
    def covered(self) -> NDArray[np.bool_]:
        """(pieces,): whether a piece lies in some segment."""
        return np.bincount(self.segments.indices, minlength=self.segments.shape[1]) > 0


def pieces_of(segments: LabelMap | MaskSet) -> tuple[Pieces, ...]:
    """The pieces of a label map, which are its segments, or of each run of masks."""
    import scipy.sparse

    if isinstance(segments, MaskSet):
        return tuple(_mask_pieces(segments, run) for run in _runs(segments))
    ids = segments.ids.cpu().reshape(-1).numpy()
    ids_found, piece = np.unique(ids, return_inverse=True)
    confidence = segments.confidence
    identity: Any = scipy.sparse.identity(len(ids_found), "f4", format="csr")
    known = np.flatnonzero(ids_found != UNLABELLED)
    pieces = Pieces(
        segment_ids=ids_found[known].astype(np.int64),
        piece=piece.reshape(-1).astype(np.int32),
        weight=None if confidence is None else confidence.cpu().float().reshape(-1).numpy(),
        segments=identity[known],
    )
    return (pieces,)


def covered_pieces(runs: Sequence[Pieces]) -> Pieces:
    """What lies in no segment of some runs, piece 0, and what lies in any, piece 1."""
    import scipy.sparse

    inside = np.zeros(len(runs[0].piece), bool)
    for pieces in runs:
        inside |= pieces.covered[pieces.piece]
    union: Any = scipy.sparse.csr_matrix(np.array([[0, 1]], np.float32))
    return Pieces(
        segment_ids=np.zeros(1, np.int64),
        piece=inside.astype(np.int32),
        weight=runs[0].weight,
        segments=union,
    )


def _runs(masks: MaskSet) -> list[range]:
    """Indices of masks that cover the image `_LAYERS` times together; one run at least."""
    areas = np.cumsum([0, *(mask.area for mask in masks.masks)])
    layer = areas[:-1] // (_LAYERS * max(1, masks.height * masks.width))
    starts = np.flatnonzero(np.diff(layer, prepend=-1)).tolist() or [0]
    return [range(a, b) for a, b in pairwise([*starts, len(masks)])]


def _mask_pieces(masks: MaskSet, run: range) -> Pieces:
    import scipy.sparse

    pixels = [_pixels_of(masks, i) for i in run]
    piece = refined(pixels, masks.height * masks.width)
    count = int(piece.max(initial=-1)) + 1
    # Any one pixel of a piece shows which masks all of it lies in.
    first = np.zeros(count, np.int64)
    first[piece[::-1]] = np.arange(len(piece))[::-1]
    is_first = np.zeros(len(piece), bool)
    is_first[first] = True
    within = [piece[part[is_first[part]]] for part in pixels]
    indptr = np.cumsum([0, *map(len, within)])
    columns = np.concatenate([np.zeros(0, np.int32), *within])
    membership: Any = scipy.sparse.csr_matrix(
        (np.ones(len(columns), np.float32), columns, indptr), shape=(len(run), count)
    )
    return Pieces(
        segment_ids=np.array(run, np.int64), piece=piece, weight=None, segments=membership
    )


def refined(sets: Sequence[NDArray[np.int64]], count: int) -> NDArray[np.int32]:
    """Numbers of the coarsest partition of `count` items that no set of items divides.

    One set after the other, what it holds of a part becomes a part of its own: each item is
    touched once for each set that it is in.

    Args:
        sets: The items of each set, each once.
        count: Number of items.
    """
    part = np.zeros(count, np.int32)
    used = 1
    number_of = np.zeros(max(1024, count), np.int32)
    hit = np.zeros(len(number_of), bool)
    for items in sets:
        before = part[items]
        hit[before] = True
        parts = np.flatnonzero(hit[:used])
        hit[parts] = False
        number_of[parts] = np.arange(used, used + len(parts), dtype=np.int32)
        part[items] = number_of[before]
        used += len(parts)
        if used > len(number_of) // 2:
            part, used = _renumbered(part, used)
            if used > len(number_of) // 4:
                number_of = np.zeros(4 * used, np.int32)
                hit = np.zeros(4 * used, bool)
    return _renumbered(part, used)[0]


def _renumbered(part: NDArray[np.int32], used: int) -> tuple[NDArray[np.int32], int]:
    """Parts numbered without gaps in the order of their numbers, and how many there are."""
    used_numbers = np.zeros(used, bool)
    used_numbers[part] = True
    rank = np.cumsum(used_numbers, dtype=np.int32) - 1
    return rank[part], int(used_numbers.sum())


def _pixels_of(segments: MaskSet, index: int) -> NDArray[np.int64]:
    """The pixels of a mask counted along the rows; run lengths go down the columns."""
    height, width = segments.height, segments.width
    counts = segments.masks[index].counts
    lengths = counts[1::2].astype(np.int64)
    starts = np.cumsum(counts, dtype=np.int64)[1::2] - lengths
    before = np.cumsum(lengths) - lengths
    down = np.arange(int(lengths.sum())) + np.repeat(starts - before, lengths)
    return down % height * width + down // height


Entries = tuple[NDArray[np.int64], NDArray[np.int32], NDArray[Any]]
"""Where rows begin, with the end of the last one; columns; values."""


def sparse_product(
    left: Any, right: Entries, width: int, *, begin: NDArray[np.int64] | None = None
) -> Any:
    """``left @ right`` as a scipy matrix of float64, columns ascending, without zeros.

    Every sum runs over a row of `left` in its order and in double precision, on any number of
    threads.

    Args:
        left: A scipy matrix of compressed rows of float32, or of float64 where `right` has
            float32.
        right: Rows of float32 or float64, or of the bits of half-precision numbers as uint16.
        width: Columns of `right`.
        begin: Where the wanted entries of each row of `right` begin; None takes all.
    """
    import scipy.sparse

    indptr, columns, values = right
    found = _native.sparse_product(
        left.indptr.astype(np.int64),
        left.indices.astype(np.int32, copy=False),
        left.data,
        indptr[:-1] if begin is None else begin,
        indptr[1:],
        columns,
        values,
        width,
    )
    rows: Any = scipy.sparse.csr_matrix(
        (found[2], found[1], found[0]), shape=(left.shape[0], width), copy=False
    )
    rows.has_sorted_indices = True
    return rows


def entries_of(rows: Any) -> Entries:
    """Where rows of a scipy matrix begin, their columns and values."""
    return rows.indptr.astype(np.int64), rows.indices.astype(np.int32, copy=False), rows.data


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
    gaussians: Gaussians, camera: Camera, segments: LabelMap | MaskSet, *, backend: str = "auto"
) -> ViewMasses:
    r"""Collect every segment of a view on the Gaussians, sparsely and in one pass.

    With the pieces of the image that no segment divides (`pieces_of`) as rows of a sparse
    matrix P over its pixels, and the segments as rows of a sparse 0/1 matrix M over the pieces, all
    masses are

    .. math:: M (P W), \qquad m_{si} = \sum_{p \in s} w_{pi}

    The first product costs the entries of W once, however many segments there are and however many
    of them lie over each other; the second costs the few Gaussians of each piece once for each of
    the segments over it. Weights of pixels are half precision and sums double, so that a sum of
    weights is exact and rounded once: it depends neither on an order nor on how masks overlap.

    The same as `render.back_project` of one mask after the other with the nearest warp, to the
    half precision of stored weights (one part in 2000).

    Args:
        gaussians: The Gaussians of the scene.
        camera: The camera of the segments' pixels (see `camera_of_map` for reduced maps).
        segments: A label map, of which -1 is left out, or masks, which may overlap and be empty.
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
    found, visible = _sums(
        runs if len(runs) == 1 else (*runs, cover), gaussians, camera, backend=backend
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
    runs: Sequence[Pieces], gaussians: Gaussians, camera: Camera, *, backend: str
) -> tuple[list[list[Any]], Tensor | None]:
    """Of each run sparse (pieces, Gaussians) of each band; the visibility where pieces lack it."""
    weight = runs[0].weight
    pinhole = undistorted_camera(camera)
    bands = list(_bands(pinhole.height * pinhole.width))
    if len(bands) == 1 and camera.is_pinhole and weight is None:
        with prepare(gaussians, camera, backend=backend) as view:
            sums = view.part_sums([torch.from_numpy(pieces.piece) for pieces in runs])
        return [[own] for own in sums], None
    pinhole_pixel = None if camera.is_pinhole else _pinhole_pixels(camera)
    found: list[list[Any]] = [[] for _ in runs]
    visible = torch.zeros(len(gaussians))
    for band in bands:
        rows = _rows(gaussians, pinhole, band, backend=backend)
        for pieces, sums in zip(runs, found, strict=True):
            sums.append(_piece_sums(_band_pieces(pieces, band, pinhole_pixel), rows))
        if weight is not None:
            visible += _visible(rows, band, pinhole_pixel)
    return found, None if weight is None else visible


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


def _rows(gaussians: Gaussians, camera: Camera, band: slice, *, backend: str) -> SparseWeights:
    """Rows of W for a run of pixels; the whole image goes by the backend's faster way."""
    pixels = None
    if (band.start, band.stop) != (0, camera.height * camera.width):
        flat = torch.arange(band.start, band.stop)
        pixels = torch.stack((flat % camera.width, flat // camera.width), dim=1)
    return weights(gaussians, camera, pixels, backend=backend)
