"""The container that is glTF 2.0: JSON, buffers, accessors and the tree of nodes."""

import base64
import struct
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, MissingFileError, quoted
from splatseg.io.foreign import is_file, read_bytes
from splatseg.io.splats._json import Json
from splatseg.io.splats._rows import read_file

_GLB_MAGIC = b"glTF"
_JSON_CHUNK = 0x4E4F534A
_BINARY_CHUNK = 0x004E4942

_COMPONENTS = {
    5120: np.dtype("i1"),
    5121: np.dtype("u1"),
    5122: np.dtype("<i2"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
_GREATEST = {
    (1, "i"): 127,
    (1, "u"): 255,
    (2, "i"): 32767,
    (2, "u"): 65535,
    (4, "u"): 2**32 - 1,
}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class Gltf:
    """A parsed file whose accessors are read when they are asked for."""

    def __init__(self, path: Path) -> None:
        """Parse the JSON of a ``.gltf`` or ``.glb`` file.

        Raises:
            FileFormatError: If it is neither or is truncated.
            MissingFileError: If there is no such file.
        """
        self.path = path
        data = read_file(path)
        self._size = len(data)
        self._binary: bytes | None = None
        if data[:4] == _GLB_MAGIC:
            text, self._binary = _glb_chunks(path, data)
        else:
            text = data
        self.root = Json.parse(path, text)
        version = self.root["asset"]["version"].text()
        if version.split(".")[0] != "2":
            raise self.root["asset"]["version"].error("glTF version 2")
        self._buffers: dict[int, bytes] = {}

    def accessor(self, index: int) -> tuple[NDArray[np.float32], np.dtype[np.generic]]:
        """Values (count, width) as real numbers, and the type they are stored in.

        Normalised integers become [0, 1], or [-1, 1] for signed ones, as glTF defines it.

        Raises:
            FileFormatError: If the accessor or its data are missing or do not fit.
        """
        entry = self.root["accessors"].element(index)
        kind = entry["componentType"].integer()
        if kind not in _COMPONENTS:
            raise entry["componentType"].error("a component type of glTF")
        shape = entry["type"].text()
        if shape not in _WIDTHS:
            raise entry["type"].error("SCALAR, VEC2, VEC3 or VEC4")
        if "sparse" in entry or "bufferView" not in entry:
            raise FileFormatError(
                f"{self.path}: expected plain data in {entry.location}, got a "
                f"{'sparse' if 'sparse' in entry else 'compressed or empty'} accessor."
            )
        values = self._values(entry, _COMPONENTS[kind], _WIDTHS[shape])
        result = values.astype(np.float32)
        if "normalized" in entry and entry["normalized"].flag() and values.dtype.kind != "f":
            result = np.maximum(result / _GREATEST[values.dtype.itemsize, values.dtype.kind], -1)
        return result, values.dtype

    def _values(self, entry: Json, kind: np.dtype[np.generic], width: int) -> NDArray[np.generic]:
        """The stored values of an accessor, as a view into its buffer."""
        count = entry["count"].integer()
        view = self.root["bufferViews"].element(entry["bufferView"].integer())
        data = self._buffer(view["buffer"].integer())
        start = view["byteOffset"].integer() if "byteOffset" in view else 0
        length = view["byteLength"].integer()
        offset = entry["byteOffset"].integer() if "byteOffset" in entry else 0
        item = kind.itemsize * width
        stride = view["byteStride"].integer(1) if "byteStride" in view else item
        needed = offset + (count - 1) * stride + item if count else 0
        if stride < item or needed > length or start + length > len(data):
            raise FileFormatError(
                f"{self.path}: expected {needed} bytes for {entry.location}, got a view of "
                f"{length} bytes at byte {start} of {len(data)}, one row each {stride} bytes."
            )
        if not count:
            return np.empty((0, width), kind)
        return np.ndarray((count, width), kind, data, start + offset, (stride, kind.itemsize))

    def _buffer(self, index: int) -> bytes:
        """The bytes of a buffer: the binary part, a data URI or a file beside this one."""
        if index in self._buffers:
            return self._buffers[index]
        entry = self.root["buffers"].element(index)
        if "uri" not in entry:
            if self._binary is None or index != 0:
                raise entry.error("a uri, or buffer 0 of a .glb file with a binary part")
            data = self._binary
        else:
            data = self._load(entry["uri"])
        length = entry["byteLength"].integer()
        if len(data) < length:
            raise FileFormatError(
                f"{self.path}: expected {length} bytes in {entry.location}, got {len(data)}: "
                "truncated."
            )
        self._buffers[index] = data
        return data

    def _load(self, uri: Json) -> bytes:
        """What a URI stands for; only data URIs and files in the same folder or below."""
        text = uri.text()
        if text.startswith("data:"):
            head, _, body = text.partition(",")
            if not head.endswith(";base64"):
                raise uri.error("a data URI in base64")
            try:
                return base64.b64decode(body, validate=True)
            except ValueError as error:  # wrong letters, or a wrong number of them
                raise uri.error("a data URI in base64") from error
        return read_bytes(self._beside(uri), "a buffer of glTF")

    def _beside(self, uri: Json) -> Path:
        """The file that a URI names."""
        name = unquote(uri.text())
        relative = Path(name)
        if ":" in name or "\\" in name or relative.is_absolute() or ".." in relative.parts:
            raise uri.error("a file in the folder of this one")
        target = self.path.parent / relative
        if not is_file(target):
            raise MissingFileError(
                f"{self.path.parent}: no such file as {quoted(name)}, which {self.path.name} names."
            )
        return target

    def packed_size(self) -> int:
        """Bytes of the file and of the buffers that lie beside it."""
        uris = [entry["uri"] for entry in self.root.optional_items("buffers") if "uri" in entry]
        files = {self._beside(uri) for uri in uris if not uri.text().startswith("data:")}
        return self._size + sum(file.stat().st_size for file in files)

    def meshes(self) -> Iterator[tuple[Json, NDArray[np.float64]]]:
        """Each mesh of the default scene with its ``world_from_mesh`` (4, 4), depth first.

        A mesh that several nodes show comes once for each.
        """
        pending = [(index, np.eye(4)) for index in reversed(self._roots())]
        visited: set[int] = set()
        while pending:
            index, world_from_parent = pending.pop()
            node = self.root["nodes"].element(index)
            if index in visited:
                raise node.error("a tree of nodes: this one has two parents")
            visited.add(index)
            world_from_node = world_from_parent @ _parent_from_node(node)
            if "mesh" in node:
                yield (
                    self.root["meshes"].element(node["mesh"].integer()),
                    world_from_node,
                )
            children = [child.integer() for child in node.optional_items("children")]
            pending += [(child, world_from_node) for child in reversed(children)]

    def _roots(self) -> list[int]:
        """The top nodes of the default scene; without scenes, the nodes nobody has as child."""
        if "scenes" in self.root:
            which = self.root["scene"].integer() if "scene" in self.root else 0
            scene = self.root["scenes"].element(which)
            return [node.integer() for node in scene.optional_items("nodes")]
        nodes = self.root.optional_items("nodes")
        children = {c.integer() for node in nodes for c in node.optional_items("children")}
        return [index for index in range(len(nodes)) if index not in children]


def _glb_chunks(path: Path, data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the binary part of a ``.glb`` file."""
    if len(data) < 12:
        raise FileFormatError(f"{path}: expected a .glb header of 12 bytes, got {len(data)}.")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise FileFormatError(f"{path}: expected .glb version 2, got {version}.")
    if length != len(data):
        raise FileFormatError(
            f"{path}: expected {length} bytes as its header says, got {len(data)}."
        )
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > length:
            raise FileFormatError(f"{path}: the .glb part at byte {at} is truncated.")
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    if _JSON_CHUNK not in chunks:
        raise FileFormatError(f"{path}: expected a JSON part in the .glb file, got none.")
    return chunks[_JSON_CHUNK], chunks.get(_BINARY_CHUNK)


def _parent_from_node(node: Json) -> NDArray[np.float64]:
    """A node's transform: its matrix (stored by columns), or translation, rotation, scale."""
    if "matrix" in node:
        return np.array(node["matrix"].numbers(min_count=16)).reshape(4, 4).T
    result = np.eye(4)
    if "rotation" in node:
        result[:3, :3] = _rotation(node["rotation"])
    if "scale" in node:
        result[:3, :3] *= np.array(node["scale"].numbers(min_count=3))
    if "translation" in node:
        result[:3, 3] = node["translation"].numbers(min_count=3)
    return result


def _rotation(entry: Json) -> NDArray[np.float64]:
    """The matrix of a quaternion (x, y, z, w)."""
    quaternion = np.array(entry.numbers(min_count=4))
    length = np.linalg.norm(quaternion)
    if length == 0:
        raise entry.error("a quaternion that is not zero")
    x, y, z, w = quaternion / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
