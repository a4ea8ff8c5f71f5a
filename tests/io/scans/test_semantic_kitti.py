"""SemanticKITTI and KITTI's odometry: poses of a camera, labels of 32 bits, and faults."""

import numpy as np
import pytest
import torch

from splatseg.core import PointLabels
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.export import write_scan_labels
from splatseg.io.scans import find_scans, read_scans
from support.kitti import numbers, write, write_bin

# The scanner's x ahead is the camera's z; the camera is 0.3 ahead of it and 0.1 below.
TR = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.1], [1, 0, 0, -0.3], [0, 0, 0, 1]])
POINTS = [[5, 0, 0, 0.25], [0, 0, 0, 0], [0, 1, 2, 1.0]]


@pytest.fixture
def root(tmp_path):
    """The camera goes ahead (its z) by 2 a frame."""
    folder = tmp_path / "dataset/sequences/08"
    write(folder / "calib.txt", f"P0: {numbers(np.eye(4)[:3])}\nTr: {numbers(TR[:3])}\n")
    poses = [np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2 * i]]) for i in range(3)]
    write(folder / "poses.txt", "\n".join(map(numbers, poses)) + "\n")
    write(folder / "times.txt", "0.0\n0.103\n0.207\n")
    for frame in range(4):
        write_bin(folder / f"velodyne/{frame:06d}.bin", POINTS)
    for frame in range(2):
        both = np.array([40, 1, 252 + (7 << 16)], "<u4")
        write(folder / f"labels/{frame:06d}.label", both.tobytes())
    return tmp_path / "dataset"


def test_scans_and_labels(root) -> None:
    scans = read_scans(root)
    assert scans.format == "semantic-kitti"
    assert scans.scan_names == ("000000", "000001", "000002")
    assert scans.notes == ("left out: 1 of 4 scans that have no pose",)
    scan = scans.scan("000001")
    # The camera's two ahead are the scanner's two ahead.
    np.testing.assert_allclose(scan.points, [[7, 0, 0], [2, 1, 2]], atol=1e-6)
    np.testing.assert_allclose(scan.origin, [2, 0, 0], atol=1e-6)
    assert scan.labels["semantic"].tolist() == [40, 252]
    assert scan.labels["instance"].tolist() == [-1, 7]
    assert scan.time == pytest.approx(0.103)
    assert scans.scan("000002").labels == {}, "later scans have no file of labels"
    assert scans.classes.name_of(252) == "moving-car"
    assert scan.intensity.tolist() == [0.25, 1]


def test_unlabelled_and_outliers_are_void(root) -> None:
    file = root / "sequences/08/labels/000000.label"
    write(file, np.array([0, 1, 1], "<u4").tobytes())
    assert read_scans(root).scan("000000").labels["semantic"].tolist() == [-1, -1]


def test_labels_are_written_back_in_the_order_of_the_file(root, tmp_path) -> None:
    scans = read_scans(root)
    found = [scans.scan(name) for name in scans.scan_names[:2]]
    said = [
        (scan, PointLabels(ids=scan.labels["semantic"], confidence=torch.ones(len(scan))))
        for scan in found
    ]
    write_scan_labels(said, tmp_path / "out", form="label")
    written = np.frombuffer((tmp_path / "out/000001.label").read_bytes(), "<u4")
    assert written.tolist() == [40, 0, 252]


@pytest.mark.parametrize("place", [".", "sequences", "sequences/08", "sequences/08/velodyne"])
def test_a_sequence_is_named_by_its_folders(place, root) -> None:
    assert find_scans(root / place) == "semantic-kitti"
    assert len(read_scans(root / place)) == 3


def test_without_labels_it_is_the_odometry(root) -> None:
    """Whose poses lie together beside the sequences."""
    folder = root / "sequences/08"
    for file in (folder / "labels").iterdir():
        file.unlink()
    (folder / "labels").rmdir()
    (root / "poses").mkdir()
    (folder / "poses.txt").rename(root / "poses/08.txt")
    (folder / "times.txt").unlink()
    scans = read_scans(root)
    assert (scans.format, scans.classes) == ("kitti-odometry", None)
    scan = scans.scan("000002")
    np.testing.assert_allclose(scan.points[0], [9, 0, 0], atol=1e-6)
    assert (scan.time, dict(scan.labels)) == (None, {})
    with pytest.raises(
        MissingFileError, match="expected a sequence of SemanticKITTI, with velodyn"
    ):
        read_scans(root, format="semantic-kitti")


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("labels/000000.label", b"\0" * 8, r"000000.label: expected 3 labels, one a point, got 2"),
        ("labels/000000.label", b"\0" * 13, r"expected 3 labels, one a point, got 3.25"),
        (
            "labels/000000.label",
            np.array([40, 77, 40], "<u4").tobytes(),
            None,  # the point at the sensor has no return, so its label counts for nothing
        ),
        (
            "labels/000000.label",
            np.array([77, 1, 40], "<u4").tobytes(),
            "32 classes of its table, got id 77 of 1 points",
        ),
        ("velodyne/000000.bin", b"\0" * 17, r"16 bytes each, got 17 bytes; the file is cut short"),
        ("velodyne/000000.bin", np.full((3, 4), np.nan, "<f4").tobytes(), "NaN or infinite"),
    ],
)
def test_damaged_files(file, content, message, root) -> None:
    write(root / "sequences/08" / file, content)
    scans = read_scans(root)
    if message is None:
        assert scans.scan("000000").labels["semantic"].tolist() == [40, 40]
        return
    with pytest.raises(FileFormatError, match=message):
        scans.scan("000000")


@pytest.mark.parametrize(
    ("file", "content", "error", "message"),
    [
        ("poses.txt", None, MissingFileError, "scans without poses are of no use"),
        ("poses.txt", "1 2 3\n", FileFormatError, "expected 12 numbers in row 1"),
        ("poses.txt", "2 " * 12, InputError, r"poses.txt: row 1: expected a rotation"),
        ("calib.txt", "P0: 1 2\n", FileFormatError, "calib.txt: expected a row Tr, got 'P0'"),
        ("calib.txt", "Tr: " + "3 " * 12, InputError, r"calib.txt: Tr: expected a rotation"),
        ("times.txt", "soon\n", FileFormatError, "times.txt: expected 1 numbers in row 1"),
    ],
)
def test_sequences_that_cannot_be(file, content, error, message, root) -> None:
    path = root / "sequences/08" / file
    path.unlink()
    if content is not None:
        write(path, content)
    with pytest.raises(error, match=message):
        read_scans(root)


def test_several_sequences_ask_for_one(root) -> None:
    write(root / "sequences/09/calib.txt", "")
    (root / "sequences/09/velodyne").mkdir()
    with pytest.raises(InputError, match=r"expected one sequence, got 2 \(08, 09\); name one"):
        read_scans(root)
    for path in root.glob("sequences/08/velodyne/*"):
        path.unlink()
    write_bin(root / "sequences/08/velodyne/000077.bin", POINTS)
    with pytest.raises(InputError, match="scans with poses, got 1 scans and 3 poses"):
        read_scans(root / "sequences/08")
