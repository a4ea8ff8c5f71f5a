"""A generated room as a capture with everything that a capture can have, made once a session.

What `splatseg.synthetic` writes (photographs, poses, start points, truth, class maps) and beside
it what other programs would leave: a COLMAP model by COLMAP's own code, and evidence of every
kind. The layout is that of the rendered scenes in the shared data.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

from splatseg.core import View
from splatseg.synthetic import SyntheticScene, Truth, look_at, room, write_capture
from support import recorded

WIDTH, HEIGHT = 320, 240  # whole cells of 16 pixels
TRAIN, TEST = 16, 3
STEP = 2 * math.pi / TRAIN  # between two train views: neighbours share most of what they see


def ring_views(scene: SyntheticScene) -> tuple[View, ...]:
    """Train views on a circle that look across the room, test views between them."""
    low, high = (np.array(corner) for corner in scene.bounds)
    centre, half = (low + high) / 2, (high - low) / 2

    def at(name: str, split: str, steps: float) -> View:
        angle = STEP * steps
        away = np.array([math.cos(angle), math.sin(angle), 0.15])
        eye, target = centre + 0.55 * half * away, centre - 0.6 * half * away
        camera = look_at(eye.tolist(), target.tolist(), width=WIDTH, height=HEIGHT)
        return View(name=name, camera=camera, split=split)

    train = [at(f"train_{i:04d}", "train", i) for i in range(TRAIN)]
    test = [at(f"test_{i:04d}", "test", 2.5 + 5 * i) for i in range(TEST)]
    return (*train, *test)


def write_room(folder: Path) -> None:
    """Write the capture into a new folder; the same bytes at every call."""
    scene = room(seed=0)
    views = ring_views(scene)
    truths = write_capture(scene, folder, views=views, points=4000)
    parts = {view.name: part_ids(view, truths[view.name]) for view in views}
    (folder / "part").mkdir()
    for name, ids in parts.items():
        Image.fromarray(ids.astype(np.uint16)).save(folder / "part" / f"{name}.png")
    _name_parts(folder, scene, parts)
    train = [view.name for view in views if view.split == "train"]
    seen = {
        name: recorded.Seen(
            semantic=truths[name].semantic.clamp_min(0).numpy(),
            instance=truths[name].instance.clamp_min(0).numpy(),
            part=parts[name],
        )
        for name in train
    }
    recorded.write_all(folder, scene, seen)
    write_colmap(folder / "sparse" / "0", views)


def part_ids(view: View, truth: Truth) -> np.ndarray:
    """Two parts an object, 2 i - 1 and 2 i: below and above the height of its middle.

    Told from the places in the world, so that a part is the same in every view.
    """
    camera = view.camera
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    depth = truth.depth.double().numpy()
    rays = np.stack(((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)), -1)
    pose = camera.cam_from_world.numpy()
    height = ((rays * depth[..., None] - pose[:3, 3]) @ pose[:3, :3])[..., 2]
    instance = truth.instance.clamp_min(0).numpy()
    middle = np.full(int(instance.max()) + 1, 1.0)
    middle[[1, 2, 3][: len(middle) - 1]] = math.inf  # walls, floor and ceiling are of one part
    return np.where(instance > 0, 2 * instance - (height < middle[instance]), 0)


def _name_parts(folder: Path, scene: SyntheticScene, parts: Mapping[str, np.ndarray]) -> None:
    """The table of parts in metadata.json, as the rendered scenes have it."""
    path = folder / "metadata.json"
    content = json.loads(path.read_text())
    present = sorted({int(i) for ids in parts.values() for i in np.unique(ids)} - {0})
    names = {item.id: item.name for item in scene.objects}
    content["parts"] = [
        {
            "id": i,
            "part_class": ("upper", "lower")[i % 2],
            "name": f"{('upper', 'lower')[i % 2]} part of {names[(i + 1) // 2]}",
            "instance": (i + 1) // 2,
        }
        for i in present
    ]
    path.write_text(json.dumps(content, indent=1))


def write_colmap(folder: Path, views: tuple[View, ...], model: str = "PINHOLE") -> None:
    """The same cameras as COLMAP writes them, with its own code."""
    reconstruction = pycolmap.Reconstruction()
    lens = views[0].camera
    parameters = [lens.fx, lens.fy, lens.cx, lens.cy]
    if model == "OPENCV":
        parameters += [*lens.distortion, 0.0, 0.0, 0.0, 0.0][:4]
    camera = pycolmap.Camera(
        camera_id=1, model=model, width=lens.width, height=lens.height, params=parameters
    )
    reconstruction.add_camera_with_trivial_rig(camera)
    for i, view in enumerate(views, start=1):
        pose = pycolmap.Rigid3d(view.camera.cam_from_world[:3].numpy())
        image = pycolmap.Image(name=f"{view.name}.jpg", camera_id=1, image_id=i)
        reconstruction.add_image_with_trivial_frame(image, pose)
    folder.mkdir(parents=True)
    reconstruction.write_binary(str(folder))
