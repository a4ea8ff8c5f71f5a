"""Run lengths of boxes and outlines, against the plain way over all pixels."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatseg.core import Rle
from splatseg.errors import FileFormatError
from splatseg.io.annotations._regions import Canvas, Region, merged

HEIGHT, WIDTH = 7, 9
CANVAS = Canvas(height=HEIGHT, width=WIDTH, where="file", packed=1000)


def inside(corners: np.ndarray, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """Pixels from whose centres a ray to the left crosses an odd number of edges."""
    found = np.zeros((height, width), bool)
    for row in range(height):
        for column in range(width):
            x, y = column + 0.5, row + 0.5
            for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                if (y0 <= y < y1) or (y1 <= y < y0):
                    found[row, column] ^= x0 + (y - y0) * (x1 - x0) / (y1 - y0) <= x
    return found


@given(seed=st.integers(0, 2**32 - 1))
def test_a_box_is_the_mask_with_nothing_around_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(1, HEIGHT + 1), rng.integers(1, WIDTH + 1)
    top, left = rng.integers(0, HEIGHT - rows + 1), rng.integers(0, WIDTH - columns + 1)
    box = rng.random((rows, columns)) < rng.choice([0.0, 0.3, 0.9, 1.0])
    whole = np.zeros((HEIGHT, WIDTH), bool)
    whole[top : top + rows, left : left + columns] = box
    found = CANVAS.boxed(box, int(left), int(top))
    assert found.counts.tolist() == Rle.encode(torch.from_numpy(whole)).counts.tolist()


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(3, 8))
def test_an_outline_holds_the_centres_that_lie_in_it(seed: int, count: int) -> None:
    """Outlines that cross themselves and leave the picture, on grid lines and off them."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-4, 13, (count, 2))
    if seed % 2:
        corners = np.round(corners * 2) / 2
    found = CANVAS.outlined([corners]).decode().numpy()
    assert np.array_equal(found, inside(corners))


def test_several_outlines_are_one_mask() -> None:
    """They add up where they overlap, unlike the parts of one outline."""
    one = np.array([[0, 0], [5, 0], [5, 4], [0, 4]], float)
    other = one + np.array([3, 2])
    found = CANVAS.outlined([one, other]).decode().numpy()
    assert np.array_equal(found, inside(one) | inside(other))
    assert CANVAS.outlined([]).area == 0
    assert CANVAS.outlined([one + 100]).area == 0
    assert CANVAS.outlined([one * 1e29 - 5e28]).area == HEIGHT * WIDTH


def test_centres_on_an_edge_belong_to_what_lies_below_and_to_its_right() -> None:
    """So that areas side by side share no pixel and leave none."""
    upper, lower = (
        np.array([[1.5, top], [5.5, top], [5.5, top + 2], [1.5, top + 2]]) for top in (0.5, 2.5)
    )
    found = [CANVAS.outlined([corners]).decode().numpy() for corners in (upper, lower)]
    wanted = np.zeros((2, HEIGHT, WIDTH), bool)
    wanted[0, 0:2, 1:5] = wanted[1, 2:4, 1:5] = True
    assert np.array_equal(found, wanted)


def test_a_box_must_lie_in_the_picture() -> None:
    for left, top in ((-1, 0), (0, -1), (WIDTH - 1, 0), (0, HEIGHT - 1)):
        with pytest.raises(FileFormatError, match="file: expected masks within 9x7 pixels"):
            CANVAS.boxed(np.ones((2, 2), bool), left, top)


def test_areas_of_a_group_are_one_and_the_order_is_that_of_layers() -> None:
    def area(left: int, **more: object) -> Region:
        return Region(mask=CANVAS.boxed(np.ones((2, 2), bool), left, 0), **more)

    found = merged(
        [
            area(0, group="a", score=0.2, order=2, category=1),
            area(4, order=1, category=2),
            area(2, group="a", score=0.7, category=1),
            area(6, order=1, category=3),
        ]
    )
    assert [region.category for region in found] == [2, 3, 1]
    assert found[2].mask.bbox == (0, 0, 4, 2)
    assert found[2].score == pytest.approx(0.7)
    assert found[2].order == 2
