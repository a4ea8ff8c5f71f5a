"""Masks by their content: a byte of confidence a Gaussian, compressed, in memory or a folder.

A mask is named by BLAKE2b of its bytes, so that equal masks are one, and a damaged file is noticed.
It lies in memory until `persist` writes it: what a person never kept leaves no file. Memory is
bounded however long a person works: few masks are kept as arrays, and where many lie packed, as in
a scene without a folder, they go to a temporary one.
"""

import hashlib
import tempfile
import zlib
from collections import OrderedDict
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, InputError, ShapeError, quoted
from splatseg.io.atomic import atomic_file, named_write_failures, sweep
from splatseg.viewer._document import MEMBER, Confidence, Mask

_DIGEST_BYTES = 16
_LEVEL = 1
"""Of zlib: masks are mostly zeros, and a click waits for it."""

_KEPT_BYTES = 1 << 24
"""Bytes of masks that are kept as arrays: those of an hour's clicks are no use to the next one, and
to read one anew takes a millisecond."""

_PACKED_BYTES = 1 << 24
"""Bytes of packed masks in memory from which on they go to a temporary folder."""

_HEX = frozenset("0123456789abcdef")


class MaskStore:
    """Masks of the Gaussians of one scene.

    Args:
        gaussians: Gaussians of the scene.
        folder: Where masks are written to and read from; made when the first one is written. None
            keeps them until the store is closed.
    """

    def __init__(self, gaussians: int, folder: Path | None = None) -> None:
        self._gaussians = gaussians
        self._folder = folder
        self._packed: dict[str, bytes] = {}
        self._packed_bytes = 0
        self._temporary: tempfile.TemporaryDirectory[str] | None = None
        self._arrays: OrderedDict[str, Confidence] = OrderedDict()
        if folder is not None:
            sweep(folder)

    def close(self) -> None:
        """Forget all that was not written to the folder."""
        self._packed.clear()
        self._arrays.clear()
        if self._temporary is not None:
            self._temporary.cleanup()
        self._packed_bytes, self._temporary = 0, None

    @property
    def gaussians(self) -> int:
        """Gaussians of the scene, the length of every mask."""
        return self._gaussians

    def put(self, confidence: NDArray[np.uint8], /) -> Mask:
        """Keep confidences, and name them.

        Args:
            confidence: (n,) one for each Gaussian of the scene, 0 to 255 for 0 to 1; from 128 on a
                Gaussian belongs to the mask.

        Raises:
            ShapeError: If they are not as many as the Gaussians.
            InputError: If they are no bytes.
        """
        if confidence.shape != (self._gaussians,):
            raise ShapeError(
                f"confidence: expected {self._gaussians} values, one a Gaussian, got "
                f"{confidence.shape}."
            )
        if confidence.dtype != np.uint8:
            raise InputError(f"confidence: expected bytes (uint8), got {confidence.dtype}.")
        own = np.array(confidence, order="C")
        own.flags.writeable = False
        mask = Mask(id=_name(own.data), count=int((own >= MEMBER).sum()))
        if mask.id not in self._packed and self._file(mask.id) is None:
            self._pack(mask.id, zlib.compress(own.data, _LEVEL))
        self._remember(mask.id, own)
        return mask

    def get(self, mask: Mask, /) -> Confidence:
        """The confidences of a mask, (n,) uint8, which may not be written to.

        Raises:
            InputError: If the store has no such mask.
            FileFormatError: If its file is damaged.
        """
        found = self._arrays.get(mask.id)
        if found is not None:
            self._arrays.move_to_end(mask.id)
            return found
        packed, where = self._packed.get(mask.id), mask.id
        if packed is None:
            path = self._file(mask.id)
            if path is None:
                raise InputError(f"mask: expected one that was stored, got {quoted(mask.id)}.")
            packed, where = path.read_bytes(), str(path)
        found = self._unpacked(packed, mask, where)
        self._remember(mask.id, found)
        return found

    def __contains__(self, mask: Mask, /) -> bool:
        return mask.id in self._packed or mask.id in self._arrays or self._file(mask.id) is not None

    def persist(self, masks: Iterable[Mask]) -> None:
        """Write masks to the folder, whole and lasting, where they are not there yet.

        Raises:
            OutputError: If the disk is full, or there is no permission.
        """
        if self._folder is None:
            return
        for mask in masks:
            packed, path = self._unwritten(mask.id), _path(self._folder, mask.id)
            if packed is None or path is None or path.is_file():
                continue
            with named_write_failures(path):
                self._folder.mkdir(parents=True, exist_ok=True)
            with atomic_file(path, durable=True) as temporary:
                temporary.write_bytes(packed)
            self._packed_bytes -= len(self._packed.pop(mask.id, b""))

    def _pack(self, id: str, packed: bytes) -> None:
        """Keep a packed mask in memory, or all of them in the temporary folder."""
        self._packed[id] = packed
        self._packed_bytes += len(packed)
        if self._packed_bytes <= _PACKED_BYTES:
            return
        if self._temporary is None:
            self._temporary = tempfile.TemporaryDirectory(prefix="splatseg-masks-")
        folder = Path(self._temporary.name)
        with named_write_failures(folder):
            for name, content in self._packed.items():
                (folder / f"{name}.z").write_bytes(content)
        self._packed.clear()
        self._packed_bytes = 0

    def _unwritten(self, id: str) -> bytes | None:
        """A packed mask that was put, from memory or the temporary folder."""
        path = None if self._temporary is None else _path(Path(self._temporary.name), id)
        if id in self._packed or path is None or not path.is_file():
            return self._packed.get(id)
        return path.read_bytes()

    def _unpacked(self, packed: bytes, mask: Mask, where: str) -> Confidence:
        # No more is unpacked than there should be, whatever the file holds.
        decoder = zlib.decompressobj()
        try:
            values = decoder.decompress(packed, self._gaussians + 1)
        except zlib.error as error:
            raise FileFormatError(f"{where}: expected a mask, got a damaged file.") from error
        if len(values) != self._gaussians or _name(values) != mask.id:
            raise FileFormatError(
                f"{where}: expected the {self._gaussians} confidences that it is named by, got "
                "others; the file is damaged."
            )
        return np.frombuffer(values, np.uint8)

    def _remember(self, id: str, values: Confidence) -> None:
        self._arrays[id] = values
        self._arrays.move_to_end(id)
        while len(self._arrays) > max(1, _KEPT_BYTES // max(1, self._gaussians)):
            self._arrays.popitem(last=False)

    def _file(self, id: str) -> Path | None:
        """The file of a mask, in the folder or the temporary one; None where there is none."""
        folders = (self._folder, None if self._temporary is None else Path(self._temporary.name))
        paths = (None if folder is None else _path(folder, id) for folder in folders)
        return next((path for path in paths if path is not None and path.is_file()), None)


def _path(folder: Path, id: str) -> Path | None:
    """The file of a mask in a folder; None where the id is none."""
    if len(id) != 2 * _DIGEST_BYTES or not _HEX.issuperset(id):
        return None
    return folder / f"{id}.z"


def _name(values: bytes | memoryview) -> str:
    return hashlib.blake2b(values, digest_size=_DIGEST_BYTES).hexdigest()
