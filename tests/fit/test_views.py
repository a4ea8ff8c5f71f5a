"""What is learned of each photograph: exposure and pose."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.core import Camera, Similarity
from splatseg.evaluate import evaluate_photographs
from splatseg.fit import FitOptions, _views, fit
from splatseg.fit._views import (
    Exposures,
    PoseRefinement,
    aligning_similarity,
    centres_of,
    exponential,
    pixel_twists,
    twist_gradient,
)
from splatseg.lift import GaussianField


@pytest.fixture(autouse=True)
def fast_exposure(monkeypatch) -> None:
    """A tenth a step, and no prior."""
    monkeypatch.setattr(_views, "_EXPOSURE_RATE", 0.1)
    monkeypatch.setattr(_views, "_EXPOSURE_PRIOR", 0.0)


def _one_step(exposures: Exposures, index: int, gradient: torch.Tensor) -> None:
    """A step along the loss <gradient, image> of an image of 0.5 with an alpha of 0.25."""
    image = torch.full((2, 3, 3), 0.5)
    rendered = exposures.applied(index, image, torch.full((2, 3), 0.25))
    rendered.backward(gradient)
    exposures.update(index, progress=0.0)


def test_nothing_is_changed_at_the_start() -> None:
    image, alpha = torch.rand(4, 5, 3), torch.rand(4, 5)
    assert torch.equal(Exposures(3).applied(1, image, alpha), image)


def test_a_step_by_hand() -> None:
    """Adam's first step is the rate times the sign; what one view gains, all give up a third."""
    exposures = Exposures(3)
    gradient = torch.zeros(2, 3, 3)
    gradient[..., 0], gradient[..., 1] = 1.0, -1.0
    _one_step(exposures, 1, gradient)
    step = 0.1
    log_gains = exposures.gains.log()
    expected = torch.tensor([[step / 3] * 3, [-2 * step / 3] * 3, [step / 3] * 3]).double()
    expected[:, 1] *= -1
    expected[:, 2] = 0
    assert torch.allclose(log_gains, expected, atol=1e-9)
    assert torch.allclose(exposures.biases, 0.1 * expected, atol=1e-9)
    image, alpha = torch.full((1, 1, 3), 0.5), torch.full((1, 1), 0.25)
    shown = exposures.applied(1, image, alpha).detach()
    red = 0.5 * math.exp(-2 * step / 3) - 0.25 * 0.1 * 2 * step / 3
    assert float(shown[0, 0, 0]) == pytest.approx(red, rel=1e-6)
    assert float(shown[0, 0, 2]) == 0.5


def test_gradients_reach_picture_alpha_and_exposure() -> None:
    exposures = Exposures(2)
    _one_step(exposures, 0, torch.rand(2, 3, 3))
    gain, bias = exposures.gains[0], exposures.biases[0]
    image = torch.rand(2, 3, 3, dtype=torch.float64).requires_grad_()
    alpha = torch.rand(2, 3, dtype=torch.float64).requires_grad_()
    gradient = torch.rand(2, 3, 3, dtype=torch.float64)
    exposures.applied(0, image, alpha).backward(gradient)
    assert torch.allclose(image.grad, gradient * gain, rtol=1e-6)
    assert torch.allclose(alpha.grad, (gradient * bias).sum(dim=2))
    found = exposures._leaf.grad
    assert torch.allclose(found[:3], (gradient * image.detach()).sum((0, 1)) * gain)
    assert torch.allclose(found[3:], (gradient * alpha.detach()[..., None]).sum((0, 1)))


def test_a_single_view_has_no_exposure_of_its_own() -> None:
    exposures = Exposures(1)
    _one_step(exposures, 0, torch.ones(2, 3, 3))
    assert torch.equal(exposures.gains, torch.ones(1, 3).double())


