"""Files and folders that appear whole, names from data, and failures of the system in words."""

import errno
import importlib
import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Camera, LabelMap, Labels, MaskSet, View
from splatseg.core.scene import MAX_NAME, MAX_PART, clean_view_names, view_name_fault
from splatseg.errors import FileFormatError, InputError, MissingFileError, OutputError
from splatseg.io.arrays import unfinished, write_checkpoint_file
from splatseg.io.atomic import (
    atomic_file,
    atomic_folder,
    check_utf8,
    failure_to_write,
    path_inside,
    sync,
)
from splatseg.io.captures import read_capture
from splatseg.io.captures.build import view_names
from splatseg.io.evidence import save_label_map, save_masks
from splatseg.io.json_files import json_text
from splatseg.io.layers import load_layer, save_layer


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_file_appears_when_the_block_ends(tmp_path: Path) -> None:
    with atomic_file(tmp_path / "a.compressed.ply") as temporary:
        temporary.write_bytes(b"new")
        assert temporary.name == "a.compressed.ply"
        assert not (tmp_path / "a.compressed.ply").exists()
    assert (tmp_path / "a.compressed.ply").read_bytes() == b"new"
    assert names(tmp_path) == ["a.compressed.ply"]


def test_file_replaces_the_old_one(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"old")
    with atomic_file(tmp_path / "a") as temporary:
        temporary.write_bytes(b"new")
        assert (tmp_path / "a").read_bytes() == b"old"
    assert (tmp_path / "a").read_bytes() == b"new"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_failed_file_leaves_the_old_one(tmp_path: Path, error: type[BaseException]) -> None:
    (tmp_path / "a").write_bytes(b"old")

    def write_half() -> None:
        with atomic_file(tmp_path / "a") as temporary:
            temporary.write_bytes(b"half")
            raise error("stop")

    with pytest.raises(error, match="stop"):
        write_half()
    assert (tmp_path / "a").read_bytes() == b"old"
    assert names(tmp_path) == ["a"]


@pytest.mark.parametrize("place", ["shutil.rmtree", "splatseg.io.atomic.try_lock"])
def test_ctrl_c_while_the_hidden_folder_is_made_or_removed_leaves_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    module, name = place.rsplit(".", 1)
    original, calls = getattr(importlib.import_module(module), name), []

    def interrupted(*args: object, **keywords: object) -> object:
        calls.append(args)
        if len(calls) == 1:
            raise KeyboardInterrupt
        return original(*args, **keywords)

    monkeypatch.setattr(place, interrupted)
    with pytest.raises(KeyboardInterrupt), atomic_file(tmp_path / "a.txt") as temporary:
        temporary.write_text("new")
    assert calls
    assert not list(tmp_path.glob(".splatseg*"))


def test_file_follows_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with atomic_file(tmp_path / "link") as temporary:
        temporary.write_bytes(b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_bytes() == b"new"


def test_file_that_was_not_written_is_an_error(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match="a: expected the file to be written"),
        atomic_file(tmp_path / "a"),
    ):
        pass
    assert names(tmp_path) == []


@pytest.mark.parametrize("writer", [atomic_file, atomic_folder])
def test_missing_parent_is_named(tmp_path: Path, writer: object) -> None:
    with (
        pytest.raises(MissingFileError, match="nowhere is missing"),
        writer(  # type: ignore[operator]
            tmp_path / "nowhere" / "a"
        ),
    ):
        pass


def test_folder_for_file_and_file_for_folder(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_bytes(b"")
    with (
        pytest.raises(InputError, match="got a folder"),
        atomic_file(tmp_path / "folder"),
    ):
        pass
    with (
        pytest.raises(InputError, match="got a file"),
        atomic_folder(tmp_path / "file"),
    ):
        pass


@pytest.mark.parametrize("name", ["scene", "previous"])
def test_folder_replaces_the_old_one_whole(tmp_path: Path, name: str) -> None:
    for content in ("first", "second"):
        with atomic_folder(tmp_path / name) as temporary:
            (temporary / content).write_text(content)
    assert names(tmp_path) == [name]
    assert names(tmp_path / name) == ["second"]


def test_failed_folder_leaves_the_old_one(tmp_path: Path) -> None:
    with atomic_folder(tmp_path / "scene") as temporary:
        (temporary / "old").touch()

    def write_half() -> None:
        with atomic_folder(tmp_path / "scene") as temporary:
            (temporary / "half").touch()
            raise ValueError("stop")

    with pytest.raises(ValueError, match="stop"):
        write_half()
    assert names(tmp_path) == ["scene"]
    assert names(tmp_path / "scene") == ["old"]


def test_folder_comes_back_when_the_second_rename_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with atomic_folder(tmp_path / "scene") as temporary:
        (temporary / "old").touch()
    replace, calls = os.replace, []

    def failing(source: object, target: object) -> None:
        calls.append(source)
        if len(calls) == 2:
            raise OSError("disk")
        replace(source, target)  # type: ignore[arg-type]

    monkeypatch.setattr(os, "replace", failing)
    with (
        pytest.raises(OSError, match="disk"),
        atomic_folder(tmp_path / "scene") as temporary,
    ):
        (temporary / "new").touch()
    assert names(tmp_path / "scene") == ["old"]


def test_ctrl_c_between_the_two_renames_brings_the_old_folder_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with atomic_folder(tmp_path / "scene") as temporary:
        (temporary / "old").touch()
    replace = os.replace
    calls: list[object] = []

    def interrupted(source: object, target: object) -> None:
        calls.append(source)
        replace(source, target)  # type: ignore[arg-type]
        if len(calls) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt), atomic_folder(tmp_path / "scene") as temporary:
        (temporary / "new").touch()
    assert names(tmp_path / "scene") == ["old"]


