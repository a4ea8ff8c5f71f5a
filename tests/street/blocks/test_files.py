"""Blocks made one by one into a folder, and read from it when they are needed."""

import json
import math
from pathlib import Path

import pytest
import torch

from splatseg.errors import FileFormatError, InputError, MissingFileError, RangeError, ShapeError
from splatseg.street import files
from splatseg.street.blocks import DriveBlock, DriveBlockOptions, DriveBlocks, cut_drive
from splatseg.street.field import MeshField
from splatseg.street.files import (
    block_file,
    build_blocks,
    drive_about,
    goes_on,
    load_drive,
    missing_blocks,
    open_blocks,
    save_drive,
)
from street.blocks.support import bend, straight
from support.mesh_fields import IDS, balls, told_field

ALONG = straight(150.0)


class Make:
    """The field of a block: balls along its span, all of one class, another in every block."""

    def __init__(self, stop_at: int | None = None) -> None:
        self.made: list[int] = []
        self.stop_at = stop_at

    def __call__(self, block: DriveBlock) -> MeshField:
        if block.index == self.stop_at:
            raise KeyboardInterrupt
        self.made.append(block.index)
        low, high = float(block.span[0, 0]), float(block.span[-1, 0])
        x = torch.arange(low, high + 0.1, 1.0)
        places = torch.stack((x, 0 * x, 0 * x), dim=1).tolist()
        return told_field(balls(places), [block.index % 3] * len(places))


def test_a_drive_comes_back_from_its_file(tmp_path):
    drive = cut_drive(bend() / 3, metres_per_unit=3.0, options=DriveBlockOptions(length=50.0))
    save_drive(drive, tmp_path / "drive.json", about={"seed": 3})
    found = load_drive(tmp_path / "drive.json")
    assert (found.overlap, found.reach, len(found)) == (drive.overlap, drive.reach, len(drive))
    for one, other in zip(found.blocks, drive.blocks, strict=True):
        assert (one.start, one.end) == (other.start, other.end)
        assert torch.equal(one.piece, other.piece)
        assert torch.equal(one.span, other.span)


def test_blocks_are_made_once_and_read_when_asked_for(tmp_path):
    drive, make, told = cut_drive(ALONG), Make(), []
    build_blocks(drive, tmp_path / "f", make, progress=lambda done, of: told.append((done, of)))
    assert make.made == [0, 1, 2]
    assert told == [(1, 3), (2, 3), (3, 3)]
    field = open_blocks(tmp_path / "f")
    assert field.layer("semantic").kind == "labels"
    points = torch.tensor([[10.3, 0.1, 0], [75.2, 0, 0], [140.1, 0, 0], [75, 30, 0]])
    assert field.labels_at(points, "semantic").ids.tolist() == [*IDS, -1]


def test_layers_are_known_before_a_block_is_read(tmp_path, monkeypatch):
    build_blocks(cut_drive(ALONG), tmp_path / "f", Make())
    monkeypatch.setattr(files, "load_mesh_field", None)
    field = open_blocks(tmp_path / "f")
    assert field.layer_names == ("semantic",)
    assert field.layer("semantic").ids == tuple(sorted(IDS))
    assert field.layer("semantic").info.names == {3: "road", 5: "sky", 8: "car"}


def test_a_folder_tells_what_it_is_made_of_and_what_lacks(tmp_path):
    drive, folder = cut_drive(ALONG), tmp_path / "f"
    with pytest.raises(KeyboardInterrupt):
        build_blocks(drive, folder, Make(stop_at=1), about={"seed": 1, "sizes": (2, 3)})
    assert drive_about(folder) == {"seed": 1, "sizes": [2, 3]}
    assert missing_blocks(folder) == (1, 2)
    assert block_file(folder, 0).is_file()
    assert goes_on(drive, folder, about={"seed": 1, "sizes": (2, 3)})
    assert not goes_on(drive, folder, about={"seed": 2, "sizes": (2, 3)})
    assert not goes_on(cut_drive(straight(90.0)), folder, about={"seed": 1, "sizes": (2, 3)})
    assert not goes_on(drive, tmp_path / "none")
    table = folder / "drive.json"
    table.write_text(json.dumps(json.loads(table.read_text()) | {"about": 3}))
    with pytest.raises(FileFormatError, match="expected an object as about, got 3"):
        drive_about(folder)


