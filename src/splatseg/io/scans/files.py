"""Scans in files of their own: one file, or those of a folder, cut into pieces where they are long.

A file of at most `clouds.PIECE` points is one scan, called as the file; a longer one is NAME_0000,
NAME_0001 and so on.
"""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures import read_metadata
from splatseg.io.scans import clouds
from splatseg.io.scans._source import RawScan, Scans
from splatseg.io.scans.las import las_points

SUFFIXES = {".las": "las", ".laz": "las", ".ply": "ply", ".npz": "npz", ".npy": "npz"}
"""Formats by the endings of their files."""

_READERS = {"las": las_points, "ply": clouds.ply_points, "npz": clouds.array_points}


def find_files(path: Path) -> dict[str, tuple[Path, ...]]:
    """Files of points by format: the path itself, or what lies in the folder, by name."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    found: dict[str, tuple[Path, ...]] = {}
    for file in files:
        format = SUFFIXES.get(file.suffix.lower())
        if format is not None and file.is_file():
            found[format] = (*found.get(format, ()), file)
    return found


def read_files(path: Path, format: str) -> Scans:
    """Points of a file or of the files of a folder; nothing of them is read but headers.

    Raises:
        MissingFileError: If there is no such file.
        InputError: If one is damaged, or two are called alike but for their ending.
    """
    files = find_files(path).get(format, ())
    if not files:
        endings = " or ".join(end for end, name in SUFFIXES.items() if name == format)
        raise MissingFileError(f"{path}: expected {endings}, got none.")
    return read_listed(path, files, format)


def read_listed(path: Path, files: Sequence[Path], format: str) -> Scans:
    """The same, of files that are named.

    Raises:
        InputError: If one is damaged, or two are called alike but for their ending.
    """
    stems = [file.stem for file in files]
    if len(set(stems)) != len(stems):
        twice = next(stem for stem in stems if stems.count(stem) > 1)
        raise InputError(f"{path}: expected files of distinct names, got {twice!r:.80} twice.")
    # Pieces of a file follow each other; what was unpacked of it is kept until the next one.
    read = lru_cache(maxsize=1)(_READERS[format])
    pieces: dict[str, tuple[Path, int, int]] = {}
    for file in files:
        count, _ = read(file)
        starts = range(0, max(count, 1), clouds.PIECE)
        for i, start in enumerate(starts):
            name = file.stem if len(starts) == 1 else f"{file.stem}_{i:04d}"
            pieces[name] = (file, start, min(count, start + clouds.PIECE))

    def raw(name: str) -> RawScan:
        file, start, end = pieces[name]
        return read(file)[1](start, end)

    folder = path if path.is_dir() else path.parent
    return Scans(
        path=path,
        format=format,
        scan_names=tuple(pieces),
        read=raw,
        classes=None if format == "las" else read_metadata(folder).classes,
    )
