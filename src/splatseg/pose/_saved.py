"""Recovered poses on disk, whole or not there, and the reports of how they were found."""

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import Capture, PointCloud
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import FileFormatError
from splatseg.io.arrays import HEADER, read_npz, save_arrays
from splatseg.io.atomic import atomic_file, named_write_failures
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.colmap_model import intrinsics_of, poses_of, read_colmap_model
from splatseg.io.captures.raw_views import Intrinsics, RawView
from splatseg.io.foreign import derived_from
from splatseg.io.json_files import parse_object, read_json, write_json
from splatseg.io.schema import structured
from splatseg.pose._photographs import LeftOut, Photograph, PoseOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class MapperTry:
    """What one mapper reached."""

    mapper: str
    registered: int
    """Photographs of its largest model."""

    error: float
    """Mean reprojection error of its largest model, pixels of the working copies."""

    points: int
    models: tuple[int, ...]
    """Photographs of each model that it found, the largest first."""

    seconds: float

    def __post_init__(self) -> None:
        convert_fields(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Lens:
    """One lens as it was found: k1 is OpenCV's, other distortion is 0."""

    width: int
    height: int
    photographs: int
    """How many of those placed were taken with it."""

    focal: float
    """Horizontal focal length, pixels of the photographs."""

    k1: float
    start: str
    """Where the search for the focal length began: ``EXIF`` or ``guess``."""

    def __post_init__(self) -> None:
        convert_fields(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseReport:
    """What came of recovering poses."""

    photographs: int
    """How many there were."""

    registered: tuple[str, ...]
    """File names of those that have a pose now, sorted."""

    left_out: tuple[LeftOut, ...]
    mapper: str
    """Whose model was kept."""

    tries: tuple[MapperTry, ...]

    error: float
    """Mean reprojection error, pixels of the working copies."""

    longest: int
    """Longest side of the working copies, pixels."""

    points: int
    track_length: float
    """Photographs in which a point was seen, in the mean."""

    lenses: tuple[Lens, ...]
    seconds: Mapping[str, float]
    """By stage. Those of stages that an earlier, stopped run had done are not in it."""

    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        convert_fields(self)


# Recovered poses on disk: a folder that is whole or not taken for one.
#
#     CAPTURE/
#       poses.json      format version, what it was made of and how, the report
#       sparse/0/       COLMAP's model in pixels of the upright photographs
#       frames/         the photographs, where they come from a video
#       work/           features and matches of a run that was stopped; gone when it ends
#
# ``poses.json`` is written last.


FORMAT = "splatseg-poses"
VERSION = 1
FILE = "poses.json"
MODEL = "sparse/0"
# What is read of each end of a photograph to know it again.
_ENDS = 65536
# Options of version 0.1 that are constants now: its digests have them.
_CONSTANTS = {"max_features": 8192, "exhaustive_up_to": 60, "overlap": 6, "neighbours": 16}


def fingerprint(files: Sequence[Path], options: PoseOptions) -> str:
    """What poses depend on: names, sizes and ends of the photographs, and the options."""
    asked = _CONSTANTS | {k: v for k, v in asdict(options).items() if k != "threads"}
    return content_digest(files, asked)


def content_digest(files: Sequence[Path], asked: Mapping[str, Any]) -> str:
    """A digest of names, sizes and ends of photographs, and of what was asked of them."""
    digest = hashlib.sha256(json.dumps(asked, sort_keys=True).encode())
    for path in files:
        size = path.stat().st_size
        digest.update(f"{path.name}\0{size}\0".encode())
        with path.open("rb") as file:
            digest.update(file.read(_ENDS))
            file.seek(max(0, size - _ENDS))
            digest.update(file.read(_ENDS))
    return digest.hexdigest()


def save_poses(model: Path, folder: Path, *, made_of: str, report: PoseReport) -> None:
    """Move a model into a folder of poses and write the report."""
    target = folder / MODEL
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(target, ignore_errors=True)
    model.replace(target)
    write_json(
        {"format": FORMAT, "version": VERSION, "made_of": made_of, "report": asdict(report)},
        folder / FILE,
    )


@boundary
def load_pose_report(folder: Path, *, made_of: str | None = None) -> PoseReport | None:
    """The report of the poses in a folder; None where there are none.

    Args:
        folder: The folder of poses.
        made_of: What they must have been made of, see `fingerprint`; None takes any.

    Raises:
        FileFormatError: If the file is damaged.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    content = read_json(path)
    current = content.get("format") == FORMAT and content.get("version") == VERSION
    if not current or made_of not in (None, content.get("made_of")):
        return None
    return structured(content.get("report"), PoseReport, where=f"{path}: report")


def load_capture(model: Path, photographs: Sequence[Path], *, root: Path) -> Capture:
    """The capture of a model in pixels of the photographs.

    Args:
        model: Folder of the model.
        photographs: The photographs; those without a pose are left out.
        root: Folder of the capture.
    """
    colmap = read_colmap_model(model)
    by_name = {path.name: path for path in photographs}
    poses = poses_of(colmap, where=str(model))
    raw = [
        RawView(
            image=by_name[image.name],
            relative=by_name[image.name].relative_to(root).as_posix(),
            intrinsics=intrinsics_of(
                colmap.cameras[image.camera_id], where=f"{model}: camera {image.camera_id}"
            ),
            cam_from_world=poses[id],
        )
        for id, image in colmap.images.items()
    ]
    capture = build_capture(root, raw, format="sfm", points=colmap.points)
    poses = np.stack([view.camera.cam_from_world.numpy() for view in capture.views])
    return replace(capture, up=capture.up or estimated_up(poses[:, :3, :3]))


def estimated_up(rotations: np.ndarray[Any, np.dtype[np.float64]]) -> tuple[float, float, float]:
    """The direction away from the ground, as well as cameras tell.

    People look up and down but hold the camera level, so up is at right angles to the x axes of
    all cameras: the eigenvector of sum x x^T with the least eigenvalue. Where the cameras all
    look one way that leaves a circle of directions, and the mean of their up axes is taken.

    Args:
        rotations: cam_from_world, (n, 3, 3).
    """
    mean = -rotations[:, 1].mean(axis=0)
    values, vectors = np.linalg.eigh(np.einsum("ni,nj->ij", rotations[:, 0], rotations[:, 0]))
    axis = vectors[:, 0]
    # At least a tenth of the x axes' squared length must lie in the second direction, and the
    # cameras must agree with the axis to some degree.
    spread = values[1] > 0.1 * len(rotations)
    up = axis * np.sign(axis @ mean) if spread and abs(axis @ mean) > 0.3 else mean
    length = float(np.linalg.norm(up))
    if length < 1e-6:
        up, length = np.array([0.0, 0.0, 1.0]), 1.0
    x, y, z = (float(v) for v in up / length)
    return (x, y, z)


# What came of finding cameras from pointmaps.


@dataclass(frozen=True, slots=True, kw_only=True)
class PointmapReport:
    """What came of finding cameras from pointmaps."""

    photographs: int
    model: str
    """Who answered: a model's name, or a folder's."""

    pairs: int
    """Pairs that were aligned, each order counted."""

    contradictory: tuple[tuple[str, str], ...]
    """Those that contradict the rest and were left out, the worst first."""

    residual: float
    """Median over the other pairs of how far their points lie from the photographs', shares of the
    depth."""

    focals: Mapping[str, float]
    """Focal length by photograph, its pixels."""

    points: int
    """Points of the cloud."""

    seconds: Mapping[str, float]
    """By stage."""

    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        convert_fields(self)


# What was found, on disk: one file that is whole or not there.
#
# CAPTURE/
# aligned.npz         cameras, focal lengths, the cloud, the report, and what it was made of
# pointmaps/          what a network answered, see `io.pointmaps`


WORLD_FORMAT = "splatseg-aligned-pointmaps"
WORLD_VERSION = 1
WORLD_FILE = "aligned.npz"
ANSWERS = "pointmaps"
_SHAPES = {
    "cam_from_world": ("f8", ("views", 4, 4)),
    "focal": ("f8", ("views",)),
    "points": ("f4", ("points", 3)),
    "colours": ("u1", ("points", 3)),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SavedWorld:
    """Cameras and cloud of photographs."""

    cam_from_world: Float[Tensor, "views 4 4"]
    focal: Float[Tensor, "views"]
    """Pixels of each photograph."""

    cloud: PointCloud
    report: PointmapReport


def save_world(world: SavedWorld, folder: Path, *, made_of: str) -> None:
    """Write what was found; an older file is replaced when the new one is whole."""
    path = folder / WORLD_FILE
    header = {
        "format": WORLD_FORMAT,
        "version": WORLD_VERSION,
        "made_of": made_of,
        "report": asdict(world.report),
    }
    colours = world.cloud.colours
    arrays: dict[str, NDArray[Any]] = {
        "cam_from_world": world.cam_from_world.numpy().astype("<f8"),
        "focal": world.focal.numpy().astype("<f8"),
        "points": world.cloud.points.numpy().astype("<f4"),
        "colours": cast(Tensor, colours).numpy().astype(np.uint8),
    }
    with named_write_failures(path), atomic_file(path) as temporary:
        save_arrays(header, arrays, temporary, name=path)


@boundary
def load_world(folder: Path, *, made_of: str | None = None) -> SavedWorld | None:
    """What was found before; None where there is nothing, or what was made of something else.

    Args:
        folder: The folder it is kept in.
        made_of: What it must have been made of; None takes any.

    Raises:
        FileFormatError: If the file is damaged.
    """
    path = folder / WORLD_FILE
    if not path.is_file():
        return None
    arrays = read_npz(path, [HEADER, *_SHAPES])
    header = parse_object(arrays[HEADER].tobytes(), where=f"{path}: header")
    current = header.get("format") == WORLD_FORMAT and header.get("version") == WORLD_VERSION
    if not current or made_of not in (None, header.get("made_of")):
        return None
    sides: dict[str, int] = {}
    for name, (kind, shape) in _SHAPES.items():
        array = arrays[name]
        fits = array.ndim == len(shape) and array.dtype == np.dtype(kind)
        for side, length in zip(shape, array.shape, strict=False):
            fits &= length == (sides.setdefault(side, length) if isinstance(side, str) else side)
        if not fits:
            raise FileFormatError(
                f"{path}: expected {name} as {kind} of {shape}, got {array.dtype} of {array.shape}."
            )
    report = structured(header.get("report"), PointmapReport, where=f"{path}: report")
    with derived_from(path):
        cloud = PointCloud(
            points=torch.from_numpy(arrays["points"]), colours=torch.from_numpy(arrays["colours"])
        )
    return SavedWorld(
        cam_from_world=torch.from_numpy(arrays["cam_from_world"]),
        focal=torch.from_numpy(arrays["focal"]),
        cloud=cloud,
        report=report,
    )


def capture_of_world(world: SavedWorld, photographs: Sequence[Photograph], root: Path) -> Capture:
    """The capture of photographs and their cameras: pinholes with the middle for their centre.

    Raises:
        FileFormatError: If there are other cameras than photographs.
    """
    if len(world.focal) != len(photographs):
        raise FileFormatError(
            f"{root}: expected cameras of {len(photographs)} photographs, got {len(world.focal)}."
        )
    raw = [
        RawView(
            image=one.path,
            relative=one.path.relative_to(root).as_posix(),
            intrinsics=Intrinsics(
                focal=(focal, focal),
                centre=(one.width / 2, one.height / 2),
                size=(one.width, one.height),
            ),
            cam_from_world=pose.numpy(),
        )
        for one, focal, pose in zip(
            photographs, world.focal.tolist(), world.cam_from_world, strict=True
        )
    ]
    capture = build_capture(root, raw, format="pointmaps", points=world.cloud)
    rotations = world.cam_from_world[:, :3, :3].numpy()
    return replace(capture, up=capture.up or estimated_up(rotations))
