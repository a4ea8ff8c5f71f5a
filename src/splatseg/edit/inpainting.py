r"""What paints the missing part of an image of a surface: copies of what is around it.

A floor, a carpet and a wall repeat themselves. So `ExemplarInpainter` first asks at which offsets s
the image around a hole is most like itself,

.. math:: D(s) = \frac{\sum_x w(x) k(x) k(x + s) |I(x) - I(x + s)|^2}
                      {\sum_x w(x) k(x) k(x + s)},

with k = 1 where the image I is known and weights w that fall with the distance from the hole: all
offsets by a few Fourier transforms. Every missing pixel then takes one of the best as its label l
and shows :math:`I(x + s_l)`; labels are chosen for the least visible seams,

.. math:: E(l) = \sum_x \lambda \sqrt{D(s_{l(x)})} + \mu |L(x) - L(x + s_{l(x)})| + \sum_{(x, y)}
          |I(x + s_{l(x)}) - I(x + s_{l(y)})| + |I(y + s_{l(x)}) - I(y + s_{l(y)})|,

where L is the mean colour of what is known around a pixel, so that a patch of sun is not copied
into the shade, and a known neighbour counts as a label of its own. The least is looked for by
expansion moves, each an exact minimum cut. What no offset reaches from the border is painted in a
further pass, from what was painted before.

References:
    He and Sun, Statistics of Patch Offsets for Image Completion, ECCV 2012: few dominant offsets,
    and a photomontage with them as labels. Theirs come from matches of patches; on a surface seen
    from straight above, one transform finds those that the whole neighbourhood shares.
    Kwatra et al., Graphcut Textures, SIGGRAPH 2003: the seam's cost, which is a metric.
    Boykov, Veksler and Zabih, Fast Approximate Energy Minimization via Graph Cuts, PAMI 2001.
    Telea, An Image Inpainting Technique Based on the Fast Marching Method, JGT 2004.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
import torch
from jaxtyping import Bool, UInt8
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter, minimum_filter
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.core.models import Inpainting
from splatseg.errors import InputError
from splatseg.lift.minimum_cut import minimum_cut
from splatseg.models import find_model, model_names

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]

EXEMPLAR, OPENCV = "exemplar", "opencv"
"""Names of the inpainters that need no weights."""

_RADIUS = 5.0
"""Pixels around a pixel that Telea's method asks."""

_MOST_OFFSETS, _WORST = 48, 1.8
"""Most offsets that are labels, and how many times the best one's deviation each may have."""

_NEAREST = 16
"""Least length of an offset, the larger of its two coordinates: shorter ones copy what is smooth
along itself, and no pattern."""

_REACH = 12.0
"""Distance from the hole at which weights fall to 1/e, pixels."""

_OVERLAP = 0.25
"""Share of the weight that must be known at both ends of an offset."""

_SPECK = 9
"""Side of a square that must fit into a hole whose surroundings count, pixels: offsets are those
of what is around large holes, where there are any."""

_PREFERENCE = 0.1
"""Weight of an offset's deviation at each pixel, the lambda of the energy."""

_LIGHT = 0.3
"""Weight of the difference between the mean colour around a pixel and around what is copied to it,
sum over three colours: light and shade go on as they are beside the hole."""

_UNKNOWN = 0.3
"""Cost of a seam next to which one of the two copies is unknown, sum over three colours."""

_IMPOSSIBLE = 100.0
"""Cost of a label that shows nothing at a pixel: more than any seams around it."""

_CYCLES, _PASSES = 2, 8
"""Rounds of expansion over all labels, and passes from the border inwards."""


@dataclass(frozen=True, slots=True)
class OpenCvInpainter:
    """OpenCV's inpainting by Telea's fast marching method: no weights, smooth."""

    name: str = OPENCV
    note: str = "smooth: patterns fade in large holes"

    @property
    def settings(self) -> Mapping[str, Any]:
        """Its radius."""
        return {"radius": _RADIUS}

    def inpaint(
        self, image: UInt8[Tensor, "height width 3"], mask: Bool[Tensor, "height width"]
    ) -> UInt8[Tensor, "height width 3"]:
        """The image, painted where the mask is True."""
        return torch.from_numpy(_telea(image.numpy(), mask.numpy()))


