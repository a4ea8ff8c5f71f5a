"""Gaussians of a scene as a folder of chunks, which commands stream (docs/formats.md).

    gaussians/
      chunks.json      how many Gaussians there are; of each chunk the rows, box and largest scale
      means.npy        (n, 3), rotations.npy (n, 4), scales.npy (n, 3), opacities.npy (n): float32
      sh.npy           (n, k, 3): harmonics of k coefficients a channel, float32 or float16
      extra_0.npy ...  further columns, whose names are in chunks.json
      level_1/ ...     the same of fewer Gaussians, for previews, where they were asked for

A chunk is a run of rows, and rows are ordered along a Morton curve, so that those of a chunk lie
near each other: the largest Gaussians first, which are seen from far, then the others. One row is
one Gaussian in all files and in the layers. The files can be mapped as they are, and a chunk is one
stretch of each: nothing is unpacked (docs/decisions/files.md has what that was held against).
"""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import FileIO
from itertools import pairwise
from pathlib import Path
from typing import IO, Annotated, Any, Self

import numpy as np
import torch
from jaxtyping import Int64
from msgspec import Meta
from numpy.lib.format import write_array_header_1_0
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import Gaussians
from splatseg.core.boundary import boundary
from splatseg.core.chunks import Chunks, morton_order
from splatseg.core.coarser import RUN, coarser, heaviest
from splatseg.core.gaussians import LOW_PASS
from splatseg.core.options import Natural
from splatseg.errors import InputError, MissingFileError
from splatseg.io.arrays import ArrayHeader, read_header, read_npy
from splatseg.io.atomic import path_inside
from splatseg.io.foreign import derived_from, expect, reading
from splatseg.io.json_files import check_version, read_json, write_json
from splatseg.io.schema import Whole, structured

CHUNKS_FOLDER = "gaussians"
"""Folder of a scene that has its Gaussians in chunks, in place of gaussians.ply."""

INDEX_FILE = "chunks.json"
FORMAT = "splatseg-chunks"
VERSION = 1

CHUNK_ROWS = 1 << 14
"""Gaussians of a chunk: 2.5 MB of degree 2. Smaller ones fit a view closer and are more to look
at."""

_MAX_HALF = 65504.0
"""Largest number of half precision."""

_BLOCK = 1 << 18
"""Rows of a source that are read at once."""

Rows = Callable[[int, int], Gaussians]
"""Reads the Gaussians from one row to before another."""


@dataclass(frozen=True, slots=True)
class _Chunk:
    """One chunk as the index has it."""

    rows: Annotated[int, Meta(ge=1)]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    largest: Annotated[float, Meta(ge=0)]


@dataclass(frozen=True, slots=True)
class _Index:
    """What chunks.json must have besides its format and version."""

    gaussians: Whole
    chunks: list[_Chunk]
    extra: list[str]
    antialiased: bool = False
    low_pass: Annotated[float, Meta(ge=0)] = LOW_PASS


@boundary
def level_folder(folder: Path, level: Natural) -> Path:
    """The folder of a coarser level of Gaussians in chunks; 0 is all of them."""
    return folder / f"level_{level}" if level else folder


@boundary
def is_in_chunks(folder: Path) -> bool:
    """Whether a folder is one of Gaussians in chunks."""
    return (folder / INDEX_FILE).is_file()


