"""COLMAP's sparse models, as binary and as text files, and what its camera models mean.

    cameras     camera_id u32, model i32 (a word as text), width u64, height u64, parameters f64
    images      image_id u32, q 4 f64, t 3 f64, camera_id u32, name, then 2D points
    points3D    id u64, xyz 3 f64, rgb 3 u8, error f64, track
    rigs        rig_id u32, m u32, and if m > 0: reference sensor (type i32, id u32),
                m - 1 times (type i32, id u32, has_pose u8, if so q 4 f64, t 3 f64)
    frames      frame_id u32, rig_id u32, q 4 f64, t 3 f64, m u32,
                m times (type i32, sensor id u32, data id u64)

Binary files are little-endian, tightly packed and begin with the number of records; text files
have a record a line (of images two, the second one with 2D points), and comments after #. Every
read is checked against the end of the file, so that a file that breaks off is an error that says
where, never a crash or a shorter model. Camera models and their parameter order are those of
COLMAP's ``sensor/models.h``.
"""

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatseg.core import CameraModel, PointCloud
from splatseg.errors import InputError, quoted
from splatseg.io.captures.points import point_cloud, read_ply_points
from splatseg.io.captures.raw_views import Intrinsics, pose_of_quaternion
from splatseg.io.foreign import expect, malformed, read_bytes, reading
from splatseg.io.schema import MAX_SIDE

_POSE = "d" * 7
_CAMERA_SENSOR = 0
_MAX_NAME = 4096
_BESIDE = ("points3D.ply", "sparse_pc.ply")


class _Lens(NamedTuple):
    """A camera model of COLMAP."""

    name: str
    parameters: int
    model: CameraModel | None = None
    """Ours; None goes through pycolmap."""

    focals: int = 1
    """Focal lengths. The principal point follows them, then the distortion in OpenCV's order, of
    which the simpler models give the first values."""


