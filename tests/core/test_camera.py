"""Cameras: projection by hand, inverses, and undistorted cameras that cover everything."""

import math
from dataclasses import replace

import pytest
import torch

from splatseg.core import Camera
from splatseg.errors import InputError, RangeError

EYE = torch.eye(4, dtype=torch.float64)
OPENCV = (-0.28, 0.09, 0.001, -0.0015, -0.01, 0.02, -0.003, 0.001)
FISHEYE = (-0.03, 0.004, -0.001, 0.0002)
MEI = (2.2, 0.017, 1.65, 0.0004, 0.0002)


def camera(**changes: object) -> Camera:
    values: dict[str, object] = {
        "width": 64, "height": 48, "fx": 50.0, "fy": 52.0, "cx": 31.0, "cy": 25.0,
        "cam_from_world": EYE,
    }  # fmt: skip
    return Camera(**(values | changes))  # pyright: ignore[reportArgumentType]


LENSES = [
    camera(),
    camera(model="opencv", distortion=OPENCV),
    camera(model="opencv", distortion=(0.2,)),
    camera(model="fisheye", distortion=FISHEYE),
    camera(model="fisheye"),
    camera(model="mei", distortion=MEI, fx=150.0, fy=152.0),
    camera(model="mei", distortion=(0.6,)),
]
IDS = ["pinhole", "opencv", "radial", "fisheye", "equidistant", "mei", "sphere"]


def test_projection_by_hand() -> None:
    """x right, y down: (0.2, -0.1, 2) lands right of and above the principal point."""
    pixels, depth = camera().project(torch.tensor([0.2, -0.1, 2.0], dtype=torch.float64))
    assert pixels.tolist() == pytest.approx([31 + 50 * 0.1, 25 - 52 * 0.05])
    assert float(depth) == 2.0


def test_the_first_pixel_has_its_centre_at_a_half() -> None:
    assert camera().pixel_centres()[0, 0].tolist() == [0.5, 0.5]
    assert camera().pixel_centres()[2, 5].tolist() == [5.5, 2.5]


def test_opencv_distortion_by_hand() -> None:
    """One point through the formula of OpenCV's documentation, written out."""
    k1, k2, p1, p2, k3, k4, k5, k6 = OPENCV
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    expected = (
        31 + 50 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)),
        25 + 52 * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y),
    )
    pixels, _ = LENSES[1].project(torch.tensor([x, y, 1.0], dtype=torch.float64))
    assert pixels.tolist() == pytest.approx(expected)


def test_fisheye_distortion_by_hand() -> None:
    x, y = 0.6, 0.8  # r = 1, theta = 45 degrees
    theta = math.pi / 4
    k1, k2, k3, k4 = FISHEYE
    theta_d = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    pixels, _ = LENSES[3].project(torch.tensor([x, y, 1.0], dtype=torch.float64))
    assert pixels.tolist() == pytest.approx([31 + 50 * x * theta_d, 25 + 52 * y * theta_d])


def test_mei_distortion_by_hand() -> None:
    """A point of the sphere, seen from xi behind its centre, by the formula of the paper."""
    xi, k1, k2, p1, p2 = MEI
    x, y, z = 2 / 7, -3 / 7, 6 / 7  # of length 1
    mx, my = x / (z + xi), y / (z + xi)
    r2 = mx * mx + my * my
    radial = 1 + k1 * r2 + k2 * r2**2
    expected = (
        31 + 150 * (mx * radial + 2 * p1 * mx * my + p2 * (r2 + 2 * mx * mx)),
        25 + 152 * (my * radial + p1 * (r2 + 2 * my * my) + 2 * p2 * mx * my),
    )
    pixels, _ = LENSES[5].project(torch.tensor([2.0, -3.0, 6.0], dtype=torch.float64))
    assert pixels.tolist() == pytest.approx(expected)


def test_mei_without_its_mirror_is_opencv() -> None:
    ours = camera(model="mei", distortion=(0.0, *OPENCV[:4]))
    theirs = camera(model="opencv", distortion=OPENCV[:4])
    points = torch.tensor([[0.2, -0.3, 1.0], [-0.1, 0.1, 0.5]], dtype=torch.float64)
    torch.testing.assert_close(ours.project(points)[0], theirs.project(points)[0])


@pytest.mark.parametrize("lens", LENSES, ids=IDS)
def test_unproject_inverts_project(lens: Camera) -> None:
    pixels = lens.pixel_centres()
    depth = torch.linspace(0.5, 9, pixels[..., 0].numel(), dtype=torch.float64).reshape(48, 64)
    back, back_depth = lens.project(lens.unproject(pixels, depth))
    torch.testing.assert_close(back, pixels, atol=1e-7, rtol=0)
    torch.testing.assert_close(back_depth, depth)


