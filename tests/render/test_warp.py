"""The warp between distorted photographs and pinhole images."""

import numpy as np
import pytest
import torch

from splatseg.core import Camera
from splatseg.errors import InputError, ShapeError
from splatseg.render.warp import (
    Warp,
    photograph_to_pinhole,
    undistorted_camera,
    warp_into_photograph,
)

BARREL = ("opencv", (-0.2, 0.05, 1e-3, -2e-3))
PINCUSHION = ("opencv", (0.15,))
FISHEYE = ("fisheye", (0.02, -0.01))


def camera_of(model="pinhole", distortion=(), *, width=40, height=30, **changes) -> Camera:
    values = {"fx": 30.0, "fy": 31.0, "cx": 19.0, "cy": 15.5} | changes
    return Camera(
        width=width,
        height=height,
        cam_from_world=torch.eye(4, dtype=torch.float64),
        model=model,
        distortion=distortion,
        **values,
    )


def dense_of(warp: Warp) -> torch.Tensor:
    """The matrix, column by column, from `apply` alone."""
    rows, columns = warp.source_shape
    basis = torch.eye(rows * columns).reshape(rows, columns, -1)
    return warp.apply(basis).flatten(0, 1)


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION, FISHEYE])
@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
@pytest.mark.parametrize("channels", [1, 3, 17])
def test_adjoint_is_the_transpose(rng, lens, mode, channels) -> None:
    camera = camera_of(*lens)
    warp = Warp.between(camera, camera.undistorted(), mode)
    source = torch.from_numpy(rng.normal(size=(*warp.source_shape, channels)))
    target = torch.from_numpy(rng.normal(size=(*warp.target_shape, channels)))
    left = float((warp.apply(source) * target).sum())
    right = float((source * warp.adjoint(target)).sum())
    assert left == pytest.approx(right, rel=1e-12, abs=1e-9)


def test_adjoint_is_the_transpose_entry_by_entry() -> None:
    camera = camera_of(*BARREL, width=9, height=7, fx=7.0, fy=7.0, cx=4.5, cy=3.5)
    warp = Warp.between(camera, camera.undistorted())
    rows, columns = warp.target_shape
    basis = torch.eye(rows * columns).reshape(rows, columns, -1)
    assert torch.equal(warp.adjoint(basis).flatten(0, 1), dense_of(warp).T)


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION, FISHEYE])
def test_every_pixel_of_the_photograph_is_found(lens) -> None:
    camera = camera_of(*lens)
    for mode in ("bilinear", "nearest"):
        warp = Warp.between(camera, camera.undistorted(), mode)
        assert bool(warp.valid.all())
        torch.testing.assert_close(dense_of(warp).sum(dim=1), torch.ones(30 * 40))


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION, FISHEYE])
def test_bilinear_reads_where_the_ray_meets_the_pinhole_image(lens) -> None:
    """Bilinear resampling is exact on the coordinates themselves."""
    camera = camera_of(*lens)
    pinhole = camera.undistorted()
    points = torch.cat((camera.rays()[1], torch.ones(30, 40, 1, dtype=torch.float64)), dim=-1)[
        ..., :3
    ]
    expected, _ = pinhole.project(points)
    read = Warp.between(camera, pinhole).apply(pinhole.pixel_centres())
    torch.testing.assert_close(read, expected, rtol=0, atol=2e-5)
    nearest = Warp.between(camera, pinhole, "nearest").apply(pinhole.pixel_centres())
    assert torch.equal(nearest, torch.floor(expected) + 0.5)


def test_identity_for_a_pinhole_camera(rng) -> None:
    camera = camera_of()
    image = torch.from_numpy(rng.random((30, 40, 2)))
    for mode in ("bilinear", "nearest"):
        same = Warp.between(camera, camera, mode).apply(image)
        torch.testing.assert_close(same, image, rtol=0, atol=1e-12)
    straight, mask = photograph_to_pinhole(image, camera)
    assert torch.equal(straight, image)
    assert bool(mask.all())


def test_half_a_pixel_of_shift_by_hand() -> None:
    """A principal point moved by half a pixel averages neighbours; borders are continued."""
    source = camera_of(width=3, height=1, fx=1.0, fy=1.0, cx=1.5, cy=0.5)
    target = camera_of(width=3, height=1, fx=1.0, fy=1.0, cx=1.0, cy=0.5)
    image = torch.tensor([[[1.0], [3.0], [7.0]]])
    warp = Warp.between(target, source)
    assert warp.apply(image).flatten().tolist() == [2.0, 5.0, 7.0]
    assert warp.valid.tolist() == [[True, True, True]]
    assert warp.adjoint(torch.ones(1, 3, 1)).flatten().tolist() == [0.5, 1.0, 1.5]


def test_pixels_without_a_counterpart_are_empty() -> None:
    source = camera_of(width=3, height=1, fx=1.0, fy=1.0, cx=1.5, cy=0.5)
    target = camera_of(width=3, height=1, fx=1.0, fy=1.0, cx=0.0, cy=0.5)
    warp = Warp.between(target, source)
    assert warp.valid.tolist() == [[True, True, False]]
    assert warp.apply(torch.ones(1, 3, 1)).flatten().tolist() == [1.0, 1.0, 0.0]
    pixels = torch.tensor([[0, 0], [1, 0], [2, 0]])
    at, found = warp.nearest_sources(pixels)
    assert found.tolist() == [True, True, False]
    assert at[found].tolist() in ([[1, 0], [2, 0]], [[2, 0], [2, 0]])


