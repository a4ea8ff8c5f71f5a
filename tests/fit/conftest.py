"""A tiny scene, photographed by the renderer itself: what a fit should find again."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Camera, Capture, Gaussians, PointCloud, View
from splatseg.fit._options import RATES
from splatseg.io.images import save_png
from splatseg.render import render

CaptureMaker = Callable[..., Capture]


def tiny_scene(seed: int = 1, count: int = 60) -> Gaussians:
    """Coloured blobs in a ball of radius 1, opaque, over a black nothing."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    means = directions * rng.random((count, 1)) ** (1 / 3)
    rotations = rng.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values.astype(np.float32))

    return Gaussians(
        means=tensor(means),
        rotations=tensor(rotations),
        scales=tensor(rng.uniform(0.08, 0.25, (count, 3))),
        opacities=tensor(rng.uniform(0.6, 0.95, count)),
        sh=tensor(rng.uniform(-1.2, 1.2, (count, 1, 3))),
    )


def ring_camera(
    angle: float,
    *,
    width: int = 56,
    height: int = 48,
    fx: float = 60.0,
    fy: float = 60.0,
    **lens: object,
) -> Camera:
    """A camera 3.2 from the centre, directed at it, at varying heights around it."""
    centre = np.array([np.cos(angle), np.sin(angle), 0.4 * np.sin(3 * angle)])
    centre = 3.2 * centre / np.linalg.norm(centre)
    forward = -centre / np.linalg.norm(centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack((right, np.cross(forward, right), forward))
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ centre
    return Camera(
        width=width,
        height=height,
        fx=fx,
        fy=fy,
        cx=width / 2 + 0.7,
        cy=height / 2 - 0.4,
        cam_from_world=torch.from_numpy(pose),
        **lens,
    )


@pytest.fixture
def make_capture(tmp_path: Path) -> CaptureMaker:
    """Photographs of `tiny_scene` on disk: 11 training views and 3 held out."""

    def make(*, count: int = 14, noise: float = 0.03, **lens: object) -> Capture:
        scene = tiny_scene()
        folder = tmp_path / "capture"
        folder.mkdir()
        views: list[View] = []
        for i in range(count):
            camera = ring_camera(2 * np.pi * i / count, **lens)
            with torch.no_grad():
                image = render(scene, camera).image
            path = folder / f"view_{i:02d}.png"
            save_png(image, path)
            split = "test" if i % 5 == 2 else "train"
            views.append(View(name=path.stem, camera=camera, image=path, split=split))
        rng = np.random.default_rng(7)
        shift = torch.from_numpy(rng.normal(scale=noise, size=(len(scene), 3)).astype(np.float32))
        colours = (scene.colours.clamp(0, 1) * 255).to(torch.uint8)
        points = PointCloud(points=scene.means + shift, colours=colours)
        return Capture(path=folder, format="test", views=tuple(views), points=points)

    return make


@pytest.fixture
def capture(make_capture: CaptureMaker) -> Capture:
    """The tiny capture with pinhole cameras."""
    return make_capture()


def photographed(
    folder: Path,
    *,
    scene: Gaussians | None = None,
    count: int = 14,
    gains: Sequence[float] | None = None,
    noise: float = 0.03,
    arc: float = 2 * np.pi,
    depth_step: int | None = None,
    **lens: object,
) -> Capture:
    """Photographs of a scene round about; every fifth, from the third on, is held out.

    Args:
        folder: Where to write them.
        scene: What is photographed; None is `tiny_scene`.
        count: Number of photographs.
        gains: Factor of each photograph's colours.
        noise: Of the start points, scene units.
        arc: Part of the circle that the cameras stand on, radians.
        depth_step: Also write depth maps of every so many pixels, in 1/1000 of a unit.
        lens: For `ring_camera`.
    """
    scene = tiny_scene() if scene is None else scene
    views: list[View] = []
    for i in range(count):
        camera = ring_camera(arc * i / count, **lens)
        with torch.no_grad():
            drawn = render(scene, camera)
        gain = 1.0 if gains is None else gains[i]
        # Bright ones keep below the white that would be cut off.
        save_png(drawn.image.clamp(0, 1) * 0.75 * gain, folder / f"view_{i:02d}.png")
        view = View(
            name=f"view_{i:02d}",
            camera=camera,
            image=folder / f"view_{i:02d}.png",
            split="test" if i % 5 == 2 else "train",
        )
        if depth_step is not None:
            depth = torch.where(drawn.alpha > 0.5, drawn.depth, 0.0)
            steps = (depth[::depth_step, ::depth_step] * 1000 + 0.5).int()
            save_png(steps, folder / f"depth_{i:02d}.png")
            view = replace(view, depth=folder / f"depth_{i:02d}.png", depth_unit=1e-3)
        views.append(view)
    rng = np.random.default_rng(7)
    shift = torch.from_numpy(rng.normal(scale=noise, size=(len(scene), 3)).astype(np.float32))
    colours = (scene.colours.clamp(0, 1) * 0.75 * 255).to(torch.uint8)
    points = PointCloud(points=scene.means + shift, colours=colours)
    return Capture(path=folder, format="test", views=tuple(views), points=points)


@pytest.fixture
def photograph(tmp_path: Path) -> CaptureMaker:
    """`photographed` into a folder of the test's own."""
    return partial(photographed, tmp_path)


@pytest.fixture
def scene_photographed() -> Gaussians:
    """What `photograph` shows by default."""
    return tiny_scene()


@pytest.fixture
def with_rates(monkeypatch):
    """Changes the learning rates and stages of fits for one test."""

    def change(**values: float) -> None:
        monkeypatch.setitem(RATES, "fast", replace(RATES["fast"], **values))

    return change
