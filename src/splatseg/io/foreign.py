"""Libraries that read files of others: whatever they raise becomes the documented error."""

import lzma
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from splatseg.errors import (
    FileFormatError,
    InputError,
    MissingFileError,
    SplatsegError,
    quoted,
    reason,
)

_DAMAGED = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    lzma.LZMAError,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What decoders of the standard library, NumPy and Pillow raise on damaged files: none of them
documents it, and flipped bits have found each of these."""

_NOTHING = object()


def malformed(where: object, expected: str, got: object = _NOTHING) -> FileFormatError:
    """The error of a file that holds something else: ``WHERE: expected EXPECTED, got GOT.``.

    Args:
        where: The file, and the place in it.
        expected: What should be there, with ", got ..." where `got` is not passed.
        got: What is there; None is "none".
    """
    came = "" if got is _NOTHING else f", got {'none' if got is None else quoted(got)}"
    return FileFormatError(f"{where}: expected {expected}{came}.")


def expect(
    holds: object,
    where: object,
    expected: str,
    got: object = _NOTHING,
    *,
    error: type[InputError] = FileFormatError,
) -> None:
    """Raise what `malformed` says, as an `error`, unless something holds."""
    if not holds:
        raise error(*malformed(where, expected, got).args)


@contextmanager
def reading(where: object, expected: str) -> Generator[None]:
    """Raise the documented error for whatever a decoder raises inside the block.

    Only calls of other libraries belong inside: faults of our own should stay what they are.
    Panics of decoders in Rust come as a class that no module names, beside `Exception`.

    Args:
        where: The file; starts the message.
        expected: What it should be, for the message.

    Raises:
        MissingFileError: If the file is not there.
        FileFormatError: For every other failure.
    """
    try:
        yield
    except SplatsegError:
        raise
    except FileNotFoundError as error:
        raise MissingFileError(f"{where}: there is no such file.") from error
    except MemoryError as error:
        raise FileFormatError(
            f"{where}: expected {expected}; memory is too small for it."
        ) from error
    except BaseException as error:
        if not isinstance(error, _DAMAGED) and type(error).__name__ != "PanicException":
            raise
        raise FileFormatError(
            f"{where}: expected {expected}, but it cannot be read ({reason(error)})."
        ) from error


def read_bytes(path: Path, expected: str) -> bytes:
    """All bytes of a file.

    Raises:
        MissingFileError: If it is not there.
        FileFormatError: If it cannot be read, or is a folder.
    """
    with reading(path, expected):
        return path.read_bytes()


def read_lines(path: Path, expected: str) -> list[str]:
    """Lines of a text file without the space around them, empty ones left out.

    Raises:
        MissingFileError: If it is not there.
        FileFormatError: If it cannot be read, or is no UTF-8.
    """
    content = read_bytes(path, expected)
    with reading(path, expected):
        text = content.decode("utf-8-sig")
    return [line for line in (line.strip() for line in text.splitlines()) if line]


def is_file(path: Path) -> bool:
    """Whether a path that a file names is a file; names that no file can have are none."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long, or with a zero byte
        return False


def is_folder(path: Path) -> bool:
    """Whether a path that a file names is a folder; names that no folder can have are none."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


@contextmanager
def derived_from(where: object) -> Generator[None]:
    """Name the file in errors of values that are made from it, which know of no file.

    Raises:
        FileFormatError: For every `InputError` whose message does not name it yet.
    """
    try:
        yield
    except InputError as error:
        if str(where) in str(error):
            raise
        raise FileFormatError(f"{where}: {error}") from error
