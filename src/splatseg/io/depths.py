"""Depth maps: what a sensor measured, or a network guessed; of captures and of evidence."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from splatseg.core import DepthKind, DepthMap, View
from splatseg.errors import InputError
from splatseg.io.arrays import npz_names, read_npy, read_npz
from splatseg.io.foreign import expect, reading
from splatseg.io.images import open_image

DEPTH_NAME = "depth"
"""The array of an npz that is a depth map of evidence."""

_KINDS: dict[str, DepthKind] = {"metric": "metric", "relative": "relative"}


def load_depth(view: View) -> Float[torch.Tensor, "rows columns"]:
    """The depth map of a view in scene units; 0 where it knows nothing.

    An image of one channel (8 or 16 bits, or floating point), an ``.npy`` file or an npz of
    evidence, times `View.depth_unit`. It has any resolution and covers the whole photograph.
    Values that are negative or not finite become 0.

    Raises:
        InputError: If the view has no depth map.
        MissingFileError: If the file is not where it was.
        FileFormatError: If it cannot be decoded, or has more than one channel.
    """
    if view.depth is None:
        raise InputError(f"view {view.name!r}: expected a view with a depth map, got one without.")
    return _cleaned(view.depth, _values(view.depth), unit=view.depth_unit or 1.0)


def depth_kind(path: Path) -> DepthKind | None:
    """What an npz of evidence says that its depths are; None for other files.

    Raises:
        FileFormatError: If it is no depth map of evidence.
    """
    if path.suffix != ".npz":
        return None
    kind = read_npz(path, ["kind"])["kind"]
    word = str(kind) if kind.ndim == 0 and kind.dtype.kind == "U" else ""
    expect(word in _KINDS, path, "kind metric or relative", word)
    return _KINDS[word]


def read_depth_map(path: Path, *, unit: float | None = None) -> DepthMap:
    """A depth map of evidence: our own npz, or an image or ``.npy`` that another program wrote.

    Args:
        path: The file.
        unit: Metres of one step of an image or an ``.npy``, whose depths are metric then; None
            says that they are relative. An npz tells its kind itself.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no depth map.
    """
    kind = depth_kind(path)
    values = _cleaned(path, _values(path), unit=1.0 if kind is not None or unit is None else unit)
    confidence = None
    if kind is not None and "confidence" in npz_names(path):
        confidence = torch.from_numpy(_confidence(path, tuple(values.shape)))
    found = kind or ("relative" if unit is None else "metric")
    return DepthMap(values=values, kind=found, confidence=confidence)


def _cleaned(
    path: Path, values: NDArray[np.generic], *, unit: float
) -> Float[torch.Tensor, "rows columns"]:
    """Depths times their unit, 0 where they are negative or not finite."""
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    single = values.ndim == 2 and values.size
    expect(single, path, f"a depth map of one channel, got shape {values.shape}")
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite becomes 0
        depth = values.astype(np.float32) * np.float32(unit)
    depth[~(np.isfinite(depth) & (depth > 0))] = 0
    return torch.from_numpy(depth)


def _values(path: Path) -> NDArray[np.generic]:
    if path.suffix == ".npz":
        return _numbers(path, read_npz(path, [DEPTH_NAME])[DEPTH_NAME])
    if path.suffix == ".npy":
        return _numbers(path, read_npy(path))
    with open_image(path) as image, reading(path, "an image of depths"):
        return np.array(image)


def _confidence(path: Path, shape: tuple[int, ...]) -> NDArray[np.float32]:
    found = _numbers(path, read_npz(path, ["confidence"])["confidence"])
    what = f"a confidence of each of {shape[1]}x{shape[0]} depths, got shape {found.shape}"
    expect(found.shape == shape, path, what)
    values = found.astype(np.float32)
    within = ((values >= 0) & (values <= 1)).all()
    expect(within, path, "confidences in [0, 1], got others")
    return values


def _numbers(path: Path, array: NDArray[np.generic]) -> NDArray[np.generic]:
    expect(array.dtype.kind in "biuf", path, "a depth map of numbers, got text")
    return array
