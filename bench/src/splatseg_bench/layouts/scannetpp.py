"""ScanNet++: vertices of a mesh with names, by segments that people put together.

Yeshwanth et al., ScanNet++, ICCV 2023.
"""

from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import UNLABELLED, ClassInfo, ClassTable, Labels
from splatseg.errors import FileFormatError, MissingFileError, quoted
from splatseg.io.captures.nerfstudio import find_scannetpp
from splatseg.io.foreign import derived_from, reading
from splatseg.io.json_files import read_json
from splatseg.io.ply import read_ply_vertices, vertex_positions
from splatseg.io.surfaces import read_triangles
from splatseg_bench.layouts._reading import read_views, scene_folders
from splatseg_bench.scene import BenchmarkScene, TruePoints

LAYOUT = "scannetpp"

_MESHES = ("mesh_aligned_0.05_semantic.ply", "mesh_aligned_0.05.ply")
_SEGMENTS = "segments.json"
_ANNOTATION = "segments_anno.json"
_NOTHING = frozenset({"remove", "split"})
"""Names that say of segments that they are no object."""


def find_scannetpp_scenes(folder: Path) -> tuple[Path, ...]:
    """Folders of scenes with DSLR photographs, there or in ``data``."""
    return scene_folders(folder, find_scannetpp) or scene_folders(folder / "data", find_scannetpp)


def read_scannetpp_scenes(folder: Path) -> tuple[BenchmarkScene, ...]:
    """Read scenes with labelled points.

    Points are the vertices of ``scans/mesh_aligned_0.05_semantic.ply``; ``segments.json`` tells
    the segment of each (``segIndices``) and ``segments_anno.json`` the segments of each object
    and its name (``segGroups`` of ``label`` and ``segments``). Of objects that share a segment
    the one with fewest vertices has it. Ids count the names of the scene, sorted, from 1.

    Args:
        folder: A scene, or the folder of several.

    Raises:
        MissingFileError: If there is no scene, or a file of its annotation lacks.
        InputError: If a file is damaged, or they do not belong together.
    """
    scenes = find_scannetpp_scenes(folder)
    if not scenes:
        raise MissingFileError(
            f"{folder}: expected scenes of ScanNet++ with dslr/nerfstudio/transforms.json, got "
            "none."
        )
    return tuple(_scene(path) for path in scenes)


def read_annotated_points(scans: Path) -> TruePoints:
    """Vertices of a scan's mesh with the names of objects, see `read_scannetpp_scenes`.

    Raises:
        MissingFileError: If the mesh, its segments or their names lack.
        FileFormatError: If one is damaged, or they do not belong together.
    """
    mesh = next((scans / name for name in _MESHES if (scans / name).is_file()), scans / _MESHES[0])
    points = vertex_positions(mesh, read_ply_vertices(mesh))
    faces = read_triangles(mesh)
    if faces is not None and len(faces) and int(faces.max()) >= len(points):
        raise FileFormatError(
            f"{mesh}: expected faces of {len(points)} vertices, got one of {int(faces.max())}."
        )
    segments = _segments(scans / _SEGMENTS, vertices=len(points))
    groups = _groups(scans / _ANNOTATION)
    names = sorted({name for name, _ in groups})
    present, counts = np.unique(segments, return_counts=True)
    sizes = [int(counts[np.isin(present, members)].sum()) for _, members in groups]
    ids = np.full(len(points), UNLABELLED, np.int32)
    # The largest come first, so that what lies on a thing is not lost under it.
    for size, (name, members) in sorted(
        zip(sizes, groups, strict=True), key=lambda item: item[0], reverse=True
    ):
        if size:
            ids[np.isin(segments, members)] = names.index(name) + 1
    with derived_from(scans / _ANNOTATION):
        rows = tuple(ClassInfo(id=i, name=name) for i, name in enumerate(names, start=1))
    return TruePoints(
        points=torch.from_numpy(np.ascontiguousarray(points, np.float32)),
        labels=Labels(ids=torch.from_numpy(ids), confidence=torch.ones(len(ids))),
        table=ClassTable(rows=rows),
        faces=faces,
    )


def _scene(path: Path) -> BenchmarkScene:
    capture = read_views(path, format="scannetpp")
    return BenchmarkScene(
        name=path.resolve().name,
        layout=LAYOUT,
        capture=capture,
        points=read_annotated_points(path / "scans"),
        notes=capture.notes,
    )


def _segments(path: Path, *, vertices: int) -> NDArray[np.int64]:
    indices = read_json(path).get("segIndices")
    segments = _integers(indices, path, "segIndices")
    if len(segments) != vertices:
        raise FileFormatError(
            f"{path}: expected a segment of each of {vertices} vertices, got {len(segments)}."
        )
    return segments


def _groups(path: Path) -> list[tuple[str, NDArray[np.int64]]]:
    """Name and segments of each object."""
    listed = read_json(path).get("segGroups")
    if not isinstance(listed, list):
        raise FileFormatError(f"{path}: expected a list segGroups, got {quoted(listed)}.")
    groups: list[tuple[str, NDArray[np.int64]]] = []
    for i, entry in enumerate(cast("list[object]", listed)):
        group = cast("dict[str, Any]", entry) if isinstance(entry, dict) else {}
        label = group.get("label")
        if not isinstance(label, str) or not label.strip():
            raise FileFormatError(f"{path}: expected segGroups[{i}].label, got {quoted(label)}.")
        members = _integers(group.get("segments"), path, f"segGroups[{i}].segments")
        if label.strip().lower() not in _NOTHING:
            groups.append((label.strip(), members))
    return groups


def _integers(value: object, path: Path, key: str) -> NDArray[np.int64]:
    """A list of whole numbers, which has a million entries in a scene."""
    with reading(path, f"whole numbers in {key}"):
        array = np.array(value if isinstance(value, list) and value else None)
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise FileFormatError(
            f"{path}: expected a list of whole numbers {key}, got {quoted(value)}."
        )
    return array.astype(np.int64)