def test_the_prior_pulls_back(monkeypatch) -> None:
    """Where the image has no gradient, the exposure decays to the identity."""
    monkeypatch.setattr(_views, "_EXPOSURE_RATE", 0.01)
    monkeypatch.setattr(_views, "_EXPOSURE_PRIOR", 1.0)
    exposures = Exposures(2)
    exposures._values = torch.tensor([[0.2] * 6, [-0.2] * 6]).double()
    for _ in range(30):
        for index in (0, 1):
            _one_step(exposures, index, torch.zeros(2, 3, 3))
    assert float(exposures.gains.log().abs().max()) < 0.05


def test_a_restored_one_goes_on_as_if_nothing_had_been(rng) -> None:
    gradients = [torch.from_numpy(rng.normal(size=(2, 3, 3))).float() for _ in range(6)]
    one, other = Exposures(3), Exposures(3)
    for i, gradient in enumerate(gradients[:3]):
        _one_step(one, i, gradient)
    other.restore({name: tensor.clone() for name, tensor in one.state().items()})
    for i, gradient in enumerate(gradients[3:]):
        _one_step(one, i, gradient)
        _one_step(other, i, gradient)
    assert torch.equal(one.gains, other.gains)
    assert torch.equal(one.biases, other.biases)


def test_unequally_bright_photographs(photograph, monkeypatch) -> None:
    """Every second photograph is half as bright again as the others; test views are in between."""
    monkeypatch.undo()
    gains = [1.25 if i % 2 else 0.8 for i in range(14)]
    capture = photograph(gains=[1.0 if i % 5 == 2 else g for i, g in enumerate(gains)])
    options = FitOptions(minutes=None, steps=700, max_gaussians=200, background="black")
    plain = fit(capture, options=options)
    freed = fit(capture, options=replace(options, exposure=True))
    scores = [
        evaluate_photographs(GaussianField(r.gaussians), capture.test_views).psnr
        for r in (plain, freed)
    ]
    assert scores[1] > scores[0] + 4.0, scores
    assert not any(note.startswith("Exposure") for note in plain.notes)
    (note,) = (note for note in freed.notes if note.startswith("Exposure"))
    least, most = (float(word) for word in note.split()[3:6:2])
    # The geometric mean of the training views' gains counts as 1.
    train = [g for i, g in enumerate(gains) if i % 5 != 2]
    mean = math.exp(sum(math.log(g) for g in train) / len(train))
    assert least == pytest.approx(0.8 / mean, abs=0.05)
    assert most == pytest.approx(1.25 / mean, abs=0.05)


# Pose refinement: the algebra by hand, the gauge, and poses that are found again.


@pytest.fixture(autouse=True)
def fast_poses(monkeypatch) -> None:
    """Half a pixel a step."""
    monkeypatch.setattr(_views, "_POSE_RATE", 0.5)


def _pose(rng: np.random.Generator) -> torch.Tensor:
    return exponential(torch.from_numpy(rng.normal(size=6)))


def _camera(pose: torch.Tensor) -> Camera:
    return Camera(width=64, height=48, fx=50.0, fy=55.0, cx=30.0, cy=25.0, cam_from_world=pose)


def test_the_exponential_by_hand() -> None:
    """A quarter turn about z; a screw moves along its axis by its pitch."""
    motion = exponential(torch.tensor([0, 0, math.pi / 2, 0, 0, 3.0], dtype=torch.float64))
    expected = torch.tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]])
    assert torch.allclose(motion, expected.double(), atol=1e-12)
    assert torch.equal(exponential(torch.zeros(6).double()), torch.eye(4).double())


def test_the_twist_gradient_is_the_slope_along_the_motion(rng: np.random.Generator) -> None:
    pose, weights = _pose(rng), torch.from_numpy(rng.normal(size=(4, 4)))
    weights[3] = 0
    found = twist_gradient(weights, pose)
    h = 1e-6
    for axis in range(6):
        twist = torch.zeros(6).double()
        twist[axis] = h
        up, down = ((weights * (exponential(s * twist) @ pose)).sum() for s in (1, -1))
        assert float(found[axis]) == pytest.approx(float(up - down) / (2 * h), abs=1e-8)


