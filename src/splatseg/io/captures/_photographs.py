"""Where the photographs of a capture are, which are not always where it says.

Blender and instant-ngp leave the suffix out, converters change it, Windows does not mind case and
macOS decomposes accents; paths are those of the machine that a capture was made on, and what makes
smaller copies puts them beside the folder under its name with a number, as in ``images_4``.
"""

import unicodedata
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

from splatseg.io.foreign import is_file, is_folder
from splatseg.io.images import IMAGE_SUFFIXES

SMALLER = (2, 4, 8)
"""Numbers of the folders of smaller copies: pixels of the photograph for one of a copy."""

_FIRST = (".png", ".jpg", ".jpeg")
_FOLDERS = ("", "images", "input", "rgb")
_DEEPEST = 16
"""Folders that may be left out of the front of a path."""


class Photographs:
    """Finds photographs by their path, or by their stem in the same folder."""

    def __init__(self) -> None:
        self._by_stem: dict[Path, dict[str, list[Path]]] = {}

    def find(self, listed: Path) -> Path | None:
        """The photograph of a path that a capture lists, None where there is none."""
        if is_file(listed):
            return listed
        stems = self._stems(listed.parent)
        found = stems.get(_key(listed.name), [])
        suffix = listed.suffix[1:]
        if not found and suffix.isalnum() and not suffix.isdigit():
            found = stems.get(_key(listed.stem), [])
        own = (listed.name, listed.stem)
        return min(found, key=lambda file: (file.stem not in own, *_rank(file)), default=None)

    def find_all(self, listed: Sequence[Path]) -> list[Path | None]:
        """The photograph of each path; no file is that of two of them."""
        named = {path for path in listed if is_file(path)}
        found: list[Path | None] = []
        for path in listed:
            file = self.find(path)
            if file is not None and file != path:
                file = None if file in named else file
                named |= set() if file is None else {file}
            found.append(file)
        return found

    def count(self, listed: Iterable[Path]) -> int:
        """How many of these are there."""
        return sum(self.find(path) is not None for path in listed)

    def _stems(self, folder: Path) -> dict[str, list[Path]]:
        if folder not in self._by_stem:
            stems: dict[str, list[Path]] = {}
            for file in folder.iterdir() if is_folder(folder) else ():
                if file.suffix.lower() in IMAGE_SUFFIXES and is_file(file):
                    stems.setdefault(_key(file.stem), []).append(file)
            self._by_stem[folder] = stems
        return self._by_stem[folder]


def moves(below: Path) -> list[tuple[int, Callable[[Path], list[Path]]]]:
    """Where files of a capture may lie instead of where it lists them, in the order to look.

    Each comes with how many pixels of the photograph one of what lies there stands for.

    Args:
        below: The capture's folder.
    """
    found: list[tuple[int, Callable[[Path], list[Path]]]] = [
        (1, partial(_moved, dropped=dropped, folder=folder, below=below))
        for dropped in range(_DEEPEST + 1)
        for folder in _FOLDERS
    ]
    return found + [(number, partial(_smaller, number=number, below=below)) for number in SMALLER]


def _moved(path: Path, *, dropped: int, folder: str, below: Path) -> list[Path]:
    """A path in a folder of the capture, without its first folders."""
    parts = path.relative_to(below).parts if path.is_relative_to(below) else path.parts[1:]
    parts = tuple(part for part in parts if part != "..")
    return [below.joinpath(folder, *parts[dropped:])] if dropped < len(parts) else []


def _smaller(path: Path, *, number: int, below: Path) -> list[Path]:
    """Where a smaller copy of a file may lie: a folder of its path with a number at its name.

    The name of the capture's folder stays.
    """
    parts = path.relative_to(below).parts if path.is_relative_to(below) else path.parts[-2:]
    base = path.parents[len(parts) - 1] if len(parts) <= len(path.parents) else path.parent
    copies: list[Path] = []
    for i, part in enumerate(parts[:-1]):
        if part not in (".", ".."):
            copies.append(base.joinpath(*parts[:i], f"{part}_{number}", *parts[i + 1 :]))
    return copies


def _key(stem: str) -> str:
    """What stems have in common that differ in case or in how accents are written."""
    return unicodedata.normalize("NFC", stem).casefold()


def _rank(file: Path) -> tuple[int, str]:
    """Of files of one stem the one to take comes first: PNG before JPEG before others."""
    suffix = file.suffix.lower()
    return (_FIRST.index(suffix) if suffix in _FIRST else len(_FIRST), file.name)
