"""New photographs of a corner of a room that others show already."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Camera, View
from splatseg.errors import InputError
from splatseg.pose.resection import Resection, _Scene, resect

from .conftest import FOCAL, HEIGHT, WIDTH, Pose, Room

NEW = (2, 5)


def camera_of(pose: Pose, *, focal: float = FOCAL) -> Camera:
    return Camera(
        width=WIDTH,
        height=HEIGHT,
        fx=focal,
        fy=focal,
        cx=WIDTH / 2,
        cy=HEIGHT / 2,
        cam_from_world=torch.from_numpy(pose.cam_from_world),
    )


def depth_of(view: View) -> torch.Tensor:
    """z-depth of the planes x = 0, y = 0 and z = 0, where the corner's squares are; else 0."""
    centre, rays = view.camera.rays()
    best = torch.full(rays.shape[:2], torch.inf, dtype=torch.float64)
    for axis in range(3):
        distance = -centre[axis] / rays[..., axis]
        at = centre + distance.unsqueeze(-1) * rays
        others = [i for i in range(3) if i != axis]
        seen = (distance > 0) & (at[..., others] >= 0).all(-1) & (at[..., others] < 4).all(-1)
        best = torch.where(seen & (distance < best), distance, best)
    forward = view.camera.cam_from_world[2, :3]
    return torch.where(best.isfinite(), best * (rays @ forward), 0.0)


@pytest.fixture
def references(room: Room, tmp_path: Path) -> list[View]:
    return [
        View(
            name=f"old_{i}",
            camera=camera_of(room.poses[i]),
            image=room.save(i, tmp_path / "old" / f"old_{i}.png"),
            split="train",
        )
        for i in range(len(room.poses))
        if i not in NEW
    ]


def placed_right(found: Resection, room: Room, which: int) -> None:
    """Its pose is the true one, to a fifth of a degree and a hundredth of the distance."""
    (one,) = [one for one in found.found if one.view.name == f"new_{which}"]
    camera, true = one.view.camera, room.poses[which]
    between = camera.cam_from_world[:3, :3].numpy() @ true.cam_from_world[:3, :3].T
    assert np.degrees(np.arccos(np.clip((np.trace(between) - 1) / 2, -1, 1))) < 0.2
    assert np.linalg.norm(camera.centre.numpy() - true.centre) < 0.05
    assert camera.fx == pytest.approx(FOCAL, rel=0.02)
    assert one.matches >= 24
    assert one.error < 1.5


def test_new_photographs_are_placed_in_the_world_of_the_others(room, references, tmp_path) -> None:
    files = [room.save(i, tmp_path / "new" / f"new_{i}.png") for i in NEW]
    told = []
    found = resect(files, references, depth_of, progress=lambda *now: told.append(now))
    assert told == [(1, 2), (2, 2)]
    assert found.left_out == ()
    for which, one in zip(NEW, found.found, strict=True):
        placed_right(found, room, which)
        assert one.view.split == "train"
        assert one.view.image == files[NEW.index(which)]
        # A photograph of the scene's own size has the scene's own lens.
        assert one.view.camera.fx == FOCAL


def test_another_lens_is_found_with_the_pose(room, references, tmp_path) -> None:
    large = np.asarray(Image.fromarray(room.pictures[2]).resize((WIDTH * 3 // 2, HEIGHT * 3 // 2)))
    (tmp_path / "new").mkdir()
    Image.fromarray(large).save(tmp_path / "new" / "new_2.png")
    found = resect([tmp_path / "new" / "new_2.png"], references, depth_of)
    assert found.left_out == ()
    (one,) = found.found
    assert one.view.camera.fx == pytest.approx(1.5 * FOCAL, rel=0.02)
    assert (one.view.camera.width, one.view.camera.height) == (WIDTH * 3 // 2, HEIGHT * 3 // 2)


def test_what_shows_something_else_is_left_out_and_says_why(room, references, tmp_path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "other.png")
    Image.fromarray(np.full((HEIGHT, WIDTH, 3), 90, np.uint8)).save(tmp_path / "grey.png")
    (tmp_path / "broken.png").write_bytes(b"no picture")
    files = [tmp_path / name for name in ("other.png", "grey.png", "broken.png")]
    good = room.save(2, tmp_path / "new_2.png")
    found = resect([*files, good], references, depth_of)
    placed_right(found, room, 2)
    why = {left.name: left.why for left in found.left_out}
    assert set(why) == {"other.png", "grey.png", "broken.png"}
    assert why["grey.png"] == "0 of its features were found in the scene"


def test_features_without_a_depth_are_no_points(room, references, tmp_path) -> None:
    file = room.save(2, tmp_path / "new_2.png")
    found = resect([file], references, lambda view: torch.zeros(HEIGHT, WIDTH))
    assert found.found == ()
    assert found.left_out[0].why == "0 of its features were found in the scene"


def test_matches_that_no_pose_explains_leave_the_photograph_out(
    room, references, tmp_path, monkeypatch
) -> None:
    """Points of the world in another order than their features."""

    def shuffled(scene: _Scene, index: int) -> np.ndarray:
        rng = np.random.default_rng(index)
        return rng.uniform(0, 4, (len(scene.features[index].pixels), 3))

    monkeypatch.setattr(_Scene, "points", shuffled)
    found = resect([room.save(2, tmp_path / "new_2.png")], references, depth_of)
    assert found.found == ()
    assert re.fullmatch(r"one pose explains \d+ of \d+ matches", found.left_out[0].why)


def test_nothing_to_place_or_to_place_it_in_is_refused(room, references, tmp_path) -> None:
    with pytest.raises(InputError, match="at least one of each, got 0 and 5"):
        resect([], references, depth_of)
    bare = [View(name="v", camera=references[0].camera, split="train")]
    with pytest.raises(InputError, match="got 1 and 0"):
        resect([room.save(2, tmp_path / "new_2.png")], bare, depth_of)