def test_pixel_twists_move_the_points_by_a_pixel(rng: np.random.Generator) -> None:
    """Where nothing bounds them: the motions are as many pixels long, and do not mix."""
    camera = _camera(torch.eye(4))
    pixels = torch.from_numpy(rng.uniform(1, 47, (300, 2)))
    points = camera.unproject(pixels, torch.from_numpy(rng.uniform(1.0, 9.0, 300)))
    twists = pixel_twists(camera, points)
    h = 1e-5

    def moved(twist: torch.Tensor) -> torch.Tensor:
        there = replace(camera, cam_from_world=exponential(h * twist) @ camera.cam_from_world)
        return ((there.project(points)[0] - camera.project(points)[0]) / h).reshape(-1)

    gradients = torch.stack([moved(column) for column in twists.T], dim=1)
    values = torch.linalg.eigvalsh(gradients.T @ gradients / len(points))
    # The strongest motion moves by one pixel in the root mean square, none by more.
    assert float(values[-1]) == pytest.approx(1, rel=1e-3)
    assert float(values[0]) > 0
    # The unit of length does not matter.
    double = pixel_twists(camera, 2 * points)
    assert torch.allclose(double[:3], twists[:3], rtol=1e-9, atol=1e-12)
    assert torch.allclose(double[3:], 2 * twists[3:], rtol=1e-9, atol=1e-12)
    behind = pixel_twists(camera, -points)
    assert bool(behind.isfinite().all())


def test_a_step_goes_down_the_slope_by_the_rate(rng: np.random.Generator) -> None:
    """The first step is as long as the rate says, in pixels, whatever the gradient's length."""
    camera = _camera(_pose(rng))
    points = camera.unproject(
        torch.from_numpy(rng.uniform(1, 47, (200, 2))), torch.from_numpy(rng.uniform(2, 4, 200))
    )
    for scale in (1e-6, 1.0, 1e6):
        poses = PoseRefinement([camera], points=points)
        leaf = poses.leaf(0, camera)
        goal = torch.from_numpy(np.random.default_rng(0).normal(size=(4, 4)))
        (scale * (leaf.cam_from_world * goal)[:3].sum()).backward()
        poses.update(0, progress=0.0)
        there = poses.camera(0, camera)
        assert float(((there.cam_from_world - camera.cam_from_world) * goal)[:3].sum()) < 0
        moved = (there.project(points)[0] - camera.project(points)[0]).square().sum(dim=1)
        # Six coordinates of root mean square 1, of which each moves by at most a pixel.
        assert 0.1 * 0.5 < float(moved.mean().sqrt()) < 6**0.5 * 0.5


def test_alignment_takes_a_common_motion_out(rng: np.random.Generator) -> None:
    given = torch.stack([_pose(rng) for _ in range(5)])
    turn = _pose(rng)[:3, :3]
    refined_from_given = Similarity(
        rotation=turn, translation=torch.tensor([1.0, -2, 0.5]).double(), scale=1.7
    )
    refined = torch.stack(
        [_camera(pose).moved(refined_from_given).cam_from_world for pose in given]
    )
    back = aligning_similarity(given, refined)
    assert torch.allclose(back.matrix, refined_from_given.inverse().matrix, atol=1e-9)
    poses = PoseRefinement([_camera(pose) for pose in given], points=torch.zeros(0, 3))
    poses.restore({**poses.state(), "poses": refined})
    assert torch.allclose(poses.aligned()[1], given, atol=1e-9)
    assert poses.shift().degrees_max < 1e-6
    assert poses.shift().distance_max < 1e-9


def test_cameras_in_one_spot_have_a_rotation_but_no_scale(rng: np.random.Generator) -> None:
    given = torch.stack([_pose(rng) for _ in range(3)])
    given[:, :3, 3] = 0
    turn = _pose(rng)[:3, :3]
    refined = given.clone()
    refined[:, :3, :3] = given[:, :3, :3] @ turn.T
    back = aligning_similarity(given, refined)
    assert back.scale == 1
    assert torch.allclose(back.rotation, turn.T, atol=1e-9)