MODELS = (
    _Lens("SIMPLE_PINHOLE", 3, "pinhole"),
    _Lens("PINHOLE", 4, "pinhole", 2),
    _Lens("SIMPLE_RADIAL", 4, "opencv"),
    _Lens("RADIAL", 5, "opencv"),
    _Lens("OPENCV", 8, "opencv", 2),
    _Lens("OPENCV_FISHEYE", 8, "fisheye", 2),
    _Lens("FULL_OPENCV", 12, "opencv", 2),
    _Lens("FOV", 5),
    _Lens("SIMPLE_RADIAL_FISHEYE", 4, "fisheye"),
    _Lens("RADIAL_FISHEYE", 5, "fisheye"),
    _Lens("THIN_PRISM_FISHEYE", 12, "thin_prism_fisheye", 2),
    _Lens("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    _Lens("SIMPLE_DIVISION", 4),
    _Lens("DIVISION", 5),
    _Lens("SIMPLE_FISHEYE", 3, "fisheye"),
    _Lens("FISHEYE", 4, "fisheye", 2),
    _Lens("EUCM", 6),
    _Lens("EQUIRECTANGULAR", 2),
)
"""By the number of the binary files."""

_LENSES = {lens.name: lens for lens in MODELS}


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapCamera:
    """One lens as COLMAP stores it."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapImage:
    """One registered photograph."""

    name: str
    camera_id: int
    cam_from_world: NDArray[np.float64]


ColmapFrame = tuple[int, NDArray[np.float64], tuple[tuple[int, int], ...]]
"""One moment of a rig: its id, rig_from_world, and pairs of camera id and image id."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapModel:
    """A sparse model. Rigs and frames are empty in the older layout of three files."""

    cameras: dict[int, ColmapCamera]
    images: dict[int, ColmapImage]
    points: PointCloud | None
    rigs: dict[int, dict[int, NDArray[np.float64]]] = field(
        default_factory=dict[int, dict[int, NDArray[np.float64]]]
    )
    """cam_from_rig by rig id and camera id."""

    frames: tuple[ColmapFrame, ...] = ()


def read_colmap_model(folder: Path) -> ColmapModel:
    """Read a sparse model; points, rigs and frames may lack.

    Raises:
        FileFormatError: If a file is cut short, corrupt or cannot be parsed.
    """
    suffix = ".bin" if is_binary_model(folder) else ".txt"
    points, rigs, frames = (folder / f"{stem}{suffix}" for stem in ("points3D", "rigs", "frames"))
    five = rigs.is_file() and frames.is_file()
    return ColmapModel(
        cameras=dict(read_records(folder / f"cameras{suffix}")),
        images=read_images(folder / f"images{suffix}"),
        points=read_points(points) if points.is_file() else None,
        rigs=dict(read_records(rigs)) if five else {},
        frames=tuple(read_records(frames)) if five else (),
    )


def is_binary_model(folder: Path) -> bool:
    """Whether a folder has a model in binary files, which come before text."""
    return (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()


def read_images(path: Path) -> dict[int, ColmapImage]:
    """Registered photographs by id; their 2D points are passed over."""
    return dict(read_records(path))


def read_points(path: Path) -> PointCloud:
    """Positions and colours of points3D; tracks are passed over."""
    values = np.fromiter(chain.from_iterable(read_records(path)), np.float64).reshape(-1, 6)
    return point_cloud(values[:, :3], values[:, 3:].astype(np.uint8))


def points_beside(folder: Path) -> PointCloud | None:
    """Points of points3D.ply, sparse_pc.ply or points3D.bin in a folder, or None.

    They are taken to lie in the same world as the poses beside them.
    """
    for name in _BESIDE:
        if (folder / name).is_file():
            return read_ply_points(folder / name)
    path = folder / "points3D.bin"
    return read_points(path) if path.is_file() else None


def intrinsics_of(camera: ColmapCamera, *, where: str) -> Intrinsics:
    """The lens of a COLMAP camera as ours.

    SIMPLE_RADIAL and RADIAL are OpenCV's k1 and k2; the fisheye models are OpenCV's polynomial
    in the angle, theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8). Models
    that are not ours go through pycolmap, see `lens_by_pycolmap`.

    Raises:
        InputError: If the model is one that cannot be undistorted, or parameters lack.
        MissingPackageError: If it needs pycolmap, and that is not installed.
    """
    lens, values = _LENSES.get(camera.model), camera.parameters
    if lens is None:
        raise malformed(where, f"a camera model of COLMAP ({', '.join(_LENSES)})", camera.model)
    fits = len(values) == lens.parameters
    expect(fits, where, f"{lens.parameters} parameters of a {lens.name} camera, got {len(values)}")
    if lens.model is None:
        fits = 1 <= camera.width <= MAX_SIDE and 1 <= camera.height <= MAX_SIDE
        expect(fits, where, f"1 to {MAX_SIDE} pixels a side, got others")
        from splatseg.io.captures.pycolmap_lens import lens_by_pycolmap

        return lens_by_pycolmap(lens.name, camera.width, camera.height, values, where=where)
    cx, cy, *distortion = values[lens.focals :]
    return Intrinsics(
        model=lens.model,
        focal=(values[0], values[lens.focals - 1]),
        centre=(cx, cy),
        distortion=tuple(distortion),
        size=(camera.width, camera.height),
    )


def poses_of(model: ColmapModel, *, where: str) -> dict[int, NDArray[np.float64]]:
    """cam_from_world by image id; frames of rigs, where there are any, come before images.

    COLMAP does the same when it opens the newer layout:
    cam_from_world = cam_from_rig @ rig_from_world.

    Raises:
        InputError: If a frame names a rig, a camera or an image that the model does not have.
    """
    poses = {id: image.cam_from_world for id, image in model.images.items()}
    for rig_id, rig_from_world, images in model.frames:
        rig = model.rigs.get(rig_id)
        if rig is None:
            raise InputError(f"{where}: a frame names rig {rig_id}, which is not there.")
        for camera_id, image_id in images:
            if image_id not in poses:
                # An image of the frame that was not registered has no row of its own.
                continue
            if camera_id not in rig:
                raise InputError(
                    f"{where}: image {image_id} was taken by camera {camera_id}, whose place in "
                    f"rig {rig_id} is not known."
                )
            poses[image_id] = rig[camera_id] @ rig_from_world
    return poses


def _camera(source: "_Source") -> tuple[int, ColmapCamera]:
    (id,) = source.take("I")
    model, (width, height, *parameters) = source.lens()
    width, height = int(width), int(height)
    return int(id), ColmapCamera(
        model=model, width=width, height=height, parameters=tuple(parameters)
    )


def _image(source: "_Source") -> tuple[int, ColmapImage]:
    id, *pose, camera = source.take(f"I{_POSE}I")
    name = source.name()
    source.pass_over(24)
    cam_from_world = pose_of_quaternion(pose)
    return int(id), ColmapImage(name=name, camera_id=int(camera), cam_from_world=cam_from_world)


def _point(source: "_Source") -> tuple[float, ...]:
    _, *found = source.take("QdddBBB")
    source.pass_over(8, after=8)
    return tuple(found)


def _rig(source: "_Source") -> tuple[int, dict[int, NDArray[np.float64]]]:
    id, sensors = source.take("II")
    poses: dict[int, NDArray[np.float64]] = {}
    for index in range(int(sensors)):
        camera = source.is_camera()
        (sensor,) = source.take("I")
        # The first sensor is the reference: the rig's own axes are its axes.
        pose = np.eye(4) if index == 0 else None
        if index > 0 and source.take("B")[0]:
            pose = pose_of_quaternion(source.take(_POSE))
        if camera and pose is not None:
            poses[int(sensor)] = pose
    return int(id), poses


def _frame(source: "_Source") -> ColmapFrame:
    _, rig, *pose, count = source.take(f"II{_POSE}I")
    images: list[tuple[int, int]] = []
    for _ in range(int(count)):
        camera = source.is_camera()
        sensor, image = source.take("IQ")
        if camera:
            images.append((int(sensor), int(image)))
    return int(rig), pose_of_quaternion(pose), tuple(images)


class _Layout(NamedTuple):
    """What the records of a file are."""

    parse: Callable[["_Source"], Any]
    columns: str
    min_bytes: int
    """What a record takes in a binary file at least."""

    max_words: int = 0
    """Into how many words a line of text is split; 0 is all. The last is the rest of it."""

    lines: int = 1
    """Of so many lines of text a record is the first."""


_POSE_COLUMNS = "QW QX QY QZ TX TY TZ"
_LAYOUTS = {
    "cameras": _Layout(_camera, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS", 24),
    "images": _Layout(_image, f"IMAGE_ID {_POSE_COLUMNS} CAMERA_ID NAME", 73, 10, 2),
    "points3D": _Layout(_point, "POINT3D_ID X Y Z R G B ERROR", 51, 9),
    "rigs": _Layout(_rig, "RIG_ID NUM_SENSORS REF_TYPE REF_ID SENSORS", 8),
    "frames": _Layout(_frame, f"FRAME_ID RIG_ID {_POSE_COLUMNS} NUM_DATA DATA", 68),
}
"""By the stem of the file."""


def read_records(path: Path) -> Iterator[Any]:
    """Records of a file, binary or text by its suffix."""
    layout = _LAYOUTS[path.stem]
    if path.suffix == ".bin":
        cursor = _Cursor(path)
        for _ in range(cursor.count(layout.min_bytes)):
            yield layout.parse(cursor)
        cursor.finish()
        return
    with reading(path, "a text file in UTF-8"):
        text = path.read_text(encoding="utf-8").splitlines()
    number = 0
    while number < len(text):
        line = text[number].strip()
        number += 1
        if not line or line.startswith("#"):
            continue
        try:
            record = layout.parse(_Line(line.split(maxsplit=layout.max_words - 1)))
        except (ValueError, IndexError, OverflowError) as error:
            raise malformed(f"{path}: line {number}", layout.columns, line) from error
        # Lines that follow belong to the same record even when they are empty.
        number += layout.lines - 1
        yield record


class _Line:
    """The words of a line of text."""

    def __init__(self, words: Sequence[str]) -> None:
        self._words, self._at = words, 0

    def _word(self) -> str:
        self._at += 1
        return self._words[self._at - 1]

    def take(self, codes: str) -> tuple[float, ...]:
        return tuple([_number(self._word(), code) for code in codes])

    def lens(self) -> tuple[str, tuple[float, ...]]:
        model, sides = self._word(), self.take("QQ")
        return model, (*sides, *self.take("d" * (len(self._words) - self._at)))

    def is_camera(self) -> bool:
        return self._word() == "CAMERA"

    def name(self) -> str:
        return self._word()

    def pass_over(self, size: int, *, after: int = 0) -> None:
        pass


def _number(word: str, code: str) -> float:
    if code == "d":
        return float(word)
    value = int(word)
    if value < 0 or (code == "B" and value > 255):
        raise ValueError("a number does not fit")
    return value


class _Cursor:
    """Reads records off a file's bytes and refuses to run past its end."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._data = read_bytes(path, "a file of COLMAP")
        self._offset = 0

    def take(self, codes: str) -> tuple[float, ...]:
        layout = f"<{codes}"
        return struct.unpack_from(layout, self._data, self._skip(struct.calcsize(layout)))

    def _skip(self, size: int) -> int:
        """Move on by `size` bytes; gives where they start."""
        start = self._offset
        if start + size > len(self._data):
            raise malformed(
                self._path,
                f"{size} more bytes at byte {start}, but the file ends after {len(self._data)}: it "
                "is cut short or corrupt",
            )
        self._offset = start + size
        return start

    def count(self, min_bytes: int) -> int:
        """The number of records that follow, each of at least this many bytes."""
        number = int(self.take("Q")[0])
        left = len(self._data) - self._offset
        if number * min_bytes > left:
            raise malformed(
                self._path,
                f"{number} records of at least {min_bytes} bytes, but {left} bytes are left: it is "
                "cut short or corrupt",
            )
        return number

    def lens(self) -> tuple[str, tuple[float, ...]]:
        number = int(self.take("i")[0])
        known = f"a model number of a camera from 0 to {len(MODELS) - 1}"
        expect(0 <= number < len(MODELS), self._path, known, number)
        lens = MODELS[number]
        return lens.name, self.take("QQ" + "d" * lens.parameters)

    def is_camera(self) -> bool:
        return self.take("i")[0] == _CAMERA_SENSOR

    def name(self) -> str:
        """Characters up to a zero byte."""
        end = self._data.find(b"\0", self._offset, self._offset + _MAX_NAME)
        if end < 0:
            raise malformed(
                self._path,
                f"a name that ends with a zero byte at byte {self._offset}: the file is cut short "
                "or corrupt",
            )
        raw = self._data[self._offset : end]
        self._offset = end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise malformed(self._path, f"names in UTF-8, got {quoted(raw)}") from error

    def pass_over(self, size: int, *, after: int = 0) -> None:
        self._skip(after)
        self._skip(size * self.count(size))

    def finish(self) -> None:
        """Refuse bytes after the last record."""
        more = len(self._data) - self._offset
        what = f"the end of the file at byte {self._offset}, got {more} bytes more: it is corrupt"
        expect(not more, self._path, what)


_Source = _Line | _Cursor
"""Fields of records, one after another."""
