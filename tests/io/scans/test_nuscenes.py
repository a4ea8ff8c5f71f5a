"""nuScenes: tables that name each other, key frames of the laser in the world, labels."""

import json
from pathlib import Path

import numpy as np
import pytest

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.scans import find_scans, read_scans

VERSION = "v1.0-mini"
STEM = "n008-2018-08-01-15-16-36-0400__LIDAR_TOP__"
TIMES = {"a": 1533151603547590, "b": 1533151604048025, "sweep": 1533151603597590}
KINDS = {"a": "samples", "b": "samples", "sweep": "sweeps"}
POINTS = np.array([[1, 0, 0, 7, 0], [0, 2, 0, 8, 1], [0, 0, 0, 0, 2], [0, 0, 3, 9, 31]], np.float32)
LABELS = np.array([24, 17, 0, 0], np.uint8)
HALF = float(np.sqrt(0.5))


def tables():
    """One scene of two key frames; the laser is turned by a quarter, and the car by another."""
    data = [
        {
            "token": name,
            "sample_token": "s-b" if name == "b" else "s-a",
            "ego_pose_token": f"e-{name}",
            "calibrated_sensor_token": "c-lidar",
            "filename": f"{KINDS[name]}/LIDAR_TOP/{STEM}{time}.pcd.bin",
            "fileformat": "pcd",
            "width": 0,
            "height": 0,
            "timestamp": time,
            "is_key_frame": name != "sweep",
            "next": "",
            "prev": "",
        }
        for name, time in TIMES.items()
    ]
    camera = dict(data[0], token="cam", calibrated_sensor_token="c-cam", ego_pose_token="e-cam")
    camera["filename"] = "samples/CAM_FRONT/x.jpg"
    poses = [
        {"token": f"e-{n}", "translation": [600.0 + i, 1600.0, 0.0], "rotation": [HALF, 0, 0, HALF]}
        for i, n in enumerate(("a", "b", "sweep", "cam"))
    ]
    return {
        "sensor": [
            {"token": "cam", "channel": "CAM_FRONT", "modality": "camera"},
            {"token": "lidar", "channel": "LIDAR_TOP", "modality": "lidar"},
        ],
        "calibrated_sensor": [
            {"token": "c-cam", "sensor_token": "cam", "translation": [1, 0, 1],
             "rotation": [1, 0, 0, 0], "camera_intrinsic": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},
            {"token": "c-lidar", "sensor_token": "lidar", "translation": [0.5, 0, 1.8],
             "rotation": [HALF, 0, 0, -HALF], "camera_intrinsic": []},
        ],
        "ego_pose": poses,
        # As in the data set the rows are in no order.
        "sample_data": [data[1], camera, data[2], data[0]],
        "sample": [
            {"token": "s-a", "timestamp": TIMES["a"], "scene_token": "one",
             "next": "s-b", "prev": ""},
            {"token": "s-b", "timestamp": TIMES["b"], "scene_token": "one",
             "next": "", "prev": "s-a"},
        ],
        "scene": [{"token": "one", "name": "scene-0061", "description": "Parked é",
                   "log_token": "l"}],
        "lidarseg": [
            {"token": "a", "sample_data_token": "a",
             "filename": f"lidarseg/{VERSION}/a_lidarseg.bin"},
            {"token": "b", "sample_data_token": "b",
             "filename": f"lidarseg/{VERSION}/b_lidarseg.bin"},
        ],
        "category": [
            {"token": "0", "name": "noise", "description": "", "index": 0},
            {"token": "1", "name": "vehicle.car", "description": "", "index": 17},
            {"token": "2", "name": "flat.driveable_surface", "description": "", "index": 24},
        ],
    }  # fmt: skip


def write(root: Path, **changes):
    """The folder; a table of None is left out."""
    for name, rows in (tables() | changes).items():
        file = root / VERSION / f"{name}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        if rows is not None:
            file.write_text(json.dumps(rows, indent=0), encoding="utf-8")
    for name in ("a", "b"):
        points = root / "samples" / "LIDAR_TOP" / f"{STEM}{TIMES[name]}.pcd.bin"
        points.parent.mkdir(parents=True, exist_ok=True)
        points.write_bytes(POINTS.tobytes())
    labels = root / "lidarseg" / VERSION
    labels.mkdir(parents=True, exist_ok=True)
    (labels / "a_lidarseg.bin").write_bytes(LABELS.tobytes())
    (labels / "b_lidarseg.bin").write_bytes(LABELS[::-1].tobytes())
    return root


def test_key_frames_of_the_laser(tmp_path) -> None:
    scans = read_scans(write(tmp_path))
    assert (find_scans(tmp_path), scans.format) == ("nuscenes", "nuscenes")
    assert scans.scan_names == tuple(f"scene-0061/{TIMES[name]}" for name in "ab")
    scan = scans.scan(scans.scan_names[1])
    # The turns of laser and car cancel; the laser is half a metre ahead of the car, along +y.
    at = np.array([601.0, 1600.5, 1.8])
    np.testing.assert_allclose(scan.origin, at, atol=1e-9)
    expected = at + np.array([[1, 0, 0], [0, 2, 0], [0, 0, 3]])
    np.testing.assert_allclose(scan.points, expected, atol=1e-9)
    # The value at the laser itself is no return.
    assert (scan.rows.tolist(), scan.recorded) == ([0, 1, 3], 4)
    assert scan.intensity.tolist() == [7, 8, 9]
    assert scan.labels["semantic"].tolist() == [-1, -1, 24]
    assert scans.scan(scans.scan_names[0]).labels["semantic"].tolist() == [24, 17, -1]
    assert scan.time == pytest.approx(TIMES["b"] / 1e6)
    assert [(row.id, row.name, row.isthing) for row in scans.classes.rows] == [
        (17, "vehicle.car", True),
        (24, "flat.driveable_surface", False),
    ]


