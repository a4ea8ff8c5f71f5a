"""Tensors by name from a file that runs no code: safetensors, or NumPy's npz.

PyTorch's own ``.pth`` files are pickles and are not read here; see `read_tensors`.
"""

import json
import math
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from splatseg.errors import FileFormatError, InputError, MissingFileError

_TYPES = {
    "F64": (torch.float64, 8),
    "F32": (torch.float32, 4),
    "F16": (torch.float16, 2),
    "BF16": (torch.bfloat16, 2),
    "I64": (torch.int64, 8),
    "I32": (torch.int32, 4),
    "U8": (torch.uint8, 1),
}
_MAX_HEADER = 100_000_000
_CONVERT = (
    "python -c \"import numpy, torch; numpy.savez('weights.npz', "
    "**torch.load('weights.pth', weights_only=True))\""
)


def read_tensors(path: Path) -> dict[str, Tensor]:
    """All tensors of a ``.safetensors`` or ``.npz`` file, by name.

    The first eight bytes of a safetensors file are the length of a JSON header, little endian;
    it gives each tensor's type, shape and place in what follows.

    Raises:
        MissingFileError: If there is no such file.
        InputError: If it is of another kind; for ``.pth`` files the message says how to make one
            of these of it.
        FileFormatError: If it is damaged, or holds types that are not numbers.
    """
    if not path.is_file():
        raise MissingFileError(f"{path}: there is no such file of weights.")
    if path.suffix == ".npz":
        return _npz(path)
    if path.suffix == ".safetensors":
        return _safetensors(path)
    if path.suffix in (".pth", ".pt", ".bin", ".ckpt"):
        raise InputError(
            f"{path}: expected .safetensors or .npz, got a pickle, which can run code; where you "
            f"trust it, convert it: {_CONVERT}"
        )
    raise InputError(f"{path}: expected .safetensors or .npz, got {path.suffix or 'no suffix'}.")


def _npz(path: Path) -> dict[str, Tensor]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: torch.from_numpy(np.array(file[name])) for name in file.files}
    except (ValueError, OSError, KeyError, TypeError, EOFError) as error:
        raise FileFormatError(f"{path}: expected an npz file of numbers ({error}).") from error


def _safetensors(path: Path) -> dict[str, Tensor]:
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > min(_MAX_HEADER, len(data) - 8):
        raise FileFormatError(f"{path}: expected a safetensors file, its header is cut off.")
    try:
        header: Any = json.loads(data[8 : 8 + length])
    except ValueError as error:
        raise FileFormatError(f"{path}: expected a header of JSON ({error}).") from error
    if not isinstance(header, dict):
        raise FileFormatError(f"{path}: expected a header of tensors by name, got something else.")
    body = memoryview(data)[8 + length :]
    entries = cast(dict[str, Any], header)
    return {
        name: _tensor(path, name, entry, body)
        for name, entry in entries.items()
        if name != "__metadata__"
    }


def _tensor(path: Path, name: str, entry: Any, body: memoryview) -> Tensor:
    try:
        kind, shape = str(entry["dtype"]), [int(n) for n in entry["shape"]]
        begin, end = (int(n) for n in entry["data_offsets"])
    except (KeyError, TypeError, ValueError) as error:
        raise FileFormatError(f"{path}: expected type, shape and place of {name!r}.") from error
    if kind not in _TYPES:
        raise FileFormatError(f"{path}: expected {name!r} of {', '.join(_TYPES)}, got {kind}.")
    dtype, size = _TYPES[kind]
    fits = 0 <= begin <= end <= len(body) and all(n >= 0 for n in shape)
    if not fits or end - begin != size * math.prod(shape):
        raise FileFormatError(f"{path}: {name!r} has not the size that its shape asks for.")
    if begin == end:
        return torch.zeros(shape, dtype=dtype)
    return torch.frombuffer(bytearray(body[begin:end]), dtype=dtype).reshape(shape)
