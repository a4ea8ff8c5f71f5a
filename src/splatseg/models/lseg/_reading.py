"""Tensors of a checkpoint: PyTorch's own files without running what is in them, or safetensors."""

import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from splatseg.errors import FileFormatError
from splatseg.io.foreign import reading
from splatseg.io.tensors import read_tensors

_EXPECTED = "a checkpoint of PyTorch 1.6 or later, or safetensors"


class Inert:
    """Stands for every class and function that a checkpoint names besides those of tensors.

    Checkpoints of Lightning hold callbacks and options, which are of no use here. Whatever would
    be made of them becomes a dictionary that nobody reads.
    """

    def __new__(cls, *arguments: object) -> Any:
        """Make a dictionary, of a kind that takes both items and a state."""
        return OrderedDict[Any, Any]()


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """Floating point tensors of a file by name.

    A file of PyTorch is read with ``weights_only``, so that nothing in it is run; classes that it
    names, other than those of tensors, become `Inert`.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it cannot be read so, or holds no tensors by name.
    """
    if path.suffix == ".safetensors":
        tensors: Mapping[str, Any] = read_tensors(path)
    else:
        tensors = _state(_loaded(path), path)
    found = {
        name: value
        for name, value in tensors.items()
        if isinstance(value, Tensor) and value.is_floating_point()
    }
    if not found:
        raise FileFormatError(f"{path}: expected tensors by name, got none.")
    return found


def _loaded(path: Path) -> object:
    with reading(path, _EXPECTED):
        if path.stat().st_size and not zipfile.is_zipfile(path):
            raise FileFormatError(f"{path}: expected {_EXPECTED}, got another kind of file.")
        named = torch.serialization.get_unsafe_globals_in_checkpoint(path)
        try:
            with torch.serialization.safe_globals([(Inert, name) for name in named]):
                # Mapped and not read: optimizers' states, which are as large as the weights,
                # are never touched.
                return cast(
                    object, torch.load(path, map_location="cpu", weights_only=True, mmap=True)
                )
        except (pickle.UnpicklingError, AssertionError) as error:
            raise FileFormatError(
                f"{path}: expected a checkpoint of tensors and plain values, got one that only the "
                "program it is of can read; its state_dict saved as safetensors is taken."
            ) from error


def _state(content: object, path: Path) -> Mapping[str, Any]:
    """Tensors by name of what a checkpoint holds: Lightning's ``state_dict``, or the whole."""
    for _ in range(2):
        if not isinstance(content, Mapping):
            break
        inner = cast(Mapping[object, object], content)
        if "state_dict" not in inner:
            return {str(name): value for name, value in inner.items()}
        content = inner["state_dict"]
    raise FileFormatError(
        f"{path}: expected tensors by name or a state_dict of them, got {type(content).__name__}."
    )
