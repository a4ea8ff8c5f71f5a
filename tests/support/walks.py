"""A tiny walk through a generated room in the layouts of Replica and ScanNet, with evidence.

Photographs, depths and truth come from `splatseg.synthetic`, a few kilobytes a frame, so that a
protocol of many methods runs in seconds. Fits are not made but written: a small Gaussian at each of
some thousand points of the surface.
"""

import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from splatseg.core import Capture, Gaussians, Scene, View
from splatseg.core.sh import SH_C0
from splatseg.io.scene import save_scene
from splatseg.synthetic import SyntheticScene, look_at, room, write_capture
from splatseg_bench.layouts import read_benchmark
from support import recorded
from support.benchmark_layouts import read_source, write_layout
from support.benchmark_layouts.evidence import write_evidence
from support.benchmark_layouts.rooms import surface_points
from support.benchmark_layouts.source import Source

WIDTH, HEIGHT = 80, 60
TRAIN, TEST = 15, 3
EVIDENCE = ("labels_semantic", "labels_panoptic", "labels_tracked", "features_text")
SCENES = {"replica": "room_0", "scannet": "scene0010_00"}
"""Named as scenes of the benchmark are."""


def walk_views(scene: SyntheticScene) -> tuple[View, ...]:
    """Views from a ring around the middle of the room across it, every sixth a test view."""
    low, high = (np.array(corner) for corner in scene.bounds)
    centre, half = (low + high) / 2, (high - low) / 2
    views = []
    for i in range(TRAIN + TEST):
        angle = 2 * math.pi * i / (TRAIN + TEST)
        away = np.array([math.cos(angle), math.sin(angle), 0.15])
        eye, target = centre + 0.55 * half * away, centre - 0.6 * half * away
        camera = look_at(eye.tolist(), target.tolist(), width=WIDTH, height=HEIGHT)
        split = "test" if i % 6 == 3 else "train"
        views.append(View(name=f"{split}_{i:02d}", camera=camera, split=split))
    return tuple(views)


def write_walk(folder: Path) -> None:
    """Write SOURCE, and ``replica`` and ``scannet`` with ``evidence/SCENE/NAME`` beside it."""
    scene = room(seed=0)
    views = walk_views(scene)
    folder.mkdir(parents=True, exist_ok=True)
    source = folder / "source"
    truths = write_capture(scene, source, views=views, points=2000, severity=0.3)
    seen = {}
    for name, truth in truths.items():
        instance = truth.instance.clamp_min(0).numpy()
        semantic = truth.semantic.clamp_min(0).numpy()
        seen[name] = recorded.Seen(semantic=semantic, instance=instance, part=instance)
    recorded.write_panoptic(source / "labels_panoptic", scene, seen)
    recorded.write_tracked(source / "labels_tracked", scene, seen)
    recorded.write_text(source, scene, seen)
    for layout in ("replica", "scannet"):
        data = write_layout(layout, source, folder / layout)
        (found,) = read_benchmark(layout, data)
        for name in EVIDENCE:
            write_evidence(read_source(source), found.capture, name, data / "evidence" / found.name)
    shutil.move(folder / "replica/source", folder / "replica/room_0")
    shutil.move(folder / "replica/evidence/source", folder / "replica/evidence/room_0")
    described = folder / "replica/semantic_info"
    shutil.move(described / "source", described / "room_0")
    scans = folder / "scannet/scans"
    shutil.move(scans / "scene0000_00", scans / "scene0010_00")
    shutil.move(folder / "scannet/evidence/scene0000_00", folder / "scannet/evidence/scene0010_00")


def surface_gaussians(source: Source) -> Gaussians:
    """Small, nearly opaque Gaussians of the surface's colours at points of it."""
    points = surface_points(source)
    xyz = torch.from_numpy(points["xyz"].astype(np.float32))
    rgb = torch.from_numpy(points["rgb"].astype(np.float32)) / 255
    count = len(xyz)
    # As wide as the way to the next point but two: the surface has no holes.
    gaps = torch.cdist(xyz, xyz).topk(4, largest=False).values[:, 3:]
    return Gaussians(
        means=xyz,
        rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=0.6 * gaps.clamp(0.01, 0.2).repeat(1, 3),
        opacities=torch.full((count,), 0.97),
        sh=((rgb - 0.5) / SH_C0)[:, None],
    )


def write_fits(
    walk: Path, splits_of: Callable[[Capture], Mapping[str, str]], *, fits: Path
) -> None:
    """Write ``LAYOUT/SCENE`` into `fits`, as if fitted with the splits that a capture is given."""
    gaussians = surface_gaussians(read_source(walk / "source"))
    for layout in ("replica", "scannet"):
        (found,) = read_benchmark(layout, walk / layout)
        splits = splits_of(found.capture)
        views = tuple(replace(view, split=splits[view.name]) for view in found.capture.views)
        scene = Scene(gaussians=gaussians, views=views, source=found.capture.path)
        target = fits / layout / found.name
        target.parent.mkdir(parents=True)
        save_scene(scene, target)


def models(walk: Path, layout: str) -> tuple[str, ...]:
    """Evidence of a layout as `splatseg bench` is told of it."""
    return tuple(str(walk / layout / "evidence" / "{scene}" / name) for name in EVIDENCE)


def fits(folder: Path, layout: str) -> str:
    """Fits of a layout as `splatseg bench` is told of them."""
    return str(folder / "fits" / layout / "{scene}")


def copied(walk: Path, layout: str, target: Path) -> Path:
    """A layout that may be changed."""
    return Path(shutil.copytree(walk / layout, target / layout))
