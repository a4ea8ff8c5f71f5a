"""Gaussians in glTF 2.0 (``.gltf`` and ``.glb``) by the extension KHR_gaussian_splatting.

Attributes of a point primitive: POSITION, and under the extension's name ROTATION (x, y, z, w),
SCALE, OPACITY in [0, 1] and SH_DEGREE_l_COEF_n. Scales are linear in the extension as ratified
in 2026 and logs in its drafts, which are told apart by what linear scales cannot be: see
`_scales_are_logs`. Nodes move, turn and scale what they hold, harmonics included; primitives
come one after the other. Coordinates stay glTF's own (y up). See docs/formats/splats.md.
"""

import base64
import itertools
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar
from urllib.parse import unquote

import numpy as np
import torch
from msgspec import Meta
from numpy.typing import NDArray

from splatseg.core import Gaussians, Similarity
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.core.sh import MAX_DEGREE, SH_C0
from splatseg.errors import FileFormatError, quoted
from splatseg.io.foreign import expect, malformed, read_bytes
from splatseg.io.json_files import parse_object
from splatseg.io.schema import structured
from splatseg.io.splats._rows import (
    SOURCE_ROW,
    Array,
    Rows,
    beside,
    check_size,
    finish,
    read_file,
    warn,
)

EXTENSION = "KHR_gaussian_splatting"
_UNDERSTOOD = (EXTENSION, "KHR_mesh_quantization", "KHR_materials_unlit")
_SRGB = "srgb_rec709_display"
_LINEAR = "lin_rec709_display"
LINEAR_COLOUR = "linear_colour"
"""The extra column (uint8) that marks Gaussians whose colours are linear, not sRGB."""

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
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}

_Attributes = Mapping[str, Array]
T = TypeVar("T")

# What the JSON of glTF must have.
_Count = Annotated[int, Meta(ge=0)]
_Number = Annotated[float, Meta(ge=-1e30, le=1e30)]
_Three = tuple[_Number, _Number, _Number]


@dataclass(frozen=True, slots=True)
class _Asset:
    version: str


@dataclass(frozen=True, slots=True)
class _Accessor:
    componentType: int
    type: str
    count: _Count
    bufferView: _Count | None = None
    byteOffset: _Count = 0
    normalized: bool = False
    sparse: Any = None


@dataclass(frozen=True, slots=True)
class _View:
    buffer: _Count
    byteLength: _Count
    byteOffset: _Count = 0
    byteStride: Annotated[int, Meta(ge=1)] | None = None


@dataclass(frozen=True, slots=True)
class _Buffer:
    byteLength: _Count
    uri: str | None = None


@dataclass(frozen=True, slots=True)
class _Node:
    mesh: _Count | None = None
    children: list[_Count] = field(default_factory=list[int])
    matrix: Annotated[list[_Number], Meta(min_length=16, max_length=16)] | None = None
    rotation: tuple[_Number, _Number, _Number, _Number] | None = None
    scale: _Three | None = None
    translation: _Three | None = None


@dataclass(frozen=True, slots=True)
class _Primitive:
    attributes: dict[str, _Count]
    mode: int = 4
    extensions: dict[str, Any] = field(default_factory=dict[str, Any])


@dataclass(frozen=True, slots=True)
class _Mesh:
    primitives: list[_Primitive]


@dataclass(frozen=True, slots=True)
class _Scene:
    nodes: list[_Count] = field(default_factory=list[int])


@dataclass(frozen=True, slots=True)
class _Extension:
    kernel: str
    colorSpace: str


@dataclass(frozen=True, slots=True)
class _Document:
    asset: _Asset
    accessors: list[_Accessor] = field(default_factory=list[_Accessor])
    bufferViews: list[_View] = field(default_factory=list[_View])
    buffers: list[_Buffer] = field(default_factory=list[_Buffer])
    meshes: list[_Mesh] = field(default_factory=list[_Mesh])
    nodes: list[_Node] = field(default_factory=list[_Node])
    scenes: list[_Scene] | None = None
    scene: _Count = 0
    extensionsRequired: list[str] = field(default_factory=list[str])


