"""Tensors by name from a file that runs no code: safetensors, or NumPy's npz.

PyTorch's own ``.pth`` files are pickles and are not read here; see `read_tensors`.
"""

import math
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from splatseg.core.json_values import json_integer
from splatseg.errors import FileFormatError, InputError, MissingFileError, quoted
from splatseg.io.foreign import read_bytes, reading
from splatseg.io.json_files import parse_object
from splatseg.io.npz import open_npz

_TYPES = {
    "F64": (torch.float64, 8),
    "F32": (torch.float32, 4),
    "F16": (torch.float16, 2),
    "BF16": (torch.bfloat16, 2),
    "I64": (torch.int64, 8),
    "I32": (torch.int32, 4),
    "U8": (torch.uint8, 1),
}
SAFETENSORS_NAMES = {dtype: name for name, (dtype, _) in _TYPES.items()}
"""What safetensors call the types that are read and written."""

_MAX_HEADER = 100_000_000
_MAX_SIDE = 1 << 40
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
        return read_safetensors(path)[0]
    if path.suffix in (".pth", ".pt", ".bin", ".ckpt"):
        raise InputError(
            f"{path}: expected .safetensors or .npz, got a pickle, which can run code; where you "
            f"trust it, convert it: {_CONVERT}"
        )
    raise InputError(f"{path}: expected .safetensors or .npz, got {path.suffix or 'no suffix'}.")


def _npz(path: Path) -> dict[str, Tensor]:
    with open_npz(path, expected="an npz file of numbers") as archive:
        arrays = {name: archive.array(name) for name in archive.names}
    text = [name for name, array in arrays.items() if array.dtype.kind == "U"]
    if text:
        raise FileFormatError(f"{path}: expected numbers in {quoted(text[0])}, got text.")
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """All tensors of a ``.safetensors`` file by name, and the words that its header has of them.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is damaged, or holds types that are not numbers.
    """
    data = read_bytes(path, "a safetensors file")
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > min(_MAX_HEADER, len(data) - 8):
        raise FileFormatError(f"{path}: expected a safetensors file, its header is cut off.")
    header = parse_object(data[8 : 8 + length], where=f"{path}: header")
    body = memoryview(data)[8 + length :]
    words = _words(path, header.pop("__metadata__", {}))
    tensors = {name: _tensor(path, name, entry, body) for name, entry in header.items()}
    return tensors, words


def read_safetensors_words(path: Path) -> dict[str, str]:
    """The words that the header of a ``.safetensors`` file has; its tensors are not read.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If its header is damaged.
    """
    with reading(path, "a safetensors file"), path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        text = file.read(length) if length <= _MAX_HEADER else b""
    if len(text) != length:
        raise FileFormatError(f"{path}: expected a safetensors file, its header is cut off.")
    return _words(path, parse_object(text, where=f"{path}: header").get("__metadata__", {}))


def _words(path: Path, words: object) -> dict[str, str]:
    if not isinstance(words, dict) or not all(isinstance(text, str) for text in words.values()):  # pyright: ignore[reportUnknownVariableType]
        raise FileFormatError(f"{path}: expected text in __metadata__, got {quoted(words)}.")
    return cast("dict[str, str]", words)


def _tensor(path: Path, name: str, entry: Any, body: memoryview) -> Tensor:
    fields = cast("dict[str, Any]", entry) if isinstance(entry, dict) else {}
    kind, sides, place = (fields.get(key) for key in ("dtype", "shape", "data_offsets"))
    where = f"{path}: tensor {quoted(name)}"
    if not isinstance(sides, list) or not isinstance(place, list) or len(place) != 2:  # pyright: ignore[reportUnknownArgumentType]
        raise FileFormatError(f"{where}: expected its type, shape and place, got {quoted(entry)}.")
    if not isinstance(kind, str) or kind not in _TYPES:
        raise FileFormatError(f"{where}: expected {', '.join(_TYPES)}, got {quoted(kind)}.")
    shape = [json_integer(n, where=where, high=_MAX_SIDE) for n in cast("list[object]", sides)]
    begin, end = (json_integer(n, where=where) for n in cast("list[object]", place))
    dtype, size = _TYPES[kind]
    if not begin <= end <= len(body) or end - begin != size * math.prod(shape):
        raise FileFormatError(f"{where}: it has not the size that its shape asks for.")
    if begin == end:
        with reading(where, "a tensor"):
            return torch.zeros(shape, dtype=dtype)
    return torch.frombuffer(bytearray(body[begin:end]), dtype=dtype).reshape(shape)
