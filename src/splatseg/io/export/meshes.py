"""Meshes of objects as files: glTF binary, OBJ or PLY, with what the object is.

Vertices are world positions in scene units in every format. The node of a GLB turns the scene's up
axis to glTF's, +y, and scales to metres, as far as the scene knows either; programs that import
glTF turn it to their own up axis, so that an object stands upright in the size that it has.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from PIL import Image
from torch import Tensor

from splatseg._check import check_choice, check_shape
from splatseg.core import UNLABELLED
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError, import_package, visible
from splatseg.io.atomic import atomic_folder
from splatseg.io.export.objects import MADE_BY, ObjectRow, object_content
from splatseg.io.export.splats import NONE, check_replaceable, object_stem
from splatseg.io.json_files import write_json

MeshFormat = Literal["glb", "obj", "ply"]
"""glTF binary, Wavefront OBJ, or PLY; see `write_object_meshes`."""

MESHES_FILE = "meshes.json"

_UP = np.array([0.0, 1.0, 0.0])
"""glTF's."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TriangleMesh:
    """Triangles, counter-clockwise seen from outside."""

    vertices: Float[Tensor, "n 3"]
    """World, scene units."""

    faces: Int64[Tensor, "m 3"]
    """Vertices of each triangle."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("vertices", self.vertices, (None, 3))
        check_shape("faces", self.faces, (None, 3))

    @property
    def volume(self) -> float:
        """What a closed surface encloses, cubic scene units."""
        a, b, c = (self.vertices - self.vertices.mean(0))[self.faces].unbind(1)
        return float((a * torch.linalg.cross(b, c)).sum() / 6)

    @property
    def is_watertight(self) -> bool:
        """Whether every edge has exactly two triangles, one in each direction."""
        heads = self.faces.reshape(-1)
        tails = self.faces.roll(-1, dims=1).reshape(-1)
        count = len(self.vertices)
        there, back = torch.sort(heads * count + tails)[0], torch.sort(tails * count + heads)[0]
        once = bool((there.diff() > 0).all()) if len(there) else False
        return once and torch.equal(there, back)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageTexture:
    """An image on a mesh."""

    uv: Float[Tensor, "n 2"]
    """Position in the image of each vertex: u right, v up from the lower edge, 0 to 1."""

    image: UInt8[Tensor, "height width 3"]
    """sRGB, the upper row first."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VertexColours:
    """A colour of each vertex."""

    colours: UInt8[Tensor, "n 3"]
    """sRGB."""

    seen: Bool[Tensor, "n"]
    """Whether a view saw it; colours of others are taken from neighbours."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectMesh:
    """An object and its surface."""

    row: ObjectRow
    mesh: TriangleMesh
    """As it is written: where charts of a texture meet, vertices are there once a chart."""

    normals: Float[Tensor, "n 3"]
    """Of its vertices, of length 1, outwards."""

    colour: ImageTexture | VertexColours
    """An image for GLB and OBJ, colours of vertices for PLY."""

    facts: Mapping[str, Any]
    """What the table says of it besides."""

    hulls: Sequence[TriangleMesh] = ()
    """Convex hulls for collisions."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoMesh:
    """An object without a mesh."""

    row: ObjectRow
    reason: str
    """Why, without a full stop."""