@boundary
def level_rows(folder: Path, level: Natural) -> Int64[Tensor, "m"]:
    """Which of all Gaussians each one of a level stands for: of a run that which weighs most.

    So a layer of all, at these rows, is one of the level.

    Args:
        folder: Of Gaussians in chunks.
        level: One that is there; 0 is all of them.

    Raises:
        MissingFileError: If a file of it, or of a level below, is not there.
        FileFormatError: If one is damaged, or has other chunks than the one below.
    """
    below = open_chunks(folder, memory=1)
    rows = torch.arange(len(below))
    for number in range(1, level + 1):
        above = open_chunks(level_folder(folder, number), memory=1)
        if below.chunks is None or above.chunks is None:
            raise InputError(f"{folder}: expected Gaussians in chunks, got others.")
        runs = list(pairwise(below.chunks.starts.tolist()))
        counts = above.chunks.starts.diff().tolist()
        kept: list[Tensor] = []
        fits = len(runs) == len(counts)
        for (first, end), count in zip(runs, counts, strict=False):
            if count == end - first:  # those that stand apart, or a single one
                kept.append(torch.arange(first, end))
            else:
                kept.append(first + heaviest(below.chunks.read([(first, end)], colours=False)))
            fits &= len(kept[-1]) == count
        what = f"the chunks of level {number - 1}, coarser, got others"
        expect(fits, level_folder(folder, number), what)
        rows, below = rows[torch.cat(kept)], above
    return rows


@boundary
def open_chunks(folder: Path, *, memory: int) -> Gaussians:
    """Gaussians that stay on the disk: the arrays are maps of the files, and views read chunks.

    Args:
        folder: The folder.
        memory: Bytes that the Gaussians of a view may take, with what the kernels make of them.

    Raises:
        MissingFileError: If the index or a file is not there.
        FileFormatError: If one is damaged, or not as long as the index says.
    """
    path = folder / INDEX_FILE
    if not path.is_file():
        raise MissingFileError(f"{folder}: expected Gaussians in chunks, got no {INDEX_FILE}.")
    content = read_json(path)
    check_version(path, content, format=FORMAT, version=VERSION, what="Gaussians in chunks")
    index = structured(content, _Index, where=str(path))
    count = sum(chunk.rows for chunk in index.chunks)
    what = f"chunks of {index.gaussians} rows together, got {count}"
    expect(count == index.gaussians, path, what)
    means = _column(folder, "means", (count, 3))
    rotations = _column(folder, "rotations", (count, 4))
    scales = _column(folder, "scales", (count, 3))
    opacities = _column(folder, "opacities", (count,))
    sh = _column(folder, "sh", (count, None, 3), half=True)
    extra: dict[str, Tensor] = {}
    for number, name in enumerate(index.extra):
        file = folder / f"extra_{number}.npy"
        column = read_npy(file, mapped=True)
        what = f"{count} rows of the column {name!r:.80}, got the shape {column.shape}"
        expect(column.ndim in (1, 2) and len(column) == count, file, what)
        extra[name] = torch.from_numpy(column)
    starts = np.cumsum([0, *(chunk.rows for chunk in index.chunks)])
    files = _Files(folder, index, starts)
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        rotations=torch.from_numpy(rotations),
        scales=torch.from_numpy(scales),
        opacities=torch.from_numpy(opacities),
        sh=torch.from_numpy(sh),
        extra=extra,
        antialiased=index.antialiased,
        low_pass=index.low_pass,
    )
    chunks = Chunks(
        starts=torch.from_numpy(starts),
        low=torch.tensor([chunk.low for chunk in index.chunks]).reshape(-1, 3),
        high=torch.tensor([chunk.high for chunk in index.chunks]).reshape(-1, 3),
        largest=torch.tensor([chunk.largest for chunk in index.chunks]),
        memory=memory,
        read=files.read,
    )
    return gaussians.in_chunks(chunks)


def _column(
    folder: Path, name: str, shape: tuple[int | None, ...], *, half: bool = False
) -> NDArray[Any]:
    """A file of the folder, mapped, after a check of its shape and type."""
    path = folder / f"{name}.npy"
    column = read_npy(path, mapped=True)
    fits = column.ndim == len(shape) and all(
        side is None or side == has for side, has in zip(shape, column.shape, strict=True)
    )
    kinds = ("<f4", "<f2") if half else ("<f4",)
    wanted = f"({', '.join('any' if side is None else str(side) for side in shape)})"
    what = f"{wanted} {'float32 or float16' if half else 'float32'}, "
    what += f"got {column.shape} {column.dtype}"
    expect(fits and column.dtype.str in kinds, path, what)
    return column


