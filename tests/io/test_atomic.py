"""Files and folders appear whole under their name or not at all."""

import os
from pathlib import Path

import pytest

from splatseg.errors import InputError, MissingFileError
from splatseg.io.atomic import atomic_file, atomic_folder


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
