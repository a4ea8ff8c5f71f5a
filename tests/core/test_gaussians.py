"""Gaussians: aligned columns that stay together, values checked where they matter."""

import math

import numpy as np
import pytest
import torch

from splatseg.core import Camera, Gaussians, Similarity
from splatseg.core.gaussians import exponential, sigmoid
from splatseg.core.rigid import normalised, rotation_from_quaternion
from splatseg.errors import InputError, RangeError, ShapeError


def make(n: int, *, degree: int = 1, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=g),
        rotations=normalised(torch.randn(n, 4, generator=g)),
        scales=torch.rand(n, 3, generator=g) + 0.1,
        opacities=torch.rand(n, generator=g),
        sh=torch.randn(n, (degree + 1) ** 2, 3, generator=g),
        extra={"class_id": torch.arange(n, dtype=torch.int32), "pair": torch.rand(n, 2)},
    )


def columns(g: Gaussians) -> list[torch.Tensor]:
    return [g.means, g.rotations, g.scales, g.opacities, g.sh, *g.extra.values()]


@pytest.mark.parametrize(
    "index",
    [slice(1, 6, 2), torch.tensor([5, 0, 0]), torch.arange(7) % 2 == 0],
    ids=["slice", "ids", "mask"],
)
def test_slicing_takes_the_same_rows_of_every_column(index: slice | torch.Tensor) -> None:
    g = make(7)
    rows = torch.arange(7)[index]
    for part, whole in zip(columns(g[index]), columns(g), strict=True):
        assert torch.equal(part, whole[rows])


def test_cutting_and_joining_is_the_identity() -> None:
    g = make(9)
    joined = Gaussians.concatenate([g[:4], g[4:4], g[4:]])
    for a, b in zip(columns(joined), columns(g), strict=True):
        assert torch.equal(a, b)


