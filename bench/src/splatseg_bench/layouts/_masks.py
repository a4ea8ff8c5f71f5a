"""Masks and maps of ids in pictures, read when somebody asks for them."""

from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from splatseg.core import UNLABELLED, LabelMap, View
from splatseg.errors import FileFormatError
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
