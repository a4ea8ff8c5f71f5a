"""Fields of drives in blocks, in memory and on disk."""

import itertools
import json
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from splatseg.core import Camera, Executor, PointLabels, Renderable, ScanSource
from splatseg.errors import FileFormatError, InputError, MissingFileError, RangeError, ShapeError
from splatseg.street import files
from splatseg.street.block_field import DriveField, DriveScans, WeightedLabels, joined
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
from street.blocks.support import NumberedScans, Opener, Says, bend, crossing, own_number, straight
from support.mesh_fields import IDS, balls, told_field


def on_line(*x: float) -> torch.Tensor:
    return torch.tensor([[at, 0.0, 0.0] for at in x], dtype=torch.float64)


def by_place(block: int, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """What all blocks agree on: a class every 7 m, and how sure they are by the place."""
    ids = 1 + (points[:, 0] // 7).long() % 3
    return ids, 0.5 + 0.4 * torch.sin(points[:, 0] / 5)


def test_a_point_takes_the_blend_of_its_blocks():
    """Block 0 says 1 with 0.8, block 1 says 2 with 0.4: equal at a weight of a third."""

    def says(block: int, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        n = len(points)
        return torch.full((n,), block + 1), torch.full((n,), (0.8, 0.4)[block])

    field = DriveField(cut_drive(straight(100.0)), Opener(says))
    # The overlap is from 40 to 60; block 0 counts (60 - x) / 20.
    found = field.labels_at(on_line(30, 45, 53, 54, 59, 70), "classes")
    assert found.ids.tolist() == [1, 1, 1, 2, 2, 2]
    expected = [0.8, 0.8 * 0.75, 0.8 * 0.35, 0.4 * 0.7, 0.4 * 0.95, 0.4]
    torch.testing.assert_close(found.confidence, torch.tensor(expected))


def test_blocks_that_agree_add_up():
    field = DriveField(cut_drive(straight(200.0)), Opener(by_place))
    points = torch.rand(500, 3, dtype=torch.float64) * torch.tensor([200.0, 10, 3])
    found = field.labels_at(points, "classes")
    ids, confidence = by_place(0, points)
    assert torch.equal(found.ids, ids.int())
    torch.testing.assert_close(found.confidence, confidence.float())


def test_a_block_that_knows_nothing_leaves_it_to_the_other():
    def says(block: int, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        n = len(points)
        return (torch.full((n,), -1), torch.zeros(n)) if block else (torch.ones(n), torch.ones(n))

    field = DriveField(cut_drive(straight(100.0)), Opener(says))
    found = field.labels_at(on_line(45, 59, 61), "classes")
    assert found.ids.tolist() == [1, 1, -1]
    torch.testing.assert_close(found.confidence, torch.tensor([0.75, 0.05, 0.0]))


def test_labels_do_not_depend_on_who_asks_with_whom(rng):
    """The block-boundary test: one point, alone, in any company, in any order, from any side."""
    drive = cut_drive(crossing(500.0))

    def says(block: int, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        ids = 1 + (points[:, 0] / 3 + block).long().abs() % 3
        return ids, 0.5 + 0.5 * torch.sin(points[:, 1] + block)

    points = torch.from_numpy(rng.uniform(-130, 130, size=(400, 3)) * [1, 0.5, 0.02])
    whole = DriveField(drive, Opener(says)).labels_at(points, "classes")
    order = torch.from_numpy(rng.permutation(400))
    turned = DriveField(drive, Opener(says)).labels_at(points[order], "classes")
    assert torch.equal(turned.ids, whole.ids[order])
    assert torch.equal(turned.confidence, whole.confidence[order])
    alone = DriveField(drive, Opener(says), max_open=1)
    for i in range(0, 400, 13):
        one = alone.labels_at(points[i : i + 1], "classes")
        assert one.ids[0] == whole.ids[i]
        assert one.confidence[0] == whole.confidence[i]


def test_nothing_jumps_where_blocks_meet():
    """Each block is as sure as it is everywhere: confidences go over without a step."""

    def says(block: int, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        n = len(points)
        return torch.ones(n), torch.full((n,), (0.9, 0.3)[block])

    field = DriveField(cut_drive(straight(100.0)), Opener(says))
    x = torch.linspace(0, 100, 10_001)
    points = torch.stack((x, 3 + 0 * x, 0 * x), dim=1)
    confidence = field.labels_at(points, "classes").confidence
    assert float((confidence[1:] - confidence[:-1]).abs().max()) < 1e-3
    assert confidence[0] == pytest.approx(0.9)
    assert confidence[-1] == pytest.approx(0.3)


def test_one_block_says_what_it_says(rng):
    """A drive that is not cut: the same ids and confidences to the last bit, -1 included."""
    drive = cut_drive(straight(60.0))
    ids = torch.from_numpy(rng.integers(-1, 4, size=300)).int()
    sure = torch.from_numpy(rng.random(300)).float()
    sure[::5] = 0
    field = DriveField(drive, Opener(lambda block, points: (ids, sure)))
    found = field.labels_at(torch.from_numpy(rng.uniform(-99, 99, (300, 3))), "classes")
    assert torch.equal(found.ids, ids)
    assert torch.equal(found.confidence, sure)
    scans = NumberedScans(straight(60.0, step=5.0))
    single = DriveField(drive, Opener(by_place))
    for name, labels in single.labels_of_scans(scans, "classes"):
        at = scans.scan(name).points
        expected = Says(drive.blocks[0], by_place).labels_at(at, "classes")
        assert torch.equal(labels.ids, expected.ids)
        assert torch.equal(labels.confidence, expected.confidence)


def test_equal_sums_go_to_the_smaller_id_and_no_label_loses_them():
    rows = torch.tensor([0, 1, 2])
    half = torch.full((3,), 0.5, dtype=torch.float64)
    parts = [
        WeightedLabels(rows=rows, ids=torch.tensor([5, -1, 4]), shares=half),
        WeightedLabels(rows=rows, ids=torch.tensor([2, 9, -1]), shares=half),
    ]
    for order in itertools.permutations(parts):
        found = joined(list(order), 4)
        assert found.ids.tolist() == [2, 9, 4, -1]
        assert found.confidence.tolist() == [0.5, 0.5, 0.5, 0.0]


@pytest.mark.parametrize("max_open", [1, 2, 3])
def test_few_blocks_are_in_memory(max_open):
    opener = Opener(by_place)
    field = DriveField(cut_drive(straight(1000.0)), opener, max_open=max_open)
    points = torch.rand(2000, 3, dtype=torch.float64) * torch.tensor([1000.0, 5, 1])
    field.labels_at(points, "classes")
    assert opener.opened == list(range(17))
    assert opener.most == max_open


def test_fields_that_are_held_are_not_opened_again():
    opener = Opener(by_place)
    field = DriveField(cut_drive(straight(200.0)), opener, max_open=2)
    for x in (10, 60, 10, 60, 45, 110, 60, 10):
        field.labels_at(on_line(x), "classes")
    assert opener.opened == [0, 1, 2, 0]


def test_scans_are_labelled_block_by_block():
    """Each block is opened once, each scan comes in its order, labelled as points are."""
    places = straight(600.0, step=8.0)
    drive, scans, opener = cut_drive(places), NumberedScans(places), Opener(by_place)
    field = DriveField(drive, opener, max_open=1)
    found = dict(field.labels_of_scans(scans, "classes"))
    assert list(found) == list(scans.scan_names)
    assert opener.opened == list(range(len(drive)))
    assert opener.most == 1
    again = DriveField(drive, Opener(by_place))
    for scan in scans:
        expected = again.labels_at(scan.points, "classes")
        assert torch.equal(found[scan.name].ids, expected.ids)
        assert torch.equal(found[scan.name].confidence, expected.confidence)


def test_scans_come_as_soon_as_their_blocks_have_spoken(tmp_path):
    """When the first scans of block 2 come, block 5 was not opened; no file is left behind."""
    places = straight(600.0, step=8.0)
    opener = Opener(by_place)
    field = DriveField(cut_drive(places), opener)
    scans = DriveScans(NumberedScans(places), cut_drive(places))
    for name, _ in field.labels_of_scans(scans, "classes", work=tmp_path):
        assert max(opener.opened) <= 8 * int(name) / 60 + 2
        assert len(list(tmp_path.glob("*/*.npy"))) < 40
    assert list(tmp_path.iterdir()) == []


def test_a_drive_that_comes_back_waits_for_its_last_block():
    """At the crossing blocks of both passes count; scans still come in their order."""
    line = crossing(500.0)
    drive, scans = cut_drive(line), NumberedScans(line[::20])
    found = dict(DriveField(drive, Opener(own_number)).labels_of_scans(scans, "classes"))
    assert list(found) == list(scans.scan_names)
    again = DriveField(drive, Opener(own_number))
    for scan in scans:
        assert torch.equal(found[scan.name].ids, again.labels_at(scan.points, "classes").ids)


def test_a_field_that_labels_scans_is_asked_for_scans():
    class Windows(Says):
        def labels_of_scans(
            self, scans: ScanSource, layer: str, *, executor: Executor
        ) -> Iterator[tuple[str, PointLabels]]:
            names = list(scans.scan_names)
            for name in names:  # all are read before any is labelled, as windows are
                scans.scan(name)
            for name in names:
                points = scans.scan(name).points
                ids = torch.full((len(points),), 7, dtype=torch.int32)
                yield name, PointLabels(ids=ids, confidence=torch.ones(len(points)))

    places = straight(300.0, step=10.0)
    field = DriveField(cut_drive(places), Opener(by_place, Windows))
    for _, labels in field.labels_of_scans(NumberedScans(places), "classes"):
        assert set(labels.ids.tolist()) == {7}
        torch.testing.assert_close(labels.confidence, torch.ones(len(labels.ids)))


def test_scans_without_points_have_no_labels():
    scans = NumberedScans(straight(40.0, step=20.0), points=0)
    field = DriveField(cut_drive(straight(40.0)), Opener(by_place))
    found = dict(field.labels_of_scans(scans, "classes"))
    assert [len(labels.ids) for labels in found.values()] == [0, 0, 0]


def test_layers_are_those_of_all_blocks():
    opener = Opener(by_place, ids=lambda block: (block, 9))
    field = DriveField(cut_drive(straight(200.0)), opener, max_open=1)
    assert isinstance(field, Renderable)
    assert field.layer_names == ("classes",)
    assert field.layer("classes").ids == (0, 1, 2, 3, 9)
    assert field.layer("classes").info.method == "said"
    assert opener.opened == [0, 1, 2, 3]
    with pytest.raises(InputError, match="expected one of classes, got 'colours'"):
        field.layer("colours")


def test_layers_that_are_told_open_nothing():
    opener = Opener(by_place)
    told = Says(cut_drive(straight(9.0)).blocks[0], by_place).layer("classes")
    field = DriveField(cut_drive(straight(200.0)), opener, layers={"classes": told})
    assert field.layer("classes") is told
    assert opener.opened == []


def test_a_view_is_that_of_the_block_of_its_camera():
    field = DriveField(cut_drive(straight(200.0)), Opener(by_place))
    for x, block in ((10.0, 0), (49.0, 0), (51.0, 1), (190.0, 3)):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = -x
        camera = Camera(width=4, height=4, fx=4, fy=4, cx=2, cy=2, cam_from_world=pose)
        with pytest.raises(KeyError, match=str(block)):
            field.view(camera)


def test_what_cannot_be_is_refused():
    drive = cut_drive(straight(60.0))
    with pytest.raises(RangeError, match="max_open: expected at least 1"):
        DriveField(drive, Opener(by_place), max_open=0)
    field = DriveField(drive, Opener(by_place))
    with pytest.raises(ShapeError, match="points"):
        field.labels_at(torch.zeros(4, 2), "classes")
    with pytest.raises(RangeError, match="points"):
        field.labels_at(torch.tensor([[0.0, 0, torch.nan]]), "classes")


def test_the_overlap_decides_where_blocks_blend():
    points = on_line(46)
    for overlap, weight in ((20.0, 0.7), (10.0, 0.9)):
        options = DriveBlockOptions(length=80.0, overlap=overlap)
        field = DriveField(cut_drive(straight(100.0), options=options), Opener(own_number))
        assert field.labels_at(points, "classes").confidence.item() == pytest.approx(weight)


# Blocks made one by one into a folder, and read from it when they are needed.


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
    with pytest.raises(FileFormatError, match="about: expected an object, got 3"):
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
        ({"version": 2}, "version 1 or less, got version 2"),
        ({"blocks": 3}, "blocks: expected a list, got 3"),
        ({"blocks": []}, "blocks: expected blocks that count from 0"),
        ({"blocks": [4]}, r"blocks\[0\]: expected an object"),
        ({"overlap": 0}, "overlap: expected a positive length"),
        ({"reach": None}, "reach: expected a number, got"),
        ({"start": "x"}, r"blocks\[0\]\.start: expected a number"),
        ({"end": -1}, "start, end: expected a piece"),
        ({"piece": []}, r"blocks\[0\]\.piece: expected a list of length at least 1"),
        ({"span": [[0, 0]]}, r"blocks\[0\]\.span\[0\]: expected a list of length 3"),
        ({"span": [[0, 0, 1e99]]}, r"blocks\[0\]\.span\[0\]\[2\]: expected a finite number"),
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
