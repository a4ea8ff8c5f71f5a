"""Depth maps of a capture: what a sensor measured, or a network guessed."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from splatseg.core import View
from splatseg.errors import FileFormatError, InputError
from splatseg.io.images import open_image
from splatseg.io.npy import read_npy


def load_depth(view: View) -> Float[torch.Tensor, "rows columns"]:
    """The depth map of a view in scene units; 0 where it knows nothing.

    An image of one channel (8 or 16 bits, or floating point) or an ``.npy`` file, times
    `View.depth_unit`. It has any resolution and covers the whole photograph. Values that are
    negative or not finite become 0.

    Raises:
        InputError: If the view has no depth map.
        MissingFileError: If the file is not where it was.
        FileFormatError: If it cannot be decoded, or has more than one channel.
    """
    if view.depth is None:
        raise InputError(f"view {view.name!r}: expected a view with a depth map, got one without.")
    values = _npy(view.depth) if view.depth.suffix == ".npy" else _image(view.depth)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2 or values.size == 0:
        raise FileFormatError(
            f"{view.depth}: expected a depth map of one channel, got shape {values.shape}."
        )
    depth = values.astype(np.float32) * np.float32(view.depth_unit or 1.0)
    depth[~(np.isfinite(depth) & (depth > 0))] = 0
    return torch.from_numpy(depth)


def _npy(path: Path) -> NDArray[np.generic]:
    array = read_npy(path)
    if array.dtype.kind not in "biuf":
        raise FileFormatError(f"{path}: expected a depth map of numbers, got text.")
    return array


def _image(path: Path) -> NDArray[np.generic]:
    with open_image(path) as image:
        try:
            return np.array(image)
        except (OSError, SyntaxError, ValueError) as error:
            raise FileFormatError(f"{path}: cannot be decoded ({error}).") from error
