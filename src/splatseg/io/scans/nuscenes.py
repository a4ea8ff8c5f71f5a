"""Scans of nuScenes, with the classes of nuScenes-lidarseg where they are there.

    ROOT/VERSION/{sensor,calibrated_sensor,ego_pose,sample,sample_data,scene}.json
    ROOT/samples/LIDAR_TOP/*.pcd.bin         float32 x y z intensity ring, in the laser's axes
    ROOT/VERSION/{lidarseg,category}.json, ROOT/lidarseg/VERSION/*_lidarseg.bin     uint8 a point

VERSION is v1.0-mini, v1.0-trainval or v1.0-test. Tables are lists of rows that name each other by
tokens; the large ones are read row by row, and only what is of the laser is kept. Caesar et al.,
CVPR 2020; Fong et al., RA-L 2022; tables as docs/schema_nuscenes.md of nuscenes-devkit has them.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from splatseg.core import ClassInfo, ClassTable
from splatseg.errors import MissingFileError, quoted
from splatseg.io.atomic import path_inside
from splatseg.io.captures.raw_views import checked_pose, pose_of_quaternion
from splatseg.io.foreign import is_file
from splatseg.io.json_files import read_json_rows
from splatseg.io.scans._source import (
    RawScan,
    Scans,
    only_one,
    read_ids,
    read_records,
    refuse_twice,
)
from splatseg.io.schema import Name, Whole, expect, malformed, structured

CHANNEL = "LIDAR_TOP"
_COLUMNS = 5
_MICROSECOND = 1e-6
_STUFF = ("flat.", "static.")
_UNIT = 1e-3

_File = Annotated[str, Meta(min_length=1, max_length=150)]
"""The name of a file, below the root."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Row:
    token: str


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sensor(_Row):
    channel: str


