"""ScanNet: labelled vertices of a mesh, and labels of frames, in the classes of NYU40.

Dai et al., ScanNet, CVPR 2017. Which classes count is OpenGaussian's (Wu et al., NeurIPS 2024).
"""

from functools import partial
from pathlib import Path

import numpy as np
import torch

from splatseg.core import UNLABELLED, ClassInfo, ClassTable, LabelMap, Labels, View
from splatseg.errors import FileFormatError, MissingFileError, quoted
from splatseg.io.captures.pose_tables import find_scannet, labelled_mesh
from splatseg.io.foreign import is_file, read_lines
from splatseg.io.ply import read_ply_vertices, vertex_positions
from splatseg_bench.layouts._reading import read_views, scene_folders, trained_on_all, true_ids
from splatseg_bench.scene import BenchmarkScene, TrueMaps, TruePoints

LAYOUT = "scannet"

_NAMES = (
    "wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window", "bookshelf",
    "picture", "counter", "blinds", "desk", "shelves", "curtain", "dresser", "pillow", "mirror",
    "floor mat", "clothes", "ceiling", "books", "refrigerator", "television", "paper", "towel",
    "shower curtain", "box", "whiteboard", "person", "night stand", "toilet", "sink", "lamp",
    "bathtub", "bag", "otherstructure", "otherfurniture", "otherprop",
)  # fmt: skip
_STUFF = frozenset({"wall", "floor", "ceiling"})

NYU40 = ClassTable(
    rows=tuple(
        ClassInfo(id=id, name=name, isthing=name not in _STUFF)
        for id, name in enumerate(_NAMES, start=1)
    )
)
"""The forty classes of NYU Depth v2 that ScanNet's labels go by; 0 is none."""

CLASS_SUBSETS: dict[int, tuple[int, ...]] = {
    19: (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16, 24, 28, 33, 34, 36),
    15: (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 33, 34),
    10: (1, 2, 4, 5, 6, 7, 8, 9, 10, 33),
}
"""Ids of NYU40 that count, by how many they are: the three settings of OpenGaussian."""

SCENES = (
    "scene0000_00", "scene0062_00", "scene0070_00", "scene0097_00", "scene0140_00",
    "scene0200_00", "scene0347_00", "scene0400_00", "scene0590_00", "scene0645_00",
)  # fmt: skip
"""The ten scans of OpenGaussian's table."""

_LABELS = "scannetv2-labels.combined.tsv"
_LEVELS_UP = 2
_MAX_RAW_ID = 1 << 16


def find_scannet_scenes(folder: Path) -> tuple[Path, ...]:
    """Folders of scans that were exported, there or in ``scans``."""
    return scene_folders(folder, find_scannet) or scene_folders(folder / "scans", find_scannet)


def read_scannet_scenes(folder: Path) -> tuple[BenchmarkScene, ...]:
    """Read exported scans with labelled points and, where they are there, labels of frames.

    ``SCENE_vh_clean_2.labels.ply`` has the class of each vertex in its column ``label``.
    ``label-filt/N.png`` has ids of ScanNet's own, which ``scannetv2-labels.combined.tsv`` in the
    scan or up to two folders above takes to NYU40; ``instance-filt/N.png`` has instances. All
    frames are training views: the points are what is scored.

    Args:
        folder: A scan, or the folder of several.

    Raises:
        MissingFileError: If there is no scan, or it has neither labelled points nor maps.
        InputError: If a file is damaged.
    """
    scenes = find_scannet_scenes(folder)
    if not scenes:
        raise MissingFileError(
            f"{folder}: expected scans of ScanNet with intrinsic/intrinsic_color.txt and pose, got "
            "none."
        )
    return tuple(_scene(path) for path in scenes)