class _Files:
    """Reads runs of rows out of the files into memory of its own: pages of maps would stay."""

    def __init__(self, folder: Path, index: _Index, starts: NDArray[np.int64]) -> None:
        self._folder, self._about, self._starts = folder, index, starts

    def read(self, runs: Sequence[tuple[int, int]], *, colours: bool = True) -> Gaussians:
        """Rows of some runs, one run behind the other; see `core.chunks.ReadRows`."""
        means = self._rows("means", runs)
        self._check(means, runs)
        found = Gaussians(
            means=torch.from_numpy(means),
            rotations=torch.from_numpy(self._rows("rotations", runs)),
            scales=torch.from_numpy(self._rows("scales", runs)),
            opacities=torch.from_numpy(self._rows("opacities", runs)),
            sh=torch.from_numpy(self._rows("sh", runs))
            if colours
            else torch.zeros(1, 1, 3).expand(len(means), 1, 3),
            antialiased=self._about.antialiased,
            low_pass=self._about.low_pass,
        )
        with derived_from(self._folder):
            found.check_values()
        return found

    def _rows(self, name: str, runs: Sequence[tuple[int, int]]) -> NDArray[np.float32]:
        with self._opened(name) as (file, header):
            count = sum(end - first for first, end in runs)
            values, at = np.empty((count, *header.shape[1:]), np.float32), 0
            for first, end in runs:
                into = values[at : at + end - first]
                if header.dtype == values.dtype:
                    _read_rows(file, header, first, into)
                else:
                    half = np.empty(into.shape, header.dtype)
                    _read_rows(file, header, first, half)
                    into[:] = half
                at += end - first
            return values

    @contextmanager
    def _opened(self, name: str) -> Generator[tuple[FileIO, ArrayHeader]]:
        path = self._folder / f"{name}.npy"
        with reading(path, "an array of NumPy"), path.open("rb", buffering=0) as file:
            yield file, read_header(file, size=path.stat().st_size, where=path)

    def _check(self, means: NDArray[np.float32], runs: Sequence[tuple[int, int]]) -> None:
        """The index must say where they are, or views would miss some."""
        at = 0
        for first, end in runs:
            for chunk in range(
                int(np.searchsorted(self._starts, first, "right")) - 1,
                int(np.searchsorted(self._starts, end, "left")),
            ):
                begin, stop = max(first, self._starts[chunk]), min(end, self._starts[chunk + 1])
                own = means[at + begin - first : at + stop - first]
                box = self._about.chunks[chunk]
                low, high = np.array(box.low, np.float32), np.array(box.high, np.float32)
                inside = bool((own >= low).all() and (own <= high).all())
                what = f"the box of chunk {chunk} to hold its Gaussians, got some outside"
                expect(inside, self._folder / INDEX_FILE, what)
            at += end - first


def _read_rows(file: FileIO, header: ArrayHeader, first: int, into: NDArray[Any]) -> None:
    """Rows of numbers of the header's type from one on; `into` is contiguous and says how many."""
    data, at = into.reshape(-1).view(np.uint8).data, 0
    file.seek(header.offset + first * int(np.prod(into.shape[1:])) * header.dtype.itemsize)
    while at < len(data):
        step = file.readinto(data[at:])
        if not step:
            raise EOFError(f"it ends after {at} of {len(data)} bytes")
        at += step


