"""Range images, PLY, LAS and arrays: points, ids, pieces, and what is refused."""

import json

import laspy
import numpy as np
import pytest
import torch

from splatseg.core import ClassInfo, ClassTable, Gaussians, ScanSource
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.export import write_points
from splatseg.io.scans import FORMATS, _source, find_scans, read_scans
from support.ply import write_ply

XYZ = np.array([[1.0, 2, 3], [4, 5, 6], [7, 8, 9], [-1, 0, 2]])
AXES = [("float", axis, XYZ[:, i].tolist()) for i, axis in enumerate("xyz")]

# A sensor at (10, 20, 1.5) that looks along +y.
POSE = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 1.5], [0, 0, 0, 1]])


def range_images(folder, **changes):
    """Two scans of two rows (level, 30 degrees down) and three columns (left, ahead, right)."""
    arrays = {
        "range_2mm": np.array([[[500, 0, 1000], [0, 2000, 0]], [[0, 0, 0], [0, 0, 50]]], np.uint16),
        "semantic": np.array([[[1, 0, 2], [0, 0, 0]], [[0, 0, 0], [0, 0, 7]]], np.uint8),
        "instance": np.array([[[5, 0, 0], [0, 9, 0]], [[0, 0, 0], [0, 0, 1]]], np.uint16),
        "intensity": np.arange(12, dtype=np.uint8).reshape(2, 2, 3),
        "lidar_to_world": np.stack([POSE, np.eye(4)]),
        "elevation": np.array([0.0, -np.pi / 6]),
        "azimuth": np.array([np.pi / 2, 0, -np.pi / 2]),
        "time": np.array([0, 2]),
    }
    arrays |= changes
    file = folder / "lidar.npz"
    np.savez(file, **{name: array for name, array in arrays.items() if array is not None})
    return file


def test_range_images(tmp_path) -> None:
    scans = read_scans(range_images(tmp_path))
    assert isinstance(scans, ScanSource)
    assert (scans.format, scans.scan_names, scans.array_shape) == (
        "lidar-npz",
        ("0000", "0001"),
        (2, 2, 3),
    )
    scan = scans.scan("0000")
    # 1 m to the left of a sensor that looks along +y is -x; 2 m to its right is +x.
    down = [10, 20 + 4 * np.cos(np.pi / 6), 1.5 - 4 * np.sin(np.pi / 6)]
    np.testing.assert_allclose(scan.points, [[9, 20, 1.5], [12, 20, 1.5], down], atol=1e-12)
    assert scan.rows.tolist() == [0, 2, 4]
    assert (scan.recorded, scan.time) == (6, 0.0)
    assert scan.origin.tolist() == [10, 20, 1.5]
    assert scan.labels["semantic"].tolist() == [1, 2, -1]
    assert scan.labels["instance"].tolist() == [5, -1, 9]
    assert scan.intensity.tolist() == [0, 2, 4]
    assert scan.recorded_labels(scan.labels["semantic"], 0).tolist() == [1, 0, 2, 0, -1, 0]
    assert scans.scan("0001").labels["semantic"].tolist() == [7]


def test_ranges_in_metres_are_the_same(tmp_path) -> None:
    steps = np.array([[[500, 0, 1000], [0, 2000, 0]], [[0, 0, 0], [0, 0, 50]]])
    other = range_images(tmp_path, range_2mm=None, range=steps * 0.002)
    first = read_scans(other).scan("0000").points
    second = read_scans(range_images(tmp_path)).scan("0000").points
    np.testing.assert_allclose(first, second, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"range_2mm": None, "range": np.full((2, 2, 3), np.nan)}, "6 of 6 that are NaN"),
        ({"range_2mm": None, "range": np.full((2, 2, 3), -1.0)}, "ranges from 0 on, got -1"),
        ({"lidar_to_world": np.full((2, 4, 4), np.nan)}, "finite pose, got 16"),
        ({"lidar_to_world": np.stack([2 * np.eye(4)] * 2)}, "a rotation in its pose"),
        ({"lidar_to_world": np.eye(4)}, "lidar_to_world of shape"),
        ({"semantic": np.zeros((2, 3), np.uint8)}, "semantic of shape"),
        ({"semantic": np.zeros((2, 2, 3))}, "(2, 2, 3) in whole numbers, got float64"),
        ({"elevation": np.zeros(3)}, "elevation of shape"),
        ({"range_2mm": np.zeros((2, 6), np.uint16)}, "shape (scans, rows, columns)"),
    ],
)
def test_broken_range_images(tmp_path, changes, words) -> None:
    file = range_images(tmp_path, **changes)
    with pytest.raises(InputError) as caught:
        read_scans(file).scan("0000")
    assert words in str(caught.value)
    assert str(file) in str(caught.value)


