"""Reads what descends from Blender's transforms.json: nerfstudio, NeRF-synthetic, ScanNet++.

A frame has its photograph and its pose, world_from_cam with OpenGL axes; intrinsics stand in it or
for all frames at the top.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from splatseg.core import CameraModel, Capture, PointCloud
from splatseg.core.json_values import json_matrix
from splatseg.errors import MissingFileError, quoted
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.colmap_model import points_beside, read_points
from splatseg.io.captures.points import read_ply_points
from splatseg.io.captures.raw_views import Intrinsics, OfSize, RawView, opencv_from_opengl
from splatseg.io.foreign import expect, is_file, malformed
from splatseg.io.json_files import read_json
from splatseg.io.ply import ply_columns
from splatseg.io.schema import MAX_SIDE, Name, read_structured, structured

FILE = "transforms.json"
BLENDER_FILE = "transforms_train.json"
SCANNETPP_FILE = Path("dslr/nerfstudio/transforms.json")
MILLIMETRE = 0.001
"""Unit of depth maps where the file does not say: nerfstudio's default, in scene units."""

MESH_FROM_NERFSTUDIO: NDArray[np.float64] = np.array(
    [[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
)
"""transforms.json of ScanNet++ is of the world that nerfstudio makes of COLMAP's: x and y are
exchanged, z is turned. COLMAP's is that of the meshes, and so is the capture's
(scannetpp/scannetpp, issue 160)."""

_SPLITS = ("train", "val", "test")
_MODELS: dict[str, CameraModel] = {
    "OPENCV": "opencv", "PINHOLE": "opencv", "SIMPLE_PINHOLE": "opencv", "SIMPLE_RADIAL": "opencv",
    "RADIAL": "opencv", "PERSPECTIVE": "opencv", "FULL_OPENCV": "opencv",
    "OPENCV_FISHEYE": "fisheye", "MEI": "mei", "THIN_PRISM_FISHEYE": "thin_prism_fisheye",
}  # fmt: skip
_FOCALS = (
    (("fl_x", "fl_y"), None),
    (("camera_angle_x", "camera_angle_y"), 1.0),
    (("x_fov", "y_fov"), math.pi / 180),
)
"""Keys of focal lengths in pixels, and of fields of view with their unit in radians; the first that
is there counts. Those in degrees are instant-ngp's."""

LENS_KEYS: dict[CameraModel, tuple[str, ...]] = {
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "mei": ("xi", "k1", "k2", "p1", "p2"),
    "thin_prism_fisheye": ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
}
"""Keys of the distortion of a lens model, in the order of `Camera.distortion`."""

_OTHER_LENSES = ("ftheta_p0", "latlong", "equirectangular")
"""Keys by which instant-ngp knows lenses that a plane does not hold."""

_Pixels = Annotated[float, Meta(ge=1, le=MAX_SIDE)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """A photograph of a transforms.json, with the keys at the top of the file under its own."""

    file_path: Name
    transform_matrix: Any = None
    mask_path: str | None = None
    depth_file_path: str | None = None
    depth_unit_scale_factor: float = MILLIMETRE
    is_bad: Any = False

    camera_model: str | None = None
    is_fisheye: Any = False
    ftheta_p0: Any = None
    latlong: Any = None
    equirectangular: Any = None
    w: _Pixels | None = None
    h: _Pixels | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    camera_angle_x: float | None = None
    camera_angle_y: float | None = None
    x_fov: float | None = None
    y_fov: float | None = None
    cx: float | None = None
    cy: float | None = None
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    xi: float = 0.0
    sx1: float = 0.0
    sy1: float = 0.0


AnyFrame = TypeVar("AnyFrame", bound=Frame)


def frames_of(
    content: Mapping[str, Any], kind: type[AnyFrame], *, where: object, key: str = "frames"
) -> list[AnyFrame]:
    """The frames of a file.

    Raises:
        FileFormatError: If it has none, or one lacks a key or has a wrong one.
    """
    shared = {name: value for name, value in content.items() if name != key}
    return [
        structured({**shared, **frame}, kind, where=f"{where}: {key}[{i}]")
        for i, frame in enumerate(_rows(content, key, where))
    ]


def _rows(content: Mapping[str, Any], key: str, where: object) -> list[dict[str, Any]]:
    if not isinstance(content.get(key), list):
        raise malformed(where, f"a list of {key}", content.get(key))
    return structured(content[key], list[dict[str, Any]], where=f"{where}: {key}")


def read_nerfstudio(folder: Path, *, strict: bool = False) -> Capture:
    """Read a capture with a transforms.json; see `read_capture`.

    Intrinsics stand at the top or in a frame, which wins: ``fl_x fl_y cx cy w h`` in pixels
    (or ``camera_angle_x`` in radians, or ``x_fov`` in degrees; without ``w h`` the photograph's
    size is taken), ``camera_model``, and distortion as OpenCV names it.
    ``transform_matrix`` is world_from_cam with OpenGL axes (x right, y up, z backwards).
    ``mask_path``, ``depth_file_path`` and ``split`` of a frame are taken over. Start points
    come from ``ply_file_path``, else from points3D.ply, sparse_pc.ply or points3D.bin beside
    it. A ply_file_path that holds Gaussians is the capture's splat file as well; one that is not
    there is noted.

    Raises:
        MissingFileError: If transforms.json, or a file that it names (ply_file_path with `strict`
            only), is missing.
        InputError: If it is broken, or what it says cannot be.
    """
    path = folder / FILE
    content = read_json(path)
    frames = frames_of(content, Frame, where=path)
    splits = _frame_splits(content, _rows(content, "frames", path))
    raw: list[RawView] = []
    for frame, split in zip(frames, splits, strict=True):
        mask, depth = (_beside(path, name) for name in (frame.mask_path, frame.depth_file_path))
        raw.append(
            _raw_view(
                frame,
                path=path,
                split=split,
                mask=mask,
                depth=depth,
                depth_unit=None if depth is None else frame.depth_unit_scale_factor,
            )
        )
    points, splats, notes = _points(content, folder, strict=strict)
    return build_capture(
        folder, raw, format="nerfstudio", points=points, splats=splats, notes=notes, strict=strict
    )


def read_blender(folder: Path, *, strict: bool = False) -> Capture:
    """Read a NeRF-synthetic capture; see `read_capture`.

    One file a split. ``camera_angle_x`` (radians) gives the focal length, the principal point
    is the middle and the size that of the photographs, unless the file has other intrinsics of
    transforms.json; ``file_path`` has no suffix (png is tried first). Poses are as there.
    Transparent pixels are blended over white when a photograph is read.

    Raises:
        InputError: If a file is broken, or what it says cannot be.
        MissingFileError: If photographs are missing.
    """
    raw: list[RawView] = []
    for split in _SPLITS:
        path = folder / f"transforms_{split}.json"
        if path.is_file():
            frames = frames_of(read_json(path), Frame, where=path)
            raw += [_raw_view(frame, path=path, split=split) for frame in frames]
    return build_capture(folder, raw, format="blender", points=points_beside(folder), strict=strict)


@dataclass(frozen=True, slots=True)
class _Lists:
    """train_test_lists.json of ScanNet++."""

    train: list[str]
    test: list[str]


def find_scannetpp(folder: Path) -> bool:
    """Whether a folder is a scene of ScanNet++ with DSLR photographs."""
    return (folder / SCANNETPP_FILE).is_file()


def read_scannetpp(folder: Path, *, strict: bool = False) -> Capture:
    """Read the DSLR photographs of a scene of ScanNet++; see `read_capture`.

    ``dslr/nerfstudio/transforms.json`` has one fisheye lens, training ``frames`` and
    ``test_frames``; ``dslr/train_test_lists.json`` counts where it is there, and frames that are
    marked as bad are ``unused``. The world is that of the meshes in ``scans``. Photographs are
    ``dslr/resized_images``; masks of ``dslr/resized_anon_masks`` become the views' masks, where
    that folder is there. Start points are those of ``dslr/colmap``.

    Raises:
        MissingFileError: If the description, photographs or masks are missing.
        InputError: If it is broken, or what it says cannot be.
    """
    path, dslr = folder / SCANNETPP_FILE, folder / "dslr"
    if not path.is_file():
        raise MissingFileError(f"{folder}: expected {SCANNETPP_FILE}, got none.")
    content = read_json(path)
    lists, masks = dslr / "train_test_lists.json", dslr / "resized_anon_masks"
    listed = read_structured(lists, _Lists) if lists.is_file() else None
    splits = {} if listed is None else dict.fromkeys(listed.train, "train")
    splits |= {} if listed is None else dict.fromkeys(listed.test, "test")
    raw: list[RawView] = []
    for key, split in (("frames", "train"), ("test_frames", "test")):
        for frame in frames_of({"test_frames": [], **content}, Frame, where=path, key=key):
            own = split if listed is None else splits.get(frame.file_path, "unused")
            raw.append(
                _raw_view(
                    frame,
                    path=path,
                    folder=dslr / "resized_images",
                    world=MESH_FROM_NERFSTUDIO,
                    split="unused" if frame.is_bad is True else own,
                    mask=masks / frame.mask_path if frame.mask_path and masks.is_dir() else None,
                )
            )
    points = dslr / "colmap" / "points3D.txt"
    return build_capture(
        folder,
        raw,
        format="scannetpp",
        points=read_points(points) if points.is_file() else None,
        metres_per_unit=1.0,
        up=(0.0, 0.0, 1.0),
        strict=strict,
    )


def _raw_view(
    frame: Frame,
    *,
    path: Path,
    folder: Path | None = None,
    world: NDArray[np.float64] | None = None,
    **more: Any,
) -> RawView:
    relative = frame.file_path.replace("\\", "/").removeprefix("./")
    where = f"{path}: frame {quoted(relative)}"
    image = (folder or path.parent) / relative
    expect(image.name, where, "a file_path that names a file, got none")
    matrix = frame_matrix(frame, where=where)
    return RawView(
        image=image,
        relative=relative,
        intrinsics=intrinsics_of_frame(frame, where=where),
        cam_from_world=opencv_from_opengl(matrix if world is None else world @ matrix),
        **more,
    )


def frame_matrix(frame: Frame, *, where: str) -> NDArray[np.float64]:
    """The 4 x 4 ``transform_matrix`` of a frame: world_from_cam, OpenGL axes; NaN stays NaN.

    Raises:
        FileFormatError: If it is no matrix of numbers of 4 x 4 or 3 x 4.
    """
    place, shapes = f"{where}: transform_matrix", ((4, 4), (3, 4))
    matrix = json_matrix(frame.transform_matrix, where=place, shapes=shapes, finite=False)
    return matrix if len(matrix) == 4 else np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])


def lens_of(frame: Frame, *, where: str) -> tuple[CameraModel, tuple[float, ...]]:
    """Lens model and distortion of a frame.

    Raises:
        FileFormatError: If the camera model is not one that can be undistorted.
    """
    for key in _OTHER_LENSES:
        known = getattr(frame, key) in (None, False)
        expect(known, where, f"a lens that can be undistorted, got one with {key}")
    default = "OPENCV_FISHEYE" if frame.is_fisheye is True else "OPENCV"
    model = _MODELS.get(frame.camera_model or default)
    if model is None:
        raise malformed(
            where, f"a camera_model of {', '.join(sorted(_MODELS))}", frame.camera_model
        )
    return model, tuple(getattr(frame, key) for key in LENS_KEYS[model])


def intrinsics_of_frame(frame: Frame, *, where: str) -> Intrinsics | OfSize:
    """The lens of a frame; by its size where that is not said.

    Raises:
        FileFormatError: If a focal length lacks, or the camera model is not one that can be
            undistorted.
    """
    model, distortion = lens_of(frame, where=where)

    def of_size(width: int, height: int) -> Intrinsics:
        return Intrinsics(
            model=model,
            focal=_focals(frame, (width, height), where=where),
            centre=(
                width / 2 if frame.cx is None else frame.cx,
                height / 2 if frame.cy is None else frame.cy,
            ),
            distortion=distortion,
            size=(width, height),
        )

    if frame.w is None or frame.h is None:
        of_size(1, 1)  # what it lacks is said before there is a photograph
        return of_size
    return of_size(int(frame.w), int(frame.h))


def _focals(frame: Frame, size: tuple[int, int], *, where: str) -> tuple[float, float]:
    """Focal lengths in pixels, from one of `_FOCALS`.

    Either axis stands for both where only it is said.
    """
    for keys, radians in _FOCALS:
        found = [
            value if radians is None else focal_of(value * radians, side)
            for value, side in zip((getattr(frame, key) for key in keys), size, strict=True)
            if value is not None
        ]
        if found:
            return found[0], found[-1]
    raise malformed(where, "a focal length (fl_x, camera_angle_x or x_fov), got none")


def focal_of(angle: float, size: float) -> float:
    """Focal length in pixels of a field of view in radians; 0 (refused later) if impossible.

    Example:
        >>> round(focal_of(math.pi / 2, 800), 6)
        400.0
    """
    tangent = math.tan(angle / 2)
    return 0.5 * size / tangent if tangent > 0 else 0.0


def _beside(path: Path, name: str | None) -> Path | None:
    return path.parent / name.replace("\\", "/") if name else None


def _frame_splits(
    content: Mapping[str, Any], frames: Sequence[Mapping[str, Any]]
) -> list[str | None]:
    """The split of each frame; None everywhere where the file gives none.

    A frame's own ``split`` comes before the lists ``train_filenames``, ``val_filenames`` and
    ``test_filenames``. A frame that no list names belongs to none of them (``unused``). A file
    in both val and test is a test view, and where there is no test split val stands for it.
    """
    listed: dict[str, str] = {}
    for split in _SPLITS:
        names = content.get(f"{split}_filenames")
        if isinstance(names, list):
            listed |= {str(name): split for name in names}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    other = "unused" if listed else None
    splits = [
        listed.get(str(frame.get("file_path")), other)
        if frame.get("split") is None
        else str(frame["split"])
        for frame in frames
    ]
    if "test" not in splits:
        splits = ["test" if split == "val" else split for split in splits]
    return splits


def splits_beside(folder: Path) -> dict[Path, str]:
    """Splits by photograph, from the transforms.json of a capture; empty where it has none."""
    path = folder / FILE
    if not path.is_file():
        return {}
    content = read_json(path)
    listed = content.get("frames")
    frames = [f for f in listed if isinstance(f, dict)] if isinstance(listed, list) else []  # pyright: ignore[reportUnknownVariableType]
    splits = zip(frames, _frame_splits(content, frames), strict=True)
    return {folder / str(f.get("file_path")): split for f, split in splits if split is not None}


def _points(
    content: Mapping[str, Any], folder: Path, *, strict: bool
) -> tuple[PointCloud | None, Path | None, list[str]]:
    """Start points, the same as splats where they are some, and notes."""
    name = content.get("ply_file_path")
    if not isinstance(name, str) or not name:
        return points_beside(folder), None, []
    path = folder / name.replace("\\", "/")
    if is_file(path):
        holds_splats = "f_dc_0" in ply_columns(path)
        return read_ply_points(path), path if holds_splats else None, []
    missing = f"the start points that it names are not there ({quoted(name)})"
    if strict:
        raise MissingFileError(f"{folder / FILE}: {missing}.")
    return None, None, [missing]