class ChunkWriter:
    """Writes a folder of chunks, one behind the other; a context that ends with the index.

    Without its index a folder is none of chunks: write it where it appears as a whole
    (`io.atomic.atomic_folder`).

    Args:
        folder: An empty folder.
        count: Gaussians of all chunks.
        like: Gaussians with the columns, and what is said of all.
        half: Harmonics as float16.

    Raises:
        InputError: If other than `count` Gaussians were written when it ends.
    """

    def __init__(self, folder: Path, count: int, *, like: Gaussians, half: bool = False) -> None:
        self._folder, self._count, self._written = folder, count, 0
        self._about = {"antialiased": like.antialiased, "low_pass": like.low_pass}
        self._extra = list(like.extra)
        self._half = np.dtype("<f2" if half else "<f4")
        self._chunks: list[dict[str, Any]] = []
        self._files: dict[str, tuple[IO[bytes], int]] = {}
        shapes: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {
            name: (np.dtype("<f4"), (count, *getattr(like, name).shape[1:]))
            for name in ("means", "rotations", "scales", "opacities")
        }
        shapes["sh"] = self._half, (count, *like.sh.shape[1:])
        for number, column in enumerate(like.extra.values()):
            shapes[f"extra_{number}"] = column.numpy().dtype, (count, *column.shape[1:])
        self._shapes = shapes

    def __enter__(self) -> Self:
        for name, (dtype, shape) in self._shapes.items():
            file = path_inside(self._folder, f"{name}.npy").open("wb")
            header: dict[str, Any] = {"descr": dtype.str, "fortran_order": False, "shape": shape}
            write_array_header_1_0(file, header)
            offset = file.tell()
            file.truncate(offset + int(np.prod(shape)) * dtype.itemsize)
            self._files[name] = file, offset
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for file, _offset in self._files.values():
            file.close()
        if kind is not None:
            return
        if self._written != self._count:
            raise InputError(f"chunks: expected {self._count} Gaussians, got {self._written}.")
        content = {
            "format": FORMAT, "version": VERSION, "gaussians": self._count, **self._about,
            "extra": self._extra, "chunks": self._chunks,
        }  # fmt: skip
        write_json(content, self._folder / INDEX_FILE)

    @property
    def written(self) -> int:
        """Gaussians so far."""
        return self._written

    def append(self, gaussians: Gaussians) -> None:
        """Write a chunk of Gaussians, which must be of the kind that was said; none is none.

        Raises:
            RangeError: If one cannot be rendered.
            InputError: If harmonics are too large for float16.
        """
        if not len(gaussians):
            return
        gaussians.check_values()
        for name in ("means", "rotations", "scales", "opacities"):
            self._put(name, self._written, getattr(gaussians, name).numpy())
        sh = gaussians.sh.numpy()
        if self._half.itemsize == 2 and float(np.abs(sh).max()) > _MAX_HALF:
            raise InputError("sh: expected harmonics that float16 can hold, got larger ones.")
        self._put("sh", self._written, sh)
        for number, name in enumerate(self._extra):
            self._put(f"extra_{number}", self._written, gaussians.extra[name].numpy())
        self._written += len(gaussians)
        self._chunks.append(
            {
                "rows": len(gaussians),
                "low": gaussians.means.amin(dim=0).tolist(),
                "high": gaussians.means.amax(dim=0).tolist(),
                "largest": float(gaussians.scales.amax()),
            }
        )

    def _put(self, name: str, row: int, values: NDArray[Any]) -> None:
        file, offset = self._files[name]
        dtype = self._shapes[name][0]
        file.seek(offset + row * int(np.prod(values.shape[1:])) * dtype.itemsize)
        file.write(np.ascontiguousarray(values, dtype).tobytes())