def test_labels_that_the_table_beside_lacks(tmp_path) -> None:
    rows = [{"id": i, "name": f"class {i}"} for i in (1, 2)]
    (tmp_path / "metadata.json").write_text(json.dumps({"classes": rows}))
    scans = read_scans(range_images(tmp_path))
    assert scans.scan("0000").labels["semantic"].tolist() == [1, 2, -1]
    with pytest.raises(FileFormatError, match=r"the 2 classes of its table, got id 7 of 1 points"):
        scans.scan("0001")
    wider = ClassTable(rows=(ClassInfo(id=7, name="seven"),))
    assert read_scans(tmp_path, classes=wider).scan("0001").labels["semantic"].tolist() == [7]


@pytest.mark.parametrize("order", ["little", "big", "ascii"])
def test_ply(tmp_path, order) -> None:
    columns = [
        ("uchar", "red", [1, 2, 3, 4]),
        ("ushort", "semantic", [7, 0, 300, 1]),
        ("int", "instance", [0, 7001, -1, 2]),
        ("float", "intensity", [0.5, 0, 1, 2]),
    ]
    file = write_ply({"vertex": [*AXES, *columns]}, tmp_path / "a.ply", order=order)
    scans = read_scans(file)
    assert (scans.format, scans.scan_names) == ("ply", ("a",))
    scan = scans.scan("a")
    assert scan.points.tolist() == XYZ.tolist()
    assert scan.labels["semantic"].tolist() == [7, -1, 300, 1]
    assert scan.labels["instance"].tolist() == [-1, 7001, -1, 2]
    assert scan.intensity.tolist() == [0.5, 0, 1, 2]
    assert (scan.rows, scan.origin, scan.recorded) == (None, None, 4)


@pytest.mark.parametrize("name", ["class_id", "label", "class", "scalar_Classification"])
def test_names_of_labels_in_ply(tmp_path, name) -> None:
    file = write_ply({"vertex": [*AXES, ("float", name, [2.0, 0, 5, 1])]}, tmp_path / "a.ply")
    assert read_scans(file).scan("a").labels["semantic"].tolist() == [2, -1, 5, 1]