@boundary
def write_object_meshes(
    objects: Iterable[ObjectMesh | NoMesh],
    folder: Path,
    *,
    format: MeshFormat = "glb",
    about: Mapping[str, Any] | None = None,
    up: tuple[float, float, float] | None = None,
    metres_per_unit: float | None = None,
) -> dict[int, str]:
    """Write a folder of meshes, one an object; it appears whole or not at all.

    ``FOLDER/007_red-chair.glb`` has the object with id 7, ``FOLDER/007_red-chair_hulls.glb`` its
    collision hulls, ``FOLDER/meshes.json`` a row each. A folder of an earlier export is replaced
    as a whole.

    - glb: extras of the mesh have object_id, name, class_id and class; hulls are meshes of their
      own, hull_00 and on.
    - obj: the material is in a ``.mtl`` and the texture in a ``.png`` of the same name, the ids in
      the comment of the first line; hulls are objects of their own.
    - ply: columns red green blue alpha, object_id and class_id (int32, 0 for none) and seen
      (uint8); of hulls object_id, class_id and hull, which hull a vertex is of.

    Args:
        objects: Made one after another, so that one is in memory.
        folder: What to write.
        format: Of the files.
        about: Further members of meshes.json.
        up: Away from the ground in the scene; None leaves GLB in the axes of the scene.
        metres_per_unit: None leaves GLB in scene units.

    Returns:
        Names of the files in the folder by object id.

    Raises:
        InputError: If the folder holds something other than an earlier export, no object has a
            mesh, or a mesh has not the colours that the format holds.
        RangeError: If `up` or `metres_per_unit` cannot be.
        MissingPackageError: If trimesh is not installed.
    """
    check_choice("format", format, tuple(_WRITERS))
    check_replaceable(folder, MESHES_FILE)
    import_package("trimesh", "writing meshes", "mesh")
    pose = glb_from_world(up, metres_per_unit)
    write = _WRITERS[format]
    table: list[dict[str, Any]] = []
    without: list[NoMesh] = []
    with atomic_folder(folder) as temporary:
        for one in objects:
            if isinstance(one, NoMesh):
                without.append(one)
                continue
            stem = object_stem(one.row)
            write(one, temporary, stem, pose)
            hulls = f"{stem}_hulls.{format}" if one.hulls else None
            files = {"file": f"{stem}.{format}", "hulls": hulls}
            table.append(object_content(one.row) | files | {"mesh": dict(one.facts)})
        if not table:
            raise InputError(_nothing(without))
        content: dict[str, Any] = {"made_by": MADE_BY} | dict(about or {}) | {"format": format}
        if format == "glb":
            content["glb_from_world"] = pose.tolist()
        content["objects"] = table
        content["without_mesh"] = [
            {"id": one.row.id, "name": one.row.name, "reason": one.reason} for one in without
        ]
        write_json(content, temporary / MESHES_FILE)
    return {row["id"]: row["file"] for row in table}


def _nothing(without: Sequence[NoMesh]) -> str:
    words = "; ".join(f"{one.row.id} {one.row.name}".strip() + f": {one.reason}" for one in without)
    return f"meshes: expected an object whose surface is seen, got none ({words or 'no objects'})."


@boundary
def glb_from_world(
    up: tuple[float, float, float] | None, metres_per_unit: float | None
) -> Float[Tensor, "4 4"]:
    """The transform of a GLB's node: the smallest turn of `up` to +y, and metres.

    An up axis of -y is turned about the x axis. None leaves axes or lengths as they are.

    Raises:
        RangeError: If the axis has no direction, or the unit is not above 0.
    """
    pose = np.eye(4)
    if metres_per_unit is not None and not 0 < metres_per_unit < np.inf:
        raise RangeError(f"metres_per_unit: expected a number above 0, got {metres_per_unit}.")
    if up is not None:
        length = float(np.linalg.norm(up))
        if len(up) != 3 or not 0 < length < np.inf:
            raise RangeError(f"up: expected a direction of three numbers, got {up}.")
        axis = np.asarray(up, np.float64) / length
        cosine, across = float(axis @ _UP), np.cross(axis, _UP)
        if cosine < -1 + 1e-9:
            pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
        else:
            x, y, z = across
            skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            # Rodrigues' formula of the turn that takes one unit vector to another.
            pose[:3, :3] = np.eye(3) + skew + skew @ skew / (1 + cosine)
    pose[:3, :3] *= 1.0 if metres_per_unit is None else metres_per_unit
    return torch.from_numpy(pose + 0.0)


def _identity(row: ObjectRow) -> dict[str, Any]:
    return {
        "object_id": row.id,
        "name": row.name,
        "class_id": None if row.class_id == UNLABELLED else row.class_id,
        "class": row.class_name,
    }


def _comment(row: ObjectRow) -> str:
    """What the object is, on one line."""
    said = _identity(row).items()
    return visible(", ".join(f"{key} {value}" for key, value in said if value not in (None, "")))


def _textured(one: ObjectMesh, name: str) -> Any:
    """A mesh of trimesh with its texture."""
    trimesh, visuals = _trimesh()
    if not isinstance(one.colour, ImageTexture):
        raise InputError("colour: expected an image for GLB and OBJ, got colours of vertices.")
    image = Image.fromarray(one.colour.image.numpy())
    material = visuals.material.PBRMaterial(
        name=name, baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0
    )
    return trimesh.Trimesh(
        vertices=one.mesh.vertices.numpy(),
        faces=one.mesh.faces.numpy(),
        vertex_normals=one.normals.numpy(),
        visual=visuals.TextureVisuals(uv=one.colour.uv.numpy(), material=material),
        process=False,
    )


def _plain(mesh: TriangleMesh) -> Any:
    trimesh, _ = _trimesh()
    return trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)


