"""Our own files of features: float16, one or several depths of a network, and a class token."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_finite
from splatseg.core import FeatureMap
from splatseg.core.models import DeepFeatures
from splatseg.errors import FileFormatError, InputError
from splatseg.io.arrays import read_npz

_MAX_PIXELS = 1 << 24
_BLOCKS, _TOKEN = "blocks", "class_token"


def features_content(what: str, features: FeatureMap | DeepFeatures) -> dict[str, NDArray[Any]]:
    """The arrays of a file, in the order in which they are written.

    The deepest map has the names that a single one has. Where there are more, or a class token,
    ``blocks`` names all depths, and ``features_0``, ``stride_0`` and so on are the shallower.

    Args:
        what: The view's name, for messages.
        features: What a model saw.

    Raises:
        RangeError: If a value is NaN or infinite, or beyond the range of float16.
        InputError: If the maps are of images of several sizes, or depths share a name.
    """
    if isinstance(features, FeatureMap):
        return _map_content(what, features, "")
    deepest, token = features.maps[-1], features.class_token
    found = _map_content(what, deepest, "")
    if len(features.maps) == 1 and token is None:
        return found
    if len(set(features.depths)) != len(features.depths):
        raise InputError(
            f"{what}: expected depths of different names, got {', '.join(features.depths)}."
        )
    found[_BLOCKS] = np.array(features.depths)
    for i, one in enumerate(features.maps[:-1]):
        if (one.height, one.width) != (deepest.height, deepest.width):
            raise InputError(
                f"{what}: expected maps of one image of {deepest.width}x{deepest.height}, got one "
                f"of {one.width}x{one.height}."
            )
        content = _map_content(what, one, f"_{i}")
        del content[f"size_{i}"]
        found |= content
    if token is not None:
        found[_TOKEN] = _half(f"{what}: class token", token)
    return found


def own_features(path: Path, block: str | None) -> FeatureMap:
    """The features of a file at one depth, of the deepest if that is None.

    Raises:
        InputError: If the file has no such depth.
        FileFormatError: If it does not hold features.
    """
    at = ""
    if block is not None:
        blocks = own_blocks(path)
        if block not in blocks:
            known = (
                f"one of the blocks {', '.join(blocks)}" if blocks else "no block, as it has none"
            )
            raise InputError(f"{path}: expected {known}, got {block!r}.")
        index = blocks.index(block)
        at = "" if index == len(blocks) - 1 else f"_{index}"
    arrays = read_npz(path, [f"features{at}", f"stride{at}", "size"])
    features, size = arrays[f"features{at}"], arrays["size"]
    check_finite_numbers(path, "features", features)
    if (
        features.ndim != 3
        or features.dtype.kind != "f"
        or size.shape != (2,)
        or 0 in features.shape
    ):
        raise FileFormatError(
            f"{path}: expected features of shape (rows, columns, channels) and a size, "
            f"got {features.dtype} of {features.shape}."
        )
    return FeatureMap(
        features=torch.from_numpy(features.astype(np.float32)),
        stride=whole_pixels(path, "stride", arrays[f"stride{at}"]),
        height=whole_pixels(path, "height", size[:1]),
        width=whole_pixels(path, "width", size[1:]),
    )


def own_blocks(path: Path) -> tuple[str, ...]:
    """Names of the depths of a file, the deepest last; none where it has one map alone.

    Raises:
        FileFormatError: If it is no npz, or the names are none.
    """
    found = read_npz(path, (), optional=(_BLOCKS,)).get(_BLOCKS)
    if found is None:
        return ()
    if found.ndim != 1 or found.dtype.kind != "U" or not found.size:
        raise FileFormatError(f"{path}: expected the names of blocks, got others.")
    names = tuple(str(name) for name in found)
    if len(set(names)) != len(names):
        raise FileFormatError(f"{path}: expected blocks of different names, got the same twice.")
    return names


def own_class_token(path: Path) -> Float[Tensor, "width"] | None:
    """The class token of a file, if it has one.

    Raises:
        FileFormatError: If it is no npz, or the token no vector of numbers.
    """
    found = read_npz(path, (), optional=(_TOKEN,)).get(_TOKEN)
    if found is None:
        return None
    check_finite_numbers(path, "class token", found)
    if found.ndim != 1 or found.dtype.kind != "f":
        raise FileFormatError(
            f"{path}: expected the class token as one vector, got {found.dtype} of {found.shape}."
        )
    return torch.from_numpy(found.astype(np.float32))


def whole_pixels(path: Path, name: str, value: NDArray[Any]) -> int:
    """A positive number of pixels that an array of one holds."""
    whole = value.size == 1 and value.dtype.kind in "iu"
    number = int(value.reshape(-1)[0]) if whole else 0
    if not 0 < number <= _MAX_PIXELS:
        raise FileFormatError(f"{path}: expected {name} as one whole number of pixels.")
    return number


def check_finite_numbers(path: Path, name: str, values: NDArray[Any]) -> None:
    """Refuse what is no number, NaN or infinite."""
    if values.dtype.kind not in "fiu":
        raise FileFormatError(f"{path}: expected {name} as numbers, got {values.dtype}.")
    bad = values.size - int(np.isfinite(values).sum()) if values.dtype.kind == "f" else 0
    if bad:
        raise FileFormatError(
            f"{path}: expected finite {name}, got {bad} of {values.size} values that are NaN or "
            "infinite."
        )


def _map_content(what: str, one: FeatureMap, at: str) -> dict[str, NDArray[Any]]:
    return {
        f"features{at}": _half(f"{what}: features", one.features),
        f"stride{at}": np.array(one.stride, np.int64),
        f"size{at}": np.array([one.height, one.width], np.int64),
    }


def _half(what: str, values: Tensor) -> NDArray[np.float16]:
    check_finite(what, values)
    half = values.detach().cpu().to(torch.float16)
    check_finite(f"{what} as float16", half)
    return half.numpy()
