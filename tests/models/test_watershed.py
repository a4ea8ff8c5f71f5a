"""The watershed of `regions` and `classical`: the readable reference beside the kernel."""

from heapq import heapify, heappop, heappush

import numpy as np
import pytest
from numpy.typing import NDArray
from skimage.segmentation import watershed

from splatseg import _native


def flooded(heights: NDArray[np.float32], markers: NDArray[np.int32]) -> NDArray[np.int32]:
    """Meyer's flooding: the lowest shore first, those of one height as the water reached them."""
    basins = markers.copy()
    shores = [(heights[y, x], k, y, x) for k, (y, x) in enumerate(np.argwhere(markers).tolist())]
    arrivals = len(shores)
    heapify(shores)
    while shores:
        _, _, y, x = heappop(shores)
        for v, u in ((y - 1, x), (y, x - 1), (y, x + 1), (y + 1, x)):
            if 0 <= v < heights.shape[0] and 0 <= u < heights.shape[1] and not basins[v, u]:
                basins[v, u] = basins[y, x]
                heappush(shores, (heights[v, u], arrivals, v, u))
                arrivals += 1
    return basins


def native(heights: NDArray[np.float32], markers: NDArray[np.int32]) -> NDArray[np.int32]:
    basins = markers.copy()
    _native.watershed(heights, basins)
    return basins


def test_a_ridge_by_hand() -> None:
    heights = np.array([[0, 2, 5, 1, 0]], np.float32)
    markers = np.array([[1, 0, 0, 0, 2]], np.int32)
    # The ridge is reached from the right first: 1 is flooded before 2.
    assert native(heights, markers).tolist() == [[1, 1, 2, 2, 2]]


def test_a_plateau_is_shared_by_arrival() -> None:
    markers = np.zeros((3, 6), np.int32)
    markers[1, 0], markers[1, 5] = 7, 9
    assert native(np.zeros((3, 6), np.float32), markers).tolist() == [[7, 7, 7, 9, 9, 9]] * 3


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (23, 31)])
@pytest.mark.parametrize("levels", [3, 1 << 20])
def test_the_reference_says_the_same(shape: tuple[int, int], levels: int) -> None:
    rng = np.random.default_rng(shape[0] + levels)
    heights = rng.integers(levels, size=shape).astype(np.float32)
    markers = (np.arange(heights.size, dtype=np.int32) + 1).reshape(shape)
    markers[rng.random(shape) > 0.1] = 0
    assert np.array_equal(native(heights, markers), flooded(heights, markers))


def test_scikit_image_says_the_same_where_heights_differ() -> None:
    rng = np.random.default_rng(5)
    heights = rng.permutation(60 * 80).reshape(60, 80).astype(np.float32)
    markers = np.zeros((60, 80), np.int32)
    markers[5::10, 5::10] = np.arange(48).reshape(6, 8) + 1
    assert np.array_equal(native(heights, markers), watershed(heights, markers))


def test_without_markers_nothing_is_flooded() -> None:
    assert not native(np.ones((4, 5), np.float32), np.zeros((4, 5), np.int32)).any()


def test_wrong_arrays_are_refused() -> None:
    basins = np.zeros((4, 5), np.int32)
    with pytest.raises(ValueError, match="shapes"):
        _native.watershed(np.zeros((5, 4), np.float32), basins)
    with pytest.raises(ValueError, match="heights"):
        _native.watershed(np.full((4, 5), np.nan, np.float32), basins)
