"""Gaussians in glTF 2.0 (``.gltf`` and ``.glb``) by the extension KHR_gaussian_splatting.

Attributes of a point primitive: POSITION, and under the extension's name ROTATION (x, y, z, w),
SCALE, OPACITY in [0, 1] and SH_DEGREE_l_COEF_n. Scales are linear in the extension as ratified
in 2026 and logs in its drafts, which are told apart by what linear scales cannot be: see
`_scales_are_logs`. Nodes move, turn and scale what they hold, harmonics included; primitives
come one after the other. Coordinates stay glTF's own (y up). See docs/formats/splats.md.
"""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Gaussians, Similarity
from splatseg.core.sh import MAX_DEGREE, SH_C0
from splatseg.errors import FileFormatError
from splatseg.io.splats._gltf_container import Gltf
from splatseg.io.splats._json import Json
from splatseg.io.splats._rows import SOURCE_ROW, Array, Rows, check_size, finish, warn

EXTENSION = "KHR_gaussian_splatting"
_UNDERSTOOD = (EXTENSION, "KHR_mesh_quantization", "KHR_materials_unlit")
_SRGB = "srgb_rec709_display"
_LINEAR = "lin_rec709_display"
LINEAR_COLOUR = "linear_colour"
"""The extra column (uint8) that marks Gaussians whose colours are linear, not sRGB."""

_Attributes = Mapping[str, Array]


def read_gltf(path: Path, *, strict: bool = False) -> Gaussians:
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
    gltf = Gltf(path)
    required = [item.text() for item in gltf.root.optional_items("extensionsRequired")]
    unknown = [name for name in required if name not in _UNDERSTOOD]
    if unknown:
        raise FileFormatError(
            f"{path}: it needs the glTF extension {', '.join(unknown)}, which is not understood."
        )
    shown = [
        (primitive, extension, transform)
        for mesh, transform in gltf.meshes()
        for primitive in mesh["primitives"].items()
        if (extension := _extension(primitive)) is not None
    ]
    if not shown:
        raise FileFormatError(f"{path}: expected Gaussians ({EXTENSION}), got a glTF without.")
    _check_amount(gltf, [primitive for primitive, _, _ in shown])
    found = [
        (_attributes(gltf, primitive), extension, transform)
        for primitive, extension, transform in shown
    ]
    logs = _scales_are_logs([attributes for attributes, _, _ in found])
    degree = max(_degree(path, attributes) for attributes, _, _ in found)
    kernels = sorted({extension["kernel"].text() for _, extension, _ in found} - {"ellipse"})
    if kernels:
        warn(path, f"the kernel {', '.join(kernels)} is not known; read as ellipses.")
    spaces = [extension["colorSpace"].text() for _, extension, _ in found]
    counts = [len(attributes.get("POSITION", ())) for attributes, _, _ in found]
    starts = list(itertools.accumulate(counts, initial=0))
    parts = [
        _gaussians(
            path,
            attributes,
            degree=degree,
            logs=logs,
            space=space,
            transform=transform,
            first=first,
            strict=strict,
        )
        for (attributes, _, transform), space, first in zip(found, spaces, starts, strict=False)
    ]
    return _marked(path, parts, spaces, count=starts[-1])


def _check_amount(gltf: Gltf, primitives: Sequence[Json]) -> None:
    """Refuse more Gaussians than the file may stand for: nodes show meshes again and again."""
    tables = [primitive["attributes"] for primitive in primitives]
    count = sum(
        gltf.root["accessors"].element(table["POSITION"].integer())["count"].integer()
        for table in tables
        if "POSITION" in table
    )
    harmonics = any("SH_DEGREE_1" in name for table in tables for name in table.names())
    check_size(gltf.path, count, MAX_DEGREE if harmonics else 0, packed=gltf.packed_size())


def _extension(primitive: Json) -> Json | None:
    """What a primitive says of its Gaussians, None if it has none."""
    if "extensions" not in primitive or EXTENSION not in primitive["extensions"]:
        return None
    if "mode" not in primitive or primitive["mode"].integer() != 0:
        raise primitive.error("a primitive of points (mode 0), as Gaussians are")
    return primitive["extensions"][EXTENSION]


def _attributes(gltf: Gltf, primitive: Json) -> dict[str, Array]:
    """The attributes of Gaussians as real numbers; the others are not read."""
    table = primitive["attributes"]
    result: dict[str, Array] = {}
    for name in table.names():
        short = name.removeprefix(f"{EXTENSION}:")
        if short == name and name not in ("POSITION", "COLOR_0"):
            continue
        values, kind = gltf.accessor(table[name].integer())
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
        if level > MAX_DEGREE or not all(have) or degree != level - 1:
            raise FileFormatError(
                f"{path}: expected all harmonics of degrees 0 to at most {MAX_DEGREE}, got "
                f"{sum(have)} of {len(names)} of degree {level} after degree {degree}."
            )
        degree = level
    return degree


def _gaussians(
    path: Path,
    attributes: _Attributes,
    *,
    degree: int,
    logs: bool,
    space: str,
    transform: NDArray[np.float64],
    first: int,
    strict: bool,
) -> Gaussians:
    """The Gaussians of one primitive in the world, harmonics padded to `degree`.

    They have the column `SOURCE_ROW`, counted from `first`.
    """
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
        index = 0
        for level in range(_degree(path, attributes) + 1):
            for n in range(2 * level + 1):
                name = f"SH_DEGREE_{level}_COEF_{n}"
                rows.sh[:, index] = _column(path, attributes, name, 3, count)
                index += 1
    elif "COLOR_0" in attributes:
        rows.sh[:, 0] = (_fallback_colour(attributes["COLOR_0"], space) - 0.5) / SH_C0
    else:
        raise FileFormatError(
            f"{path}: expected SH_DEGREE_0_COEF_0 or COLOR_0 for Gaussians, got neither."
        )
    of_file = torch.arange(first, first + count, dtype=torch.int32)
    gaussians = finish(path, rows, {SOURCE_ROW: of_file}, strict=strict)
    if np.array_equal(transform, np.eye(4)):
        return gaussians
    return gaussians.transformed(_similarity(path, transform))


def _column(path: Path, attributes: _Attributes, name: str, width: int, count: int | None) -> Array:
    """One attribute with the right number of columns and rows."""
    if name not in attributes:
        raise FileFormatError(f"{path}: expected the attribute {name} of Gaussians, got none.")
    values = attributes[name]
    expected = (len(values) if count is None else count, width)
    if values.shape != expected:
        raise FileFormatError(
            f"{path}: expected the shape {expected} of the attribute {name}, got {values.shape}."
        )
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
    if (
        determinant <= 0
        or not np.allclose(transform[3], [0, 0, 0, 1])
        or not np.allclose(linear.T @ linear, scale**2 * np.eye(3), atol=1e-4 * scale**2)
    ):
        raise FileFormatError(
            f"{path}: expected nodes that move, turn and scale alike in all directions, "
            f"got the matrix {np.round(transform, 4).tolist()}."
        )
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
            f"the colour space {', '.join(unknown)} is not known; colours are as stored.",
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
