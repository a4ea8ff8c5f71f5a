"""Paths are smooth, level, of constant speed, and stay where the cameras were."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from splatseg.core import Camera, View
from splatseg.core.rigid import quaternion_from_rotation
from splatseg.errors import InputError, RangeError
from splatseg.render.paths import Poses, camera_path, is_forward_facing, poses_along_spline

UP = (0.0, 0.0, 1.0)


def looking(eye: Sequence[float], target: Sequence[float], *, roll: float = 0.0, **lens) -> Camera:
    eye_, forward = np.array(eye, float), np.array(target, float) - np.array(eye, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    turned = math.cos(roll) * right + math.sin(roll) * down
    rotation = np.stack((turned, np.cross(forward, turned), forward))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye_
    values = {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "cx": 32.0, "cy": 24.0} | lens
    return Camera(cam_from_world=torch.from_numpy(pose), **values)


def views_of(cameras: Sequence[Camera]) -> list[View]:
    return [View(name=f"v{i}", camera=camera) for i, camera in enumerate(cameras)]


def ring(rng: np.random.Generator, count: int = 50, *, shake: float = 0.03) -> list[View]:
    """Cameras on a circle of radius 2, shaken, looking at the middle."""
    cameras = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        eye = 2 * np.array([math.cos(angle), math.sin(angle), 0.3]) + rng.normal(
            scale=shake, size=3
        )
        cameras.append(looking(eye, rng.normal(scale=0.1, size=3), roll=rng.normal(scale=0.05)))
    return views_of([cameras[i] for i in rng.permutation(count)])


def centres_of(path: Sequence[Camera]) -> torch.Tensor:
    return torch.stack([camera.centre for camera in path])


def test_once_round_a_ring(rng) -> None:
    views = ring(rng)
    assert not is_forward_facing(views)
    path = camera_path(views, frames=120, up=UP)
    centres = centres_of(path)
    steps = (centres - centres.roll(1, 0)).norm(dim=1)
    # The last frame is one step before the first, and no step is longer than another: speed
    # counts turning too, and shaken directions turn unevenly.
    assert float(steps.max() / steps.median()) < 1.25
    assert 2 * math.pi * 1.8 < float(steps.sum()) < 2 * math.pi * 2.15
    around = np.unwrap(np.arctan2(*centres.numpy().T[1::-1]))
    assert abs(abs(around[-1] - around[0]) - 2 * math.pi * 119 / 120) < 0.05
    captured = torch.stack([view.camera.centre for view in views])
    assert float(torch.cdist(centres, captured).amin(dim=1).max()) < 0.25
    for camera in path:
        right, down, forward = camera.cam_from_world[:3, :3]
        assert abs(float(right[2])) < 1e-9, "level"
        assert float(down[2]) < -0.9, "upright"
        inward = -camera.centre / camera.centre.norm()
        assert float(forward @ inward) > math.cos(math.radians(10))
        assert camera.is_pinhole
        assert (camera.width, camera.height, camera.fx, camera.fy) == (64, 48, 60.0, 61.0)


def test_shaking_is_smoothed(rng) -> None:
    """Second differences of the path are far below those of the captured places."""
    count = 60
    eyes = [(0.1 * i, 0.03 * rng.normal(), 1 + 0.03 * rng.normal()) for i in range(count)]
    views = views_of([looking(eye, (eye[0], 10.0, 1.0)) for eye in eyes])
    path = centres_of(camera_path([*views, *_other_way()], frames=count, up=UP))
    line = path[path[:, 1] < 0.5]

    def shake(points: torch.Tensor) -> float:
        return float((points[2:, 2] - 2 * points[1:-1, 2] + points[:-2, 2]).square().mean().sqrt())

    assert shake(line) < 0.35 * shake(torch.tensor(eyes).double())


def _other_way() -> list[View]:
    """Views that look back, so that the capture is not forward-facing."""
    cameras = [looking((0.4 * i, 1.0, 1.0), (0.4 * i, -9.0, 1.0)) for i in range(15)]
    return [View(name=f"back{i}", camera=camera) for i, camera in enumerate(cameras)]


def test_a_drive_is_open_and_begins_and_ends_at_its_ends(rng) -> None:
    eyes = [(0.0, 0.5 * i, 1.2) for i in range(40)]
    views = views_of([looking(eye, (0, eye[1] + 5, 1.2)) for eye in eyes])
    shuffled = [views[i] for i in rng.permutation(40)]
    assert not is_forward_facing(shuffled)
    path = centres_of(camera_path(shuffled, frames=50, up=UP))
    ends = sorted((float(path[0, 1]), float(path[-1, 1])))
    assert ends == pytest.approx([0.0, 19.5], abs=1e-9)
    steps = (path[1:] - path[:-1]).norm(dim=1)
    assert torch.allclose(steps, steps.mean().expand(49), rtol=2e-3)


def test_a_tour_does_not_close_through_what_nobody_saw() -> None:
    """Along a U, whose open side is shorter than the way back: a wall may stand there."""
    eyes = [(0.0, 5 - 0.3 * i, 1.0) for i in range(17)]
    eyes += [(0.3 * i, 0.0, 1.0) for i in range(1, 10)]
    eyes += [(3.0, 0.3 * i, 1.0) for i in range(17)]
    views = views_of([looking(eye, (1.5, 2.5, 1.2)) for eye in eyes])
    centres = centres_of(camera_path(views, frames=100, up=UP))
    apart = torch.cdist(centres, torch.tensor(eyes).double()).amin(dim=1)
    assert float(apart.max()) < 0.6
    assert float((centres[0] - centres[-1]).norm()) > 2.5


def test_a_film_looks_about_less_than_people_do(rng) -> None:
    """Along a line, with a glance to a random side from every place."""
    yaws = rng.uniform(-1.2, 1.2, 40)
    eyes = [(0.3 * i, 0.0, 1.0) for i in range(40)]
    views = views_of(
        [
            looking(eye, (eye[0] + math.sin(yaw), math.cos(yaw), 1.0))
            for eye, yaw in zip(eyes, yaws, strict=True)
        ]
    )
    path = camera_path(views, frames=200, up=UP)
    forward = torch.stack([camera.cam_from_world[2, :3] for camera in path])
    turned = (forward[1:] * forward[:-1]).sum(dim=1).clamp(-1, 1).acos().sum()
    assert float(turned) < 0.2 * float(np.abs(np.diff(yaws)).sum())


def test_the_spline_is_the_uniform_cubic_b_spline(rng) -> None:
    """Against SciPy, through equally dense parameters instead of constant speed."""
    from splatseg.render import paths as _path_spline

    places = torch.from_numpy(rng.normal(size=(9, 3)))
    flat = Poses(centres=places, quaternions=torch.eye(4).double()[:1].expand(9, 4))
    at = torch.linspace(0, 6, 31, dtype=torch.float64)
    ours = _path_spline._spline(flat, at).centres
    theirs = BSpline(np.arange(-3, 10), places.numpy(), 3)(at.numpy())
    np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-12)


def test_quaternions_of_either_sign_are_the_same_path(rng) -> None:
    rotations = torch.stack(
        [looking((0, 0, 0), (math.cos(a), math.sin(a), 0)).world_from_cam[:3, :3]
         for a in np.linspace(0, 3, 8)]
    )  # fmt: skip
    centres = torch.from_numpy(rng.normal(size=(8, 3)))
    quaternions = quaternion_from_rotation(rotations)
    signs = torch.tensor([1, -1, -1, 1, -1, 1, 1, -1.0]).double()[:, None]
    for closed in (False, True):
        one, other = (
            poses_along_spline(
                Poses(centres=centres, quaternions=q), frames=20, closed=closed, unit=1.0
            )
            for q in (quaternions, signs * quaternions)
        )
        assert torch.allclose(one.centres, other.centres)
        overlap = (one.quaternions * other.quaternions).sum(dim=1).abs()
        assert torch.allclose(overlap, torch.ones(20).double())


def test_a_closed_path_over_a_square_is_the_same_after_a_quarter_turn() -> None:
    corners = torch.tensor([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]).double()
    one_way = torch.eye(4).double()[:1].expand(4, 4)
    keys = Poses(centres=corners, quaternions=one_way)
    path = poses_along_spline(keys, frames=12, closed=True, unit=1.0).centres
    quarter = torch.stack((-path[:, 1], path[:, 0], path[:, 2]), dim=1)
    assert torch.allclose(path.roll(-3, 0), quarter, atol=1e-6)


@pytest.mark.parametrize("focus", [None, 4.0])
def test_an_ellipse_before_a_forward_facing_capture(rng, focus) -> None:
    eyes = np.stack(
        (rng.uniform(-1, 1, 200), rng.normal(scale=0.05, size=200), rng.uniform(-0.5, 0.5, 200)), 1
    )
    views = views_of([looking(eye, eye + np.array([0.0, 9.0, 0.0])) for eye in eyes])
    assert is_forward_facing(views)
    path = camera_path(views, frames=40, up=UP, focus=focus)
    centres = centres_of(path)
    middle = torch.tensor([0.0, float(np.quantile(eyes[:, 1], [0.05, 0.95]).mean()), 0.0]).double()
    across, along, high = (centres - centres.mean(dim=0)).abs().amax(dim=0).tolist()
    assert across == pytest.approx(0.72, abs=0.05), "of an even spread of 1"
    assert high == pytest.approx(0.36, abs=0.03)
    assert along < 1e-9, "it stays beside the captured places"
    target = middle + torch.tensor([0, focus or 0, 0.0]).double()
    for camera in path:
        assert abs(float(camera.cam_from_world[0, 2])) < 1e-9
        if focus is None:
            assert torch.allclose(camera.cam_from_world[2, :3], torch.tensor([0, 1.0, 0]).double())
        else:
            pixel, depth = camera.project(target)
            assert (pixel - torch.tensor([32.0, 24.0])).abs().max() < 2.5
            assert 3.5 < float(depth) < 4.5


def test_up_is_the_images_own_unless_it_is_said(rng) -> None:
    views = ring(rng)
    for camera in camera_path(views, frames=12):
        assert float(camera.cam_from_world[1, 2]) < -0.9
    for camera in camera_path(views, frames=12, up=(0, 0, -3.0)):
        assert float(camera.cam_from_world[1, 2]) > 0.9, "up decides, not the photographs"


def test_a_steep_view_keeps_its_own_roll() -> None:
    """Looking straight down has no horizon: no frame may spin round."""
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    cameras = []
    for i in range(12):
        pose = down.copy()
        pose[:3, 3] = -pose[:3, :3] @ np.array([0.3 * i, 0.01 * (i % 2), 2.0])
        cameras.append(Camera(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0,
                              cam_from_world=torch.from_numpy(pose)))  # fmt: skip
    path = camera_path(views_of(cameras), frames=20, up=UP)
    for camera in path:
        assert torch.allclose(
            camera.cam_from_world[:3, :3], torch.from_numpy(down[:3, :3]), atol=1e-6
        )


def test_half_way_to_steep_half_the_roll_is_kept() -> None:
    """The sine to up is 0.3, in the middle of 0.15 and 0.45: up bisects level and the camera's."""
    eye = np.array([1.0, 2.0, 3.0])
    target = eye + np.array([0.3, 0.0, -math.sqrt(1 - 0.3**2)])
    (found,) = camera_path(views_of([looking(eye, target, roll=0.4)]), frames=1, up=UP)
    expected = looking(eye, target, roll=0.2).cam_from_world
    torch.testing.assert_close(found.cam_from_world, expected, atol=1e-9, rtol=0)


