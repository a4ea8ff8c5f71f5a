"""3D-OVS: masks of every class of a scene in some of its views.

Liu et al., Weakly Supervised 3D Open-vocabulary Segmentation, NeurIPS 2023.
"""

from pathlib import Path

from splatseg.core import View
from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures import find_formats
from splatseg.io.foreign import derived_from, read_lines
from splatseg.io.images import find_images
from splatseg_bench.layouts._reading import (
    ViewsByFile,
    read_views,
    scene_folders,
    trained_on_all,
    true_mask,
)
from splatseg_bench.scene import BenchmarkScene, TargetTask, TrueMask

LAYOUT = "3d-ovs"

_TRUTH = "segmentations"
_CLASSES = "classes.txt"
_MAX_DIGITS = 9


def find_ovs3d(folder: Path) -> tuple[Path, ...]:
    """Folders of scenes: captures with ``segmentations``."""
    return scene_folders(folder, lambda path: (path / _TRUTH).is_dir() and bool(find_formats(path)))


def read_ovs3d(folder: Path) -> tuple[BenchmarkScene, ...]:
    """Read scenes, one task a class.

    A scene is a capture with ``segmentations/VIEW/CLASS.png`` and ``classes.txt`` (one a line)
    there or beside it. VIEW is the photograph's name, or the number in it. Annotated views are
    training views.

    Args:
        folder: A scene, or the folder of several.

    Raises:
        MissingFileError: If there is no scene, no list of classes, or no mask of a class.
        InputError: If a mask is of a view or a class that is not there.
    """
    scenes = find_ovs3d(folder)
    if not scenes:
        raise MissingFileError(f"{folder}: expected captures with {_TRUTH}, got none.")
    return tuple(_scene(path) for path in scenes)


def _scene(path: Path) -> BenchmarkScene:
    capture = trained_on_all(read_views(path))
    views, numbers = ViewsByFile(capture), _by_number(capture.views)
    listed = next(
        (p for p in (path / _TRUTH / _CLASSES, path / _CLASSES) if p.is_file()),
        path / _TRUTH / _CLASSES,
    )
    classes = list(dict.fromkeys(read_lines(listed, "names of classes")))
    truth: dict[str, list[TrueMask]] = {name: [] for name in classes}
    for folder in sorted(child for child in (path / _TRUTH).iterdir() if child.is_dir()):
        word = folder.name
        number = int(word) if _is_number(word) else -1
        known = numbers.get(number) if not views.has(word) else None
        view = views.view(word, where=folder) if known is None else known
        for file in find_images(folder):
            if file.stem not in truth:
                raise InputError(
                    f"{file}: expected the mask of one of the {len(classes)} classes of {listed}."
                )
            truth[file.stem].append(true_mask(file, view))
    for name, masks in truth.items():
        if not masks:
            raise MissingFileError(
                f"{path / _TRUTH}: expected a mask {name}.png of some view, got none."
            )
    with derived_from(listed):
        tasks = tuple(
            TargetTask(name=name, truth=tuple(masks), words=name) for name, masks in truth.items()
        )
    return BenchmarkScene(
        name=path.resolve().name,
        layout=LAYOUT,
        capture=capture,
        tasks=tasks,
        notes=capture.notes,
    )


def _by_number(views: tuple[View, ...]) -> dict[int, View]:
    """Views by the number that their photograph's name ends in, where it is the only one."""
    found: dict[int, list[View]] = {}
    for view in views:
        stem = view.name if view.image is None else view.image.stem
        digits = stem[len(stem.rstrip("0123456789")) :]
        if _is_number(digits):
            found.setdefault(int(digits), []).append(view)
    return {number: several[0] for number, several in found.items() if len(several) == 1}


def _is_number(word: str) -> bool:
    return word.isascii() and word.isdigit() and len(word) <= _MAX_DIGITS
