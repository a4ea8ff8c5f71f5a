"""NVOS: strokes in one view, the true mask in another, of objects in forward-facing scenes.

Ren et al., Neural Volumetric Object Selection, CVPR 2022. Labels and photographs come from two
places: the benchmark's own folders, and the LLFF scenes that they are of.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from jaxtyping import Bool
from torch import Tensor

from splatseg.core import View
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.captures import find_formats
from splatseg.io.images import find_images
from splatseg_bench.layouts._reading import (
    ViewsByFile,
    read_mask,
    read_views,
    trained_on_all,
    true_mask,
)
from splatseg_bench.scene import BenchmarkScene, Scribble, TargetTask

LAYOUT = "nvos"

_LABELS = (".", "labels/llff", "labels", "nvos")
_SCENES = ("llff", "nerf_llff_data", "scenes", ".")
_LEVELS_UP = 2
_MASK = "_mask"
_HORNS = ("DJI_20200223_163055_437", "DJI_20200223_163024_597")


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewPair:
    """Which views of which scene a task is about."""

    scene: str
    reference: str
    """Stem of the photograph with the strokes."""

    target: str
    """Stem of the photograph whose mask is scored."""


VIEW_PAIRS = {
    "fern": ViewPair(scene="fern", reference="IMG_4038", target="IMG_4027"),
    "flower": ViewPair(scene="flower", reference="IMG_2983", target="IMG_2962"),
    "fortress": ViewPair(scene="fortress", reference="IMG_1821", target="IMG_1800"),
    "horns_center": ViewPair(scene="horns", reference=_HORNS[0], target=_HORNS[1]),
    "horns_left": ViewPair(scene="horns", reference=_HORNS[0], target=_HORNS[1]),
    "leaves": ViewPair(scene="leaves", reference="IMG_3011", target="IMG_2997"),
    "orchids": ViewPair(scene="orchids", reference="IMG_4479", target="IMG_4480"),
    "trex": ViewPair(
        scene="trex",
        reference="DJI_20200223_163607_906",
        target="DJI_20200223_163619_411",
    ),
}
"""The eight tasks of the benchmark. The views of others are told by their files."""


def find_nvos(folder: Path) -> bool:
    """Whether a folder has the benchmark's labels, or is a scene beside them."""
    if not _labels_below(folder) and not find_formats(folder):
        return False
    return _find_labels(folder) is not None


def read_nvos(folder: Path) -> tuple[BenchmarkScene, ...]:
    """Read the tasks of the benchmark, grouped by scene.

    Labels are ``scribbles/TASK/pos_*.png`` and ``neg_*.png`` (all strokes of a kind are taken
    together) and ``masks/TASK/VIEW_mask.png``, in the folder or in its ``labels/llff``. The
    scribbled view is that of ``reference_image/TASK/``, where that is there, else of
    `VIEW_PAIRS`. Scenes are captures in ``llff``, ``nerf_llff_data``, ``scenes`` (there called
    ``SCENE_undistort`` too) or beside the labels.

    Args:
        folder: With the labels, or a scene of it; then its tasks alone are read.

    Raises:
        MissingFileError: If labels or a scene are missing.
        InputError: If a file is of a view that the scene does not have.
    """
    root, labels = _labels_of(folder)
    tasks = sorted(child.name for child in (labels / "scribbles").iterdir() if child.is_dir())
    scenes: dict[Path, list[str]] = {}
    for task in tasks:
        scenes.setdefault(_scene_folder(root, labels, task), []).append(task)
    if folder.resolve() != root.resolve():
        asked = folder.resolve()
        scenes = {path: names for path, names in scenes.items() if path.resolve() == asked}
    if not scenes:
        raise InputError(f"{folder}: expected folders of scribbles of NVOS, got none.")
    return tuple(
        _scene(path, labels, names)
        for path, names in sorted(scenes.items(), key=lambda item: item[0].name)
    )


def _scene(path: Path, labels: Path, tasks: Iterable[str]) -> BenchmarkScene:
    capture = trained_on_all(read_views(path))
    views = ViewsByFile(capture)
    return BenchmarkScene(
        name=path.name.removesuffix("_undistort"),
        layout=LAYOUT,
        capture=capture,
        tasks=tuple(_task(name, labels, views) for name in tasks),
        notes=capture.notes,
    )


