"""Start points that lie beside a description of poses which does not name them."""

from pathlib import Path

from splatseg.core import PointCloud
from splatseg.io.captures._colmap_binary import read_points
from splatseg.io.captures._points import read_ply_points

_PLY = ("points3D.ply", "sparse_pc.ply")


def points_beside(folder: Path) -> PointCloud | None:
    """Points of points3D.ply, sparse_pc.ply or points3D.bin in a folder, or None.

    They are taken to lie in the same world as the poses beside them.
    """
    for name in _PLY:
        if (folder / name).is_file():
            return read_ply_points(folder / name)
    if (folder / "points3D.bin").is_file():
        return read_points(folder / "points3D.bin")
    return None