@dataclass(frozen=True, slots=True)
class ExemplarInpainter:
    """Copies of the surroundings at the offsets at which they repeat themselves: no weights."""

    name: str = EXEMPLAR
    note: str = "copies of what is around: patterns go on, and nothing new appears"

    @property
    def settings(self) -> Mapping[str, Any]:
        """None that a user may set."""
        return {}

    def inpaint(
        self, image: UInt8[Tensor, "height width 3"], mask: Bool[Tensor, "height width"]
    ) -> UInt8[Tensor, "height width 3"]:
        """The image, painted where the mask is True; smooth where nothing repeats itself."""
        painted = image.numpy().copy()
        missing = mask.numpy().copy()
        for _ in range(_PASSES):
            if not missing.any():
                break
            again = _copied(painted, missing)
            if not (missing & ~again).any():
                break
            missing = again
        if missing.any():
            painted = _telea(painted, missing)
        return torch.from_numpy(painted)


@boundary
def find_inpainter(name: str) -> Inpainting:
    """The inpainter of this name: `EXEMPLAR`, `OPENCV`, or a model of another package.

    Raises:
        InputError: If there is none, or it does not inpaint.
    """
    for own in (ExemplarInpainter(), OpenCvInpainter()):
        if name == own.name:
            return own
    model = find_model(name) if name in model_names() else None
    if not isinstance(model, Inpainting):
        raise InputError(
            f"fill: expected {EXEMPLAR}, {OPENCV} or a model that inpaints, got {name!r}."
        )
    return model


def _telea(image: NDArray[np.uint8], mask: Mask) -> NDArray[np.uint8]:
    painted = cv2.inpaint(image, mask.astype(np.uint8), _RADIUS, cv2.INPAINT_TELEA)
    return np.asarray(painted, dtype=np.uint8)


# Offsets.


