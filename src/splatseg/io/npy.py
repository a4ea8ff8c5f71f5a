"""Arrays of NumPy in files: their headers, held against the bytes that are there.

This and `npz` are all that reads arrays: nothing is allocated before the header is known to be
true, and no object of Python is ever made from a file (no pickles).
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError
from splatseg.io.foreign import reading

KINDS = "biufU"
"""Kinds of arrays that are read: booleans, integers, real numbers, text."""

_MAX_HEADER = 4096
_MAX_SIDE = 1 << 40
_MAX_ITEM = 8
"""Bytes of a number; what has more (long doubles) torch does not know."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ArrayHeader:
    """What the first bytes of an array say."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    order: Literal["C", "F"]
    offset: int
    """Bytes of the header."""

    @property
    def nbytes(self) -> int:
        """Bytes that the values take."""
        return math.prod(self.shape) * self.dtype.itemsize


def read_header(file: IO[bytes], *, size: int, where: object) -> ArrayHeader:
    """The header of an array of `size` bytes, checked; leaves `file` at the first value.

    Raises:
        FileFormatError: If it is damaged, of a type that is not read, or promises another number
            of bytes than there are.
    """
    with reading(where, "an array of NumPy"):
        version = np.lib.format.read_magic(file)
        read = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }.get(version)
        if read is None:
            raise FileFormatError(
                f"{where}: expected an array of NumPy of version 1 or 2, got version {version[0]}."
            )
        shape, fortran, dtype = read(file, max_header_size=_MAX_HEADER)
        header = ArrayHeader(
            shape=tuple(int(n) for n in shape),
            dtype=dtype,
            order="F" if fortran else "C",
            offset=file.tell(),
        )
    _check(header, size, where)
    return header


def read_npy(path: Path, *, mapped: bool = False) -> NDArray[Any]:
    """The array of an ``.npy`` file, in the machine's byte order.

    Args:
        path: The file.
        mapped: Leave the values in the file: pages are read when they are looked at, and what
            is written stays in memory (copy on write).

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no array of numbers or text, or shorter or longer than it says.
    """
    with reading(path, "an array of NumPy"), path.open("rb") as file:
        size = path.stat().st_size
        header = read_header(file, size=size, where=path)
        if mapped and header.nbytes:
            return _mapped(path, header, offset=header.offset)
        return filled(file, header)


def map_values(path: Path, *, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """Values of a file without a header, left in it: pages are read when they are looked at.

    Args:
        path: The file.
        dtype: Type of a value, with its byte order.
        shape: Of the array that the file holds and nothing else.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is shorter or longer than these values.
    """
    header = ArrayHeader(shape=shape, dtype=np.dtype(dtype), order="C", offset=0)
    with reading(path, "values of NumPy"):
        size = path.stat().st_size
        if size != header.nbytes:
            raise FileFormatError(
                f"{path}: expected {header.nbytes} bytes, {shape} values of {header.dtype}, "
                f"got {size}."
            )
        return _mapped(path, header, offset=0) if size else np.zeros(shape, header.dtype)


def _mapped(path: Path, header: ArrayHeader, *, offset: int) -> NDArray[Any]:
    """What is written to it stays in memory (copy on write)."""
    return np.memmap(path, header.dtype, "c", offset, header.shape, order=header.order)


def filled(file: IO[bytes], header: ArrayHeader) -> NDArray[Any]:
    """The values that follow a header, in the machine's byte order.

    Raises:
        EOFError: If there are fewer.
        ValueError: If text holds what is no character.
    """
    data, at = bytearray(header.nbytes), 0
    view = memoryview(data)
    while at < header.nbytes:
        step = file.readinto(view[at : at + (1 << 20)])  # type: ignore[attr-defined]
        if not step:
            raise EOFError(f"it ends after {at} of {header.nbytes} bytes")
        at += step
    if header.dtype.kind == "b":  # a byte that is neither 0 nor 1 would be neither true nor false
        array = np.frombuffer(data, np.uint8) != 0
    else:
        array = np.frombuffer(data, header.dtype) if data else np.empty(0, header.dtype)
    array = array.reshape(header.shape, order=header.order)
    array = array.astype(header.dtype.newbyteorder("="), copy=False)
    if header.dtype.kind == "U":
        codes = np.frombuffer(data, np.dtype("u4").newbyteorder(header.dtype.byteorder))
        if ((codes > 0x10FFFF) | ((codes >= 0xD800) & (codes < 0xE000))).any():
            raise ValueError("its text is no Unicode")
    return array


def _check(header: ArrayHeader, size: int, where: object) -> None:
    dtype, shape = header.dtype, header.shape
    if dtype.kind not in KINDS or (dtype.kind != "U" and dtype.itemsize > _MAX_ITEM):
        what = "objects, and nothing is unpickled" if dtype.kind == "O" else repr(dtype.kind)
        raise FileFormatError(f"{where}: expected an array of numbers or text, got {what}.")
    if any(not 0 <= side < _MAX_SIDE for side in shape) or (
        math.prod(shape) and not dtype.itemsize
    ):
        raise FileFormatError(f"{where}: expected the shape of an array, got one that cannot be.")
    if header.offset + header.nbytes != size:
        raise FileFormatError(
            f"{where}: expected {header.nbytes} bytes of values, as its header says, got "
            f"{size - header.offset}."
        )
