"""The order in which a tracker goes through views, solved by hand."""

import math

import pytest
import torch

from splatseg.core import Camera, View
from splatseg.models._tracked import ordered_views


def view(name: str, x: float, degrees: float = 0.0) -> View:
    """A camera at (x, 0, 0) that looks along z, turned to the right."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]], dtype=torch.float64)
    pose[0, 3] = x
    camera = Camera(
        width=4, height=3, fx=3.0, fy=3.0, cx=2.0, cy=1.5, cam_from_world=torch.linalg.inv(pose)
    )
    return View(name=name, camera=camera, image=None, split="train")


def order(views, how: str) -> list[str]:
    return [one.name for one in ordered_views(views, how)]


def test_by_name_numbers_count_by_their_value() -> None:
    names = ["b", "frame_10", "frame_9", "a/2", "a/10", "frame_09", "1"]
    wanted = ["1", "a/2", "a/10", "b", "frame_09", "frame_9", "frame_10"]
    assert order([view(name, 0.0) for name in names], "name") == wanted


def test_along_the_cameras() -> None:
    """Names jump to and fro, the cameras stand in a row: a at 0, then d, b, c."""
    views = [view("c", 3.0), view("a", 0.0), view("d", 1.0), view("b", 1.9)]
    assert order(views, "name") == ["a", "b", "c", "d"]
    assert order(views, "path") == ["a", "d", "b", "c"]
    assert order(views[::-1], "path") == ["a", "d", "b", "c"], "however they come"


@pytest.mark.parametrize(("degrees", "wanted"), [(0.0, ["a", "b", "c"]), (170.0, ["a", "c", "b"])])
def test_where_a_camera_looks_counts(degrees: float, wanted: list[str]) -> None:
    """Centres 0, 1, 2: their mean distance from the mean is 2/3, so c is 1.5 further than b."""
    assert order([view("a", 0.0), view("b", 1.0, degrees), view("c", 2.0)], "path") == wanted


def test_how_much_it_counts() -> None:
    """1.5 rad, 85.94 degrees, are as much as the mean distance of centres times 1.5, here 1."""
    for degrees, wanted in ((85.0, "b"), (87.0, "c")):
        views = [view("a", 0.0), view("b", 1.0, degrees), view("c", 2.0)]
        assert order(views, "path")[1] == wanted


def test_cameras_in_one_place() -> None:
    views = [view("a", 0.0, 0), view("b", 0.0, 80), view("c", 0.0, 40)]
    assert order(views, "path") == ["a", "c", "b"]
    assert order(views[:1], "path") == ["a"]