@pytest.mark.parametrize("lens", LENSES, ids=IDS)
def test_rays_point_at_what_projects_there(lens: Camera) -> None:
    origin, directions = lens.rays()
    along = origin + 3.7 * directions
    pixels, _ = lens.project(along)
    torch.testing.assert_close(pixels, lens.pixel_centres(), atol=1e-7, rtol=0)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(48, 64).double())


@pytest.mark.parametrize(
    "change",
    [
        {"fx": 51.0},
        {"cy": 24.0},
        {"width": 60},
        {"distortion": (0.2,)},
        {"model": "thin_prism_fisheye"},
    ],
)
def test_rays_of_all_pixels_are_of_this_lens(change: dict[str, object]) -> None:
    """The plane of another lens, which is kept, is not taken for this one's; nor another pose."""
    before = camera(model="opencv", distortion=(0.1,))
    before.rays()
    turned = EYE.clone()
    turned[:3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for pose in (EYE, turned):
        lens = replace(before, cam_from_world=pose, **change)  # pyright: ignore[reportArgumentType]
        assert torch.equal(lens.rays()[1], lens.rays(lens.pixel_centres())[1])


@pytest.mark.parametrize("lens", LENSES, ids=IDS)
def test_the_undistorted_camera_covers_every_pixel(lens: Camera) -> None:
    flat = lens.undistorted()
    assert flat.is_pinhole
    corners = torch.tensor([[0.0, 0], [64, 0], [0, 48], [64, 48]], dtype=torch.float64)
    for pixels in (lens.pixel_centres().reshape(-1, 2), corners):
        points = lens.unproject(pixels, torch.ones(len(pixels), dtype=torch.float64))
        u, v = flat.project(points)[0].unbind(-1)
        assert float(u.min()) >= 0
        assert float(u.max()) <= flat.width
        assert float(v.min()) >= 0
        assert float(v.max()) <= flat.height


def test_a_view_too_wide_for_a_plane_is_refused() -> None:
    with pytest.raises(InputError, match=r"too wide for a plane|narrower than 180 degrees"):
        camera(model="fisheye", fx=20.6, fy=20.6, cx=32.0, cy=24.0).undistorted()
    for focal in (60.0, 80.0):  # past the lens' image, and past 90 degrees
        with pytest.raises(InputError, match=r"too wide for a plane|narrower than 180 degrees"):
            camera(model="mei", distortion=(2.2,), fx=focal, fy=focal).undistorted()


def test_distortion_without_an_inverse_is_refused() -> None:
    with pytest.raises(InputError, match="no inverse"):
        camera(model="opencv", distortion=(-3.0,)).undistorted()


def test_resizing_keeps_rays() -> None:
    lens = LENSES[1]
    half = lens.resized(32, 24)
    pixels = torch.tensor([[10.0, 20.0], [60.0, 3.0]], dtype=torch.float64)
    torch.testing.assert_close(half.rays(pixels / 2)[1], lens.rays(pixels)[1])


def test_world_from_cam_inverts_the_pose() -> None:
    pose = EYE.clone()
    pose[:3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    pose[:3, 3] = torch.tensor([1.0, 2, 3])
    lens = camera(cam_from_world=pose)
    torch.testing.assert_close(lens.world_from_cam @ pose, EYE)
    torch.testing.assert_close(pose[:3, :3] @ lens.centre + pose[:3, 3], torch.zeros(3).double())


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"fx": 0.0}, RangeError, "fx: expected more than 0, got 0"),
        ({"cy": float("nan")}, RangeError, "cy: expected finite numbers"),
        ({"width": 0}, RangeError, "expected at least 1"),
        ({"cam_from_world": 2 * EYE}, RangeError, "expected a rotation"),
        ({"cam_from_world": torch.diag(torch.tensor([-1.0, 1, 1, 1]))}, RangeError, "determinant"),
        ({"cam_from_world": EYE[:3]}, InputError, r"expected shape \(4, 4\), got \(3, 4\)"),
        ({"cam_from_world": EYE * float("nan")}, RangeError, "not finite"),
        ({"model": "cylinder"}, InputError, "expected one of pinhole, opencv, fisheye"),
        ({"distortion": (0.1,)}, InputError, "pinhole takes at most 0 values"),
        ({"model": "opencv", "distortion": (float("inf"),)}, RangeError, "finite numbers"),
    ],
)
def test_bad_cameras_are_refused(
    changes: dict[str, object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        camera(**changes)


def test_depth_must_be_positive() -> None:
    with pytest.raises(RangeError, match="positive z-depths"):
        camera().unproject(torch.zeros(2, 2), torch.tensor([1.0, 0.0]))