def read_gltf(path: Path, *, strict: bool) -> Gaussians:
    """Read all Gaussians of the default scene, in world coordinates.

    Harmonics are padded with zeros to the highest degree in the file. Colours stay as they
    are stored; where the file calls them linear, the extra column ``linear_colour`` is 1 for
    those Gaussians, and a warning says so, because everything else here takes colours as sRGB.

    Raises:
        FileFormatError: If the file is damaged, holds no Gaussians, needs an extension that is
            not understood (compression, for example), shears or mirrors Gaussians, or holds
            a row that cannot be rendered.
        MissingFileError: If the file or a buffer's file does not exist.
    """
    gltf = _Gltf(path)
    unknown = [name for name in gltf.root.extensionsRequired if name not in _UNDERSTOOD]
    if unknown:
        raise FileFormatError(
            f"{path}: it needs the glTF extension {quoted(', '.join(unknown))}, which is not "
            "understood."
        )
    shown = [
        (primitive, extension, transform)
        for mesh, transform in gltf.meshes()
        for primitive in mesh.primitives
        if (extension := _extension(path, primitive)) is not None
    ]
    expect(shown, path, f"Gaussians ({EXTENSION}), got a glTF without")
    _check_amount(gltf, [primitive for primitive, _, _ in shown])
    found = [
        (_attributes(gltf, primitive), extension, transform)
        for primitive, extension, transform in shown
    ]
    logs = _scales_are_logs([attributes for attributes, _, _ in found])
    degree = max(_degree(path, attributes) for attributes, _, _ in found)
    kernels = sorted({extension.kernel for _, extension, _ in found} - {"ellipse"})
    if kernels:
        warn(path, f"the kernel {quoted(', '.join(kernels))} is not known; read as ellipses.")
    parts: list[Gaussians] = []
    first = 0
    for attributes, extension, transform in found:
        rows = _rows(path, attributes, degree=degree, logs=logs, space=extension.colorSpace)
        count = len(rows.means)
        of_file = torch.arange(first, first + count, dtype=torch.int32)
        part = finish(path, rows, {SOURCE_ROW: of_file}, strict=strict)
        moved = not np.array_equal(transform, np.eye(4))
        parts.append(part.transformed(_similarity(path, transform)) if moved else part)
        first += count
    return _marked(path, parts, [extension.colorSpace for _, extension, _ in found], count=first)


def _check_amount(gltf: "_Gltf", primitives: Sequence[_Primitive]) -> None:
    """Refuse more Gaussians than the file may stand for: nodes show meshes again and again."""
    tables = [primitive.attributes for primitive in primitives]
    positions = [table["POSITION"] for table in tables if "POSITION" in table]
    count = sum(gltf.at(gltf.root.accessors, i, "accessors").count for i in positions)
    harmonics = any("SH_DEGREE_1" in name for table in tables for name in table)
    check_size(gltf.path, count, MAX_DEGREE if harmonics else 0, packed=gltf.packed_size())


def _extension(path: Path, primitive: _Primitive) -> _Extension | None:
    """What a primitive says of its Gaussians, None if it has none."""
    if EXTENSION not in primitive.extensions:
        return None
    expect(primitive.mode == 0, path, "a primitive of points (mode 0), as Gaussians are")
    return structured(primitive.extensions[EXTENSION], _Extension, where=f"{path}: {EXTENSION}")


def _attributes(gltf: "_Gltf", primitive: _Primitive) -> dict[str, Array]:
    """The attributes of Gaussians as real numbers; the others are not read."""
    result: dict[str, Array] = {}
    for name, index in primitive.attributes.items():
        short = name.removeprefix(f"{EXTENSION}:")
        if short == name and name not in ("POSITION", "COLOR_0"):
            continue
        values, kind = gltf.accessor(index)
        result[short] = values
        if short == "SCALE" and kind.kind == "i":
            result["SIGNED_SCALE"] = values[:0]  # only its presence counts
    return result