def test_joining_refuses_other_columns_and_harmonics() -> None:
    with pytest.raises(InputError, match=r"parts\[1\]: expected the extra columns"):
        Gaussians.concatenate([make(2), make(2).replace(extra={})])
    with pytest.raises(ShapeError, match="degree 1, got 2"):
        Gaussians.concatenate([make(2), make(2, degree=2)])
    with pytest.raises(InputError, match="at least one"):
        Gaussians.concatenate([])


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("means", torch.zeros(3, 2), r"means: expected shape \(any, 3\), got \(3, 2\)"),
        ("rotations", torch.zeros(2, 4), r"rotations: expected shape \(3, 4\)"),
        ("sh", torch.zeros(3, 5, 3), "expected 1, 4, 9 or 16 coefficients"),
        ("extra", {"x": torch.zeros(2)}, r"extra\['x'\]: expected \(3,\) or \(3, c\)"),
    ],
)
def test_a_wrong_shape_is_named(column: str, value: object, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        make(3).replace(**{column: value})


@pytest.mark.parametrize(
    ("column", "row", "message"),
    [
        ("means", [0.0, float("nan"), 0.0], r"means: 1 of 9 values are not finite; .* \(1, 1\)"),
        ("scales", [0.1, -0.1, 0.1], r"scales: expected values in \[0, inf\], got -0.1"),
        ("scales", [0.1, float("inf"), 0.1], "scales: 1 of 9 values are not finite"),
        ("rotations", [0.0, 0.0, 0.0, 0.0], "got zero in row 1"),
        ("opacities", 1.5, r"opacities: expected values in \[0, 1\], got 1.5"),
    ],
)
def test_values_are_checked_when_asked(column: str, row: object, message: str) -> None:
    g = make(3)
    poisoned = getattr(g, column).clone()
    poisoned[1] = torch.tensor(row)
    with pytest.raises(RangeError, match=message):
        g.replace(**{column: poisoned}).check_values()


def test_zero_scales_are_allowed() -> None:
    make(3).replace(scales=torch.zeros(3, 3)).check_values()


def test_a_moved_scene_looks_the_same_from_a_moved_camera() -> None:
    """Centres, covariances and colours seen from a camera do not notice a similarity."""
    g = make(20, degree=3).to(dtype=torch.float64)
    turn = rotation_from_quaternion(
        normalised(torch.tensor([0.3, -0.5, 0.7, 0.2], dtype=torch.float64))
    )
    move = Similarity(rotation=turn, translation=torch.tensor([1.0, -2, 3]).double(), scale=2.5)
    camera = Camera(width=64, height=48, fx=50, fy=52, cx=31, cy=25, cam_from_world=torch.eye(4))
    moved, moved_camera = g.transformed(move), camera.moved(move)

    pixels, depth = camera.project(g.means)
    moved_pixels, moved_depth = moved_camera.project(moved.means)
    torch.testing.assert_close(moved_pixels, pixels)
    torch.testing.assert_close(moved_depth, 2.5 * depth)

    def covariance_in_camera(scene: Gaussians, view: Camera) -> torch.Tensor:
        axes = view.cam_from_world[:3, :3] @ rotation_from_quaternion(scene.rotations)
        half = axes * scene.scales[:, None]
        return half @ half.mT

    torch.testing.assert_close(
        covariance_in_camera(moved, moved_camera), 2.5**2 * covariance_in_camera(g, camera)
    )
    from splatseg.core.sh import evaluate_sh

    def colours(scene: Gaussians, view: Camera) -> torch.Tensor:
        return evaluate_sh(
            scene.sh, torch.nn.functional.normalize(scene.means - view.centre, dim=1)
        )

    torch.testing.assert_close(colours(moved, moved_camera), colours(g, camera))


def test_what_they_are_meant_for_goes_with_them() -> None:
    """Every way to make Gaussians of Gaussians keeps `antialiased`; two kinds do not mix."""
    plain = make(4)
    g = plain.replace(antialiased=True)
    assert not plain.antialiased
    turned = Similarity(rotation=torch.eye(3), translation=torch.ones(3), scale=2.0)
    made = [g[1:], g[torch.tensor([2])], g.to(dtype=torch.float64), g.transformed(turned)]
    made += [Gaussians.concatenate([g, g]), g.replace(extra={})]
    assert all(one.antialiased for one in made)
    with pytest.raises(InputError, match=r"parts\[1\]: expected antialiased to be True"):
        Gaussians.concatenate([g, plain])


def test_their_low_pass_goes_with_them() -> None:
    plain = make(4)
    g = plain.replace(low_pass=0.1)
    assert plain.low_pass == 0.3
    turned = Similarity(rotation=torch.eye(3), translation=torch.ones(3), scale=2.0)
    made = [g[1:], g[torch.tensor([2])], g.to(dtype=torch.float64), g.transformed(turned)]
    made += [Gaussians.concatenate([g, g]), g.replace(extra={})]
    assert all(one.low_pass == 0.1 for one in made)
    with pytest.raises(InputError, match=r"parts\[1\]: expected low_pass to be 0.1 as.* got 0.3"):
        Gaussians.concatenate([g, plain])


# Scales and opacities from logs and logits: exact to half a unit, and the same everywhere.


FUNCTIONS = {
    exponential: math.exp,
    sigmoid: lambda x: 1 / (1 + math.exp(-x)),
}


@pytest.mark.parametrize("function", FUNCTIONS)
def test_every_value_is_the_nearest_float(function, rng: np.random.Generator) -> None:
    values = rng.uniform(-30, 30, 2000).astype(np.float32)
    expected = [np.float32(FUNCTIONS[function](float(value))) for value in values]
    found = function(values)
    assert found.dtype == np.float32
    off = np.abs(found.view(np.int32) - np.array(expected, np.float32).view(np.int32))
    assert int(off.max()) <= 1
    assert float((off > 0).mean()) < 1e-3


@pytest.mark.parametrize("function", FUNCTIONS)
def test_a_value_alone_is_a_value_among_others(function, rng: np.random.Generator) -> None:
    """Over the border of a block, from any start, in any shape and order of memory."""
    values = rng.normal(scale=4, size=33_000).astype(np.float32)
    whole = function(values)
    for start in (1, 5, 31, 32_760):
        assert np.array_equal(function(values[start : start + 13]), whole[start : start + 13])
    assert np.array_equal(function(values[::-3]), whole[::-3])
    assert np.array_equal(function(values.reshape(-1, 3)), whole.reshape(-1, 3))
    assert np.array_equal(function(values.reshape(-1, 3).T), whole.reshape(-1, 3).T)
    assert function(values[:0]).shape == (0,)


def test_limits() -> None:
    values = np.array([-np.inf, -110.0, 20.0, np.inf, np.nan, 200.0], np.float32)
    exponentials = [0.0, 0.0, float(np.float32(math.exp(20))), np.inf, np.nan, np.inf]
    assert np.array_equal(exponential(values), np.array(exponentials, np.float32), equal_nan=True)
    assert np.array_equal(
        sigmoid(values), np.array([0, 0, 1, 1, np.nan, 1], np.float32), equal_nan=True
    )