@boundary
def write_chunks(
    rows: Rows,
    count: int,
    folder: Path,
    *,
    memory: int,
    half: bool = False,
    levels: Natural = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Int64[Tensor, "n"]:
    """Order Gaussians of any source along a Morton curve and write them as chunks.

    The source is read once for the order, of which 24 bytes a Gaussian stay, and then as often as
    it takes to gather stretches of what is written that fit in the memory: always from its first
    row to its last.

    Args:
        rows: Reads the source.
        count: Gaussians of the source, at least one.
        folder: An empty folder.
        memory: Bytes of the largest stretch.
        half: Harmonics as float16.
        levels: How many coarser levels to write as well, each of a fourth of the Gaussians of the
            one before but for those that stand apart as the largest, which all have.
        progress: Called with rows that were read and all there are to read.

    Returns:
        Which row of the source each row is.

    Raises:
        RangeError: If a Gaussian cannot be rendered.
        InputError: If there is none.
    """
    if count < 1:
        raise InputError("gaussians: expected at least one to write in chunks, got none.")
    like = rows(0, 1)
    columns = {name: getattr(like, name) for name in ("means", "rotations", "scales", "opacities")}
    columns |= {"sh": like.sh} | {f"extra {name}": c for name, c in like.extra.items()}
    size = sum(column[0].numel() * column.element_size() for column in columns.values())
    step = progress or _unheard
    means, largest = torch.empty(count, 3), torch.empty(count)
    for start, part in _blocks(rows, count):
        part.check_values()
        means[start : start + len(part)] = part.means
        largest[start : start + len(part)] = part.scales.amax(dim=1)
        step(start + len(part), 2 * count)
    order, apart = morton_order(means, largest)
    del means, largest
    stretches = list(_stretches(count, apart, memory // size))
    total = (1 + len(stretches)) * count
    place = torch.empty_like(order)
    place[order] = torch.arange(count)
    done = count
    with ChunkWriter(folder, count, like=like, half=half) as writer:
        for cuts in stretches:
            first, end = cuts[0], cuts[-1]
            room = {name: c.new_empty((end - first, *c.shape[1:])) for name, c in columns.items()}
            for start, part in _blocks(rows, count):
                here = place[start : start + len(part)]
                mine = (here >= first) & (here < end)
                into = here[mine] - first
                for name, column in room.items():
                    extra = name.removeprefix("extra ")
                    own = part.extra[extra] if extra != name else getattr(part, name)
                    column[into] = own[mine]
                done += len(part)
                step(done, total)
            for begin, stop in pairwise(cuts):
                own = {name: c[begin - first : stop - first] for name, c in room.items()}
                named = {n.removeprefix("extra "): own.pop(n) for n in list(own) if "extra " in n}
                writer.append(like.replace(**own, extra=named))
    for level in range(1, levels + 1):
        _write_coarser(folder, level, apart=apart, half=half)
    return order


def _write_coarser(folder: Path, level: int, *, apart: int, half: bool) -> None:
    """A level of the one before it, chunk by chunk."""
    before = open_chunks(level_folder(folder, level - 1), memory=1)
    chunks = before.chunks
    if chunks is None:
        raise InputError(f"{folder}: expected Gaussians in chunks, got others.")
    runs = list(pairwise(chunks.starts.tolist()))
    counts = [end - first if first < apart else -(-(end - first) // RUN) for first, end in runs]
    into = level_folder(folder, level)
    into.mkdir()
    with ChunkWriter(into, sum(counts), like=before[:1].replace(extra={}), half=half) as writer:
        for first, end in runs:
            part = chunks.read([(first, end)])
            writer.append(part if first < apart else coarser(part))


def _unheard(done: int, total: int) -> None:
    """Nobody wants to know."""


def _blocks(rows: Rows, count: int) -> Iterator[tuple[int, Gaussians]]:
    """The Gaussians of a source from its first row to its last, and the row where each begins."""
    for start in range(0, count, _BLOCK):
        yield start, rows(start, min(count, start + _BLOCK))


def _stretches(count: int, apart: int, most: int) -> Iterator[list[int]]:
    """Where chunks begin and end, those of a stretch together: so many rows, or one chunk.

    No chunk has both Gaussians that stand apart and others.
    """
    begin = [*range(0, apart, CHUNK_ROWS), *range(apart, count, CHUNK_ROWS)]
    cuts = [begin[0]]
    for end in [*begin[1:], count]:
        if len(cuts) > 1 and end - cuts[0] > most:
            yield cuts
            cuts = [cuts[-1]]
        cuts.append(end)
    yield cuts
