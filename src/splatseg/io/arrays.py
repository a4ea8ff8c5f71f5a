"""Arrays of NumPy in files (``.npy``, ``.npz``): all that reads and writes them.

Headers are held against the bytes that are there before anything is allocated, members of archives
are read only as far as they may unpack, and no object of Python is ever made from a file (no
pickles). Archives are written uncompressed and without time stamps: the same values give the same
bytes.
"""

import io
import math
import zipfile
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal
from zipfile import ZipFile

import numpy as np
from numpy.lib.format import write_array
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, MissingFileError, quoted
from splatseg.io.atomic import named_write_failures, sync
from splatseg.io.foreign import expect, malformed, reading
from splatseg.io.json_files import json_text
from splatseg.io.limits import check_unpacked

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 1


@contextmanager
def open_archive(
    source: Path | IO[bytes], *, where: object, expected: str
) -> Generator[zipfile.ZipFile]:
    """A ZIP archive to read; what is damaged in it becomes the documented error.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no archive, or damaged.
    """
    with reading(where, expected):
        archive = zipfile.ZipFile(source)
    with archive:
        yield archive


@contextmanager
def open_member(
    archive: zipfile.ZipFile, name: str, *, where: object, expected: str
) -> Generator[tuple[IO[bytes], int]]:
    """A member to read, and the bytes it says that it unpacks to.

    Raises:
        FileFormatError: If there is none of this name, or it is encrypted or compressed in a way
            that nobody uses for these files (bz2, LZMA), or damaged.
    """
    with reading(where, expected):
        info = archive.NameToInfo.get(name)
        if info is None:
            raise FileFormatError(f"{where}: expected a member {quoted(name)}, got none.")
        what = f"{quoted(name)} stored or deflated, got a member that is encrypted or compressed "
        what += "otherwise"
        plain = info.compress_type in _METHODS and not info.flag_bits & _ENCRYPTED
        expect(plain, where, what)
        with archive.open(info) as member:
            yield member, info.file_size


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
            raise malformed(where, f"an array of NumPy of version 1 or 2, got version {version[0]}")
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
    sound = all(0 <= side < _MAX_SIDE for side in shape)
    sound = sound and bool(not math.prod(shape) or dtype.itemsize)
    expect(sound, where, "the shape of an array, got one that cannot be")
    wanted = f"{header.nbytes} bytes of values, as its header says, got {size - header.offset}"
    expect(header.offset + header.nbytes == size, where, wanted)


_SUFFIX = ".npy"


class Npz:
    """An archive of arrays, of which each is unpacked when it is asked for."""

    def __init__(self, archive: ZipFile, *, where: object, size: int, expected: str) -> None:
        self.where = where
        self._archive = archive
        self._size = size
        self._expected = expected
        self._unpacked = 0
        members = archive.namelist()
        self.names = tuple(n.removesuffix(_SUFFIX) for n in members if n.endswith(_SUFFIX))
        """Names of the arrays, in file order; members of other kinds are passed over."""

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def array(self, name: str) -> NDArray[Any]:
        """One array.

        Raises:
            FileFormatError: If there is none of this name, it is damaged or holds objects, or the
                archive would unpack to more than a file of its size may.
        """
        what = f"an array {quoted(name)}, got {_listed(self.names) or 'none'}"
        expect(name in self.names, self.where, what)
        place = f"{self.where}: array {quoted(name)}"
        with open_member(
            self._archive, name + _SUFFIX, where=self.where, expected=self._expected
        ) as (member, size):
            header = read_header(member, size=size, where=place)
            self._unpacked += header.nbytes
            check_unpacked(self.where, self._unpacked, packed=self._size, what="arrays")
            array = filled(member, header)
            member.read(1)  # at the end of the member its check sum is looked at
        return array


@contextmanager
def open_npz(
    source: Path | bytes, *, where: object = None, expected: str = "an npz"
) -> Generator[Npz]:
    """An npz to read arrays from.

    Args:
        source: The file, or its bytes.
        where: What starts the message of an error; the file by default.
        expected: What the file should be, for messages.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no npz.
    """
    where = source if where is None and isinstance(source, Path) else where
    if isinstance(source, Path) and not source.is_file():
        raise MissingFileError(f"{source}: there is no such file.")
    size = source.stat().st_size if isinstance(source, Path) else len(source)
    opened = source if isinstance(source, Path) else io.BytesIO(source)
    with open_archive(opened, where=where, expected=expected) as archive:
        yield Npz(archive, where=where, size=size, expected=expected)


def read_npz(
    path: Path, names: Sequence[str], *, optional: Sequence[str] = ()
) -> dict[str, NDArray[Any]]:
    """Named arrays of an npz, and those of the optional ones that are there.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no npz, or lacks one of them.
    """
    with open_npz(path) as archive:
        there = [name for name in optional if name in archive]
        return {name: archive.array(name) for name in (*names, *there)}


def npz_names(path: Path) -> tuple[str, ...]:
    """Names of the arrays of an npz; none where it is no npz."""
    try:
        with open_npz(path) as archive:
            return archive.names
    except (FileFormatError, MissingFileError):
        return ()


def _listed(names: Sequence[str]) -> str:
    return ", ".join(quoted(name, 40).strip("'") for name in names[:8])


HEADER = "header"
"""Name of the entry that holds the header, JSON as bytes of UTF-8."""


def save_arrays(
    header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], path: Path, *, name: Path
) -> None:
    """Write a header and arrays to a file as they come.

    Args:
        header: Values that JSON holds.
        arrays: By name.
        path: The file.
        name: What the file is to be called, for messages.

    Raises:
        InputError: If the header holds a value that JSON has no word for.
        OSError: If it cannot be written.
    """
    text = json_text(f"{name}: header", header)
    named: dict[str, Any] = {HEADER: np.frombuffer(text.encode(), np.uint8), **arrays}
    # As np.savez does it, which before numpy 2.1 makes allow_pickle=False an array of that name, or
    # leaves an archive that complains when it is collected, where the disk is full.
    with ZipFile(path, "w") as archive:
        for key, array in named.items():
            with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                write_array(member, np.asanyarray(array), allow_pickle=False)


def write_checkpoint_file(
    header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], path: Path
) -> None:
    """Write a checkpoint; the one before stays until the disk has the new one.

    It is written under a fixed second name, so that a process that is killed at any moment
    leaves a complete one, and an unfinished file that the next one overwrites.

    Raises:
        OutputError: If it cannot be written; the one before is still there.
    """
    new = unfinished(path)
    with named_write_failures(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            save_arrays(header, arrays, new, name=path)
            sync(new)
            new.replace(path)
            sync(path.parent)
        except OSError:
            new.unlink(missing_ok=True)  # a full disk needs the space
            raise


def discard_checkpoint_file(path: Path) -> None:
    """Remove a checkpoint, and its folder if nothing else is in it."""
    for file in (path, unfinished(path)):
        file.unlink(missing_ok=True)
    if path.parent.is_dir() and not any(path.parent.iterdir()):
        path.parent.rmdir()


def unfinished(path: Path) -> Path:
    """Where a checkpoint is while it is being written."""
    return path.with_name(f"{path.name}.new")
