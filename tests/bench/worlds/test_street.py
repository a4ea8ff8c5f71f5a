"""The street, and the drive through it."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, RangeError
from splatseg.synthetic import render_truth, room
from splatseg_bench.worlds import STREET_CLASSES, drive_cameras, street

SEEDS = range(5)


def test_streets_have_all_kinds_of_things():
    used: set[int] = set()
    for seed in range(12):
        scene = street(seed)
        assert scene.classes is STREET_CLASSES
        assert {solid.instance for solid in scene.primitives} == {o.id for o in scene.objects}
        assert len({item.name for item in scene.objects}) == len(scene.objects)
        used |= {item.class_id for item in scene.objects}
    assert used == {row.id for row in STREET_CLASSES.rows}
    names = {row.name for row in STREET_CLASSES.rows}
    assert all(set(group) <= names for group in scene.related_classes)


def test_the_seed_and_the_length_decide():
    assert street(4).primitives == street(4).primitives
    assert street(4).primitives != street(5).primitives
    long = np.array(street(4, length=90.0).drive)
    assert np.linalg.norm(np.diff(long, axis=0), axis=1).sum() == pytest.approx(90.0, rel=0.05)
    with pytest.raises(RangeError, match="^length"):
        street(0, length=5.0)


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_but_marks_lies_where_the_camera_car_drives(seed):
    scene = street(seed)
    for view in drive_cameras(scene, 12, width=32, height=16):
        eye = view.camera.centre.unsqueeze(0)
        assert not any(bool(p.contains(eye, 0.7)) for p in scene.primitives if p.shape != "plane")
        low, high = torch.tensor(scene.bounds[0]), torch.tensor(scene.bounds[1])
        assert bool(((eye[0] > low) & (eye[0] < high)).all())


def test_a_drive_goes_forward_and_looks_ahead():
    scene = street(1)
    views = drive_cameras(scene, 17, width=32, height=16)
    assert [view.name for view in views[:2]] == ["drive_0000", "drive_0001"]
    assert [i for i, view in enumerate(views) if view.split == "test"] == [4, 12]
    for one, after in pairwise(views):
        step = after.camera.centre - one.camera.centre
        forward = one.camera.cam_from_world[2, :3]
        assert float(step @ forward) > 0.9 * float(step.norm()) > 0
    everything = drive_cameras(scene, 5, test_every=0, reach=1.0, field_of_view=60.0)
    assert {view.split for view in everything} == {"train"}
    assert everything[0].camera.fx == pytest.approx(176 / np.tan(np.pi / 6))
    end = everything[-1].camera.centre[:2]
    assert float((end - torch.tensor(scene.drive[-1][:2])).norm()) < 0.2


def test_a_room_has_no_drive():
    with pytest.raises(InputError, match="expected one with a drive"):
        drive_cameras(room(0), 3)


def test_a_view_of_the_street_has_road_below_and_sky_above():
    scene = street(0)
    view = drive_cameras(scene, 3, width=64, height=32)[0]
    truth = render_truth(scene, view.camera)
    names = {row.id: row.name for row in STREET_CLASSES.rows}
    assert names[int(truth.semantic[-1, 32])] == "road"
    assert int(truth.semantic[0].min()) == -1
    grey = truth.image.float().mean(dim=-1)
    assert 60 < float(grey.mean()) < 200
    assert float((grey < 8).float().mean()) < 0.02