def repeating_offsets(image: Array, missing: Mask) -> tuple[Index, Array]:
    """Offsets (n, 2), rows and columns, and their root mean square deviations, best first.

    Args:
        image: (h, w, 3) in [0, 1]; what is missing is not used.
        missing: (h, w).
    """
    height, width = missing.shape
    tall, wide = (int(cast("int", next_fast_len(2 * n, real=True))) for n in (height, width))
    known = (~missing).astype(np.float64)
    weights = known * np.exp(-_distance_from_holes(missing) / _REACH)
    image = image * known[..., None]

    def transformed(values: Array) -> Any:
        return rfft2(values, (tall, wide))

    def correlation(first: Any, second: Any) -> Array:
        """Sums over x of first(x) second(x + s)."""
        return np.asarray(irfft2(np.conj(first) * second, (tall, wide)))

    there, weighted = transformed(known), transformed(weights)
    square = (image**2).sum(axis=-1)
    together = correlation(weighted, there)
    total = correlation(transformed(weights * square), there)
    total += correlation(weighted, transformed(square))
    for channel in range(3):
        plane = image[..., channel]
        total -= 2 * correlation(transformed(weights * plane), transformed(plane))
    enough = together > _OVERLAP * weights.sum()
    deviation = np.where(enough, total / np.where(enough, together, 1.0), np.inf)
    deviation = np.sqrt(np.maximum(deviation, 0))
    # Offsets beyond half the size are negative ones.
    rows, columns = ((np.arange(n) + n // 2) % n - n // 2 for n in (tall, wide))
    far = np.maximum(np.abs(rows)[:, None], np.abs(columns)) >= _NEAREST
    deviation[~far] = np.inf
    least = (deviation == minimum_filter(deviation, 5, mode="wrap")) & np.isfinite(deviation)
    at = np.flatnonzero(least)
    at = at[np.argsort(deviation.flat[at], kind="stable")][:_MOST_OFFSETS]
    found = deviation.flat[at]
    # The images have 8 bits.
    good = found <= _WORST * np.maximum(found[:1], 1 / 255)
    at, found = at[good], found[good]
    row, column = np.divmod(at, wide)
    return np.stack((rows[row], columns[column]), axis=1), found


def _distance_from_holes(missing: Mask) -> Array:
    """Distance of each pixel from the nearest large hole, or from any if none is large."""
    holes = missing.astype(np.uint8)
    large = cv2.morphologyEx(holes, cv2.MORPH_OPEN, np.ones((_SPECK, _SPECK), np.uint8))
    return cv2.distanceTransform(1 - (large if large.any() else holes), cv2.DIST_L2, 5).astype(
        np.float64
    )


# The montage.


@dataclass(frozen=True, slots=True, eq=False)
class _Copies:
    """What each label shows at some pixels."""

    colours: NDArray[np.float32]
    """(labels, n, 3)."""

    known: Mask
    """(labels, n)."""


def _copies(image: Array, missing: Mask, offsets: Index, row: Index, column: Index) -> _Copies:
    height, width = missing.shape
    colours = np.zeros((len(offsets), len(row), 3), np.float32)
    known = np.zeros((len(offsets), len(row)), np.bool_)
    for label, (down, right) in enumerate(offsets):
        y, x = row + down, column + right
        inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        y, x = np.where(inside, y, 0), np.where(inside, x, 0)
        known[label] = inside & ~missing[y, x]
        colours[label] = np.where(known[label][:, None], image[y, x], 0)
    return _Copies(colours, known)


def _copied(painted: NDArray[np.uint8], missing: Mask) -> Mask:
    """Paint what some offset reaches, in place; what is still missing."""
    image = painted / 255.0
    offsets, deviations = repeating_offsets(image, missing)
    row, column = np.nonzero(missing)
    if not len(offsets):
        return missing
    copies = _copies(image, missing, offsets, row, column)
    reached = copies.known.any(axis=0)
    row, column = row[reached], column[reached]
    copies = _Copies(copies.colours[:, reached], copies.known[:, reached])
    light = _light(image, missing)
    lit = _copies(light, missing, offsets, row, column).colours - light[row, column]
    unary = _PREFERENCE * deviations[:, None] + _LIGHT * np.abs(lit).sum(axis=-1)
    unary = np.where(copies.known, unary, _IMPOSSIBLE)
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        unary += _border(image, missing, offsets, row + down, column + right)
    labels = _montage(unary, copies, *_pairs(row, column, missing.shape))
    chosen = copies.colours[labels, np.arange(len(labels))]
    painted[row, column] = (chosen * 255).round().astype(np.uint8)
    rest = missing.copy()
    rest[row, column] = False
    return rest


def _light(image: Array, missing: Mask) -> Array:
    """Mean colour of what is known around each pixel, (h, w, 3), also far inside a hole."""
    known = (~missing).astype(np.float64)
    weights = gaussian_filter(known, _NEAREST, truncate=8)
    found = np.stack(
        [gaussian_filter(image[..., i] * known, _NEAREST, truncate=8) for i in range(3)], axis=-1
    )
    return found / np.maximum(weights, 1e-30)[..., None]


def _border(image: Array, missing: Mask, offsets: Index, row: Index, column: Index) -> Array:
    """Cost (labels, n) of a label against the neighbour at a place, if it is a known one."""
    height, width = missing.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    border = inside & ~missing[row, column]
    cost = np.zeros((len(offsets), len(row)))
    row, column = row[border], column[border]
    copies = _copies(image, missing, offsets, row, column)
    apart = np.abs(copies.colours - image[row, column]).sum(axis=-1)
    cost[:, border] = np.where(copies.known, apart, _UNKNOWN)
    return cost


def _pairs(row: Index, column: Index, shape: tuple[int, int]) -> tuple[Index, Index]:
    """Both ends of all pairs of neighbours among pixels."""
    index = np.full((shape[0] + 1, shape[1] + 1), -1)
    index[row, column] = np.arange(len(row))
    beside = [index[row, column + 1], index[row + 1, column]]
    first = [np.flatnonzero(other >= 0) for other in beside]
    second = [other[other >= 0] for other in beside]
    return np.concatenate(first), np.concatenate(second)


def _montage(unary: Array, copies: _Copies, first: Index, second: Index) -> Index:
    """Labels (n,) of low energy: expansions until none helps, each the best there is."""
    pixels = np.arange(unary.shape[1])

    def seam(one: Index, other: Index) -> Array:
        """Cost of the labels at the first ends with those at the second."""
        cost = np.zeros(len(first))
        for ends in (first, second):
            apart = np.abs(copies.colours[one, ends] - copies.colours[other, ends]).sum(axis=-1)
            cost += np.where(copies.known[one, ends] & copies.known[other, ends], apart, _UNKNOWN)
        return np.where(one == other, 0.0, cost)

    labels = unary.argmin(axis=0)
    both = seam(labels[first], labels[second])
    best = float(unary[labels, pixels].sum() + both.sum())
    for _ in range(_CYCLES):
        before = best
        for label in range(len(unary)):
            new = np.full(len(first), label)
            # With x = 1 for the new label a pair (a, b) costs both + (to_second - both) x_a
            # - to_second x_b + 2 weight (1 - x_a) x_b, where the last product is
            # (|x_a - x_b| + x_b - x_a) / 2.
            to_second, to_first = seam(new, labels[second]), seam(labels[first], new)
            weight = np.maximum(to_first + to_second - both, 0.0) / 2
            gain = unary[labels, pixels] - unary[label]
            gain -= np.bincount(first, to_second - both - weight, len(pixels))
            gain -= np.bincount(second, weight - to_second, len(pixels))
            taken = np.where(minimum_cut(gain, first, second, weight), label, labels)
            after = seam(taken[first], taken[second])
            value = float(unary[taken, pixels].sum() + after.sum())
            if value < best:
                labels, both, best = taken, after, value
        if best == before:
            break
    return labels
