"""Files of PyTorch (``torch.save``), read without running what is in them."""

import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any, cast

import torch

from splatseg.errors import FileFormatError
from splatseg.io.foreign import reading

_EXPECTED = "a checkpoint of PyTorch 1.6 or later, or safetensors"


class Inert:
    """Stands for every class and function that a checkpoint names besides those of tensors.

    Checkpoints of Lightning hold callbacks and options, which are of no use here. Whatever would
    be made of them becomes a dictionary that nobody reads.
    """

    def __new__(cls, *arguments: object) -> Any:
        """Make a dictionary, of a kind that takes both items and a state."""
        return OrderedDict[Any, Any]()


class InertNumber:
    """Stands for NumPy's numbers and arrays, whose states are not those of dictionaries.

    Training programs leave their best scores in checkpoints.
    """

    def __init__(self, *arguments: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        """Forget it."""


def read_torch_file(path: Path) -> object:
    """What a file of PyTorch holds, by `torch.load` with ``weights_only``: nothing in it is run.

    Classes that it names, other than those of tensors, become `Inert` or `InertNumber`. Tensors
    are mapped from the file: they must be copied before it is changed.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it cannot be read so.
    """
    with reading(path, _EXPECTED):
        if path.stat().st_size and not zipfile.is_zipfile(path):
            raise FileFormatError(f"{path}: expected {_EXPECTED}, got another kind of file.")
        try:
            named = torch.serialization.get_unsafe_globals_in_checkpoint(path)
            with torch.serialization.safe_globals([(_stand_in(name), name) for name in named]):
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


def _stand_in(name: str) -> type:
    return InertNumber if name.startswith("numpy.") else Inert