def test_what_was_stopped_is_gone_on_with(tmp_path):
    drive = cut_drive(ALONG)
    with pytest.raises(KeyboardInterrupt):
        build_blocks(drive, tmp_path / "f", Make(stop_at=2), about={"seed": 1})
    with pytest.raises(
        MissingFileError, match=r"all 3 blocks of the drive, 1 lack, the first 0002"
    ):
        open_blocks(tmp_path / "f")
    again = Make()
    build_blocks(drive, tmp_path / "f", again, about={"seed": 1})
    assert again.made == [2]
    whole = Make()
    build_blocks(drive, tmp_path / "g", whole, about={"seed": 1})
    for index in range(3):
        one, other = (tmp_path / name / f"{index:04d}.safetensors" for name in "fg")
        assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("change", ["about", "cut"])
def test_blocks_of_something_else_are_made_anew(change, tmp_path):
    build_blocks(cut_drive(ALONG), tmp_path, Make(), about={"seed": 1})
    other = DriveBlockOptions(length=60.0) if change == "cut" else None
    drive, make = cut_drive(ALONG, options=other), Make()
    build_blocks(drive, tmp_path, make, about={"seed": 1 if change == "cut" else 2})
    assert make.made == list(range(len(drive)))
    assert len(list(tmp_path.glob("*.safetensors"))) == len(drive)
    assert len(load_drive(tmp_path / "drive.json")) == len(drive)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": "scene"}, "expected a drive, got 'scene'"),
        ({"version": 2}, "version 1, got 2"),
        ({"blocks": 3}, "expected a list of blocks"),
        ({"blocks": []}, "blocks: expected blocks that count from 0"),
        ({"blocks": [4]}, r"blocks\[0\]: expected an object"),
        ({"overlap": 0}, "overlap: expected a positive length"),
        ({"reach": None}, "reach: expected a finite number"),
        ({"start": "x"}, r"blocks\[0\]: start"),
        ({"end": -1}, "start, end: expected a piece"),
        ({"piece": []}, r"blocks\[0\]: piece: expected places of three numbers"),
        ({"span": [[0, 0]]}, r"blocks\[0\]: span: expected places of three numbers"),
        ({"span": [[0, 0, 1e99]]}, r"blocks\[0\]: span: expected a finite number"),
    ],
)
def test_files_of_something_else_are_refused(changes, words, tmp_path):
    path = tmp_path / "drive.json"
    save_drive(cut_drive(straight(10.0)), path)
    content = json.loads(path.read_text())
    for key, value in changes.items():
        at = content["blocks"][0] if key in ("start", "end", "piece", "span") else content
        at[key] = value
    path.write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match=words):
        load_drive(path)


def test_there_is_no_drive(tmp_path: Path):
    with pytest.raises(MissingFileError, match=r"drive\.json"):
        open_blocks(tmp_path)


def test_what_is_no_block_is_refused():
    line = straight(3.0)
    with pytest.raises(ShapeError, match="piece"):
        DriveBlock(index=0, start=0, end=1, piece=line[:, :2], span=line)
    with pytest.raises(RangeError, match="span"):
        DriveBlock(index=0, start=0, end=1, piece=line, span=line * math.nan)
    block = DriveBlock(index=1, start=0, end=1, piece=line, span=line)
    with pytest.raises(InputError, match=r"blocks: expected blocks that count from 0, got \[1\]"):
        DriveBlocks(blocks=(block,), overlap=1.0, reach=1.0)
