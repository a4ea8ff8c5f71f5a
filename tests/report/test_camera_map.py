"""The picture of cameras and points: what stands where, seen from above and from the side."""

from dataclasses import replace

import numpy as np
import torch

from splatseg.core import Camera, Gaussians, View
from splatseg.report.maps import _HELD_OUT, _TRAIN, camera_map
from splatseg.synthetic import look_at

RED = torch.tensor([1.7, -1.7, -1.7])


def scene() -> Gaussians:
    """A red patch at the origin, and one far above that hides it from above."""
    x, y = torch.meshgrid(torch.linspace(-0.3, 0.3, 9), torch.linspace(-0.3, 0.3, 9), indexing="ij")
    patch = torch.stack((x, y, torch.zeros_like(x)), -1).reshape(-1, 3)
    means = torch.cat((patch, patch + torch.tensor([0.0, 0.0, 5.0])))
    n = len(means)
    sh = torch.where(means[:, 2:] < 1, RED, -RED).unsqueeze(1)
    return Gaussians(
        means=means,
        rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 0.1),
        opacities=torch.full((n,), 0.9),
        sh=sh,
    )


def views() -> tuple[View, ...]:
    def camera(x: float, y: float) -> Camera:
        return look_at([x, y, 1.0], [0.0, 0.0, 0.0], width=40, height=30)

    train = [View(name=f"t{i}", camera=camera(x, 0.0)) for i, x in enumerate((-3.0, -1.0, 3.0))]
    return (*train, View(name="h", camera=camera(0.0, 2.0), split="test"))


def places(image: torch.Tensor, colour: tuple[int, int, int], tolerance: int = 60) -> np.ndarray:
    near = (image.int() - torch.tensor(colour)).abs().amax(dim=-1) < tolerance
    rows, columns = torch.nonzero(near, as_tuple=True)
    return np.stack((columns.numpy(), rows.numpy()), 1)


def test_cameras_stand_around_what_they_saw() -> None:
    found = camera_map(scene(), views(), up=(0.0, 0.0, 1.0))
    assert found is not None
    assert found.columns == ("from above", "from the side")
    above, side = (panel.image for panel in found.rows[0][1])
    train, held_out = places(above, _TRAIN), places(above, _HELD_OUT)
    red = places(above, (250, 0, 0), 40)
    assert len(red) > 20, "what is higher than the cameras does not hide it"
    middle = red.mean(axis=0)
    assert train[:, 0].min() < middle[0] - 100
    assert train[:, 0].max() > middle[0] + 100
    assert abs(train[:, 1].mean() - middle[1]) < 40
    assert np.all(np.abs(held_out[:, 0] - middle[0]) < 60)
    assert held_out[:, 1].max() < middle[1], "farther off is higher on the map"
    # From the side the cameras stand above the patch.
    assert places(side, _TRAIN)[:, 1].mean() < places(side, (250, 0, 0), 40)[:, 1].mean()


def test_up_is_found_from_the_views_where_it_is_not_told() -> None:
    told = camera_map(scene(), views(), up=(0.0, 0.0, 1.0))
    level = [replace(view, camera=_level(view.camera)) for view in views()]
    found = camera_map(scene(), level, up=None)
    same = camera_map(scene(), level, up=(0.0, 0.0, 2.5))
    assert told is not None
    assert found is not None
    assert same is not None
    assert torch.equal(found.rows[0][1][0].image, same.rows[0][1][0].image)


def _level(camera: Camera) -> Camera:
    """The same camera, looking straight ahead."""
    eye = -camera.cam_from_world[:3, :3].T @ camera.cam_from_world[:3, 3]
    return look_at(eye.tolist(), [0.0, 0.0, float(eye[2])], width=40, height=30)


def test_nothing_to_show() -> None:
    assert camera_map(scene(), (), up=None) is None
    bare = camera_map(scene()[:0], views()[:1], up=None)
    assert bare is not None
