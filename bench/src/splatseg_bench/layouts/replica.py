"""Replica: classes and instances of every pixel, in two layouts that people have.

Straub et al., The Replica Dataset, 2019, as Semantic-NeRF (Zhi et al., ICCV 2021) rendered it, and
as Gaussian Grouping (Ye et al., ECCV 2024) ships it.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from splatseg.core import Capture, ClassInfo, ClassTable, View
from splatseg.core.json_values import json_integer
from splatseg.errors import FileFormatError, InputError, MissingFileError, quoted
from splatseg.io.captures import find_formats
from splatseg.io.captures.pose_tables import SEQUENCE, find_replica
from splatseg.io.foreign import derived_from
from splatseg.io.images import find_images
from splatseg.io.json_files import read_json
from splatseg_bench.layouts._reading import (
    ViewsByFile,
    read_views,
    scene_folders,
    split_by,
    true_ids,
)
from splatseg_bench.scene import BenchmarkScene, TrueMaps

_CLASS_NAMES = (
    "backpack", "base-cabinet", "basket", "bathtub", "beam", "beanbag", "bed", "bench", "bike",
    "bin", "blanket", "blinds", "book", "bottle", "box", "bowl", "camera", "cabinet", "candle",
    "chair", "chopping-board", "clock", "cloth", "clothing", "coaster", "comforter",
    "computer-keyboard", "cup", "cushion", "curtain", "ceiling", "cooktop", "countertop", "desk",
    "desk-organizer", "desktop-computer", "door", "exercise-ball", "faucet", "floor", "handbag",
    "hair-dryer", "handrail", "indoor-plant", "knife-block", "kitchen-utensil", "lamp", "laptop",
    "major-appliance", "mat", "microwave", "monitor", "mouse", "nightstand", "pan", "panel",
    "paper-towel", "phone", "picture", "pillar", "pillow", "pipe", "plant-stand", "plate", "pot",
    "rack", "refrigerator", "remote-control", "scarf", "sculpture", "shelf", "shoe",
    "shower-stall", "sink", "small-appliance", "sofa", "stair", "stool", "switch", "table",
    "table-runner", "tablet", "tissue-paper", "toilet", "toothbrush", "towel", "tv-screen",
    "tv-stand", "umbrella", "utensil-holder", "vase", "vent", "wall", "wall-cabinet", "wall-plug",
    "wardrobe", "window", "rug", "logo", "bag", "set-of-clothing",
)  # fmt: skip

REPLICA_CLASSES = ClassTable(
    rows=tuple(ClassInfo(id=id, name=name) for id, name in enumerate(_CLASS_NAMES, start=1))
)
"""All 101 of them."""


LAYOUT = "replica"
SEQUENCES = ("Sequence_1", "Sequence_2")
"""Walks through a scene, 900 frames each."""

GROUPING_LAYOUT = "replica-gg"

_NAMES = "info_semantic.json"
_OBJECTS = "object_mask"
_TRAIN = "images_train"
_MAX_ID = 2**31 - 1


def find_replica_scenes(folder: Path, sequence: str | None = None) -> tuple[Path, ...]:
    """Folders of scenes with a sequence, or of that sequence, as Semantic-NeRF rendered them."""
    return scene_folders(folder, lambda path: _sequence_of(path, sequence) is not None)


def find_grouping_replica(folder: Path) -> tuple[Path, ...]:
    """Folders of scenes: captures with ``object_mask``."""
    return scene_folders(
        folder, lambda path: (path / _OBJECTS).is_dir() and bool(find_formats(path))
    )


def read_replica_scenes(folder: Path, *, sequence: str | None = None) -> tuple[BenchmarkScene, ...]:
    """Read scenes with classes and instances of every pixel.

    A scene is a sequence (see `io.captures.pose_tables`), or has it in its folder, with
    ``semantic_class/semantic_class_N.png`` and ``semantic_instance/semantic_instance_N.png``;
    0 is none. Names come from Replica's ``info_semantic.json`` in the scene or in
    ``semantic_info/SCENE`` beside it, where it is there.

    Args:
        folder: A sequence, a scene, or the folder of several.
        sequence: Which of a scene's sequences is read; scenes without it are passed over. None
            reads the first, or the folder itself, where it is one.

    Raises:
        MissingFileError: If there is no scene, or it has no maps.
        InputError: If a map is of a frame that is not there.
    """
    scenes = find_replica_scenes(folder, sequence)
    if not scenes:
        raise MissingFileError(
            f"{folder}: expected scenes of Replica with traj_w_c.txt, there or in "
            f"{sequence or SEQUENCE}, got none."
        )
    return tuple(_scene(path, sequence) for path in scenes)


def read_grouping_replica(folder: Path) -> tuple[BenchmarkScene, ...]:
    """Read scenes with an instance of every pixel.

    A scene is a COLMAP capture with ``object_mask/VIEW.png``; 0 is none. Where there is
    ``images_train``, the views that it lacks are test views; else every 8th is.

    Args:
        folder: A scene, or the folder of several.

    Raises:
        MissingFileError: If there is no scene, or it has no maps.
        InputError: If a map is of a view that is not there.
    """
    scenes = find_grouping_replica(folder)
    if not scenes:
        raise MissingFileError(f"{folder}: expected captures with {_OBJECTS}, got none.")
    return tuple(_grouping_scene(path) for path in scenes)


def _sequence_of(path: Path, name: str | None) -> Path | None:
    """The sequence that a folder is, or has: any, or the one of a name."""
    found = find_replica(path, name or SEQUENCE)
    own = path.resolve().name
    if name is not None and found == path and own.startswith("Sequence") and own != name:
        return None  # another walk
    return found


def _scene_of(sequence: Path) -> Path:
    """The folder of the scene of a sequence, which may be the sequence itself."""
    return sequence.parent if sequence.resolve().name.startswith("Sequence") else sequence


def _scene(path: Path, name: str | None) -> BenchmarkScene:
    sequence = _sequence_of(path, name) or path
    scene = _scene_of(sequence)
    capture = read_views(sequence, format="replica")
    classes, objects = _tables(scene)
    views = ViewsByFile(capture)
    semantic = _maps(sequence, "semantic_class", views, classes)
    instances = _maps(sequence, "semantic_instance", views, objects)
    if semantic is None and instances is None:
        raise MissingFileError(
            f"{sequence}: expected maps in semantic_class or semantic_instance, got neither."
        )
    return BenchmarkScene(
        name=scene.resolve().name,
        layout=LAYOUT,
        capture=capture,
        semantic=semantic,
        instances=instances,
        notes=capture.notes,
    )


def _maps(
    sequence: Path, kind: str, views: ViewsByFile, table: ClassTable | None
) -> TrueMaps | None:
    """Maps ``KIND/KIND_N.png`` of the frames ``rgb_N``; None where there are none."""
    found: dict[str, tuple[Path, View]] = {}
    for file in find_images(sequence / kind):
        if file.stem.startswith(f"{kind}_"):  # pictures for people lie beside, vis_sem_class_N.png
            view = views.view(f"rgb_{file.stem.removeprefix(f'{kind}_')}", where=file)
            found[view.name] = (file, view)
    if not found:
        return None
    return TrueMaps(
        read={name: true_ids(file, view) for name, (file, view) in found.items()}, table=table
    )


def _grouping_scene(path: Path) -> BenchmarkScene:
    capture = _grouping_split(read_views(path), path)
    views = ViewsByFile(capture)
    files = find_images(path / _OBJECTS)
    if not files:
        raise MissingFileError(f"{path / _OBJECTS}: expected maps of instances, got none.")
    found = {file: views.view(file.stem, where=file) for file in files}
    return BenchmarkScene(
        name=path.resolve().name,
        layout=GROUPING_LAYOUT,
        capture=capture,
        instances=TrueMaps(read={view.name: true_ids(file, view) for file, view in found.items()}),
        notes=capture.notes,
    )


def _grouping_split(capture: Capture, path: Path) -> Capture:
    trained = find_images(path / _TRAIN)
    if not trained:
        return capture
    views = ViewsByFile(capture)
    kept = {views.find(file.stem, where=file) for file in trained}
    tests = {view.name for view in capture.views} - kept
    note = f"test views are those that {_TRAIN} lacks"
    return split_by(capture, dict.fromkeys(tests, "test"), note)


def _tables(scene: Path) -> tuple[ClassTable | None, ClassTable | None]:
    """Names of classes, and the class of each object, from Replica's own description."""
    beside = scene.resolve().parent / "semantic_info" / scene.resolve().name
    path = next((p for p in (scene / _NAMES, beside / _NAMES) if p.is_file()), None)
    if path is None:
        return None, None
    content = read_json(path)
    return _table(content, "classes", "name", path), _table(content, "objects", "class_name", path)


def _table(content: Mapping[str, Any], key: str, name: str, path: Path) -> ClassTable | None:
    rows = content.get(key)
    if rows is None:
        return None
    if not isinstance(rows, list):
        raise FileFormatError(f"{path}: expected a list {key}, got {quoted(rows)}.")
    named: dict[int, str] = {}
    for i, row in enumerate(cast("list[object]", rows)):
        entry = cast("dict[str, Any]", row) if isinstance(row, dict) else {}
        where = f"{path}: {key}[{i}]"
        id = json_integer(entry.get("id"), where=f"{where}.id", high=_MAX_ID)
        word = entry.get(name)
        if not isinstance(word, str):
            raise InputError(f"{where}: expected a {name}, got {quoted(word)}.")
        if id > 0:  # 0 is none in maps
            named.setdefault(id, word)
    with derived_from(path):
        return ClassTable(rows=tuple(ClassInfo(id=id, name=word) for id, word in named.items()))
