"""Labelled meshes and points."""

from pathlib import Path

from splatseg.io.surfaces import read_surface
from support.fuzz.targets.base import Target, target
from support.ply import write_ply

AXES = [("float", axis, [0.0, 1.0, 2.0, 0.5, float(i)]) for i, axis in enumerate("xyz")]
LABEL = ("ushort", "label", [1, 2, 0, 7, 3])
LISTS = [(0, 1, 2), (1, 2, 3, 4), (2, 3, 4)]


def _mesh(name: str, order: str, lists: list[tuple[int, ...]]) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        faces = [("list uchar int", "vertex_indices", lists), ("int", "object_id", [3, 4, 5])]
        file = write_ply({"vertex": [*AXES, LABEL], "face": faces}, folder / "a.ply", order=order)
        return Target(file=file, read=lambda: read_surface(file))


_mesh("mesh.ply", "little", [row[:3] for row in LISTS])
_mesh("mesh-polygons.ply", "big", LISTS)
_mesh("mesh-ascii.ply", "ascii", LISTS)


@target("labelled-points.npz")
def points(folder: Path) -> Target:
    """xyz, ids and normals."""
    import numpy as np

    file = folder / "a.npz"
    ids = np.arange(5, dtype=np.uint16)
    np.savez(file, xyz=np.zeros((5, 3), np.float32), semantic=ids, normal=np.ones((5, 3), np.int8))
    return Target(file=file, read=lambda: read_surface(file))
