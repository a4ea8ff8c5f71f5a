"""What data names is written below its folder or not at all."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Camera, LabelMap, MaskSet, View
from splatseg.core.scene import MAX_NAME, MAX_PART, clean_view_names, view_name_fault
from splatseg.errors import FileFormatError, InputError
from splatseg.io.atomic import check_utf8, path_inside
from splatseg.io.captures import read_capture
from splatseg.io.captures.build import view_names
from splatseg.io.evidence import save_label_map, save_masks
from splatseg.io.json_files import json_text

CAMERA = Camera(
    width=8, height=6, fx=9.0, fy=9.0, cx=4.0, cy=3.0, cam_from_world=torch.eye(4).double()
)
CLIMBING = ("../x", "a/../../x", "/etc/x", "..", ".", "", "a//b", "a/", "..\\x", "a\0b")
NO_NAMES = (
    *CLIMBING,
    *("a\nb", "\x1b[2J", "\u2028", "\u2029", "\udcff"),
    *(".hidden", "a/.b", "a\\b", "x" * (MAX_PART + 1)),
    *("\u00e9" * (MAX_PART // 2 + 1), "/".join(["x" * MAX_PART] * (MAX_NAME // MAX_PART))),
)


@pytest.mark.parametrize("name", NO_NAMES)
def test_no_view_has_a_name_that_no_file_may_have(name: str) -> None:
    with pytest.raises(InputError, match="^(view: expected a view's name|name: expected)"):
        View(name=name, camera=CAMERA)
    assert view_name_fault(clean_view_names([name])[0]) is None
    with pytest.raises(InputError):
        save_masks(MaskSet.from_dense(torch.ones(1, 2, 2, dtype=torch.bool)), Path("nowhere"), name)


@pytest.mark.parametrize("name", ["0001", "left/0001", "IMG 1 (2)", "été", "a.b", "_x", "日本/1"])
def test_good_names_stay(name: str) -> None:
    assert View(name=name, camera=CAMERA).name == name
    assert clean_view_names([name]) == [name]


@pytest.mark.parametrize(
    ("relatives", "names"),
    [
        (["../../000.png", "images/000.png"], ["000", "images/000"]),
        (["/a/000.png", "images/000.png"], ["a/000", "images/000"]),
        (["a/../000.png", "b/000.png"], ["a/000", "b/000"]),
        (["i/A.png", "i/a.png", "i/a_2.png"], ["A", "a_3", "a_2"]),
        (["e\u0301.png", "\u00e9.png"], ["e\u0301", "\u00e9_2"]),
        (["evidence.png", "x.png"], ["evidence_2", "x"]),
        (["../b.png", "b.png"], ["b_2", "b"]),
        (["a\n.png", "\x1b.png"], ["a_", "_"]),
    ],
)
def test_names_of_a_capture_are_clean(relatives: list[str], names: list[str]) -> None:
    assert view_names(relatives) == names


def test_long_names_are_short_and_their_own() -> None:
    names = clean_view_names(["é" * 300, "é" * 301, "/".join(["d" * 150] * 30)])
    assert len(set(names)) == 3
    assert all(view_name_fault(name) is None for name in names)


def test_an_honest_capture_with_climbing_paths(tmp_path: Path) -> None:
    capture = tmp_path / "a" / "b"
    (capture / "images").mkdir(parents=True)
    frames = []
    for i, path in enumerate(("../../000.png", "images/000.png")):
        Image.fromarray(np.full((6, 8, 3), 9, np.uint8)).save(capture / path)
        pose = np.eye(4)
        pose[0, 3] = i
        frames.append({"file_path": path, "transform_matrix": pose.tolist()})
    lens = {"fl_x": 9, "fl_y": 9, "cx": 4, "cy": 3, "w": 8, "h": 6}
    (capture / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    views = read_capture(capture).views
    assert [view.name for view in views] == ["000", "images/000"]
    assert views[0].image is not None
    assert views[0].image.samefile(tmp_path / "000.png")


@pytest.mark.parametrize("name", CLIMBING)
def test_a_path_never_climbs(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="the name of a file below it"):
        path_inside(tmp_path / "in", "labels", name)
    assert not (tmp_path / "in").exists()


@pytest.mark.parametrize("link", ["file", "folder", "circle"])
def test_links_do_not_lead_out(tmp_path: Path, link: str) -> None:
    inside, outside = tmp_path / "in", tmp_path / "out"
    inside.mkdir()
    outside.mkdir()
    (outside / "a.png").write_bytes(b"precious")
    if link == "file":
        (inside / "a.png").symlink_to(outside / "a.png")
    elif link == "folder":
        (inside / "d").symlink_to(outside)
    else:
        (inside / "d").symlink_to(inside / "d")
    name = "a" if link == "file" else "d/a"
    ids = LabelMap(ids=torch.ones(2, 2, dtype=torch.int64))
    with pytest.raises(InputError, match=r"a link leads out|cannot be followed"):
        save_label_map(ids, inside, name)
    assert (outside / "a.png").read_bytes() == b"precious"
    assert len(list(outside.iterdir())) == 1


def test_a_link_to_the_folder_itself_and_links_within_it_are_fine(tmp_path: Path) -> None:
    (tmp_path / "in" / "real").mkdir(parents=True)
    (tmp_path / "alias").symlink_to(tmp_path / "in")
    (tmp_path / "in" / "d").symlink_to(tmp_path / "in" / "real")
    assert path_inside(tmp_path / "alias", "d/a.png") == tmp_path / "alias" / "d" / "a.png"


def test_names_that_are_no_utf8_are_refused_before_the_work(tmp_path: Path) -> None:
    bad = Path(os.fsdecode(bytes(tmp_path) + b"/caf\xe9.png"))
    with pytest.raises(InputError, match=r"UTF-8, got the bytes .*caf\\xe9.png"):
        check_utf8(bad)
    Image.fromarray(np.full((6, 8, 3), 9, np.uint8)).save(bad)
    frame = {"file_path": bad.name, "transform_matrix": np.eye(4).tolist()}
    lens = {"fl_x": 9, "fl_y": 9, "cx": 4, "cy": 3, "w": 8, "h": 6}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": [frame]}))
    with pytest.raises((InputError, FileFormatError)) as caught:
        read_capture(tmp_path)
    str(caught.value).encode()
    with pytest.raises(InputError, match="provenance: expected text that UTF-8 can hold"):
        json_text("provenance", {"file": bad.name})
