"""Tensors of a checkpoint: PyTorch's own files without running what is in them, or safetensors."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from torch import Tensor

from splatseg.errors import FileFormatError
from splatseg.io.tensors import read_tensors, read_torch_file


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """Floating point tensors of a file by name.

    Of a file of PyTorch nothing is run, see `read_torch_file`.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it cannot be read so, or holds no tensors by name.
    """
    if path.suffix == ".safetensors":
        tensors: Mapping[str, Any] = read_tensors(path)
    else:
        tensors = _state(read_torch_file(path), path)
    found = {
        name: value
        for name, value in tensors.items()
        if isinstance(value, Tensor) and value.is_floating_point()
    }
    if not found:
        raise FileFormatError(f"{path}: expected tensors by name, got none.")
    return found


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
