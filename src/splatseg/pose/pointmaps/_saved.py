"""What was found, on disk: one file that is whole or not there.

CAPTURE/
aligned.npz         cameras, focal lengths, the cloud, the report, and what it was made of
pointmaps/          what a network answered, see `io.pointmaps`
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import Capture, PointCloud
from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError, InputError, quoted
from splatseg.io.arrays import HEADER, read_npz, save_arrays
from splatseg.io.atomic import atomic_file, named_write_failures
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.raw_views import Intrinsics, RawView
from splatseg.io.foreign import made_from
from splatseg.io.json_files import parse_object
from splatseg.pose._photographs import Photograph
from splatseg.pose._saved import estimated_up
from splatseg.pose.pointmaps._report import PointmapReport

FORMAT = "splatseg-aligned-pointmaps"
VERSION = 1
FILE = "aligned.npz"
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
    path = folder / FILE
    header = {
        "format": FORMAT,
        "version": VERSION,
        "made_of": made_of,
        "report": world.report.as_json(),
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
    path = folder / FILE
    if not path.is_file():
        return None
    arrays = read_npz(path, [HEADER, *_SHAPES])
    header = parse_object(arrays[HEADER].tobytes(), where=f"{path}: header")
    current = header.get("format") == FORMAT and header.get("version") == VERSION
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
    try:
        report = PointmapReport.from_json(cast("dict[str, Any]", header.get("report")))
    except (InputError, KeyError, TypeError, ValueError) as error:
        raise FileFormatError(
            f"{path}: expected the report of poses, got {quoted(header.get('report'))}."
        ) from error
    with made_from(path):
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
                fx=focal,
                fy=focal,
                cx=one.width / 2,
                cy=one.height / 2,
                width=one.width,
                height=one.height,
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
