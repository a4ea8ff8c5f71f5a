"""Scans of nuScenes, with the classes of nuScenes-lidarseg where they are there.

    ROOT/VERSION/{sensor,calibrated_sensor,ego_pose,sample,sample_data,scene}.json
    ROOT/samples/LIDAR_TOP/*.pcd.bin         float32 x y z intensity ring, in the laser's axes
    ROOT/VERSION/{lidarseg,category}.json, ROOT/lidarseg/VERSION/*_lidarseg.bin     uint8 a point

VERSION is v1.0-mini, v1.0-trainval or v1.0-test. Tables are lists of rows that name each other by
tokens; the large ones are read row by row, and only what is of the laser is kept. Caesar et al.,
CVPR 2020; Fong et al., RA-L 2022; tables as docs/schema_nuscenes.md of nuscenes-devkit has them.
"""

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.core import ClassInfo, ClassTable
from splatseg.core.json_values import json_integer, json_number
from splatseg.errors import FileFormatError, MissingFileError, quoted
from splatseg.io.captures.raw_views import checked_pose
from splatseg.io.foreign import is_file
from splatseg.io.json_files import read_json_rows
from splatseg.io.paths import path_inside
from splatseg.io.scans._records import read_ids, read_records
from splatseg.io.scans._source import RawScan, Scans, only_one

CHANNEL = "LIDAR_TOP"
_ENDING = ".pcd.bin"
_COLUMNS = 5
_MICROSECOND = 1e-6
_STUFF = ("flat.", "static.")
_MAX_CLASS = 255
_UNIT = 1e-3
_LONGEST = 150
"""Characters of the name of a file."""

_Rows = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sweep:
    """One scan: where it is, and from where it was measured."""

    file: Path
    world_from_sensor: NDArray[np.float64]
    time: float
    labels: Path | None


def find_nuscenes(path: Path) -> tuple[str, ...]:
    """Versions whose tables a folder has, by name."""
    if not path.is_dir():
        return ()
    return tuple(sorted(file.parent.name for file in path.glob("v1.0-*/sample_data.json")))


def read_nuscenes(path: Path) -> Scans:
    """Key frames of the laser, in the world of the map, z up, metres.

    A scan is called SCENE/TIMESTAMP, such as ``scene-0061/1532402927647951``; scenes come by name,
    their scans by time. Scenes of one place share a world, those of two cities do not. Labels are
    those of the files, 0 (noise) for none; they are named by category.json. Sweeps between key
    frames, which have no labels, are left out.

    Args:
        path: The folder with the tables and samples.

    Raises:
        MissingFileError: If there are no tables, or a file that they name is not there.
        InputError: If there are tables of several versions, or one is damaged.
    """
    versions = find_nuscenes(path)
    if not versions:
        raise MissingFileError(
            f"{path}: expected tables of nuScenes, v1.0-.../sample_data.json, got none."
        )
    version = path / only_one(path, versions, "version of tables")
    sweeps = _sweeps(path, version)
    if not sweeps:
        raise FileFormatError(
            f"{version / 'sample_data.json'}: expected key frames of {CHANNEL}, got none."
        )
    return Scans(
        path=path,
        format="nuscenes",
        scan_names=tuple(sweeps),
        read=lambda name: _raw(sweeps[name]),
        classes=_classes(version) if any(sweep.labels for sweep in sweeps.values()) else None,
    )


def _raw(sweep: _Sweep) -> RawScan:
    points = read_records(sweep.file, _COLUMNS)
    labels: dict[str, NDArray[Any]] = {}
    if sweep.labels is not None:
        labels["semantic"] = read_ids(sweep.labels, "u1", points=len(points))
    return RawScan(
        where=sweep.file,
        points=points[:, :3],
        world_from_sensor=sweep.world_from_sensor,
        intensity=points[:, 3],
        labels=labels,
        time=sweep.time,
    )


def _sweeps(root: Path, version: Path) -> dict[str, _Sweep]:
    sensors = _table(version / "sensor.json", ("channel",))
    lasers = {token for token, row in sensors.items() if row["channel"] == CHANNEL}
    mounted = _table(
        version / "calibrated_sensor.json",
        ("sensor_token", "translation", "rotation"),
        kept=lambda row: _is_one_of(row.get("sensor_token"), lasers),
    )
    data = _table(
        version / "sample_data.json",
        ("sample_token", "ego_pose_token", "calibrated_sensor_token", "filename", "timestamp"),
        kept=lambda row: (
            row.get("is_key_frame") is True
            and _is_one_of(row.get("calibrated_sensor_token"), mounted)
        ),
    )
    asked = {token for row in data.values() if isinstance(token := row["ego_pose_token"], str)}
    poses = _table(
        version / "ego_pose.json",
        ("translation", "rotation"),
        kept=lambda row: _is_one_of(row.get("token"), asked),
    )
    samples = _table(version / "sample.json", ("scene_token",))
    scenes = _table(version / "scene.json", ("name",))
    labels = _label_files(root, version)
    found: list[tuple[str, int, _Sweep]] = []
    for token, row in data.items():
        where = f"{version / 'sample_data.json'}: {quoted(token)}"
        sample = _linked(row, "sample_token", samples, where)
        scene = _text(_linked(sample, "scene_token", scenes, where)["name"], where)
        vehicle_from_laser = _pose(_linked(row, "calibrated_sensor_token", mounted, where), where)
        world_from_vehicle = _pose(_linked(row, "ego_pose_token", poses, where), where)
        time = json_integer(row["timestamp"], where=f"{where}: timestamp")
        sweep = _Sweep(
            file=_named(root, row["filename"], where),
            world_from_sensor=world_from_vehicle @ vehicle_from_laser,
            time=time * _MICROSECOND,
            labels=labels.get(token),
        )
        found.append((scene, time, sweep))
    found.sort(key=lambda one: one[:2])
    names = [f"{scene}/{time}" for scene, time, _ in found]
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise FileFormatError(
            f"{version / 'sample_data.json'}: expected one key frame of {CHANNEL} a moment, got "
            f"{quoted(twice)} twice."
        )
    return {name: sweep for name, (_, _, sweep) in zip(names, found, strict=True)}


