"""The order of a drive's places, told from names."""

import pytest
import torch

from splatseg.core import Camera, View
from splatseg.errors import InputError
from splatseg.io.captures import read_capture
from splatseg.street.blocks import frame_centres


def at(name: str, x: float) -> View:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    camera = Camera(width=4, height=4, fx=4, fy=4, cx=2, cy=2, cam_from_world=pose)
    return View(name=name, camera=camera)


@pytest.mark.parametrize(
    "names",
    [
        ("train_0000_L", "train_0000_R", "train_0001_L", "train_0001_R"),
        (
            "image_00/0000000009",
            "image_01/0000000009",
            "image_00/0000000010",
            "image_01/0000000010",
        ),
        ("9", "9_2_a9", "10", "b10"),
    ],
)
def test_cameras_of_one_time_are_one_place(names):
    views = [at(name, x) for name, x in zip(names, (0.0, 1.0, 4.0, 6.0), strict=True)]
    assert frame_centres(views)[:, 0].tolist() == [0.5, 5.0]
    assert frame_centres(views[::-1])[:, 0].tolist() == [0.5, 5.0]


def test_numbers_are_counted_and_not_spelt():
    assert frame_centres([at("a10", 2.0), at("a9", 1.0)])[:, 0].tolist() == [1.0, 2.0]


def test_drives_whose_numbers_begin_again_follow_each_other():
    views = [at("b/1", 100.0), at("a/1", 0.0), at("a/2", 1.0), at("b/2", 101.0)]
    assert frame_centres(views)[:, 0].tolist() == [0.0, 1.0, 100.0, 101.0]


def test_a_rig_is_measured_in_metres():
    views = [at("a/1", 0.0), at("b/1", 1.0)]
    assert len(frame_centres(views)) == 1
    assert len(frame_centres(views, metres_per_unit=10.0)) == 2


def test_names_without_numbers_are_in_their_order():
    views = [at("c", 3.0), at("a", 1.0), at("b2", 2.0)]
    assert frame_centres(views)[:, 0].tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(InputError, match="views: expected views along a drive"):
        frame_centres([])


def test_a_generated_drive_goes_forward(generated_drive):
    places = frame_centres(read_capture(generated_drive).train_views)
    assert len(places) == 10
    assert bool((places[1:, 0] > places[:-1, 0]).all())


def test_stereo_pairs_of_the_street(shared_data):
    places = frame_centres(read_capture(shared_data / "street").train_views)
    steps = (places[1:] - places[:-1]).norm(dim=1)
    assert len(places) == 60
    assert 0.7 < float(steps.min()) <= float(steps.max()) < 1.7
