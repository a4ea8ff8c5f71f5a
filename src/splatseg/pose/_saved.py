"""Recovered poses on disk: a folder that is whole or not taken for one.

    CAPTURE/
      poses.json      format version, what it was made of and how, the report
      sparse/0/       COLMAP's model in pixels of the upright photographs
      frames/         the photographs, where they come from a video
      work/           features and matches of a run that was stopped; gone when it ends

``poses.json`` is written last.
"""

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np

from splatseg.core import Capture
from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError, InputError, quoted
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.colmap_model import read_colmap_model
from splatseg.io.captures.colmap_model import intrinsics_of, poses_of
from splatseg.io.captures.raw_views import RawView
from splatseg.io.json_files import read_json, write_json
from splatseg.pose._options import PoseOptions
from splatseg.pose._report import PoseReport

FORMAT = "splatseg-poses"
VERSION = 1
FILE = "poses.json"
MODEL = "sparse/0"
# What is read of each end of a photograph to know it again.
_ENDS = 65536


def fingerprint(files: Sequence[Path], options: PoseOptions) -> str:
    """What poses depend on: names, sizes and ends of the photographs, and the options."""
    return content_digest(files, {k: v for k, v in asdict(options).items() if k != "threads"})


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
        {"format": FORMAT, "version": VERSION, "made_of": made_of, "report": report.as_json()},
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
    report = content.get("report")
    try:
        return PoseReport.from_json(cast(dict[str, Any], report))
    except (InputError, KeyError, TypeError, ValueError) as error:
        raise FileFormatError(
            f"{path}: expected the report of poses, got {quoted(report)}."
        ) from error


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
    return capture if capture.up is not None else _with_up(capture)


def _with_up(capture: Capture) -> Capture:
    """The capture with the direction that its photographers held up."""
    from dataclasses import replace

    poses = np.stack([view.camera.cam_from_world.numpy() for view in capture.views])
    return replace(capture, up=estimated_up(poses[:, :3, :3]))


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