@dataclass(frozen=True, slots=True, kw_only=True)
class _Placed(_Row):
    """A rigid transform: on the vehicle (calibrated_sensor), or in the world (ego_pose)."""

    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    """A unit quaternion w x y z."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Data(_Row):
    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    filename: _File
    timestamp: Whole


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sample(_Row):
    scene_token: str


@dataclass(frozen=True, slots=True, kw_only=True)
class _Scene(_Row):
    name: Name


@dataclass(frozen=True, slots=True, kw_only=True)
class _Labels(_Row):
    filename: _File
    sample_data_token: Name


@dataclass(frozen=True, slots=True, kw_only=True)
class _Category:
    name: Name
    index: Annotated[int, Meta(ge=0, le=255)] | None = None


T = TypeVar("T")
AnyRow = TypeVar("AnyRow", bound=_Row)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sweep:
    """One scan: where it is, and from where it was measured."""

    file: Path
    world_from_sensor: NDArray[np.float64]
    time: float
    labels: Path | None


def find_nuscenes(path: Path) -> tuple[str, ...]:
    """Versions whose tables a folder has, by name."""
    tables = path.glob("v1.0-*/sample_data.json") if path.is_dir() else ()
    return tuple(sorted(file.parent.name for file in tables))


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
    expect(sweeps, version / "sample_data.json", f"key frames of {CHANNEL}, got none")
    return Scans(
        path=path,
        format="nuscenes",
        scan_names=tuple(sweeps),
        read=lambda name: _raw(sweeps[name]),
        classes=_classes(version) if any(sweep.labels for sweep in sweeps.values()) else None,
    )


def _raw(sweep: _Sweep) -> RawScan:
    points, file = read_records(sweep.file, _COLUMNS), sweep.labels
    labels = {} if file is None else {"semantic": read_ids(file, "u1", points=len(points))}
    return RawScan(
        where=sweep.file,
        points=points[:, :3],
        world_from_sensor=sweep.world_from_sensor,
        intensity=points[:, 3],
        labels=labels,
        time=sweep.time,
    )


def _sweeps(root: Path, version: Path) -> dict[str, _Sweep]:
    def table(
        name: str, kind: type[AnyRow], kept: Callable[[Mapping[str, Any]], bool] | None = None
    ) -> dict[str, AnyRow]:
        return _table(version / f"{name}.json", kind, kept)

    lasers = {t for t, row in table("sensor", _Sensor).items() if row.channel == CHANNEL}
    mounted = table(
        "calibrated_sensor", _Placed, lambda row: _is_one_of(row.get("sensor_token"), lasers)
    )
    data = table(
        "sample_data",
        _Data,
        lambda row: (
            row.get("is_key_frame") is True
            and _is_one_of(row.get("calibrated_sensor_token"), mounted)
        ),
    )
    used = {row.ego_pose_token for row in data.values()}
    poses = table("ego_pose", _Placed, lambda row: _is_one_of(row.get("token"), used))
    samples, scenes = table("sample", _Sample), table("scene", _Scene)
    labels = _label_files(root, version)
    found: list[tuple[str, int, _Sweep]] = []
    for token, row in data.items():
        where = f"{version / 'sample_data.json'}: {quoted(token)}"
        sample = _linked(samples, "sample_token", row.sample_token, where)
        scene = _linked(scenes, "scene_token", sample.scene_token, where)
        vehicle_from_laser = _pose(mounted[row.calibrated_sensor_token], where)
        pose = _linked(poses, "ego_pose_token", row.ego_pose_token, where)
        sweep = _Sweep(
            file=path_inside(root, row.filename, make=False),
            world_from_sensor=_pose(pose, where) @ vehicle_from_laser,
            time=row.timestamp * _MICROSECOND,
            labels=labels.get(token),
        )
        found.append((scene.name, row.timestamp, sweep))
    found.sort(key=lambda one: one[:2])
    names = [f"{scene}/{time}" for scene, time, _ in found]
    refuse_twice(version / "sample_data.json", names, f"one key frame of {CHANNEL} a moment")
    return {name: sweep for name, (_, _, sweep) in zip(names, found, strict=True)}


def _is_one_of(token: object, known: "set[str] | Mapping[str, object]") -> bool:
    return isinstance(token, str) and token in known


def _table(
    path: Path, kind: type[AnyRow], kept: Callable[[Mapping[str, Any]], bool] | None = None
) -> dict[str, AnyRow]:
    """Rows of a table by token, those that are wanted."""
    found: dict[str, AnyRow] = {}
    for i, content in enumerate(read_json_rows(path)):
        if kept is None or kept(content):
            row = structured(content, kind, where=f"{path}: row {i}")
            expect(row.token not in found, f"{path}: row {i}", "a token of its own", row.token)
            found[row.token] = row
    return found


def _linked(table: Mapping[str, T], key: str, token: str, where: str) -> T:
    if token not in table:
        raise malformed(where, f"{key} of a row that is there", token)
    return table[token]


def _label_files(root: Path, version: Path) -> dict[str, Path]:
    """Files of labels by the token of their scan; none where there is no lidarseg."""
    path = version / "lidarseg.json"
    rows = _table(path, _Labels).values() if is_file(path) else ()
    files = {row.sample_data_token: path_inside(root, row.filename, make=False) for row in rows}
    # The tables of the test split name files that were never published.
    return {token: file for token, file in files.items() if is_file(file)}


def _classes(version: Path) -> ClassTable | None:
    """Names of the labels, where the table of categories numbers them; nuScenes' own does not."""
    path = version / "category.json"
    if not is_file(path):
        return None
    rows: dict[int, ClassInfo] = {}
    for i, content in enumerate(read_json_rows(path)):
        row = structured(content, _Category, where=f"{path}: row {i}")
        if row.index is None:
            return None
        expect(row.index not in rows, path, "distinct indices, got one twice")
        isthing = not row.name.startswith(_STUFF)
        rows[row.index] = ClassInfo(id=row.index, name=row.name, isthing=isthing)
    return ClassTable(rows=tuple(rows[id] for id in sorted(rows) if id))


def _pose(row: _Placed, where: str) -> NDArray[np.float64]:
    length = math.hypot(*row.rotation)
    what = f"a unit quaternion as rotation, got one of length {length:g}"
    expect(abs(length - 1) <= _UNIT, where, what)
    return checked_pose(pose_of_quaternion((*row.rotation, *row.translation)), where=where)