def test_the_shift_by_hand() -> None:
    """One of two cameras turned in place by 2 degrees.

    Two turns, 0 and 2 degrees, and twice the line between the centres, which did not turn but
    counts across its length only: the alignment turns all by 2 / 3 degrees.
    """
    eye = torch.eye(4).double()
    far = eye.clone()
    far[0, 3] = 1000.0
    angle = math.radians(2)
    turned = exponential(torch.tensor([0, angle, 0, 0, 0, 0], dtype=torch.float64)) @ far
    turned[:3, 3] = -turned[:3, :3] @ centres_of(far[None])[0]
    poses = PoseRefinement([_camera(eye), _camera(far)], points=torch.zeros(0, 3))
    poses.restore({**poses.state(), "poses": torch.stack((eye, turned))})
    shift = poses.shift()
    assert shift.degrees_max == pytest.approx(4 / 3, rel=1e-3)
    assert shift.degrees_mean == pytest.approx(1, rel=1e-3)


def test_restored_poses_go_on_as_if_nothing_had_been(rng: np.random.Generator) -> None:
    cameras = [_camera(_pose(rng)) for _ in range(2)]
    points = torch.from_numpy(rng.normal(size=(50, 3)) + np.array([0.0, 0.0, 3.0]))
    one, other = (PoseRefinement(cameras, points=points) for _ in range(2))
    gradients = torch.from_numpy(rng.normal(size=(4, 4, 4)))

    def step(poses: PoseRefinement, i: int) -> None:
        (poses.leaf(i % 2, cameras[0]).cam_from_world * gradients[i]).sum().backward()
        poses.update(i % 2, progress=0.1)

    step(one, 0)
    step(one, 1)
    other.restore({name: tensor.clone() for name, tensor in one.state().items()})
    for poses in (one, other):
        step(poses, 2)
        step(poses, 3)
    assert torch.equal(one.state()["poses"], other.state()["poses"])


def test_wrong_poses_are_found_again(
    photograph, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poses off by half a degree and 1 % of the distance: the fit moves them most of the way."""
    capture = photograph(count=15, arc=1.2, noise=0.02, width=128, height=112, fx=160.0, fy=160.0)
    wrong = []
    for view in capture.views:
        turn, move = rng.normal(size=3), rng.normal(size=3)
        turn *= math.radians(0.5) / np.linalg.norm(turn)
        move *= 0.032 / np.linalg.norm(move)
        off = exponential(torch.from_numpy(np.concatenate((turn, move))))
        pose = off @ view.camera.cam_from_world
        train = view.split == "train"
        camera = replace(view.camera, cam_from_world=pose) if train else view.camera
        wrong.append(replace(view, camera=camera))
    started = replace(capture, views=tuple(wrong))
    monkeypatch.undo()
    options = FitOptions(minutes=None, steps=700, max_gaussians=150, background="black")
    plain = fit(started, options=options)
    refined = fit(started, options=replace(options, refine_poses=True))
    before, after = (
        _pixels_off(capture.train_views, [v for v in views if v.split == "train"], capture)
        for views in (started.views, refined.views)
    )
    assert after < 0.4 * before, (before, after)
    assert [v.camera for v in refined.views if v.split == "test"] == [
        v.camera for v in started.test_views
    ]
    scores = [
        evaluate_photographs(GaussianField(r.gaussians), capture.test_views).psnr
        for r in (plain, refined)
    ]
    assert scores[1] > scores[0] + 1, scores
    assert plain.views == started.views
    assert [note.split(":")[0] for note in refined.notes if "views" in note] == ["Poses"]


def _pixels_off(truth, views, capture) -> float:
    """How far the scene's points are from where they should be, aligned, in pixels."""
    poses = [torch.stack([v.camera.cam_from_world for v in some]) for some in (truth, views)]
    back = aligning_similarity(*poses)
    points = capture.points.points.double()
    off = [
        (one.camera.project(points)[0] - other.camera.moved(back).project(points)[0])
        .norm(dim=1)
        .mean()
        for one, other in zip(truth, views, strict=True)
    ]
    return float(torch.stack(off).mean())