def _task(name: str, labels: Path, views: ViewsByFile) -> TargetTask:
    masks = [p for p in find_images(labels / "masks" / name) if p.stem.endswith(_MASK)]
    pair = VIEW_PAIRS.get(name)
    if len(masks) != 1:
        raise MissingFileError(
            f"{labels / 'masks' / name}: expected one mask called VIEW{_MASK}.png, got "
            f"{len(masks)}."
        )
    stem = masks[0].stem.removesuffix(_MASK)
    if pair is not None and stem != pair.target:
        raise InputError(
            f"{masks[0]}: expected the mask of {pair.target}, the target view of {name}."
        )
    return TargetTask(
        name=name,
        truth=(true_mask(masks[0], views.view(stem, where=masks[0])),),
        scribble=_scribble(name, labels, views),
    )


def _scribble(name: str, labels: Path, views: ViewsByFile) -> Scribble:
    folder = labels / "scribbles" / name
    files = find_images(folder)
    kinds = [tuple(p for p in files if p.stem.startswith(kind)) for kind in ("pos_", "neg_")]
    for kind, found in zip(("pos_*.png", "neg_*.png"), kinds, strict=True):
        if not found:
            raise MissingFileError(f"{folder}: expected scribbles called {kind}, got none.")
    photographs = find_images(labels / "reference_image" / name)
    where: Path = photographs[0] if photographs else folder
    if len(photographs) > 1:
        raise InputError(
            f"{where.parent}: expected the one photograph that is scribbled on, got "
            f"{len(photographs)}."
        )
    if photographs:
        stem = photographs[0].stem
    elif name in VIEW_PAIRS:
        stem = VIEW_PAIRS[name].reference
    else:
        raise MissingFileError(
            f"{labels / 'reference_image' / name}: expected the photograph that is scribbled on, "
            f"as {name} is no task of NVOS, got none."
        )
    view = views.view(stem, where=where)
    return Scribble(view=view.name, read=partial(_read_strokes, kinds[0], kinds[1], view))


def _read_strokes(
    on: tuple[Path, ...], off: tuple[Path, ...], view: View
) -> tuple[Bool[Tensor, "height width"], Bool[Tensor, "height width"]]:
    strokes = [_union(files, view) for files in (on, off)]
    if strokes[0].shape != strokes[1].shape:
        raise FileFormatError(
            f"{off[0]}: expected as many pixels as {on[0].name} has, {tuple(strokes[0].shape)}, "
            f"got {tuple(strokes[1].shape)}."
        )
    return strokes[0], strokes[1]


def _union(files: tuple[Path, ...], view: View) -> Bool[Tensor, "height width"]:
    union = read_mask(files[0], view)
    for path in files[1:]:
        more = read_mask(path, view)
        if more.shape != union.shape:
            raise FileFormatError(
                f"{path}: expected as many pixels as {files[0].name} has, {tuple(union.shape)}, "
                f"got {tuple(more.shape)}."
            )
        union = union | more
    return union


def _labels_below(folder: Path) -> Path | None:
    """The folder of ``scribbles`` and ``masks``."""
    for name in _LABELS:
        labels = folder / name
        if (labels / "scribbles").is_dir() and (labels / "masks").is_dir():
            return labels
    return None


def _labels_of(folder: Path) -> tuple[Path, Path]:
    """The data set's folder and that of its labels; a scene lies a folder or two below it."""
    found = _find_labels(folder)
    if found is None:
        raise MissingFileError(
            f"{folder}: expected the folders scribbles and masks of NVOS, there or in labels/llff, "
            "got none."
        )
    return found


def _find_labels(folder: Path) -> tuple[Path, Path] | None:
    for root in (folder, *list(folder.resolve().parents)[:_LEVELS_UP]):
        labels = _labels_below(root)
        if labels is not None:
            return root, labels
    return None


def _scene_folder(root: Path, labels: Path, task: str) -> Path:
    """Where the photographs of a task are."""
    if task in VIEW_PAIRS:
        names = [VIEW_PAIRS[task].scene]
    else:
        # A task of another collection: its scribbles are called pos_0_SCENE.png.
        files = find_images(labels / "scribbles" / task)
        written = [p.stem.split("_", 2)[2] for p in files if p.stem.count("_") >= 2]
        names = list(dict.fromkeys([*written, task]))
    tried = [root / place / name for place in _SCENES for name in names]
    tried += [root / "scenes" / f"{name}_undistort" for name in names]
    for path in tried:
        if path.is_dir() and find_formats(path):
            return path
    raise MissingFileError(
        f"{root}: expected the scene of the task {task} ({' or '.join(names)}) in "
        f"{', '.join(_SCENES[:-1])} or beside the labels, got none."
    )
