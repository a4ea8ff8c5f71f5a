"""What readers of benchmarks share: true masks, folders of scenes, views."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from splatseg.core import UNLABELLED, Capture, LabelMap, View
from splatseg.errors import FileFormatError, InputError, quoted
from splatseg.io.captures import read_capture
from splatseg.io.evidence import read_id_map
from splatseg.io.foreign import reading
from splatseg.io.images import open_image
from splatseg_bench.scene import TrueMask

_ABOVE = 127
"""Grey values above this are the mask, in files with values above 1."""


def true_mask(path: Path, view: View) -> TrueMask:
    """The mask in a file, of a view; its pixels are not read."""
    return TrueMask(view=view.name, read=partial(read_mask, path, view))


def read_mask(path: Path, view: View) -> Bool[Tensor, "height width"]:
    """A mask in a picture of the view's proportions, of any size.

    Grey above 127 is the mask; in a file of zeros and ones the ones are; in a palette every
    colour but black is. Colours count by their luminance.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no picture, or has not the proportions of the photograph.
    """
    with open_image(path) as image:
        check_proportions(path, image.size, view)
        palette = image.mode == "P"
        with reading(path, "a mask"):
            wide = image.mode.startswith(("I", "F"))
            grey = np.asarray(image if wide else image.convert("L"))
    above = 0 if palette or grey.max(initial=0) <= 1 else _ABOVE
    return torch.from_numpy(grey > above)


def true_ids(path: Path, view: View) -> partial[LabelMap]:
    """Reads ids of pixels from a picture of one channel when it is called; 0 is none."""
    return partial(_read_ids, path, view)


def check_proportions(where: object, size: tuple[int, int], view: View) -> None:
    """Refuse a picture that is no smaller or larger one of the view's photograph.

    Args:
        where: The file; starts the message.
        size: Width and height of the picture.
        view: Its view.

    Raises:
        FileFormatError: If the sides are more than a pixel from a uniform scale.
    """
    camera = view.camera
    off = abs(size[0] * camera.height - size[1] * camera.width)
    if min(size) < 1 or off > max(camera.width, camera.height, *size):
        raise FileFormatError(
            f"{where}: expected {camera.width}x{camera.height} pixels as the photograph of view "
            f"{view.name!r} has, or a uniform scale of it, got {size[0]}x{size[1]}."
        )


def _read_ids(path: Path, view: View) -> LabelMap:
    ids = read_id_map(path)
    check_proportions(path, (ids.shape[1], ids.shape[0]), view)
    return LabelMap(ids=torch.from_numpy(np.where(ids > 0, ids, UNLABELLED).astype(np.int32)))


# What readers of benchmarks share: the folders of scenes, views by the words of a benchmark.


ALL_TRAIN = "every view is a training view, as the benchmark has it"
"""The note on captures whose benchmark fits to all photographs."""

_DEFAULT_SPLIT = "no split of its own"


def scene_folders(folder: Path, is_scene: Callable[[Path], bool]) -> tuple[Path, ...]:
    """The folder itself where it is a scene, else those of its folders that are, by name."""
    if is_scene(folder):
        return (folder,)
    if not folder.is_dir():
        return ()
    return tuple(sorted(child for child in folder.iterdir() if child.is_dir() and is_scene(child)))


def read_views(folder: Path, *, format: str = "auto") -> Capture:
    """The capture of a scene, of which no photograph may lack: numbers would not compare."""
    return read_capture(folder, format=format, strict=True)


def split_by(capture: Capture, split_of: Mapping[str, str], note: str) -> Capture:
    """The same capture with a split of the benchmark's own.

    Args:
        capture: As it was read.
        split_of: Split by name of the view; what it lacks is a training view.
        note: Says where the split comes from; it takes the place of that on the default split.
    """
    views = tuple(replace(view, split=split_of.get(view.name, "train")) for view in capture.views)
    notes = tuple(old for old in capture.notes if not old.startswith(_DEFAULT_SPLIT))
    return replace(capture, views=views, notes=(*notes, note))


def trained_on_all(capture: Capture) -> Capture:
    """The capture with all views for training, or as its ``sparse/0/test.txt`` splits it.

    That file holds the names of test photographs, one a line; 3DGS reads it, and COB-GS ships it
    for the scenes of NVOS.

    Raises:
        InputError: If it names a photograph that the capture does not have.
    """
    path = capture.path / "sparse" / "0" / "test.txt"
    if not path.is_file():
        return split_by(capture, {}, ALL_TRAIN)
    named = [
        line.strip() for line in path.read_text(encoding="utf-8", errors="replace").split("\n")
    ]
    names = ViewsByFile(capture)
    tests = {names.find(Path(name).stem, where=path): "test" for name in named if name}
    return split_by(capture, tests, "the split is that of sparse/0/test.txt")


class ViewsByFile:
    """Views of a capture by what a benchmark calls them: the stem of the photograph's file."""

    def __init__(self, capture: Capture) -> None:
        self._path = capture.path
        self._views: dict[str, View | None] = {}
        for view in capture.views:
            stem = view.name if view.image is None else view.image.stem
            # A stem that two photographs have tells neither.
            self._views[stem] = None if stem in self._views else view
        self._views |= {view.name: view for view in capture.views}

    def has(self, stem: str) -> bool:
        """Whether exactly one photograph is called so."""
        return self._views.get(stem) is not None

    def view(self, stem: str, *, where: object) -> View:
        """The view of a photograph.

        Args:
            stem: What the benchmark calls it.
            where: The file that speaks of it; starts the message.

        Raises:
            InputError: If there is none, or more than one.
        """
        view = self._views.get(stem)
        if view is None:
            shown = ", ".join(sorted(self._views)[:3])
            raise InputError(
                f"{where}: expected the name of one of the {len(self._views)} photographs of "
                f"{self._path} ({shown}, ...), got {quoted(stem)}."
            )
        return view

    def find(self, stem: str, *, where: object) -> str:
        """The name of the view of a photograph, see `view`."""
        return self.view(stem, where=where).name
