"""Tensors by name in files that run no code (safetensors, npz), and PyTorch's own, not run."""

import json
import math
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import torch
from msgspec import Meta
from torch import Tensor

from splatseg.errors import FileFormatError, InputError, MissingFileError, quoted
from splatseg.io.arrays import open_npz
from splatseg.io.atomic import atomic_file
from splatseg.io.foreign import expect, read_bytes, reading
from splatseg.io.json_files import parse_object
from splatseg.io.schema import structured

_TYPES = {
    "F64": torch.float64,
    "F32": torch.float32,
    "F16": torch.float16,
    "BF16": torch.bfloat16,
    "I64": torch.int64,
    "I32": torch.int32,
    "U8": torch.uint8,
}
_NAMES = {dtype: name for name, dtype in _TYPES.items()}
"""What safetensors call the types that are read and written."""

_MAX_HEADER = 100_000_000
_KIND = "a safetensors file"
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


@dataclass(frozen=True, slots=True)
class _Entry:
    """A tensor in the header of a safetensors file."""

    dtype: Literal["F64", "F32", "F16", "BF16", "I64", "I32", "U8"]
    shape: list[Annotated[int, Meta(ge=0, le=1 << 40)]]
    data_offsets: tuple[int, int]


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """All tensors of a ``.safetensors`` file by name, and the words that its header has of them.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is damaged, or holds types that are not numbers.
    """
    header, words, start = _header(path)
    body = memoryview(read_bytes(path, _KIND))[start:]
    return {name: _tensor(path, name, entry, body) for name, entry in header.items()}, words


def read_safetensors_words(path: Path) -> dict[str, str]:
    """The words that the header of a ``.safetensors`` file has; its tensors are not read.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If its header is damaged.
    """
    return _header(path)[1]


def _header(path: Path) -> tuple[dict[str, Any], dict[str, str], int]:
    """Entries of tensors, words about them, and the byte at which values start."""
    with reading(path, _KIND), path.open("rb") as file:
        first = file.read(8)
        length = int.from_bytes(first, "little")
        text = file.read(length) if length <= _MAX_HEADER else b""
    whole = len(first) == 8 and len(text) == length
    expect(whole, path, "a safetensors file, its header is cut off")
    header = parse_object(text, where=f"{path}: header")
    words = header.pop("__metadata__", {})
    return header, structured(words, dict[str, str], where=f"{path}: __metadata__"), 8 + length


def _tensor(path: Path, name: str, value: object, body: memoryview) -> Tensor:
    where = f"{path}: tensor {quoted(name)}"
    entry = structured(value, _Entry, where=where)
    dtype, (begin, end) = _TYPES[entry.dtype], entry.data_offsets
    fits = 0 <= begin <= end <= len(body)
    size = dtype.itemsize * math.prod(entry.shape)
    expect(fits and end - begin == size, where, f"{size} bytes within the file, as its shape says")
    if begin == end:
        with reading(where, "a tensor"):
            return torch.zeros(entry.shape, dtype=dtype)
    return torch.frombuffer(bytearray(body[begin:end]), dtype=dtype).reshape(entry.shape)


_ALIGNED = 8
"""Bytes that the header's length is a multiple of, so that numbers stand at even places."""


def write_tensors(
    tensors: Mapping[str, Tensor], path: Path, *, metadata: Mapping[str, str]
) -> None:
    """Write tensors to a ``.safetensors`` file; the same values give the same bytes.

    `splatseg.io.tensors.read_safetensors` is the inverse.

    Args:
        tensors: By name, of types that `read_tensors` reads, in the order in which they are
            written.
        path: The file.
        metadata: Text about them.

    Raises:
        InputError: If the name does not end in ``.safetensors``, or a tensor has another type.
        MissingFileError: If the folder of `path` does not exist.
        OutputError: If it cannot be written.
    """
    if path.suffix != ".safetensors":
        raise InputError(f"{path}: expected .safetensors, got {path.suffix or 'no suffix'}.")
    header: dict[str, object] = {"__metadata__": dict(metadata)} if metadata else {}
    end = 0
    for name, tensor in tensors.items():
        kind = _NAMES.get(tensor.dtype)
        if kind is None:
            raise InputError(f"{name}: expected a type of safetensors, got {tensor.dtype}.")
        begin, end = end, end + tensor.numel() * tensor.element_size()
        header[name] = {"dtype": kind, "shape": list(tensor.shape), "data_offsets": [begin, end]}
    words = json.dumps(header, separators=(",", ":")).encode()
    words += b" " * (-len(words) % _ALIGNED)
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        file.write(len(words).to_bytes(8, "little"))
        file.write(words)
        for tensor in tensors.values():
            values = tensor.detach().cpu().contiguous().reshape(-1)
            file.write(values.view(torch.uint8).numpy().tobytes())


_EXPECTED = "a checkpoint of PyTorch 1.6 or later, or safetensors"


class PickleStub:
    """Stands for every class and function that a checkpoint names besides those of tensors.

    Checkpoints of Lightning hold callbacks and options, which are of no use here. Whatever would
    be made of them becomes a dictionary that nobody reads.
    """

    def __new__(cls, *arguments: object) -> Any:
        """Make a dictionary, of a kind that takes both items and a state."""
        return OrderedDict[Any, Any]()


class NumpyStub:
    """Stands for NumPy's numbers and arrays, whose states are not those of dictionaries.

    Training programs leave their best scores in checkpoints.
    """

    def __init__(self, *arguments: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        """Forget it."""


def read_torch_file(path: Path) -> object:
    """What a file of PyTorch holds, by `torch.load` with ``weights_only``: nothing in it is run.

    Classes that it names, other than those of tensors, become `PickleStub` or `NumpyStub`. Tensors
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
    return NumpyStub if name.startswith("numpy.") else PickleStub