def test_nearest_sources_agree_with_apply() -> None:
    camera = camera_of(*BARREL)
    pinhole = camera.undistorted()
    warp = Warp.between(camera, pinhole, "nearest")
    pixels = torch.tensor([[0, 0], [39, 29], [20, 3], [7, 28]])
    at, found = warp.nearest_sources(pixels)
    assert bool(found.all())
    shown = warp.apply(pinhole.pixel_centres())[pixels[:, 1], pixels[:, 0]]
    assert torch.equal(at + 0.5, shown)


def test_gradients_are_the_adjoint(rng) -> None:
    camera = camera_of(*PINCUSHION, width=8, height=6, cx=4.0, cy=3.0)
    warp = Warp.between(camera, camera.undistorted())
    image = torch.from_numpy(rng.normal(size=(*warp.source_shape, 2))).requires_grad_()
    assert torch.autograd.gradcheck(warp.apply, (image,))
    target = torch.from_numpy(rng.normal(size=(6, 8, 2))).requires_grad_()
    assert torch.autograd.gradcheck(warp.adjoint, (target,))


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION, FISHEYE])
def test_a_smooth_photograph_survives_there_and_back(lens) -> None:
    camera = camera_of(*lens)
    centres = camera.pixel_centres()
    image = torch.stack((torch.sin(centres[..., 0] / 9), torch.cos(centres[..., 1] / 7)), -1)
    straight, mask = photograph_to_pinhole(image, camera)
    assert straight.shape[:2] == mask.shape
    assert 0.5 < float(mask.double().mean()) < 1
    assert bool((straight[~mask] == 0).all())
    again = warp_into_photograph(camera).apply(straight)
    torch.testing.assert_close(again[3:-3, 3:-3], image[3:-3, 3:-3], rtol=0, atol=0.01)


def test_a_folded_lens_shows_no_ghosts() -> None:
    """Beyond the fold of a strong barrel, plane points fall back into the photograph."""
    camera = camera_of("opencv", (-0.25,), width=40, height=30, fx=36.0, fy=36.0, cx=20, cy=15)
    wide = camera_of(width=400, height=300, fx=36.0, fy=36.0, cx=200, cy=150)
    warp = Warp.between(wide, camera)
    rows, columns = np.nonzero(warp.valid.numpy())
    # One filled region around the centre, not the whole plane.
    assert columns.min() > 150
    assert columns.max() < 250
    assert rows.min() > 110
    assert rows.max() < 190


@pytest.mark.bits
def test_float32_and_threads_give_the_same_bits(rng) -> None:
    camera = camera_of(*BARREL, width=120, height=90, fx=90.0, fy=90.0, cx=60.0, cy=45.0)
    warp = Warp.between(camera, camera.undistorted())
    image = torch.from_numpy(rng.random((90, 120, 5), dtype=np.float32))
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = warp.adjoint(image)
        torch.set_num_threads(2)
        two = warp.adjoint(image)
    finally:
        torch.set_num_threads(before)
    assert one.dtype == torch.float32
    assert torch.equal(one, two)


def test_cached_by_lens_and_not_by_pose() -> None:
    camera = camera_of(*BARREL)
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = 2.0
    moved = Camera(
        width=40, height=30, fx=30.0, fy=31.0, cx=19.0, cy=15.5, cam_from_world=pose,
        model=camera.model, distortion=camera.distortion,
    )  # fmt: skip
    assert warp_into_photograph(camera) is warp_into_photograph(moved)
    assert torch.equal(undistorted_camera(moved).cam_from_world, pose)
    assert undistorted_camera(moved).is_pinhole


def test_bad_input_is_refused() -> None:
    camera = camera_of(*BARREL)
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 1.0
    elsewhere = Camera(width=40, height=30, fx=30.0, fy=31.0, cx=19.0, cy=15.5, cam_from_world=pose)
    with pytest.raises(InputError, match="same pose"):
        Warp.between(camera, elsewhere)
    with pytest.raises(InputError, match="bilinear, nearest"):
        Warp.between(camera, camera.undistorted(), "cubic")  # type: ignore[arg-type]
    warp = Warp.between(camera, camera.undistorted())
    with pytest.raises(ShapeError, match="image"):
        warp.apply(torch.zeros(3, 3, 1))
    with pytest.raises(ShapeError, match="image"):
        warp.adjoint(torch.zeros(3, 3, 1))


def test_no_channels_and_no_overlap() -> None:
    camera = camera_of(*BARREL)
    warp = Warp.between(camera, camera.undistorted())
    assert warp.apply(torch.zeros(*warp.source_shape, 0)).shape == (30, 40, 0)
    away = camera_of(cx=-500.0)
    nothing = Warp.between(away, camera_of())
    assert not bool(nothing.valid.any())
    assert float(nothing.apply(torch.ones(30, 40, 2)).abs().max()) == 0
    _, found = nothing.nearest_sources(torch.tensor([[0, 0]]))
    assert found.tolist() == [False]