def test_a_long_file_comes_in_pieces(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(_source, "PIECE", 3)
    columns = [*AXES, ("uchar", "semantic", [1, 2, 3, 4])]
    write_ply({"vertex": columns}, tmp_path / "a.ply")
    write_ply({"vertex": columns}, tmp_path / "b.ply", order="ascii")
    np.savez(tmp_path / "c.npz", xyz=XYZ, semantic=np.arange(4))
    scans = read_scans(tmp_path)
    assert scans.scan_names == ("a_0000", "a_0001", "b_0000", "b_0001")
    for stem in "ab":
        assert len(scans.scan(f"{stem}_0000")) == 3
        last = scans.scan(f"{stem}_0001")
        assert last.points.tolist() == [XYZ[3].tolist()]
        assert last.labels["semantic"].tolist() == [4]
    arrays = read_scans(tmp_path / "c.npz")
    assert [len(arrays.scan(name)) for name in arrays.scan_names] == [3, 1]
    assert arrays.scan("c_0001").labels["semantic"].tolist() == [3]


def test_arrays(tmp_path) -> None:
    np.save(tmp_path / "a.npy", np.concatenate((XYZ, XYZ), axis=1).astype(np.float32))
    assert read_scans(tmp_path / "a.npy").scan("a").points.tolist() == XYZ.tolist()
    np.savez(tmp_path / "b.npz", points=XYZ, instance=np.arange(4), intensity=np.ones(4))
    scan = read_scans(tmp_path / "b.npz").scan("b")
    assert scan.labels["instance"].tolist() == [-1, 1, 2, 3]
    assert scan.intensity.tolist() == [1] * 4


def write_las(path, classification, version="1.4", point_format=6, extra=None) -> None:
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales = np.full(3, 0.001)
    if extra is not None:
        header.add_extra_dim(laspy.ExtraBytesParams(name="class_id", type=np.int32))
    las = laspy.LasData(header)
    las.xyz = XYZ
    las.classification = np.array(classification, np.uint8)
    las.intensity = np.array([9, 8, 7, 6], np.uint16)
    if extra is not None:
        las["class_id"] = np.array(extra, np.int32)
    las.write(str(path))


@pytest.mark.parametrize("ending", ["las", "laz"])
@pytest.mark.parametrize(("version", "point_format"), [("1.2", 1), ("1.4", 6)])
def test_las(tmp_path, ending, version, point_format, monkeypatch) -> None:
    monkeypatch.setattr(_source, "PIECE", 3)
    write_las(tmp_path / f"a.{ending}", [2, 0, 1, 6], version, point_format)
    scans = read_scans(tmp_path)
    assert (scans.format, scans.scan_names) == ("las", ("a_0000", "a_0001"))
    scan = scans.scan("a_0000")
    np.testing.assert_allclose(scan.points, XYZ[:3], atol=1e-9)
    # Never classified and unclassified are both nothing.
    assert scan.labels["semantic"].tolist() == [2, -1, -1]
    assert scan.intensity.tolist() == [9, 8, 7]
    assert scans.scan("a_0001").labels["semantic"].tolist() == [6]


def test_class_ids_of_our_own_las_count(tmp_path) -> None:
    gaussians = Gaussians(
        means=torch.from_numpy(XYZ).float(),
        rotations=torch.eye(4)[:1].expand(4, 4).clone(),
        scales=torch.full((4, 3), 0.1),
        opacities=torch.full((4,), 0.5),
        sh=torch.zeros(4, 1, 3),
    )
    ids = torch.tensor([0, 1, 2, 70], dtype=torch.int32)
    write_points(gaussians, tmp_path / "a.las", columns={"class_id": ids})
    scan = read_scans(tmp_path / "a.las").scan("a")
    assert scan.labels["semantic"].tolist() == [-1, 1, 2, 70]
    np.testing.assert_allclose(scan.points, gaussians.means, atol=1e-6)


def damaged(folder, kind):
    """A file of points with a fault, by its kind."""
    if kind == "ply-short":
        file = write_ply({"vertex": AXES}, folder / "a.ply")
        file.write_bytes(file.read_bytes()[:-1])
        return file
    if kind == "ply-nan":
        columns = [*AXES[:2], ("float", "z", [0.0, float("nan"), 1, 2])]
        return write_ply({"vertex": columns}, folder / "a.ply")
    if kind == "ply-no-z":
        return write_ply({"vertex": AXES[:2]}, folder / "a.ply")
    if kind == "ply-half-id":
        return write_ply({"vertex": [*AXES, ("float", "label", [1.5] * 4)]}, folder / "a.ply")
    if kind == "npz-labels":
        np.savez(folder / "a.npz", xyz=XYZ, semantic=np.arange(3))
        return folder / "a.npz"
    if kind == "npz-shape":
        np.savez(folder / "a.npz", xyz=XYZ[:, :2])
        return folder / "a.npz"
    if kind == "npy-inf":
        np.save(folder / "a.npy", np.where(XYZ == 5, np.inf, XYZ))
        return folder / "a.npy"
    write_las(folder / "a.las", [2] * 4)
    content = (folder / "a.las").read_bytes()
    (folder / "a.las").write_bytes(content[:-40] if kind == "las-short" else content[:100])
    return folder / "a.las"


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("ply-short", "the file ends early"),
        ("ply-nan", "got 1 of 4 that are NaN or infinite, the first at point 1"),
        ("ply-no-z", "vertex with x, y and z, got 'x, y'"),
        ("ply-half-id", "whole ids (semantic), got 1.5"),
        ("npz-labels", "semantic of shape (4,) in whole numbers, got int64 of (3,)"),
        ("npz-shape", "xyz of shape (n, 3)"),
        ("npy-inf", "NaN or infinite"),
        ("las-short", "expected 4 points, but the file ends early"),
        ("las-header", "a LAS file"),
    ],
)
def test_damaged_files_in_a_sentence(tmp_path, kind, words) -> None:
    file = damaged(tmp_path, kind)
    with pytest.raises(FileFormatError) as caught:
        read_scans(file).scan("a")
    assert words in str(caught.value)
    assert str(caught.value).startswith(str(file))


def test_what_is_not_there(tmp_path) -> None:
    with pytest.raises(MissingFileError, match="no such folder or file of scans"):
        read_scans(tmp_path / "nothing")
    with pytest.raises(InputError, match=r"expected scans of a laser \(lidar-npz, .*\), got none"):
        read_scans(tmp_path)
    with pytest.raises(InputError, match="format: expected one of auto, lidar-npz"):
        read_scans(tmp_path, format="dxf")
    for format in FORMATS:
        with pytest.raises(MissingFileError, match=str(tmp_path)):
            read_scans(tmp_path, format=format)
    scans = read_scans(range_images(tmp_path))
    with pytest.raises(InputError, match=r"no '0007' among 2 of .* \(0001, 0000\)|\(0000, 0001\)"):
        scans.scan("0007")


def test_the_folder_of_a_street_is_its_laser_and_not_its_points(tmp_path) -> None:
    range_images(tmp_path)
    write_ply({"vertex": AXES}, tmp_path / "points3D.ply")
    assert find_scans(tmp_path) == "lidar-npz"
    assert read_scans(tmp_path, format="ply").scan_names == ("points3D",)


def test_two_files_of_one_name(tmp_path) -> None:
    write_las(tmp_path / "a.las", [2] * 4)
    write_las(tmp_path / "a.laz", [2] * 4)
    with pytest.raises(InputError, match="distinct names, got 'a' more than once"):
        read_scans(tmp_path)


def test_a_rendered_street(shared_data) -> None:
    """The scans of the shared street: points lie on what its depth maps show."""
    scans = read_scans(shared_data / "street")
    total = [scans.scan(name) for name in scans.scan_names]
    assert (len(total), sum(map(len, total))) == (35, 1_472_976)
    ids = torch.cat([scan.labels["semantic"] for scan in total])
    assert int((ids == 7).sum()) == 52
