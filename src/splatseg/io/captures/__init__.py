"""Captures: posed photographs in the layouts people have, read without their pixels.

One module a layout; `read_capture` finds out which. Where a folder has several descriptions
the first of `FORMATS` wins.
"""

from pathlib import Path

from splatseg._check import check_choice
from splatseg.core import Capture, PointCloud
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures._metadata import Metadata as Metadata
from splatseg.io.captures._metadata import read_metadata as read_metadata
from splatseg.io.captures._points import read_ply_points
from splatseg.io.captures.blender import find_blender, read_blender
from splatseg.io.captures.build import finite_points
from splatseg.io.captures.colmap import find_colmap, read_colmap
from splatseg.io.captures.idr import FILES as _IDR_FILES
from splatseg.io.captures.idr import find_idr, read_idr
from splatseg.io.captures.kitti360 import find_kitti360, read_kitti360
from splatseg.io.captures.llff import FILE as _LLFF_FILE
from splatseg.io.captures.llff import read_llff
from splatseg.io.captures.nerfstudio import FILE as _NERFSTUDIO_FILE
from splatseg.io.captures.nerfstudio import read_nerfstudio
from splatseg.io.captures.replica import FILE as _REPLICA_FILE
from splatseg.io.captures.replica import find_replica, read_replica
from splatseg.io.captures.scannet import find_scannet, read_scannet
from splatseg.io.captures.scannetpp import find_scannetpp, read_scannetpp
from splatseg.io.captures.waymo import find_waymo, read_waymo
from splatseg.io.captures.waymo_segment import SUFFIX as _WAYMO_SUFFIX
from splatseg.io.captures.waymo_tfrecord import ENDING as _TFRECORD
from splatseg.io.images import find_images

FORMATS = (
    "nerfstudio", "blender", "colmap", "llff", "idr", "replica", "scannet", "scannetpp", "kitti360",
    "waymo",
)  # fmt: skip
"""Layouts that are read, in the order in which they are looked for."""


@boundary
def read_capture(path: Path | str, *, format: str = "auto", strict: bool = False) -> Capture:
    """Read a capture: cameras, split, start points and classes, not the photographs themselves.

    Views are sorted by name. The split is the capture's own, else every 8th view by sorted
    name (0, 8, 16, ...) is a test view. Photographs are checked to be there, under their name or
    their stem, and to have the size their intrinsics say, or a uniform scale of it, which is
    noted. Where fewer than half are there, the capture's own folders stand for those of another
    machine, and folders of smaller copies (``images_2``, ``images_4``, ``images_8``) for theirs.
    Those that are not there, cannot be opened, are of another shape than their intrinsics or mask,
    or have an impossible pose or lens are left out, which is noted too, as long as half of them can
    be used; so are start points that are not finite.

    Args:
        path: The capture's folder, or its transforms.json, poses_bounds.npy,
            cameras_sphere.npz or traj_w_c.txt, the folder of a COLMAP model, a component of a
            segment of Waymo, or of KITTI-360 a drive, a camera or a window of frames of one
            (see `kitti360_drive`).
        format: One of `FORMATS`, or ``auto`` for the first of them that is found.
        strict: Refuse a capture of which a photograph or a start point would be left out, or
            whose ``ply_file_path`` is not there.

    Returns:
        The capture, with `notes` on what a person should know of how it was read.

    Raises:
        MissingFileError: If there is no such folder, or more than half of the photographs (with
            `strict` any) are missing.
        InputError: If no layout is found, what it says cannot be, or more than half of the
            photographs (with `strict` any) cannot be used; one sentence with the reason.
        MissingPackageError: If a lens needs pycolmap, and that is not installed.
    """
    check_choice("format", format, ("auto", *FORMATS))
    folder = Path(path)
    window = not folder.is_dir() and find_kitti360(folder)
    if folder.is_file() and not window:
        folder, named = _from_file(folder)
        format = named if format == "auto" else format
    if not folder.is_dir() and format != "waymo" and not window:
        raise MissingFileError(f"{path}: there is no such capture.")
    if format == "auto":
        found = find_formats(folder)
        if not found:
            raise InputError(_nothing_found(folder))
        format = found[0]
    match format:
        case "nerfstudio":
            return read_nerfstudio(folder, strict=strict)
        case "blender":
            return read_blender(folder, strict=strict)
        case "colmap":
            return read_colmap(folder, strict=strict)
        case "llff":
            return read_llff(folder, strict=strict)
        case "idr":
            return read_idr(folder, strict=strict)
        case "replica":
            return read_replica(folder, strict=strict)
        case "scannet":
            return read_scannet(folder, strict=strict)
        case "waymo":
            return read_waymo(folder, strict=strict)
        case "scannetpp":
            return read_scannetpp(folder, strict=strict)
        case _:
            return read_kitti360(folder, strict=strict)


@boundary
def read_start_points(
    path: Path | str, *, strict: bool = False
) -> tuple[PointCloud, tuple[str, ...]]:
    """Points of a PLY file of points or of a mesh, and notes on those that are left out.

    Args:
        path: The file.
        strict: Refuse points that are NaN or infinite.

    Raises:
        MissingFileError: If there is no such file.
        InputError: If it is no PLY of points, or all of them, any with `strict`, are not finite.
    """
    file = Path(path)
    return finite_points(read_ply_points(file), where=file, strict=strict)


@boundary
def find_formats(folder: Path) -> tuple[str, ...]:
    """Layouts that a folder has, the one that would be read first."""
    found = {
        "nerfstudio": (folder / _NERFSTUDIO_FILE).is_file(),
        "blender": find_blender(folder),
        "colmap": find_colmap(folder) is not None,
        "llff": (folder / _LLFF_FILE).is_file(),
        "idr": find_idr(folder) is not None,
        "replica": find_replica(folder) is not None,
        "scannet": find_scannet(folder),
        "scannetpp": find_scannetpp(folder),
        "kitti360": find_kitti360(folder),
        "waymo": find_waymo(folder),
    }
    return tuple(format for format in FORMATS if found[format])


@boundary
def bare_photographs(folder: Path) -> tuple[Path, ...]:
    """Photographs of a folder that has no poses: in it, or in its folder ``images``."""
    return find_images(folder) or find_images(folder / "images")


def _from_file(path: Path) -> tuple[Path, str]:
    if path.suffix in (_WAYMO_SUFFIX, _TFRECORD):
        return path, "waymo"
    named = {_NERFSTUDIO_FILE: "nerfstudio", "transforms_train.json": "blender"}
    named |= {_LLFF_FILE: "llff", _REPLICA_FILE: "replica"} | dict.fromkeys(_IDR_FILES, "idr")
    if path.name not in named:
        raise InputError(f"{path}: expected a capture's folder or one of {', '.join(named)}.")
    return path.parent, named[path.name]


def _nothing_found(folder: Path) -> str:
    photographs = len(bare_photographs(folder))
    if photographs:
        return (
            f"{folder}: expected photographs with poses, got {photographs} photographs without; "
            "poses come from COLMAP or another tool, or `splatseg fit` finds them."
        )
    return (
        f"{folder}: expected a capture (transforms.json, a COLMAP model, poses_bounds.npy, "
        "cameras_sphere.npz, or a scene of Replica, ScanNet, ScanNet++, KITTI-360 or Waymo), got "
        "none of them."
    )
