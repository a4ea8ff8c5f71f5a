"""How much a file may unpack to.

A few kilobytes can stand for gigabytes: zeros that were compressed, a picture of one colour, a
mesh that is shown a thousand times. So before anything is unpacked, what it will take is held
against one rule: at most `FREE` bytes, or `RATIO` times the bytes of the file where that is more.
What people have stays far below both; docs/formats.md has a table of what counts in each format.

The first number is raised for a whole program with `--max-unpacked`, or with `unpacking`.
"""

import os
import re
from collections.abc import Generator
from contextlib import contextmanager

from splatseg.errors import FileFormatError, InputError, RangeError, quoted

FREE = 1 << 28
"""Bytes that any file may unpack to, however small it is: 256 MiB."""

RATIO = 64
"""Times its own size that any file may unpack to."""

OPTION = "--max-unpacked"

MEMORY = "--memory"
"""The option of commands that stream a scene in chunks."""

_UNITS = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9, "Ki": 1 << 10, "Mi": 1 << 20, "Gi": 1 << 30}
_SIZE = re.compile(r"(\d{1,12})\s?(k|M|G|Ki|Mi|Gi|)B?")

_free = FREE


def max_unpacked(packed: int) -> int:
    """Bytes that a file of `packed` bytes may unpack to.

    Example:
        >>> max_unpacked(1000) == FREE
        True
        >>> max_unpacked(1 << 30) == RATIO << 30
        True
    """
    return max(_free, RATIO * packed)


def check_unpacked(where: object, unpacked: int, *, packed: int, what: str) -> None:
    """Refuse what would unpack to more than a file of its size may.

    Args:
        where: The file; starts the message.
        unpacked: Bytes that it will take.
        packed: Bytes of the file.
        what: What takes them, for the message.

    Raises:
        FileFormatError: If that is too much; the message names the option that allows it.
    """
    most = max_unpacked(packed)
    if unpacked > most:
        raise FileFormatError(
            f"{where}: expected at most {_readable(most)} from a file of {_readable(packed)}, got "
            f"{what}, which is {_readable(unpacked)}; if you trust it, "
            f"{OPTION} {-(-unpacked // 10**9)}GB reads it."
        )


@contextmanager
def unpacking(free: int | None) -> Generator[None]:
    """Let any file unpack to this many bytes inside the block; None changes nothing.

    It holds for all threads. Pillow's own limit of the pixels of a picture gives way too.

    Args:
        free: Bytes, instead of `FREE`.

    Raises:
        RangeError: If it is negative.
    """
    global _free
    if free is None:
        yield
        return
    if free < 0:
        raise RangeError(f"max_unpacked: expected 0 bytes or more, got {free}.")
    from PIL import Image  # here: arrays are read without it

    before = _free, Image.MAX_IMAGE_PIXELS
    _free = free
    if free > FREE:
        Image.MAX_IMAGE_PIXELS = None
    try:
        yield
    finally:
        _free, Image.MAX_IMAGE_PIXELS = before


def memory_to_use(text: str | None) -> int:
    """Bytes that ``--memory`` allows; without it half of what the machine has.

    Raises:
        InputError: If it is no size, or nothing.
    """
    if text is None:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    size = parse_size(text, option=MEMORY)
    if not size:
        raise InputError(f"{MEMORY}: expected more than nothing, got {quoted(text)}.")
    return size


def parse_size(text: str, *, option: str = OPTION) -> int:
    """Bytes from words such as ``500MB`` (10^6), ``2 GiB`` (2^30) or a plain number.

    Args:
        text: The words.
        option: The option that they are of, for the message.

    Raises:
        InputError: If it is something else.

    Example:
        >>> parse_size("2GB"), parse_size("1 MiB"), parse_size("77")
        (2000000000, 1048576, 77)
    """
    found = _SIZE.fullmatch(text.strip())
    if found is None:
        raise InputError(f"{option}: expected a size such as 4GB or 500MiB, got {quoted(text)}.")
    return int(found[1]) * _UNITS[found[2]]


def _readable(size: int) -> str:
    for unit, scale in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if size >= scale:
            return (
                f"{size / scale:.3g} {unit}" if size < 1000 * scale else f"{size // scale} {unit}"
            )
    return f"{size} bytes"
