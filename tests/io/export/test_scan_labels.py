"""Labels of scans in files: in the order of the scans' own files, counted, whole or not at all."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import PointLabels, Scan
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.io.export import write_scan_labels, write_scan_points
from splatseg.io.ply import read_ply_header, read_ply_tables


def scans(ids: list[int] | None = None) -> Iterator[tuple[Scan, PointLabels]]:
    """Two scans of 4 recorded values; of the first two had no return."""
    first = Scan(name="a/0", points=torch.eye(3)[:2] + 5e6, rows=torch.tensor([1, 3]), recorded=4)
    yield first, PointLabels(ids=torch.tensor(ids or [7, -1]), confidence=torch.tensor([0.5, 0.0]))
    second = Scan(name="b", points=torch.zeros(4, 3))
    yield second, PointLabels(ids=torch.tensor([2, 2, -1, 7]), confidence=torch.full((4,), 0.25))


def test_arrays_have_the_order_of_the_file(tmp_path: Path) -> None:
    counts = write_scan_labels(scans(), tmp_path / "out", about={"classes": {"7": "car"}})
    with np.load(tmp_path / "out/a/0.npz", allow_pickle=False) as found:
        assert found["semantic"].tolist() == [0, 7, 0, 0]
        assert found["semantic"].dtype == np.int32
        assert found["confidence"].tolist() == [0, 0.5, 0, 0]
    with np.load(tmp_path / "out/b.npz", allow_pickle=False) as found:
        assert found["semantic"].tolist() == [2, 2, 0, 7]
    assert (counts.scans, counts.points, counts.unlabelled) == (2, 6, 2)
    assert counts.ids == {2: 2, 7: 2}
    record = json.loads((tmp_path / "out/labels.json").read_text())
    assert record["points_by_id"] == {"2": 2, "7": 2}
    assert (record["points"], record["unlabelled"]) == (6, 2)
    assert record["classes"] == {"7": "car"}


def test_scans_of_one_array_become_one_of_its_shape(tmp_path: Path) -> None:
    write_scan_labels(scans(), tmp_path / "out", array_shape=(2, 2, 2))
    with np.load(tmp_path / "out/labels.npz", allow_pickle=False) as found:
        assert found["semantic"].tolist() == [[[0, 7], [0, 0]], [[2, 2], [0, 7]]]
        assert found["confidence"].shape == (2, 2, 2)
    with pytest.raises(ShapeError, match="^array_shape: "):
        write_scan_labels(scans(), tmp_path / "bad", array_shape=(3, 2, 2))
    assert not (tmp_path / "bad").exists()


def test_label_files_are_semantickittis(tmp_path: Path) -> None:
    write_scan_labels(scans(), tmp_path / "out", form="label")
    assert (tmp_path / "out/a/0.label").read_bytes() == np.array([0, 7, 0, 0], "<u4").tobytes()
    with pytest.raises(InputError, match="^form: expected ids up to 65535 for .label files"):
        write_scan_labels(scans([70000, -1]), tmp_path / "bad", form="label")


def test_ply_keeps_the_digits_of_coordinates(tmp_path: Path) -> None:
    write_scan_labels(scans(), tmp_path / "out", form="ply")
    path = tmp_path / "out/a/0.ply"
    vertex = read_ply_tables(path, read_ply_header(path), ["vertex"])["vertex"].numbers
    assert vertex["x"].tolist() == [5000001.0, 5000000.0]
    assert vertex["x"].dtype == np.float64
    assert vertex["class_id"].tolist() == [7, 0]
    assert vertex["confidence"].tolist() == [0.5, 0.0]


def test_las_has_the_class_in_its_byte(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    write_scan_labels(scans(), tmp_path / "out", form="las")
    found = laspy.read(tmp_path / "out/a/0.las")
    assert found.classification.tolist() == [70, 0]
    np.testing.assert_allclose(np.asarray(found.xyz)[0], [5000001, 5000000, 5000000], atol=1e-5)
    record = json.loads((tmp_path / "out/labels.json").read_text())
    assert record["las_classification"] == {"2": 65, "7": 70}


def test_others_folders_are_left_alone_and_earlier_labels_replaced(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/diary.txt").write_text("dear")
    with pytest.raises(InputError, match="expected a new or empty folder"):
        write_scan_labels(scans(), tmp_path / "mine")
    write_scan_labels(scans(), tmp_path / "out")
    write_scan_labels(scans(), tmp_path / "out", form="label")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a", "b.label", "labels.json"]


def test_a_label_too_few_is_refused(tmp_path: Path) -> None:
    short = PointLabels(ids=torch.zeros(1).int(), confidence=torch.zeros(1))
    with pytest.raises(ShapeError, match="^labels: "):
        write_scan_labels([(Scan(name="b", points=torch.zeros(4, 3)), short)], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_points_are_checked(tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="^points: "):
        write_scan_points(torch.zeros(3), tmp_path / "a.ply", columns={})
    with pytest.raises(RangeError, match="^points: "):
        write_scan_points(torch.full((1, 3), torch.nan), tmp_path / "a.ply", columns={})
    with pytest.raises(InputError, match=r"^columns\['a'\]: expected 1 values"):
        write_scan_points(torch.zeros(1, 3), tmp_path / "a.ply", columns={"a": torch.zeros(2)})
    with pytest.raises(InputError, match="to end in .ply, .las or .laz"):
        write_scan_points(torch.zeros(1, 3), tmp_path / "a.txt", columns={})
