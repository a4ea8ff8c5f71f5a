"""Hits of training rays, found once: compressed, in memory or in files.

A hit is the number of its triangle (int32) and two of its three weights (uint16, in steps of
1/65535), 8 bytes; a ray is how many it has (uint8). Where the hits exceed the memory given, they
lie in a folder of

    cache.json      format, version, identity, rays, hits, checks (CRC-32 of each file)
    counts.bin      uint8 [rays]
    faces.bin       int32 [hits], little-endian
    weights.bin     uint16 [hits, 2], little-endian

that takes its name when it is complete. Kept, it serves the next training with the same identity.
"""

import shutil
import tempfile
import zlib
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core.json_values import json_integer
from splatseg.errors import FileFormatError, InputError, MissingFileError, quoted
from splatseg.io.atomic import atomic_folder, is_vacant
from splatseg.io.json_files import json_text, read_json
from splatseg.io.npy import map_values
from splatseg.street.hits import MeshHits

FORMAT = "splatseg.street.ray-hits"
VERSION = 2

_STEPS = 65535
_HEADER = "cache.json"
_TYPES = {"counts": "u1", "faces": "<i4", "weights": "<u2"}
_BLOCK = 1 << 24
_EMPTY = {"counts": (0,), "faces": (0,), "weights": (0, 2)}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CachedHits:
    """Hits of all rays, one ray after the other."""

    starts: Int64[Tensor, "n"]
    """Index of each ray's first hit; one more than there are rays."""

    faces: NDArray[np.int32]
    weights: NDArray[np.uint16]
    """(hits, 2)."""

    folder: Path | None = None
    """Where the hits lie, if not in memory."""

    temporary: Path | None = None
    """What `close` removes."""

    @property
    def hits(self) -> int:
        """How many there are."""
        return len(self.faces)

    @property
    def nbytes(self) -> int:
        """Bytes of all hits."""
        return self.faces.nbytes + self.weights.nbytes

    def of(
        self, rays: Int64[Tensor, "b"], width: int
    ) -> tuple[Int64[Tensor, "s"], Int64[Tensor, "s"], Float[Tensor, "s 3"]]:
        """The hits of some rays.

        Args:
            rays: Their numbers.
            width: The most hits that a ray has.

        Returns:
            Where each hit stands among ``len(rays) * width`` places, ray by ray; its triangle;
            its weights.
        """
        start, stop = self.starts[rays], self.starts[rays + 1]
        rank = torch.arange(width)
        places = ((start[:, None] + rank) < stop[:, None]).reshape(-1).nonzero()[:, 0]
        at = (start[places // width] + places % width).numpy()
        faces = torch.from_numpy(self.faces[at].astype(np.int64))
        two = torch.from_numpy(self.weights[at].astype(np.float32)) / _STEPS
        third = (1 - two[:, :1] - two[:, 1:]).clamp_min(0)
        return places, faces, torch.cat((two, third), dim=1)

    def close(self) -> None:
        """Remove files that nobody asked to keep."""
        if self.temporary is not None:
            shutil.rmtree(self.temporary, ignore_errors=True)


def cached_hits(
    parts: Iterable[MeshHits],
    *,
    triangles: int,
    memory: int,
    folder: Path | None,
    identity: str,
) -> CachedHits:
    """Hits as they are found, kept in memory or, beyond `memory` bytes, in files.

    Args:
        parts: Hits of rays in their order; not asked for where the folder holds them already.
        triangles: How many there are.
        memory: Bytes.
        folder: Where files are kept; its parent exists. None is a temporary place, removed by
            `CachedHits.close`.
        identity: What the hits are of: files of another one are replaced, and so are damaged ones.

    Raises:
        InputError: If the folder holds something else.
        OutputError: If they cannot be written.
    """
    if folder is not None and folder.exists() and not is_vacant(folder):
        if not (folder / _HEADER).is_file():
            raise InputError(f"cache_folder: expected a folder of hits or none, got {folder}.")
        try:
            return read_hits(folder, triangles=triangles, identity=identity)
        except (FileFormatError, MissingFileError):  # of something else or damaged: found again
            shutil.rmtree(folder)
    with ExitStack() as stack:
        temporary, target = None, folder
        if target is None:
            temporary = Path(tempfile.mkdtemp(prefix="splatseg-hits-"))
            stack.callback(shutil.rmtree, temporary, ignore_errors=True)
            target = temporary / "hits"
        kept = _gathered(parts, memory, target, identity)
        if kept is not None:
            return kept
        stack.pop_all()
    found = read_hits(target, triangles=triangles, identity=identity)
    return replace(found, temporary=temporary)


def _gathered(
    parts: Iterable[MeshHits], memory: int, target: Path, identity: str
) -> CachedHits | None:
    """The hits, or None if they are too many and lie in the target folder."""
    arrays: dict[str, list[NDArray[Any]]] = {name: [] for name in _TYPES}
    rays = hits = 0
    checks = dict.fromkeys(_TYPES, 0)
    with ExitStack() as stack:
        files: dict[str, IO[bytes]] = {}
        for part in parts:
            packed = _packed(part)
            rays += len(packed["counts"])
            hits += len(packed["faces"])
            for name, array in packed.items():
                arrays[name].append(array)
            if not files and rays + 8 * hits > memory:
                writing = stack.enter_context(atomic_folder(target))
                files = {n: stack.enter_context((writing / f"{n}.bin").open("wb")) for n in _TYPES}
            for name, file in files.items():
                for array in arrays[name]:
                    content = array.tobytes()
                    checks[name] = zlib.crc32(content, checks[name])
                    file.write(content)
                arrays[name].clear()
        if files:
            about = {"format": FORMAT, "version": VERSION, "identity": identity}
            text = json_text(_HEADER, about | {"rays": rays, "hits": hits, "checks": checks})
            (Path(files["counts"].name).parent / _HEADER).write_text(text, encoding="utf-8")
            return None
    joined: dict[str, NDArray[Any]] = {}
    for name, dtype in _TYPES.items():
        parted = arrays.pop(name)
        joined[name] = np.concatenate(parted) if parted else np.zeros(_EMPTY[name], dtype)
    return CachedHits(
        starts=_starts(joined["counts"]), faces=joined["faces"], weights=joined["weights"]
    )


def _packed(hits: MeshHits) -> dict[str, NDArray[Any]]:
    valid = hits.valid
    two = (hits.weights[valid][:, :2].clamp(0, 1) * _STEPS).round()
    return {
        "counts": valid.sum(dim=1).numpy().astype(_TYPES["counts"]),
        "faces": hits.faces[valid].numpy().astype(_TYPES["faces"]),
        "weights": two.numpy().astype(_TYPES["weights"]),
    }


def read_hits(folder: Path, *, triangles: int, identity: str) -> CachedHits:
    """Hits that `cached_hits` left in a folder; their pages are read when they are looked at.

    Raises:
        FileFormatError: If they are of something else, or damaged.
        MissingFileError: If a file of them is not there.
    """
    header = read_json(folder / _HEADER)
    wanted = {"format": FORMAT, "version": VERSION, "identity": identity}
    found = {name: header.get(name) for name in wanted}
    if found != wanted:
        raise FileFormatError(
            f"{folder}: expected hits of these rays and primitives ({quoted(identity)}), "
            f"got {quoted(header.get('identity'))}."
        )
    rays, hits = (json_integer(header.get(n), where=f"{folder}: {n}") for n in ("rays", "hits"))
    shapes = {"counts": (rays,), "faces": (hits,), "weights": (hits, 2)}
    arrays = {
        name: map_values(folder / f"{name}.bin", dtype=_TYPES[name], shape=shape)
        for name, shape in shapes.items()
    }
    starts = _starts(arrays["counts"])
    if int(starts[-1]) != hits:
        raise FileFormatError(f"{folder}: expected {hits} hits, got counts of {int(starts[-1])}.")
    faces = arrays["faces"]
    if hits and not 0 <= int(faces.min()) <= int(faces.max()) < triangles:
        raise FileFormatError(
            f"{folder}: expected {triangles} triangles, got [{int(faces.min())}, "
            f"{int(faces.max())}]."
        )
    checks = {name: _check_sum(array) for name, array in arrays.items()}
    if header.get("checks") != checks:
        raise FileFormatError(
            f"{folder}: expected the check sums of {_HEADER}, got others; the files are damaged."
        )
    return CachedHits(starts=starts, faces=faces, weights=arrays["weights"], folder=folder)


def _check_sum(array: NDArray[Any]) -> int:
    """CRC-32 of the bytes of a file, a block in memory."""
    flat, value = array.reshape(-1).view(np.uint8), 0
    for start in range(0, len(flat), _BLOCK):
        value = zlib.crc32(flat[start : start + _BLOCK].tobytes(), value)
    return value


def _starts(counts: NDArray[np.uint8]) -> Int64[Tensor, "n"]:
    starts = np.zeros(len(counts) + 1, dtype=np.int64)
    np.cumsum(counts, out=starts[1:], dtype=np.int64)
    return torch.from_numpy(starts)
