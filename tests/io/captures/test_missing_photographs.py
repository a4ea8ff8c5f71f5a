"""Photographs that a capture lists and that are not there, in every layout."""

import json

import numpy as np
import pytest

from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures import read_capture

NAMES = tuple(f"images/{i:02d}.png" for i in range(10))


def test_photographs_that_are_not_there_are_left_out_and_named(nerfstudio) -> None:
    folder = nerfstudio(NAMES)
    for name in NAMES[2:5]:
        (folder / name).unlink()
    capture = read_capture(folder)
    assert [view.name for view in capture.views] == ["00", "01", "05", "06", "07", "08", "09"]
    assert capture.missing == NAMES[2:5]
    assert capture.notes[0] == (
        "3 of 10 photographs that the capture lists are not there and left out "
        "(images/02.png, images/03.png, images/04.png)"
    )
    assert [view.name for view in capture.test_views] == ["00"], "split after they are left out"
    with pytest.raises(MissingFileError, match="3 of 10 .* expected all of them .*02.png"):
        read_capture(folder, strict=True)


def test_a_whole_capture_has_nothing_to_say_of_it(nerfstudio) -> None:
    capture = read_capture(nerfstudio(), strict=True)
    assert capture.missing == ()
    assert not any("not there" in note for note in capture.notes)


@pytest.mark.parametrize(("lost", "read"), [(5, True), (6, False)])
def test_half_of_them_must_be_there(nerfstudio, lost, read) -> None:
    folder = nerfstudio(NAMES)
    for name in NAMES[:lost]:
        (folder / name).unlink()
    if read:
        assert len(read_capture(folder).views) == 5
        return
    with pytest.raises(MissingFileError, match="6 of 10 .* expected at least half") as caught:
        read_capture(folder)
    assert str(caught.value).count(".png") == 5, "five are named"


def test_a_note_stays_short(nerfstudio, write_image) -> None:
    names = tuple(f"images/{i:03d}.png" for i in range(80))
    folder = nerfstudio(names, images=False)
    for name in names[:40]:
        write_image(folder / name)
    note = read_capture(folder).notes[0]
    assert note.startswith("40 of 80 photographs")
    assert note.count(".png") == 20
    assert note.endswith(", ...)")


def test_views_keep_their_names_when_a_namesake_is_not_there(nerfstudio) -> None:
    """So that evidence of a view is still that of the view when the others come back."""
    folder = nerfstudio(("left/1.png", "right/1.png", "right/2.png"))
    (folder / "left/1.png").unlink()
    assert [view.name for view in read_capture(folder).views] == ["2", "right/1"]


def test_what_belongs_to_a_photograph_that_is_not_there_may_lack_too(nerfstudio) -> None:
    frames = {0: {"mask_path": "m/a.png", "depth_file_path": "d/a.png"}}
    folder = nerfstudio(frames=frames)
    (folder / "images/a.png").unlink()
    assert [view.name for view in read_capture(folder).views] == ["b", "c"]


def test_colmap(tmp_path, write_image) -> None:
    """Also where none of the first twenty is there."""
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse/cameras.txt").write_text("7 PINHOLE 64 48 50 51 32 24\n")
    lines = [f"{i + 1} 1 0 0 0 1 2 3 7 {i:02d}.png\n\n" for i in range(50)]
    (tmp_path / "sparse/images.txt").write_text("".join(lines))
    for i in range(22, 50):
        write_image(tmp_path / f"images/{i:02d}.png")
    capture = read_capture(tmp_path)
    assert len(capture.views) == 28
    assert capture.notes[0].startswith("22 of 50 photographs that the capture lists are not there")
    with pytest.raises(MissingFileError, match="22 of 50"):
        read_capture(tmp_path, strict=True)


def test_colmap_takes_the_first_folder_that_has_enough(tmp_path, write_image) -> None:
    """`images` with one of four lost comes before `images_2` with all, but not with one left."""
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse/cameras.txt").write_text("7 PINHOLE 64 48 50 51 32 24\n")
    lines = [f"{i + 1} 1 0 0 0 1 2 3 7 {i}.png\n\n" for i in range(4)]
    (tmp_path / "sparse/images.txt").write_text("".join(lines))
    for i in range(4):
        write_image(tmp_path / f"images/{i}.png")
        write_image(tmp_path / f"images_2/{i}.png", 32, 24)
    (tmp_path / "images/0.png").unlink()
    assert [view.camera.width for view in read_capture(tmp_path).views] == [64] * 3
    for i in (1, 2):
        (tmp_path / f"images/{i}.png").unlink()
    assert [view.camera.width for view in read_capture(tmp_path).views] == [32] * 4


def test_blender(tmp_path, write_image) -> None:
    pose = np.eye(4).tolist()
    frames = [{"file_path": f"./train/r_{i}", "transform_matrix": pose} for i in range(3)]
    content = {"camera_angle_x": 0.7, "frames": frames}
    (tmp_path / "transforms_train.json").write_text(json.dumps(content))
    for i in (0, 2):
        write_image(tmp_path / f"train/r_{i}.png")
    capture = read_capture(tmp_path)
    assert [view.name for view in capture.views] == ["r_0", "r_2"]
    assert capture.missing == ("train/r_1",)
    with pytest.raises(MissingFileError, match=r"1 of 3 .*train/r_1"):
        read_capture(tmp_path, strict=True)


def idr(folder, write_image, *, matrices, photographs) -> None:
    """world_mat_i looks from (i, 0, 0); photographs are named by their numbers."""
    k = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    poses = {i: k @ np.array([[1, 0, 0, -i], [0, 1, 0, 0], [0, 0, 1, 0.0]]) for i in matrices}
    np.savez(folder / "cameras_sphere.npz", **{f"world_mat_{i}": p for i, p in poses.items()})
    for i in photographs:
        write_image(folder / f"image/{i:06d}.png")


def test_idr_goes_by_number(tmp_path, write_image) -> None:
    idr(tmp_path, write_image, matrices=range(6), photographs=(0, 2, 3, 5))
    capture = read_capture(tmp_path)
    centres = {int(view.name): float(view.camera.centre[0]) for view in capture.views}
    assert centres == pytest.approx({0: 0, 2: 2, 3: 3, 5: 5})
    assert capture.missing == ("world_mat_1", "world_mat_4")
    with pytest.raises(MissingFileError, match=r"2 of 6 .*world_mat_1, world_mat_4"):
        read_capture(tmp_path, strict=True)


@pytest.mark.parametrize("photographs", [(1, 2, 3, 4, 5), (0, 1, 2, 7)])
def test_idr_is_refused_where_numbers_do_not_tell(tmp_path, write_image, photographs) -> None:
    """1 to 5 may be the names of matrices 0 to 4."""
    idr(tmp_path, write_image, matrices=range(6), photographs=photographs)
    with pytest.raises(InputError, match="expected one world_mat a photograph"):
        read_capture(tmp_path)


def test_llff_is_refused_since_its_rows_have_no_names(tmp_path, write_image) -> None:
    np.save(tmp_path / "poses_bounds.npy", np.zeros((3, 17)))
    for i in range(2):
        write_image(tmp_path / f"images/{i}.png")
    with pytest.raises(InputError, match="rows do not say of which photograph they are"):
        read_capture(tmp_path)