def _scales_are_logs(primitives: list[_Attributes]) -> bool:
    """Whether a file keeps logs of scales, as drafts of the extension did until 2026.

    The ratified extension says that scales are linear, not negative and of unsigned type or
    float; drafts said logs of signed type or float. So a negative or signed scale anywhere
    in the file tells a draft, and so do scales that are all zero, as nothing could be seen.
    """
    scales = [attributes["SCALE"] for attributes in primitives if "SCALE" in attributes]
    signed = any("SIGNED_SCALE" in attributes for attributes in primitives)
    return (
        signed
        or any(bool((scale < 0).any()) for scale in scales)
        or all(not scale.any() for scale in scales)
    )


def _degree(path: Path, attributes: _Attributes) -> int:
    """The degree of the harmonics, all of whose coefficients must be there."""
    degree = 0
    for level in range(1, MAX_DEGREE + 2):
        names = [f"SH_DEGREE_{level}_COEF_{n}" for n in range(2 * level + 1)]
        have = [name in attributes for name in names]
        if not any(have):
            continue
        what = f"all harmonics of degrees 0 to at most {MAX_DEGREE}, got {sum(have)} of "
        what += f"{len(names)} of degree {level} after degree {degree}"
        expect(level <= MAX_DEGREE and all(have) and degree == level - 1, path, what)
        degree = level
    return degree


def _rows(path: Path, attributes: _Attributes, *, degree: int, logs: bool, space: str) -> Rows:
    """The arrays of one primitive, harmonics padded to `degree`."""
    means = _column(path, attributes, "POSITION", 3, None)
    count = len(means)
    rotations = _column(path, attributes, "ROTATION", 4, count)
    scales = _column(path, attributes, "SCALE", 3, count)
    rows = Rows(
        means=means,
        rotations=np.ascontiguousarray(rotations[:, [3, 0, 1, 2]]),
        scales=scales,
        opacities=_column(path, attributes, "OPACITY", 1, count)[:, 0],
        sh=np.zeros((count, (degree + 1) ** 2, 3), np.float32),
    )
    if logs:
        with np.errstate(over="ignore"):
            rows.scales = np.where(np.isneginf(scales), scales, np.exp(scales))
    if "SH_DEGREE_0_COEF_0" in attributes:
        levels = range(_degree(path, attributes) + 1)
        names = [f"SH_DEGREE_{level}_COEF_{n}" for level in levels for n in range(2 * level + 1)]
        for i, name in enumerate(names):
            rows.sh[:, i] = _column(path, attributes, name, 3, count)
    else:
        what = "SH_DEGREE_0_COEF_0 or COLOR_0 for Gaussians, got neither"
        expect("COLOR_0" in attributes, path, what)
        rows.sh[:, 0] = (_fallback_colour(attributes["COLOR_0"], space) - 0.5) / SH_C0
    return rows


def _column(path: Path, attributes: _Attributes, name: str, width: int, count: int | None) -> Array:
    """One attribute with the right number of columns and rows."""
    expect(name in attributes, path, f"the attribute {name} of Gaussians, got none")
    values = attributes[name]
    shape = (len(values) if count is None else count, width)
    what = f"the shape {shape} of the attribute {name}, got {values.shape}"
    expect(values.shape == shape, path, what)
    return values


def _fallback_colour(colour: Array, space: str) -> Array:
    """The mean colour from COLOR_0, which is linear, in the colour space of the Gaussians."""
    rgb = colour[:, :3]
    if space != _SRGB:
        return rgb
    low = np.clip(rgb, 0, 1)
    return np.where(low <= 0.0031308, low * 12.92, 1.055 * low ** (1 / 2.4) - 0.055)


def _similarity(path: Path, transform: NDArray[np.float64]) -> Similarity:
    """A node's matrix as a similarity.

    Raises:
        FileFormatError: If it shears, mirrors, flattens or scales axes differently: a Gaussian's
            scales and rotation could not hold the result together with its harmonics.
    """
    linear = transform[:3, :3]
    determinant = float(np.linalg.det(linear))
    scale = np.cbrt(abs(determinant))
    what = "nodes that move, turn and scale alike in all directions, got the matrix "
    what += f"{np.round(transform, 4).tolist()}"
    even = np.allclose(linear.T @ linear, scale**2 * np.eye(3), atol=1e-4 * scale**2)
    sound = determinant > 0 and even and np.allclose(transform[3], [0, 0, 0, 1])
    expect(sound, path, what)
    left, _, right = np.linalg.svd(linear)
    return Similarity(
        rotation=torch.from_numpy(left @ right),
        translation=torch.from_numpy(transform[:3, 3].copy()),
        scale=float(scale),
    )


