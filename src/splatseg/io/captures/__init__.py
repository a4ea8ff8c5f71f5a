"""Captures: posed photographs in the layouts people have, read without their pixels.

`LAYOUTS` is the table of them; `read_capture` finds out which. Where a folder has several
descriptions the first of the table wins. A layout more is a row more.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from splatseg._check import check_choice
from splatseg.core import Capture, PointCloud
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures import colmap, kitti360, nerfstudio, waymo
from splatseg.io.captures import pose_tables as tables
from splatseg.io.captures.points import Metadata as Metadata
from splatseg.io.captures.points import finite_points, read_ply_points
from splatseg.io.captures.points import read_metadata as read_metadata
from splatseg.io.images import find_images


class _Layout(NamedTuple):
    """How captures of a layout are found and read."""

    name: str
    find: Callable[[Path], object]
    """Whether a folder is one: anything that counts as true."""

    read: Callable[..., Capture]
    """Takes the path, and `strict`."""

    files: tuple[str, ...] = ()
    """Names of files, beside others of the capture, that may stand for its folder."""

    suffixes: tuple[str, ...] = ()
    """Of files that are captures by themselves."""


def _has(file: str | Path) -> Callable[[Path], bool]:
    return lambda folder: (folder / file).is_file()


LAYOUTS = (
    _Layout("nerfstudio", _has(nerfstudio.FILE), nerfstudio.read_nerfstudio, (nerfstudio.FILE,)),
    _Layout(
        "blender",
        _has(nerfstudio.BLENDER_FILE),
        nerfstudio.read_blender,
        (nerfstudio.BLENDER_FILE,),
    ),
    _Layout("colmap", colmap.find_colmap, colmap.read_colmap),
    _Layout("llff", _has(tables.LLFF_FILE), tables.read_llff, (tables.LLFF_FILE,)),
    _Layout("idr", tables.find_idr, tables.read_idr, tables.IDR_FILES),
    _Layout("replica", tables.find_replica, tables.read_replica, (tables.REPLICA_FILE,)),
    _Layout("scannet", tables.find_scannet, tables.read_scannet),
    _Layout("scannetpp", nerfstudio.find_scannetpp, nerfstudio.read_scannetpp),
    _Layout("kitti360", kitti360.find_kitti360, kitti360.read_kitti360),
    _Layout("waymo", waymo.find_waymo, waymo.read_waymo, suffixes=(waymo.SUFFIX, waymo.OLD_SUFFIX)),
)
"""Layouts that are read, in the order in which they are looked for."""

FORMATS = tuple(layout.name for layout in LAYOUTS)


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
            (see `io.captures.kitti360`).
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
    window = not folder.is_dir() and kitti360.find_kitti360(folder)
    if folder.is_file() and not window:
        folder, named = _from_file(folder)
        format = named if format == "auto" else format
    if not folder.is_dir() and format != "waymo" and not window:
        raise MissingFileError(f"{path}: there is no such capture.")
    if format == "auto":
        format = next(iter(find_formats(folder)), "")
    layout = next((layout for layout in LAYOUTS if layout.name == format), None)
    if layout is None:
        raise InputError(_nothing_found(folder))
    return layout.read(folder, strict=strict)


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
    return tuple(layout.name for layout in LAYOUTS if layout.find(folder))


@boundary
def bare_photographs(folder: Path) -> tuple[Path, ...]:
    """Photographs of a folder that has no poses: in it, or in its folder ``images``."""
    return find_images(folder) or find_images(folder / "images")


def _from_file(path: Path) -> tuple[Path, str]:
    for layout in LAYOUTS:
        if path.suffix in layout.suffixes:
            return path, layout.name
        if path.name in layout.files:
            return path.parent, layout.name
    known = ", ".join(file for layout in LAYOUTS for file in layout.files)
    raise InputError(f"{path}: expected a capture's folder or one of {known}.")


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