def read_labelled_points(path: Path) -> TruePoints:
    """Vertices of a ``labels.ply`` with their classes of NYU40; 0 becomes -1.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is damaged, lacks the column ``label`` or has others than 0 to 40.
    """
    rows = read_ply_vertices(path)
    if "label" not in rows or rows["label"].dtype.kind not in "iu":
        raise FileFormatError(f"{path}: expected vertices with a whole number label, got none.")
    ids = rows["label"].astype(np.int64)
    if ids.size and not (ids.min() >= 0 and ids.max() <= len(_NAMES)):
        raise FileFormatError(
            f"{path}: expected labels of NYU40, 0 to {len(_NAMES)}, got {ids.min()} to {ids.max()}."
        )
    points = vertex_positions(path, rows)
    return TruePoints(
        points=torch.from_numpy(np.ascontiguousarray(points, np.float32)),
        labels=Labels(
            ids=torch.from_numpy(np.where(ids > 0, ids, UNLABELLED).astype(np.int32)),
            confidence=torch.ones(len(ids)),
        ),
        table=NYU40,
    )


def read_nyu40_ids(path: Path) -> dict[int, int]:
    """Classes of NYU40 by ScanNet's own ids, from ``scannetv2-labels.combined.tsv``.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it lacks the columns ``id`` and ``nyu40id``, or holds no numbers there.
    """
    lines = [line.split("\t") for line in read_lines(path, "a table with tabs")]
    header = lines[0] if lines else []
    if not {"id", "nyu40id"} <= set(header):
        raise FileFormatError(
            f"{path}: expected columns id and nyu40id, got {quoted(', '.join(header))}."
        )
    own, nyu = header.index("id"), header.index("nyu40id")
    found: dict[int, int] = {}
    for i, words in enumerate(lines[1:], start=2):
        row = words[own : own + 1] + words[nyu : nyu + 1]
        numbers = [int(w) for w in row if w.isascii() and w.isdigit() and len(w) < 10]
        if len(numbers) != 2 or numbers[1] > len(_NAMES) or numbers[0] >= _MAX_RAW_ID:
            raise FileFormatError(
                f"{path}: expected an id and one of NYU40 in row {i}, got {quoted(row)}."
            )
        found[numbers[0]] = numbers[1]
    return found


def _scene(path: Path) -> BenchmarkScene:
    capture = trained_on_all(read_views(path, format="scannet"))
    mesh = labelled_mesh(path)
    labels = _files(path / "label-filt", capture.views)
    instances = _files(path / "instance-filt", capture.views)
    if mesh is None and not labels and not instances:
        raise MissingFileError(
            f"{path}: expected {path.resolve().name}_vh_clean_2.labels.ply, label-filt or "
            "instance-filt, got none."
        )
    table = _table_of(path) if labels else None
    notes = capture.notes
    if labels and table is None:
        notes = (*notes, f"label-filt was left out: there is no {_LABELS} to tell its classes")
    return BenchmarkScene(
        name=path.resolve().name,
        layout=LAYOUT,
        capture=capture,
        semantic=None
        if table is None
        else TrueMaps(
            read={
                view.name: partial(_nyu40_map, true_ids(file, view), table, file)
                for file, view in labels
            },
            table=NYU40,
        ),
        instances=TrueMaps(read={view.name: true_ids(file, view) for file, view in instances})
        if instances
        else None,
        points=None if mesh is None else read_labelled_points(mesh),
        notes=notes,
    )


def _files(folder: Path, views: tuple[View, ...]) -> list[tuple[Path, View]]:
    """Maps of the frames that were taken; a scan has maps of others too."""
    named = [(folder / f"{view.image.stem}.png", view) for view in views if view.image is not None]
    return [(file, view) for file, view in named if is_file(file)]


def _table_of(path: Path) -> dict[int, int] | None:
    for folder in (path, *list(path.resolve().parents)[:_LEVELS_UP]):
        if (folder / _LABELS).is_file():
            return read_nyu40_ids(folder / _LABELS)
    return None


def _nyu40_map(read: partial[LabelMap], table: dict[int, int], file: Path) -> LabelMap:
    ids = read().ids.numpy()
    present = np.unique(ids)
    strange = [int(i) for i in present if i != UNLABELLED and int(i) not in table]
    if strange:
        raise FileFormatError(f"{file}: expected ids of {_LABELS}, got {quoted(strange)} as well.")
    classes = np.array([table.get(int(i), 0) or UNLABELLED for i in present], np.int32)
    return LabelMap(ids=torch.from_numpy(classes[np.searchsorted(present, ids)]))