def test_few_views_and_few_frames() -> None:
    one = views_of([looking((0, 0, 1), (1, 1, 1))])
    for path in (camera_path(one, frames=5), camera_path(one * 3, frames=5, up=UP)):
        for camera in path:
            assert torch.allclose(camera.cam_from_world, one[0].camera.cam_from_world, atol=1e-6)
    two = views_of([looking((0, 0, 1), (0, 5, 1)), looking((1, 0, 1), (9, 0, 1))])
    path = camera_path(two, frames=3, up=UP)
    assert torch.allclose(path[0].centre, two[0].camera.centre)
    assert torch.allclose(path[-1].centre, two[1].camera.centre)
    turned = path[1].cam_from_world[2, :3]
    assert torch.allclose(turned, torch.tensor([0.5**0.5, 0.5**0.5, 0]).double(), atol=1e-6)
    assert len(camera_path(two, frames=1)) == 1


def test_the_most_common_size_and_no_lens(rng) -> None:
    views = [view.camera for view in ring(rng, 6)]
    other = [looking((3, i, 1), (0, 0, 1), width=32, height=24, fx=200.0 + i) for i in range(3)]
    bent = [
        looking((-3, i, 1), (0, 0, 1), fx=50.0 + i, model="opencv", distortion=(0.1,))
        for i in range(3)
    ]
    camera = camera_path(views_of([*other, *bent, *views]), frames=2)[0]
    assert (camera.width, camera.fx, camera.model) == (64, 60.0, "pinhole")


def test_refusals() -> None:
    one = views_of([looking((0, 0, 1), (1, 1, 1))])
    with pytest.raises(InputError, match="at least one view"):
        camera_path([])
    with pytest.raises(RangeError, match="frames"):
        camera_path(one, frames=0)
    with pytest.raises(RangeError, match="focus"):
        camera_path(one, focus=-1.0)
    with pytest.raises(RangeError, match="up"):
        camera_path(one, up=(0, 0, 0))
