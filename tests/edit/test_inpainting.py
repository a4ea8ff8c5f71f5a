"""Patterns go on in holes: against periodic images, all labellings, and the smooth inpainter."""

import itertools

import numpy as np
import pytest
import torch

from splatseg.edit import inpainting as module
from splatseg.edit.inpainting import (
    ExemplarInpainter,
    OpenCvInpainter,
    _border,
    _copied,
    _Copies,
    _light,
    _montage,
    _pairs,
    repeating_offsets,
)


def check(height: int = 90, width: int = 110, side: int = 10, angle: float = 0.0) -> np.ndarray:
    """Squares of two colours, turned by an angle."""
    y, x = np.mgrid[:height, :width]
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    odd = (np.floor(u / side) + np.floor(v / side)) % 2
    return np.stack((60 + 120 * odd, 200 - 90 * odd, 90 + 30 * odd), axis=-1).astype(np.uint8)


def disc(height: int = 90, width: int = 110, radius: int = 24) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return (y - height // 2) ** 2 + (x - width // 2) ** 2 < radius**2


def painted(inpainter, image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """What is missing is poisoned first."""
    given = np.where(mask[..., None], np.uint8(255), image)
    found = inpainter.inpaint(torch.from_numpy(given), torch.from_numpy(mask)).numpy()
    assert found.dtype == np.uint8
    assert np.array_equal(found[~mask], image[~mask])
    return found


def error(found: np.ndarray, image: np.ndarray, mask: np.ndarray) -> float:
    return float(((found.astype(float) - image)[mask] ** 2).mean())


def test_a_check_goes_on_exactly() -> None:
    image, mask = check(), disc()
    assert np.array_equal(painted(ExemplarInpainter(), image, mask), image)


def test_a_turned_check_with_noise_goes_on(rng) -> None:
    image, mask = check(side=13, angle=0.2).astype(float), disc()
    image = (image + rng.normal(0, 4, image.shape)).clip(0, 255).astype(np.uint8)
    found = painted(ExemplarInpainter(), image, mask)
    smooth = painted(OpenCvInpainter(), image, mask)
    assert error(found, image, mask) < 0.1 * error(smooth, image, mask)


def test_what_is_beyond_one_offset_is_painted_in_a_further_pass(monkeypatch) -> None:
    """The hole is three periods wide, and offsets of one period are all there are."""
    image, mask = check(), disc(radius=35)
    monkeypatch.setattr(module, "_MOST_OFFSETS", 4)
    missing = mask.copy()
    assert _copied(np.where(mask[..., None], np.uint8(255), image), missing).any()
    assert np.array_equal(painted(ExemplarInpainter(), image, mask), image)
    monkeypatch.setattr(module, "_PASSES", 1)
    assert not np.array_equal(painted(ExemplarInpainter(), image, mask), image)


def test_where_nothing_repeats_itself_it_is_smooth() -> None:
    # Too small an image for any offset of 16 pixels with enough on both sides.
    image, mask = check(14, 14, side=3), disc(14, 14, radius=4)
    assert len(repeating_offsets(image / 255, mask)[0]) == 0
    found = painted(ExemplarInpainter(), image, mask)
    assert np.array_equal(found, painted(OpenCvInpainter(), image, mask))


def test_nothing_missing_and_everything_missing() -> None:
    image = check()
    none, every = np.zeros((90, 110), bool), np.ones((90, 110), bool)
    assert np.array_equal(painted(ExemplarInpainter(), image, none), image)
    assert painted(ExemplarInpainter(), image, every).shape == image.shape


# Offsets.


def test_offsets_are_those_of_the_pattern_best_first(monkeypatch) -> None:
    image, mask = check(), disc()
    monkeypatch.setattr(module, "_MOST_OFFSETS", 1000)
    offsets, deviations = repeating_offsets(image / 255, mask)
    assert len(offsets)
    assert np.abs(deviations).max() < 1e-6
    # Squares of 10: all that are even in number along both diagonals.
    assert (offsets % 10 == 0).all()
    assert (offsets.sum(axis=1) % 20 == 0).all()
    assert (np.abs(offsets).max(axis=1) >= 16).all()
    assert {(20, 0), (0, -20), (10, 30)} <= set(map(tuple, offsets.tolist()))


@pytest.mark.parametrize("offset", [(16, 0), (0, -17), (-20, 33)])
def test_deviations_are_the_weighted_means_of_the_definition(rng, offset, monkeypatch) -> None:
    image, mask = rng.random((60, 70, 3)), disc(60, 70, radius=9)
    monkeypatch.setattr(module, "_MOST_OFFSETS", 10_000)
    monkeypatch.setattr(module, "_WORST", 1e9)
    monkeypatch.setattr(module, "minimum_filter", lambda values, *_, **__: values)
    offsets, deviations = repeating_offsets(image, mask)
    weights = np.exp(-module._distance_from_holes(mask) / module._REACH)
    total = count = 0.0
    for y, x in itertools.product(range(60), range(70)):
        there = (y + offset[0], x + offset[1])
        if not (0 <= there[0] < 60 and 0 <= there[1] < 70) or mask[y, x] or mask[there]:
            continue
        total += weights[y, x] * ((image[y, x] - image[there]) ** 2).sum()
        count += weights[y, x]
    (row,) = np.flatnonzero((offsets == offset).all(axis=1))
    assert deviations[row] == pytest.approx(np.sqrt(total / count), rel=1e-6)


def test_offsets_may_be_worse_than_the_best_by_a_factor(rng) -> None:
    image, mask = rng.random((60, 70, 3)), disc(60, 70, radius=9)
    _, deviations = repeating_offsets(image, mask)
    assert (np.diff(deviations) >= 0).all()
    assert len(deviations) == module._MOST_OFFSETS
    # Columns that come again after 32: all other offsets are far worse.
    image[:] = 0.1 * image + np.tile(rng.random((32, 3)), (3, 1))[None, :70] * 0.9
    offsets, deviations = repeating_offsets(image, mask)
    assert deviations[-1] <= module._WORST * float(deviations[0])
    assert set(np.abs(offsets[:, 1]).tolist()) <= {0, 32}


def test_only_large_holes_say_where_to_look() -> None:
    mask = disc()
    speckled = mask.copy()
    speckled[3, 3] = True
    assert np.array_equal(module._distance_from_holes(speckled), module._distance_from_holes(mask))
    alone = np.zeros_like(mask)
    alone[3, 3] = True
    assert module._distance_from_holes(alone)[3, 4] == pytest.approx(1, abs=0.1)


def test_offsets_are_of_what_is_around_the_hole() -> None:
    """A check on the left, wide stripes on the right, the hole among the squares."""
    image = check(90, 240)
    image[:, 140:] = np.where(np.arange(100)[None, :, None] // 23 % 2, 220, 30)
    mask = np.zeros((90, 240), bool)
    mask[30:60, 50:80] = True
    offsets, _ = repeating_offsets(image / 255, mask)
    assert (offsets[0] % 10 == 0).all()


def test_light_goes_on_as_it_is_beside_the_hole(monkeypatch) -> None:
    """Half of a check is in the sun, and the hole is in the shade."""
    image = check(90, 160)
    image[:, 80:] //= 2
    mask = np.zeros((90, 160), bool)
    mask[30:60, 88:128] = True
    monkeypatch.setattr(module, "_WORST", 1e9)
    monkeypatch.setattr(module, "_MOST_OFFSETS", 500)
    offsets, _ = repeating_offsets(image / 255, mask)
    assert (offsets[:, 1] < -40).any(), "some copy from the sun"
    assert error(painted(ExemplarInpainter(), image, mask), image, mask) < 60
    light = _light(image / 255, mask)
    assert light[45, 10] == pytest.approx((image[:, :60] / 255).mean(axis=(0, 1)), abs=0.02)
    assert light[45, 108] == pytest.approx((image[:, 90:] / 255).mean(axis=(0, 1)), abs=0.03)
    monkeypatch.setattr(module, "_LIGHT", -0.3)
    assert error(painted(ExemplarInpainter(), image, mask), image, mask) > 600


# The montage.


def test_labels_have_the_least_energy_of_all(rng) -> None:
    """Two labels: one expansion is exact. Three: never worse than any change of one pixel."""
    row, column = np.divmod(np.arange(9), 3)
    first, second = _pairs(row, column, (3, 3))
    assert len(first) == 12
    for labels in (2,) * 20 + (3,):
        copies = _Copies(
            rng.random((labels, 9, 3)).astype(np.float32), rng.random((labels, 9)) < 0.8
        )
        unary = rng.random((labels, 9))

        def energy(of, unary=unary, copies=copies) -> float:
            total = unary[of, np.arange(9)].sum()
            for a, b in zip(first, second, strict=True):
                for end in (a, b):
                    if of[a] == of[b]:
                        continue
                    if copies.known[of[a], end] and copies.known[of[b], end]:
                        one, other = copies.colours[of[a], end], copies.colours[of[b], end]
                        total += np.abs(one - other).sum()
                    else:
                        total += module._UNKNOWN
            return float(total)

        found = energy(_montage(unary, copies, first, second))
        every = (np.array(of) for of in itertools.product(range(labels), repeat=9))
        least = min(map(energy, every))
        assert found == pytest.approx(least, abs=1e-4) if labels == 2 else found < 1.1 * least


def test_a_known_neighbour_counts_as_a_label_of_its_own() -> None:
    """A row of four: the second is missing, its right neighbour is known."""
    image = np.array([[0.1, 0.0, 0.5, 0.9]])[..., None].repeat(3, axis=2)
    missing = np.array([[False, True, False, False]])
    offsets = np.array([[0, 1], [0, -1], [0, 2]])
    row, column = np.array([0]), np.array([1])
    # At the neighbour the copies show 0.9, a missing pixel, and nothing.
    cost = _border(image, missing, offsets, row, column + 1)
    assert cost[:, 0] == pytest.approx([3 * 0.4, module._UNKNOWN, module._UNKNOWN])
    assert (_border(image, missing, offsets, row + 1, column) == 0).all()
    assert (_border(image, ~missing, offsets, row, column + 1) == 0).all()


def test_a_seam_goes_where_two_copies_agree() -> None:
    """A row of five pixels; both copies show the same at the fourth only."""
    colours = np.zeros((2, 5, 3), np.float32)
    colours[1] = 0.5
    colours[1, 3] = 0
    unary = np.array([[0.0, 0, 0, 0, 9], [9, 0, 0, 0, 0]])
    ends = np.arange(4), np.arange(1, 5)
    labels = _montage(unary, _Copies(colours, np.ones((2, 5), bool)), *ends)
    change = int(np.flatnonzero(np.diff(labels))[0])
    assert change in (2, 3)
    assert np.abs(np.diff(labels)).sum() == 1