def _trimesh() -> tuple[Any, Any]:
    trimesh: Any = import_package("trimesh", "writing meshes", "mesh")
    return trimesh, import_package("trimesh.visual", "writing meshes", "mesh")


def _write_glb(one: ObjectMesh, folder: Path, stem: str, pose: Tensor) -> None:
    mesh = _textured(one, stem)
    mesh.metadata.update(_identity(one.row))
    _write_glb_scene({stem: mesh}, folder / f"{stem}.glb", pose)
    if one.hulls:
        hulls = {f"hull_{i:02d}": _plain(hull) for i, hull in enumerate(one.hulls)}
        for hull in hulls.values():
            hull.metadata.update(_identity(one.row))
        _write_glb_scene(hulls, folder / f"{stem}_hulls.glb", pose)


def _write_glb_scene(meshes: Mapping[str, Any], path: Path, pose: Tensor) -> None:
    trimesh, _ = _trimesh()
    scene = trimesh.Scene()
    for name, mesh in meshes.items():
        scene.add_geometry(mesh, node_name=name, geom_name=name, transform=pose.numpy())
    path.write_bytes(scene.export(file_type="glb", include_normals=True))


def _write_obj(one: ObjectMesh, folder: Path, stem: str, pose: Tensor) -> None:
    exchange: Any = import_package("trimesh.exchange.obj", "writing meshes", "mesh")
    mesh = _textured(one, stem)
    mesh.metadata["name"] = stem
    comment = _comment(one.row)
    text, files = exchange.export_obj(
        mesh, include_normals=True, return_texture=True, mtl_name=f"{stem}.mtl", header=comment
    )
    (folder / f"{stem}.obj").write_text(text, encoding="utf-8")
    for name, content in files.items():
        (folder / name).write_bytes(content)
    if one.hulls:
        hulls = [_plain(hull) for hull in one.hulls]
        for index, hull in enumerate(hulls):
            hull.metadata["name"] = f"hull_{index:02d}"
        text = "\n".join(
            _obj_part(hull.vertices, hull.faces, hull.metadata["name"], start)
            for hull, start in zip(hulls, _starts(hulls), strict=True)
        )
        (folder / f"{stem}_hulls.obj").write_text(f"# {comment}\n{text}", encoding="utf-8")


def _starts(hulls: Sequence[Any]) -> list[int]:
    """Number of the first vertex of each hull, from 1."""
    counts = [len(hull.vertices) for hull in hulls]
    return [1 + sum(counts[:index]) for index in range(len(counts))]


def _obj_part(vertices: Any, faces: Any, name: str, start: int) -> str:
    lines = [f"o {name}"]
    lines += [f"v {x:.8f} {y:.8f} {z:.8f}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + start).tolist()]
    return "\n".join(lines) + "\n"


def _write_ply(one: ObjectMesh, folder: Path, stem: str, pose: Tensor) -> None:
    if not isinstance(one.colour, VertexColours):
        raise InputError("colour: expected colours of vertices for PLY, got an image.")
    trimesh, _ = _trimesh()
    colours = one.colour.colours.numpy()
    mesh = trimesh.Trimesh(
        vertices=one.mesh.vertices.numpy(),
        faces=one.mesh.faces.numpy(),
        vertex_normals=one.normals.numpy(),
        vertex_colors=np.concatenate((colours, np.full_like(colours[:, :1], 255)), axis=1),
        process=False,
    )
    mesh.vertex_attributes.update(_id_columns(one.row, len(mesh.vertices)))
    mesh.vertex_attributes["seen"] = one.colour.seen.numpy().astype(np.uint8)
    (folder / f"{stem}.ply").write_bytes(mesh.export(file_type="ply", vertex_normal=True))
    if one.hulls:
        counts = [len(hull.vertices) for hull in one.hulls]
        whole = trimesh.util.concatenate([_plain(hull) for hull in one.hulls])
        whole.vertex_attributes.update(_id_columns(one.row, sum(counts)))
        whole.vertex_attributes["hull"] = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        (folder / f"{stem}_hulls.ply").write_bytes(whole.export(file_type="ply"))


def _id_columns(row: ObjectRow, count: int) -> dict[str, Any]:
    class_id = NONE if row.class_id == UNLABELLED else row.class_id
    return {
        name: np.full(count, id, np.int32)
        for name, id in (("object_id", row.id), ("class_id", class_id))
    }


_WRITERS = {"glb": _write_glb, "obj": _write_obj, "ply": _write_ply}