def _is_one_of(token: object, known: Container[str]) -> bool:
    return isinstance(token, str) and token in known


def _table(
    path: Path,
    needed: tuple[str, ...],
    kept: Callable[[Mapping[str, Any]], bool] | None = None,
) -> dict[str, Mapping[str, Any]]:
    """Rows of a table by token: those that are wanted, and of them what is needed.

    Raises:
        FileFormatError: If a wanted row lacks something, or has no token.
    """
    found: dict[str, Mapping[str, Any]] = {}
    for i, row in enumerate(read_json_rows(path)):
        if kept is not None and not kept(row):
            continue
        missing = [name for name in ("token", *needed) if name not in row]
        if missing:
            raise FileFormatError(f"{path}: row {i}: expected {missing[0]}, got {quoted(row)}.")
        token = row["token"]
        if not isinstance(token, str) or token in found:
            raise FileFormatError(
                f"{path}: row {i}: expected a token of its own, got {quoted(token)}."
            )
        found[token] = {name: row[name] for name in needed}
    return found


def _linked(row: Mapping[str, Any], key: str, table: _Rows, where: str) -> Mapping[str, Any]:
    token: object = row[key]
    if not isinstance(token, str) or token not in table:
        raise FileFormatError(
            f"{where}: expected {key} of a row that is there, got {quoted(token)}."
        )
    return table[token]


def _text(value: object, where: str) -> str:
    if not isinstance(value, str) or not value:
        raise FileFormatError(f"{where}: expected a name, got {quoted(value)}.")
    return value


def _named(root: Path, value: object, where: str) -> Path:
    """A file that a table names, below the root."""
    name = _text(value, where)
    if len(name) > _LONGEST:
        raise FileFormatError(f"{where}: expected the name of a file, got {quoted(name)}.")
    return path_inside(root, name, make=False)


def _label_files(root: Path, version: Path) -> dict[str, Path]:
    """Files of labels by the token of their scan; none where there is no lidarseg."""
    path = version / "lidarseg.json"
    if not is_file(path):
        return {}
    found: dict[str, Path] = {}
    for token, row in _table(path, ("filename", "sample_data_token")).items():
        where = f"{path}: {quoted(token)}"
        file = _named(root, row["filename"], where)
        # The tables of the test split name files that were never published.
        if is_file(file):
            found[_text(row["sample_data_token"], where)] = file
    return found


def _classes(version: Path) -> ClassTable | None:
    """Names of the labels, where the table of categories numbers them; nuScenes' own does not."""
    path = version / "category.json"
    if not is_file(path):
        return None
    rows: list[ClassInfo] = []
    for i, row in enumerate(read_json_rows(path)):
        if "index" not in row:
            return None
        where = f"{path}: row {i}"
        id = json_integer(row["index"], where=f"{where}: index", high=_MAX_CLASS)
        name = _text(row.get("name"), where)
        if id:
            rows.append(ClassInfo(id=id, name=name, isthing=not name.startswith(_STUFF)))
    if len({row.id for row in rows}) != len(rows):
        raise FileFormatError(f"{path}: expected distinct indices, got one twice.")
    return ClassTable(rows=tuple(sorted(rows, key=lambda row: row.id)))


def _pose(row: Mapping[str, Any], where: str) -> NDArray[np.float64]:
    """A rigid transform of a translation and a unit quaternion w x y z."""
    values: dict[str, list[float]] = {}
    for name, count in (("translation", 3), ("rotation", 4)):
        value: object = row[name]
        if not isinstance(value, list) or len(value) != count:
            raise FileFormatError(
                f"{where}: expected {count} numbers in {name}, got {quoted(value)}."
            )
        values[name] = [json_number(number, where=f"{where}: {name}") for number in value]
    w, x, y, z = values["rotation"]
    length = float(np.sqrt(w * w + x * x + y * y + z * z))
    if abs(length - 1) > _UNIT:
        raise FileFormatError(
            f"{where}: expected a unit quaternion as rotation, got one of length {length:g}."
        )
    w, x, y, z = w / length, x / length, y / length, z / length
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = values["translation"]
    return checked_pose(pose, where=where)
