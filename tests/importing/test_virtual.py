"""Virtual cameras: where they stand, what they show, and that they are the same every time."""

import numpy as np
import pytest
import torch

from splatseg.core import Gaussians
from splatseg.errors import InputError
from splatseg.importing import VIEWS, place_cameras
from splatseg.render import render

UP = (0.0, -1.0, 0.0)


def test_cameras_around_an_object(blobs) -> None:
    placed = place_cameras(blobs, up=UP, count=24)
    assert placed.kind == "object"
    assert placed.coverage > 0.97
    assert [view.name for view in placed.views] == [f"virtual_{i:04d}" for i in range(24)]
    assert [i for i, v in enumerate(placed.views) if v.split == "test"] == [0, 8, 16]
    middle = torch.tensor([5.0, -3.0, 2.0], dtype=torch.float64)
    off_centre = []
    for view in placed.views:
        assert view.image is None
        pixel, depth = view.camera.project(middle)
        off_centre.append(float((pixel - torch.tensor([400.0, 300.0])).norm()))
        assert depth > 2, "from outside the ball"
        # Upright: the image's up is no more than its pitch away from the world's.
        assert view.camera.cam_from_world[1, 1] > 0.4
        # Level: right has no part along up.
        assert abs(view.camera.cam_from_world[0, 1]) < 1e-9
    # They look at the middle; the nearer ones at the ends too, as it is twice as high as wide.
    assert sum(pixels < 60 for pixels in off_centre) >= 12
    assert 60 < max(off_centre) < 250


def test_the_whole_object_is_in_some_views(blobs) -> None:
    placed = place_cameras(blobs, up=UP, count=24, width=160, height=120)
    borders = []
    for view in placed.views:
        alpha = render(blobs, view.camera).alpha
        borders.append(float(torch.cat((alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1])).mean()))
        assert alpha.mean() > 0.05
    assert sum(border < 0.05 for border in borders) >= 8


def test_cameras_within_a_room(walls) -> None:
    placed = place_cameras(walls, up=UP, count=24)
    assert placed.kind == "room"
    assert placed.coverage > 0.9
    inside = torch.tensor([3.0, 1.5, 2.0], dtype=torch.float64)
    for view in placed.views:
        assert (view.camera.centre.abs() < inside).all()
        assert render(walls, view.camera.resized(80, 60)).alpha.mean() > 0.5
    directions = torch.stack([view.camera.cam_from_world[2, :3] for view in placed.views])
    assert directions.mean(dim=0).norm() < 0.5, "they look in all directions"


def test_the_kind_can_be_said(walls) -> None:
    placed = place_cameras(walls, up=UP, count=13, kind="object")
    assert placed.kind == "object"
    assert all((view.camera.centre.abs() > 2).any() for view in placed.views)


def test_as_many_as_its_kind_needs(blobs, monkeypatch) -> None:
    assert VIEWS["room"] > VIEWS["object"]
    monkeypatch.setattr("splatseg.importing._virtual.VIEWS", {"object": 14, "room": 1})
    assert len(place_cameras(blobs, up=UP).views) == 14


def test_views_look_where_detail_is(walls, rng) -> None:
    """Small Gaussians on a spot of one wall draw cameras towards it."""
    spot = np.array([2.9, 0.0, 0.0])
    around = spot + rng.normal(size=(len(walls), 3)) * 0.15
    many = walls.replace(
        means=torch.from_numpy(around).float(), scales=torch.full((len(walls), 3), 0.02)
    )

    def shown(scene: Gaussians) -> int:
        views = place_cameras(scene, up=UP, count=16, kind="room").views
        pixels, depth = zip(*(v.camera.project(torch.from_numpy(spot)) for v in views), strict=True)
        at, ahead = torch.stack(pixels), torch.stack(depth)
        inside = (at > 0).all(dim=1) & (at < torch.tensor([800, 600])).all(dim=1) & (ahead > 0)
        return int(inside.sum())

    assert shown(Gaussians.concatenate([walls, many])) > shown(walls)


def test_the_same_every_time(blobs) -> None:
    first, second = (place_cameras(blobs, up=UP, count=12) for _ in range(2))
    for a, b in zip(first.views, second.views, strict=True):
        assert torch.equal(a.camera.cam_from_world, b.camera.cam_from_world)


def test_floaters_do_not_matter(blobs, rng) -> None:
    far = rng.normal(size=(6, 3)) * 400
    floaters = Gaussians(
        means=torch.from_numpy(far).float(),
        rotations=torch.eye(4)[:1].expand(6, 4),
        scales=torch.full((6, 3), 2.0),
        opacities=torch.full((6,), 0.9),
        sh=torch.zeros(6, 1, 3),
    )
    placed = place_cameras(Gaussians.concatenate([blobs, floaters]), up=UP, count=12)
    middle = torch.tensor([5.0, -3.0, 2.0], dtype=torch.float64)
    assert max(float((v.camera.centre - middle).norm()) for v in placed.views) < 20


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (1.0, 2.0, -0.5)])
def test_up_is_respected(blobs, up) -> None:
    placed = place_cameras(blobs, up=up, count=12)
    direction = np.array(up) / np.linalg.norm(up)
    for view in placed.views:
        rotation = view.camera.cam_from_world[:3, :3].numpy()
        assert abs(rotation[0] @ direction) < 1e-9
        assert -rotation[1] @ direction > 0.4
    assert placed.up == up


def test_a_single_translucent_gaussian() -> None:
    one = Gaussians(
        means=torch.tensor([[1.0, 2.0, 3.0]]),
        rotations=torch.eye(4)[:1],
        scales=torch.ones(1, 3),
        opacities=torch.tensor([0.3]),
        sh=torch.zeros(1, 1, 3),
    )
    placed = place_cameras(one, up=UP, count=12)
    assert placed.kind == "object"
    assert placed.coverage == pytest.approx(1.0)


def test_what_cannot_be_seen_is_refused(blobs) -> None:
    with pytest.raises(InputError, match="expected at least one, got none"):
        place_cameras(blobs[:0], up=UP)
    with pytest.raises(InputError, match="no camera sees it"):
        place_cameras(blobs.replace(opacities=torch.zeros(300)), up=UP)
    with pytest.raises(InputError, match="up: expected a direction"):
        place_cameras(blobs, up=(0.0, 0.0, 0.0))
