"""Pictures of generated rooms and tables with exact truth, to train the network of regions on."""

import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Camera
from splatseg.errors import InputError
from splatseg.synthetic.photographs import cameras
from splatseg.synthetic.raycast import render_truth
from splatseg.synthetic.solids import SyntheticScene
from splatseg_bench.worlds import clutter, clutter_camera, varied_room

WIDTH, HEIGHT = 512, 384
_RING = 12
"""Places of a room's cameras, of which some are drawn."""

_ANGLES = (50.0, 78.0)
_QUALITY = (75, 96)
"""Of the JPEG that a picture is kept as: photographs have its blocks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A rendered photograph and what is seen in each of its pixels."""

    name: str
    image: NDArray[np.uint8]
    """(h, w, 3), sRGB, once compressed."""

    instance: NDArray[np.int32]
    """(h, w): objects, from 1; 0 where there is none."""

    part: NDArray[np.int32]
    """(h, w): solids, from 1; 0 where there is none."""

    thing: NDArray[np.bool_]
    """(h, w): whether it is of a thing, not of walls, floors and ceilings."""

    depth: NDArray[np.float32]
    """(h, w): metres; 0 where there is nothing."""


def draw_pictures(folder: Path, kind: str, seed: int, count: int) -> list[Path]:
    """Render pictures of one scene, those that are not there.

    Args:
        folder: Where they go, made if needed.
        kind: `table` is of `clutter`, `room` of `varied_room`.
        seed: Of the scene.
        count: Pictures of it.

    Returns:
        The new ones; none of a room that is too full for a camera.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{kind}-{seed:04d}-{k}" for k in range(count)]
    missing = [k for k, name in enumerate(names) if not (folder / f"{name}.npz").exists()]
    if not missing:
        return []
    try:
        scene, views = _views(kind, seed, count)
    except InputError:
        return []
    return [_save(folder / f"{names[k]}.npz", scene, views[k]) for k in missing]


def _views(kind: str, seed: int, count: int) -> tuple[SyntheticScene, list[Camera]]:
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode())])
    if kind == "table":
        return clutter(seed), [
            clutter_camera(rng, width=WIDTH, height=HEIGHT) for _ in range(count)
        ]
    scene = varied_room(seed)
    views = cameras(
        scene, train=_RING, test=0, width=WIDTH, height=HEIGHT,
        field_of_view=float(rng.uniform(*_ANGLES)),
    )  # fmt: skip
    return scene, [views[k].camera for k in rng.choice(_RING, count, replace=False)]


def _save(path: Path, scene: SyntheticScene, camera: Camera) -> Path:
    import cv2

    truth = render_truth(scene, camera)
    things = [row.id for row in scene.classes.rows if row.isthing]
    quality = int(np.random.default_rng(zlib.crc32(path.name.encode())).integers(*_QUALITY))
    jpeg = cv2.imencode(
        ".jpg", truth.image.numpy()[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality]
    )[1]
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.savez_compressed(
            file,
            jpeg=jpeg,
            instance=truth.instance.clamp_min(0).numpy().astype(np.int32),
            part=(truth.solid + 1).numpy().astype(np.int32),
            thing=torch.isin(truth.semantic, torch.tensor(things)).numpy(),
            depth=truth.depth.numpy().astype(np.float16),
        )
    return part.rename(path)


def read_picture(path: Path) -> Picture:
    """A picture that `draw_pictures` wrote."""
    import cv2

    with np.load(path) as file:
        image = np.asarray(cv2.imdecode(file["jpeg"], cv2.IMREAD_COLOR), np.uint8)
        return Picture(
            name=path.stem,
            image=np.ascontiguousarray(image[..., ::-1]),
            instance=file["instance"],
            part=file["part"],
            thing=file["thing"],
            depth=file["depth"].astype(np.float32),
        )
