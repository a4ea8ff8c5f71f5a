"""Reads NeRF-synthetic captures: transforms_train.json and its like, as Blender wrote them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from splatseg.core import Capture
from splatseg.errors import FileFormatError, quoted
from splatseg.io.captures._points_beside import points_beside
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.nerfstudio import cam_from_world_of, intrinsics_of_frame
from splatseg.io.captures.raw_views import RawView
from splatseg.io.json_files import read_json

SPLITS = ("train", "val", "test")


def find_blender(folder: Path) -> bool:
    """Whether a folder has transforms_train.json."""
    return (folder / "transforms_train.json").is_file()


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
    for split in SPLITS:
        path = folder / f"transforms_{split}.json"
        if not path.is_file():
            continue
        content = read_json(path)
        frames = content.get("frames")
        if not isinstance(frames, list):
            raise FileFormatError(f"{path}: expected a list of frames, got none.")
        raw += [_raw_view(content, frame, split, path=path) for frame in frames]  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    return build_capture(folder, raw, format="blender", points=points_beside(folder), strict=strict)


def _raw_view(content: Mapping[str, Any], frame: object, split: str, *, path: Path) -> RawView:
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):  # pyright: ignore[reportUnknownMemberType]
        raise FileFormatError(f"{path}: expected frames with a file_path, got {quoted(frame)}.")
    entry: dict[str, Any] = frame  # pyright: ignore[reportUnknownVariableType]
    relative = entry["file_path"].replace("\\", "/").removeprefix("./")
    where = f"{path}: frame {quoted(relative)}"
    image = path.parent / relative
    if not image.name:
        raise FileFormatError(f"{where}: expected a file_path that names a file, got none.")
    return RawView(
        image=image,
        relative=relative,
        intrinsics=intrinsics_of_frame({**content, **entry}, where=where),
        cam_from_world=cam_from_world_of(entry, where=where),
        split=split,
    )
