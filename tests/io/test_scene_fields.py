"""Where the fields of a scene are: files, and folders of drives in blocks."""

from pathlib import Path

import pytest

from splatseg.errors import InputError
from splatseg.io.scene import (
    new_field_file,
    new_field_folder,
    remove_field_file,
    remove_field_folder,
    scene_field_names,
    scene_field_path,
)


@pytest.fixture
def root(tmp_path) -> Path:
    """A scene with a field of each form, and with what is none."""
    new_field_file(tmp_path, "one").write_bytes(b"")
    folder = new_field_folder(tmp_path, "drive")
    for name in ("drive.json", "0000.safetensors", "0001.safetensors"):
        (folder / name).write_bytes(b"")
    (tmp_path / "fields/empty").mkdir()
    (tmp_path / "fields/odd.safetensors").mkdir()
    (tmp_path / "fields/.hidden").mkdir()
    (tmp_path / "fields/.hidden/drive.json").write_bytes(b"")
    (tmp_path / "fields/notes.txt").write_bytes(b"")
    return tmp_path


def test_files_and_folders_are_fields(root) -> None:
    assert scene_field_names(root) == ("drive", "one")
    assert scene_field_path(root, "one") == root / "fields/one.safetensors"
    assert scene_field_path(root, "drive") == root / "fields/drive"
    with pytest.raises(InputError, match=r"^field: expected one of .* \(drive, one\), got 'odd'"):
        scene_field_path(root, "odd")
    with pytest.raises(InputError, match="it has none; `splatseg street` makes one"):
        scene_field_path(root / "fields", "one")


def test_of_two_forms_of_a_name_the_file_counts(root) -> None:
    new_field_file(root, "drive").write_bytes(b"")
    assert scene_field_names(root) == ("drive", "one")
    assert scene_field_path(root, "drive").is_file()


def test_what_is_removed_is_the_field_and_nothing_else(root) -> None:
    kept = root / "fields/drive/notes.txt"
    kept.write_text("mine")
    remove_field_folder(root, "drive")
    assert scene_field_names(root) == ("one",)
    assert list(kept.parent.iterdir()) == [kept]
    kept.unlink()
    remove_field_folder(root, "drive")
    assert not kept.parent.exists()
    remove_field_folder(root, "drive")
    remove_field_file(root, "one")
    remove_field_file(root, "one")
    assert scene_field_names(root) == ()


def test_nothing_is_written_or_removed_outside(tmp_path) -> None:
    outside, root = tmp_path / "outside", tmp_path / "scene"
    outside.mkdir()
    (outside / "drive.json").write_bytes(b"")
    (root / "fields").mkdir(parents=True)
    (root / "fields/drive").symlink_to(outside)
    for work in (new_field_folder, remove_field_folder):
        with pytest.raises(InputError, match="a link leads out of it"):
            work(root, "drive")
        with pytest.raises(InputError, match="^field: expected a name of letters"):
            work(root, "../outside")
    assert (outside / "drive.json").is_file()