# What data names is written below its folder or not at all.


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


# What cannot be written is named, with what to do; what was there stays.


SMALL_FILES = """
import resource
import signal
import sys
from pathlib import Path

import numpy as np
import torch

from splatseg.core import Labels
from splatseg.errors import OutputError
from splatseg.io.layers import load_layer, save_layer
from splatseg.io.arrays import write_checkpoint_file

path = Path(sys.argv[1])
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
"""


def with_small_files(code: str, path: Path) -> str:
    """What that code printed in a process where no file may be larger than 4096 bytes.

    That is what a full disk looks like to a writer. The limit is on all files of a process, logs
    and the notes of pytest among them: that of the tests must not have it.
    """
    command = [sys.executable, "-c", SMALL_FILES + textwrap.dedent(code), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("number", [28, 122, 13, 30, 36])
def test_each_reason_says_what_to_do(number: int) -> None:
    sentence = failure_to_write("a.ply", OSError(number, os.strerror(number)))
    assert sentence.startswith("a.ply: cannot be written: ")
    assert any(word in sentence for word in ("free some space", "choose a"))


def test_a_full_disk_leaves_the_old_layer(tmp_path: Path) -> None:
    path = tmp_path / "classes.npz"
    out = with_small_files(
        """
        save_layer(Labels(ids=torch.ones(9, dtype=torch.int64), confidence=torch.ones(9)), path)
        new = Labels(ids=torch.ones(9000, dtype=torch.int64), confidence=torch.ones(9000))
        try:
            save_layer(new, path)
        except OutputError as error:
            print(error)
        """,
        path,
    )
    assert "classes.npz: cannot be written: the file would be" in out
    assert len(load_layer(path)) == 9
    assert [entry.name for entry in tmp_path.iterdir()] == ["classes.npz"]


def test_a_full_disk_leaves_the_old_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "fit" / "checkpoint.npz"
    write_checkpoint_file({"steps": 1}, {"a": np.zeros(3)}, path)
    before = path.read_bytes()
    out = with_small_files(
        """
        try:
            write_checkpoint_file({"steps": 2}, {"a": np.zeros(9000)}, path)
        except OutputError as error:
            print(error)
        """,
        path,
    )
    assert "checkpoint.npz: cannot be written" in out
    assert path.read_bytes() == before
    assert not unfinished(path).exists(), "a full disk needs the space"


def test_errors_that_are_not_of_writing_go_through(tmp_path: Path) -> None:
    missing = tmp_path / "photograph.png"
    with pytest.raises(FileNotFoundError) as caught, atomic_file(tmp_path / "a"):
        missing.read_bytes()
    assert not isinstance(caught.value, OutputError)
    with pytest.raises(BrokenPipeError), atomic_folder(tmp_path / "b"):
        raise BrokenPipeError(32, "Broken pipe")
    with pytest.raises(InputError), atomic_folder(tmp_path / "b"):
        raise InputError("b: expected something else.")
    with (
        pytest.raises(OutputError, match="b: cannot be written: 20 requested and 8 written"),
        atomic_folder(tmp_path / "b"),
    ):
        raise OSError("20 requested and 8 written")  # as NumPy's tofile says it
    assert not list(tmp_path.iterdir())


def test_scenes_layers_and_checkpoints_wait_for_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk has the content before the name is given to it, and then the name."""
    done: list[str] = []
    fsync, replace = os.fsync, os.replace

    def watched_fsync(handle: int) -> None:
        done.append(f"sync {Path(f'/proc/self/fd/{handle}').readlink().name}")
        fsync(handle)

    def watched_replace(source: object, target: object) -> None:
        done.append(f"rename {Path(str(target)).name}")
        replace(source, target)  # type: ignore[arg-type]

    monkeypatch.setattr(os, "fsync", watched_fsync)
    monkeypatch.setattr(os, "replace", watched_replace)
    save_layer(
        Labels(ids=torch.ones(2, dtype=torch.int64), confidence=torch.ones(2)), tmp_path / "a.npz"
    )
    here = f"sync {tmp_path.name}"
    assert done == ["sync a.npz", "rename a.npz", here]
    done.clear()
    write_checkpoint_file({}, {}, tmp_path / "c.npz")
    assert done == ["sync c.npz.new", "rename c.npz", here]
    done.clear()
    with atomic_folder(tmp_path / "scene", durable=True) as temporary:
        (temporary / "scene.json").touch()
    assert done == ["sync scene.json", "sync scene", "rename scene", here]


def test_a_file_system_may_lack_syncing_of_folders_but_not_of_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(number: int) -> None:
        def fsync(handle: int) -> None:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(os, "fsync", fsync)

    file = tmp_path / "a"
    file.touch()
    for number in (errno.EINVAL, errno.ENOTSUP):
        refused(number)
        sync(tmp_path)
        with pytest.raises(OSError, match=os.strerror(number)):
            sync(file)
    refused(errno.EIO)
    with pytest.raises(OSError, match=os.strerror(errno.EIO)):
        sync(tmp_path)
