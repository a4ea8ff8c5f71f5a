"""LERF-Mask: masks by prompt in held-out views, as Gaussian Grouping ships them.

Ye et al., Gaussian Grouping: Segment and Edit Anything in 3D Scenes, ECCV 2024, and its page
``docs/dataset.md``.
"""

from pathlib import Path

from splatseg.core import Capture, View
from splatseg.errors import InputError, MissingFileError, quoted
from splatseg.io.captures import find_formats
from splatseg.io.images import find_images
from splatseg_bench.layouts._reading import (
    ViewsByFile,
    read_views,
    scene_folders,
    split_by,
    true_mask,
)
from splatseg_bench.scene import BenchmarkScene, TargetTask, TrueMask

LAYOUT = "lerf-mask"

_TRUTH = "test_mask"
_TRAIN = "images_train"


def find_lerf_mask(folder: Path) -> tuple[Path, ...]:
    """Folders of scenes: captures with ``test_mask``."""
    return scene_folders(folder, _is_scene)


def read_lerf_mask(folder: Path) -> tuple[BenchmarkScene, ...]:
    """Read scenes, one task a prompt.

    A scene has ``images`` and ``sparse/0`` with all photographs, ``images_train`` with those to
    fit to (the others are the test views), and ``test_mask/N/PROMPT.png``, where N counts the
    test views by sorted name from 0, or is a view's name.

    Args:
        folder: A scene, or the folder of several.

    Raises:
        MissingFileError: If there is no scene, or none of its masks.
        InputError: If masks are of a view that is no test view.
    """
    scenes = find_lerf_mask(folder)
    if not scenes:
        raise MissingFileError(f"{folder}: expected captures with {_TRUTH}, got none.")
    return tuple(_scene(path) for path in scenes)


def _scene(path: Path) -> BenchmarkScene:
    folders = sorted(child for child in (path / _TRUTH).iterdir() if child.is_dir())
    capture = _split(read_views(path), path, folders)
    tests = sorted(capture.test_views, key=lambda view: view.name)
    prompts: dict[str, list[TrueMask]] = {}
    for folder in folders:
        view = _view_of(folder, tests)
        for file in find_images(folder):
            prompts.setdefault(file.stem, []).append(true_mask(file, view))
    if not prompts:
        raise MissingFileError(f"{path / _TRUTH}: expected masks N/PROMPT.png, got none.")
    return BenchmarkScene(
        name=path.name,
        layout=LAYOUT,
        capture=capture,
        tasks=tuple(
            TargetTask(name=prompt, truth=tuple(truth), words=prompt)
            for prompt, truth in sorted(prompts.items())
        ),
        notes=capture.notes,
    )


def _split(capture: Capture, path: Path, folders: list[Path]) -> Capture:
    """The capture with its test views: what `_TRAIN` lacks, else what masks are named after."""
    names = ViewsByFile(capture)
    trained = find_images(path / _TRAIN)
    if trained:
        kept = {names.find(file.stem, where=file) for file in trained}
        tests = {view.name for view in capture.views} - kept
        note = f"test views are those that {_TRAIN} lacks"
    elif folders and all(names.has(folder.name) for folder in folders):
        tests = {names.find(folder.name, where=folder) for folder in folders}
        note = f"test views are those that {_TRUTH} names"
    else:
        raise MissingFileError(
            f"{path / _TRAIN}: expected the photographs to fit to, as the others are the test "
            "views, got none."
        )
    return split_by(capture, dict.fromkeys(tests, "test"), note)


def _view_of(folder: Path, tests: list[View]) -> View:
    """The test view of a folder of masks, by its name or its number."""
    for view in tests:
        if folder.name in (view.name, "" if view.image is None else view.image.stem):
            return view
    name = folder.name
    if not (name.isascii() and name.isdigit() and len(name) < 10 and int(name) < len(tests)):
        raise InputError(
            f"{folder}: expected the number of one of {len(tests)} test views, from 0, or the "
            f"name of one, got {quoted(name)}."
        )
    return tests[int(name)]


def _is_scene(path: Path) -> bool:
    return (path / _TRUTH).is_dir() and bool(find_formats(path))