def test_without_lidarseg_there_are_no_labels(tmp_path) -> None:
    rows = [{"token": "1", "name": "vehicle.car", "description": ""}]
    scans = read_scans(write(tmp_path, lidarseg=None, category=rows))
    assert (scans.classes, dict(scans.scan(scans.scan_names[0]).labels)) == (None, {})


def test_label_files_that_were_never_published(tmp_path) -> None:
    """The tables of the test split name them."""
    write(tmp_path)
    (tmp_path / "lidarseg" / VERSION / "a_lidarseg.bin").unlink()
    scans = read_scans(tmp_path)
    assert [list(scans.scan(name).labels) for name in scans.scan_names] == [[], ["semantic"]]


def changed(table, key, value, row=0):
    rows = tables()[table]
    rows[row] = {name: v for name, v in rows[row].items() if name != key}
    if value is not None:
        rows[row][key] = value
    return {table: rows}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"ego_pose": None}, "ego_pose.json: there is no such file"),
        ({"ego_pose": []}, "expected ego_pose_token of a row that is there, got 'e-"),
        ({"sample": []}, "expected sample_token of a row that is there"),
        ({"scene": []}, "expected scene_token of a row that is there"),
        ({"sample_data": []}, "expected key frames of LIDAR_TOP, got none"),
        ({"sensor": {"token": "a"}}, "expected a JSON list of objects"),
        ({"sensor": [1]}, "expected a list of JSON objects, got 1 in it"),
        (
            changed("ego_pose", "translation", None),
            "ego_pose.json: row 0: expected a field translation",
        ),
        (
            changed("ego_pose", "translation", [1, 2]),
            "translation: expected a list of length 3, got a list of 2",
        ),
        (changed("ego_pose", "translation", [1, 2, float("nan")]), "expected a finite number"),
        (changed("ego_pose", "rotation", [0, 0, 0, 0]), "a unit quaternion as rotation"),
        (changed("ego_pose", "token", "e-b"), "row 1: expected a token of its own, got 'e-b'"),
        (
            changed("sample_data", "filename", "../x.pcd.bin"),
            "expected the name of a file below it",
        ),
        (changed("sample_data", "timestamp", "now"), "timestamp: expected a whole number"),
        (changed("category", "index", 17, row=2), "expected distinct indices"),
        (changed("category", "index", 300, row=2), "index: expected a whole number"),
    ],
)
def test_broken_tables(tmp_path, changes, words) -> None:
    with pytest.raises(InputError) as caught:
        read_scans(write(tmp_path, **changes))
    assert words in str(caught.value)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("samples", POINTS.tobytes()[:-3], "77 bytes; the file is cut short"),
        ("samples", POINTS[:3].tobytes(), "expected 3 labels, one a point, got 4"),
        ("samples", None, "there is no such file"),
        ("lidarseg", LABELS[1:].tobytes(), "expected 4 labels, one a point, got 3"),
        ("lidarseg", bytes([24, 3, 0, 0]), "of the 2 classes of its table, got id 3 of 1 points"),
        ("samples", np.full_like(POINTS, np.nan).tobytes(), "4 of 4 that are NaN"),
    ],
)
def test_broken_files(tmp_path, file, content, words) -> None:
    write(tmp_path)
    paths = {
        "samples": tmp_path / "samples" / "LIDAR_TOP" / f"{STEM}{TIMES['a']}.pcd.bin",
        "lidarseg": tmp_path / "lidarseg" / VERSION / "a_lidarseg.bin",
    }
    if content is None:
        paths[file].unlink()
    else:
        paths[file].write_bytes(content)
    scans = read_scans(tmp_path)
    with pytest.raises(FileFormatError if content is not None else MissingFileError) as caught:
        scans.scan(scans.scan_names[0])
    assert words in str(caught.value)


def test_two_versions_of_tables(tmp_path) -> None:
    write(tmp_path)
    (tmp_path / "v1.0-test").mkdir()
    (tmp_path / "v1.0-test" / "sample_data.json").write_text("[]")
    with pytest.raises(InputError, match=r"one version of tables, got 2 \(v1.0-mini, v1.0-test\)"):
        read_scans(tmp_path)


def test_links_that_are_no_tokens_lead_nowhere(tmp_path) -> None:
    """A row whose sensor is a list is of no laser; one whose pose is one has no pose."""
    write(tmp_path, **changed("sample_data", "calibrated_sensor_token", ["c-lidar"]))
    assert len(read_scans(tmp_path)) == 1
    with pytest.raises(FileFormatError, match="ego_pose_token: expected text, got a list"):
        read_scans(write(tmp_path, **changed("sample_data", "ego_pose_token", ["e-a"])))
