"""ZIP archives of others: members are read only as far as they may unpack."""

import zipfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from splatseg.errors import FileFormatError, quoted
from splatseg.io.foreign import reading

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
        if info.compress_type not in _METHODS or info.flag_bits & _ENCRYPTED:
            raise FileFormatError(
                f"{where}: expected {quoted(name)} stored or deflated, got a member that is "
                "encrypted or compressed otherwise."
            )
        with archive.open(info) as member:
            yield member, info.file_size
