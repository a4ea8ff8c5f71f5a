"""A path through a scene, and films."""

from collections.abc import Generator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from splatseg.core import ClassTable, Renderable, Scene, View
from splatseg.errors import InputError, RangeError
from splatseg.io.cameras import cameras_content
from splatseg.io.images import check_encoder, write_video
from splatseg.io.json_files import read_json, write_json
from splatseg.render.paths import camera_path, is_forward_facing
from splatseg.report.colours import colour_labels
from splatseg.report.images import colour_depth

# Depths beyond these shares of all are shown in the end colours.
_NEAR, _FAR = 0.01, 0.99
_FOCUS_PIXELS = 128


def path_views(scene: Scene, field: Renderable, *, frames: int) -> tuple[View, ...]:
    """Views ``path_0000`` and on, along `camera_path` of the training views, or of all.

    Raises:
        InputError: If the scene has no views to go along.
    """
    along = scene.train_views or scene.views
    if not along:
        raise InputError("split: a path goes along the scene's views, and this scene has none.")
    if frames < 1:
        raise RangeError(f"frames: expected at least 1, got {frames}.")
    focus = _focus(field, along) if is_forward_facing(along) else None
    cameras = camera_path(along, frames=frames, up=scene.up, focus=focus)
    digits = max(4, len(str(frames - 1)))
    return tuple(
        View(name=f"path_{i:0{digits}d}", camera=camera, split="path")
        for i, camera in enumerate(cameras)
    )


def _focus(field: Renderable, views: Sequence[View]) -> float | None:
    """Median over some views of the median depth of what they show; None where that is nothing."""
    depths: list[float] = []
    for view in views[:: max(1, len(views) // 5)]:
        longest = max(view.camera.width, view.camera.height)
        share = min(1.0, _FOCUS_PIXELS / longest)
        small = view.camera.resized(
            max(1, round(view.camera.width * share)), max(1, round(view.camera.height * share))
        )
        with field.view(small) as looked_at:
            shown = looked_at.signals(colour=False)
        depth = shown.depth if shown.median_depth is None else shown.median_depth
        if bool((depth > 0).any()):
            depths.append(float(depth[depth > 0].median()))
    return sorted(depths)[len(depths) // 2] if depths else None


def write_path(views: Sequence[View], folder: Path, *, pictures: bool) -> None:
    """The cameras of a path as nerfstudio's transforms.json, with the pictures if there are."""
    shown = [
        View(
            name=view.name,
            camera=view.camera,
            split=view.split,
            image=folder.absolute() / "rgb" / f"{view.name}.png" if pictures else None,
        )
        for view in views
    ]
    write_json(
        cameras_content(shown, folder=folder.absolute(), source=None), folder / "transforms.json"
    )


def check_film(views: Sequence[View], *, fps: float) -> None:
    """Refuse before the work what the encoder could not do after it.

    Raises:
        InputError: If the views differ in size.
        RangeError: If `fps` is out of range.
        MissingPackageError: If there is no encoder.
    """
    sizes = sorted({(view.camera.width, view.camera.height) for view in views})
    if len(sizes) > 1:
        shown = ", ".join(f"{width}x{height}" for width, height in sizes[:4])
        raise InputError(f"video: expected views of one size, got {shown}; a path has.")
    check_encoder(fps)


def write_film(
    views: Sequence[View],
    folder: Path,
    *,
    fps: float,
    is_label_map: bool,
    classes: ClassTable | None,
) -> None:
    """A film beside a folder of pictures: ``rgb.mp4`` beside ``rgb/``.

    Depth is shown from near, light, to far, dark, on one scale for the whole film; labels in
    the colours of the legend.
    """
    files = [folder / f"{view.name}.png" for view in views]
    if is_label_map:
        frames = (_coloured_ids(file, classes) for file in files)
    elif folder.name == "depth":
        frames = _depths(files, unit=float(read_json(folder / "depth.json")["unit"]))
    else:
        frames = (_colours(file) for file in files)
    write_video(frames, folder.with_name(f"{folder.name}.mp4"), fps=fps)


def _depths(files: Sequence[Path], *, unit: float) -> Generator[UInt8[Tensor, "h w 3"]]:
    sample = np.concatenate([_read(file)[::7, ::7].reshape(-1) for file in files])
    known = sample[sample > 0]
    near, far = (np.quantile(known, (_NEAR, _FAR)) * unit).tolist() if len(known) else (0.0, 1.0)
    for file in files:
        yield colour_depth(torch.from_numpy(_read(file) * unit), near=near, far=far)


def _coloured_ids(file: Path, classes: ClassTable | None) -> UInt8[Tensor, "h w 3"]:
    ids = torch.from_numpy(_read(file).astype(np.int32))
    return colour_labels(torch.where(ids == 0, -1, ids), classes)


def _colours(file: Path) -> UInt8[Tensor, "h w 3"]:
    with Image.open(file) as image:
        return torch.from_numpy(np.array(image.convert("RGB")))


def _read(file: Path) -> np.ndarray:
    with Image.open(file) as image:
        return np.array(image).astype(np.float64)