def _marked(path: Path, parts: list[Gaussians], spaces: list[str], *, count: int) -> Gaussians:
    """All parts as one, with the Gaussians of linear colour marked, of `count` in the file."""
    joined = Gaussians.concatenate(parts)
    if len(joined) == count:
        joined = joined.replace(extra={})
    unknown = sorted(set(spaces) - {_SRGB, _LINEAR})
    if unknown:
        warn(
            path,
            f"the colour space {quoted(', '.join(unknown))} is not known; colours are as stored.",
        )
    if _LINEAR not in spaces:
        return joined
    linear = torch.cat(
        [
            torch.full((len(part),), int(space == _LINEAR), dtype=torch.uint8)
            for part, space in zip(parts, spaces, strict=True)
        ]
    )
    warn(
        path,
        f"{int(linear.sum())} of {len(joined)} Gaussians have linear colours; they are kept as "
        f"stored, marked in the extra column {LINEAR_COLOUR!r}, and look dark.",
    )
    return joined.replace(extra={**joined.extra, LINEAR_COLOUR: linear})


class _Gltf:
    """A parsed file whose accessors are read when they are asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        data = read_file(path)
        self._size = len(data)
        text, self._binary = _glb_chunks(path, data) if data[:4] == b"glTF" else (data, None)
        self.root = structured(parse_object(text, where=str(path)), _Document, where=str(path))
        version = self.root.asset.version
        expect(version.split(".")[0] == "2", path, f"glTF version 2, got {quoted(version)}")
        self._buffers: dict[int, bytes] = {}

    def at(self, items: Sequence[T], index: int, name: str) -> T:
        """An element of a list of the file, by an index that the file has."""
        fits = 0 <= index < len(items)
        expect(fits, self.path, f"a list {name} with an element {index}, got {len(items)}")
        return items[index]

    def accessor(self, index: int) -> tuple[NDArray[np.float32], np.dtype[np.generic]]:
        """Values (count, width) as real numbers, and the type they are stored in.

        Normalised integers become [0, 1], or [-1, 1] for signed ones, as glTF defines it.

        Raises:
            FileFormatError: If the accessor or its data are missing or do not fit.
        """
        entry = self.at(self.root.accessors, index, "accessors")
        where = f"{self.path}: accessors[{index}]"
        known = entry.componentType in _COMPONENTS and entry.type in _WIDTHS
        what = f"a component type and shape of glTF, got {entry.componentType}"
        expect(known, where, f"{what} {quoted(entry.type)}")
        if entry.sparse is not None or entry.bufferView is None:
            kind = "sparse" if entry.sparse is not None else "compressed or empty"
            raise FileFormatError(f"{where}: expected plain data, got a {kind} accessor.")
        kind, width = _COMPONENTS[entry.componentType], _WIDTHS[entry.type]
        view = self.at(self.root.bufferViews, entry.bufferView, "bufferViews")
        data = self._buffer(view.buffer)
        item = kind.itemsize * width
        stride = view.byteStride or item
        needed = entry.byteOffset + (entry.count - 1) * stride + item if entry.count else 0
        start, length = view.byteOffset, view.byteLength
        wanted = f"{needed} bytes, got a view of {length} bytes at byte {start} of {len(data)}, "
        wanted += f"one row each {stride} bytes"
        expect(stride >= item and needed <= length and start + length <= len(data), where, wanted)
        values: NDArray[Any] = np.empty((0, width), kind)
        if entry.count:
            strides = (stride, kind.itemsize)
            shape = (entry.count, width)
            values = np.ndarray(shape, kind, data, start + entry.byteOffset, strides)
        result = values.astype(np.float32)
        if entry.normalized and kind.kind != "f":
            result = np.maximum(result / np.iinfo(kind.str).max, -1)
        return result, values.dtype

    def _buffer(self, index: int) -> bytes:
        """The bytes of a buffer: the binary part, a data URI or a file beside this one."""
        if index not in self._buffers:
            entry = self.at(self.root.buffers, index, "buffers")
            where = f"{self.path}: buffers[{index}]"
            if entry.uri is not None:
                data = self._load(entry.uri)
            elif self._binary is not None and index == 0:
                data = self._binary
            else:
                raise malformed(where, "a uri, or buffer 0 of a .glb file with a binary part")
            have = f"{entry.byteLength} bytes, got {len(data)}: truncated"
            expect(len(data) >= entry.byteLength, where, have)
            self._buffers[index] = data
        return self._buffers[index]

    def _load(self, uri: str) -> bytes:
        """What a URI stands for; only data URIs and files in the same folder or below."""
        if not uri.startswith("data:"):
            return read_bytes(beside(self.path, unquote(uri)), "a buffer of glTF")
        head, _, body = uri.partition(",")
        try:
            if head.endswith(";base64"):
                return base64.b64decode(body, validate=True)
        except ValueError:  # wrong letters, or a wrong number of them
            pass
        raise FileFormatError(f"{self.path}: expected a data URI in base64, got {quoted(uri)}.")

    def packed_size(self) -> int:
        """Bytes of the file and of the buffers that lie beside it."""
        uris = [one.uri for one in self.root.buffers if one.uri is not None]
        files = {beside(self.path, unquote(uri)) for uri in uris if not uri.startswith("data:")}
        return self._size + sum(file.stat().st_size for file in files)

    def meshes(self) -> Iterator[tuple[_Mesh, NDArray[np.float64]]]:
        """Each mesh of the default scene with its ``world_from_mesh`` (4, 4), depth first.

        A mesh that several nodes show comes once for each.
        """
        nodes = self.root.nodes
        if self.root.scenes is not None:
            roots = self.at(self.root.scenes, self.root.scene, "scenes").nodes
        else:  # the nodes that nobody has as a child
            children = set(itertools.chain.from_iterable(node.children for node in nodes))
            roots = [index for index in range(len(nodes)) if index not in children]
        pending = [(index, np.eye(4)) for index in reversed(roots)]
        visited: set[int] = set()
        while pending:
            index, world_from_parent = pending.pop()
            node = self.at(nodes, index, "nodes")
            where = f"{self.path}: nodes[{index}]"
            expect(index not in visited, where, "a tree of nodes: this one has two parents")
            visited.add(index)
            world_from_node = world_from_parent @ _parent_from_node(where, node)
            if node.mesh is not None:
                yield self.at(self.root.meshes, node.mesh, "meshes"), world_from_node
            pending += [(child, world_from_node) for child in reversed(node.children)]


def _glb_chunks(path: Path, data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the binary part of a ``.glb`` file."""
    expect(len(data) >= 12, path, f"a .glb header of 12 bytes, got {len(data)}")
    version, length = struct.unpack_from("<II", data, 4)
    expect(version == 2, path, f".glb version 2, got {version}")
    expect(length == len(data), path, f"{length} bytes as its header says, got {len(data)}")
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        whole = at + 8 + size <= length
        expect(whole, path, f"a part of {size} bytes at byte {at}, got a truncated one")
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    expect(_JSON_CHUNK in chunks, path, "a JSON part in the .glb file, got none")
    return chunks[_JSON_CHUNK], chunks.get(_BINARY_CHUNK)


def _parent_from_node(where: str, node: _Node) -> NDArray[np.float64]:
    """A node's transform: its matrix (stored by columns), or translation, rotation, scale."""
    if node.matrix is not None:
        return np.array(node.matrix, np.float64).reshape(4, 4).T
    result = np.eye(4)
    if node.rotation is not None:
        x, y, z, w = node.rotation
        expect(any(node.rotation), where, "a quaternion that is not zero")
        quaternion = torch.tensor([w, x, y, z], dtype=torch.float64)
        result[:3, :3] = rotation_from_quaternion(quaternion).numpy()
    if node.scale is not None:
        result[:3, :3] *= np.array(node.scale)
    if node.translation is not None:
        result[:3, 3] = node.translation
    return result
