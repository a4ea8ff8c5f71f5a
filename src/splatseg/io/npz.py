"""Archives of NumPy arrays: read member by member, each header held against its bytes first."""

import io
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import ZipFile

from numpy.typing import NDArray

from splatseg.errors import FileFormatError, MissingFileError, quoted
from splatseg.io.archives import open_archive, open_member
from splatseg.io.limits import check_unpacked
from splatseg.io.npy import filled, read_header

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
        if name not in self.names:
            raise FileFormatError(
                f"{self.where}: expected an array {quoted(name)}, got "
                f"{_listed(self.names) or 'none'}."
            )
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
