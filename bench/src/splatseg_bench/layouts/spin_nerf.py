"""SPIn-NeRF's multi-view segmentation: true masks of one object in many views of a scene.

Mirzaei et al., SPIn-NeRF: Multiview Segmentation and Perceptual Inpainting with Neural Radiance
Fields, CVPR 2023.
"""

from pathlib import Path

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.captures import find_formats
from splatseg.io.foreign import read_lines
from splatseg.io.images import find_images
from splatseg_bench.layouts._reading import (
    ViewsByFile,
    read_views,
    scene_folders,
    trained_on_all,
    true_mask,
)
from splatseg_bench.scene import BenchmarkScene, TargetTask

LAYOUT = "spin-nerf"

_FOLDERS = ("masks", "label", "labels", "images_4/label", "images/label", "images_2/label")
_MASK = "_mask"

WORDS_FILE = "words.txt"
"""What asks for a scene's object in words, one line. The data set has no such file: it is for
scenes of one's own."""


def find_spin_nerf(folder: Path) -> tuple[Path, ...]:
    """Folders of scenes: captures with a folder of masks."""
    return scene_folders(folder, _is_scene)


def read_spin_nerf(folder: Path) -> tuple[BenchmarkScene, ...]:
    """Read scenes, one task each: the object, by its mask in the first annotated view.

    A scene is a capture with a folder of masks, one a view that is annotated, called as its
    photograph or ``VIEW_mask``: ``masks``, ``label``, ``labels`` or ``label`` in the folder of
    photographs. Views are sorted by name; the mask of the first is the prompt, and it is among
    those that are scored: a protocol that leaves it out says so. ``words.txt`` in the scene's
    folder, one line, has the words that ask for the object; it may lack.

    Args:
        folder: A scene, or the folder of several.

    Raises:
        MissingFileError: If there is no scene, or it has no masks.
        InputError: If a mask is of a view that the scene does not have.
        FileFormatError: If ``words.txt`` has not one line.
    """
    scenes = find_spin_nerf(folder)
    if not scenes:
        raise MissingFileError(
            f"{folder}: expected captures with masks in {', '.join(_FOLDERS)}, got none."
        )
    return tuple(_scene(path) for path in scenes)


def _scene(path: Path) -> BenchmarkScene:
    capture = trained_on_all(read_views(path))
    views = ViewsByFile(capture)
    found = {}
    for file in _masks(path):
        stem = file.stem if views.has(file.stem) else file.stem.removesuffix(_MASK)
        view = views.view(stem, where=file)
        if view.name in found:
            raise InputError(f"{file}: expected one mask of a view, got two of {view.name!r}.")
        found[view.name] = true_mask(file, view)
    truth = tuple(found[name] for name in sorted(found))
    return BenchmarkScene(
        name=path.name,
        layout=LAYOUT,
        capture=capture,
        tasks=(TargetTask(name=path.name, truth=truth, reference=truth[0], words=_words(path)),),
        notes=capture.notes,
    )


def _words(path: Path) -> str | None:
    file = path / WORDS_FILE
    if not file.is_file():
        return None
    lines = read_lines(file, "words")
    if len(lines) != 1:
        raise FileFormatError(
            f"{file}: expected one line, the words that ask for the object, got {len(lines)}."
        )
    return lines[0]


def _masks(path: Path) -> tuple[Path, ...]:
    return next((found for name in _FOLDERS if (found := find_images(path / name))), ())


def _is_scene(path: Path) -> bool:
    return bool(_masks(path)) and bool(find_formats(path))
