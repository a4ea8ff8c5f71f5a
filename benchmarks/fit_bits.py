"""Digests of fits of a small generated scene: what a change of the program must not change.

    python benchmarks/fit_bits.py --save before.json
    python benchmarks/fit_bits.py --compare before.json

Fits the scene in every way that takes another path through a step: both strategies, masks,
alpha over a random and over a fixed background, exposures, poses, metric and relative depth, and
a refinement of the result. For each it prints a digest of the state at the end (parameters,
moments, exposures, poses, random generator) and one of the Gaussians that were returned. With
``--compare`` it names every digest that differs and exits with 1. Digests are those of one
machine: other instruction sets round otherwise.
"""

import argparse
import hashlib
import json
import math
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatseg.core import Camera, Capture, Gaussians, PointCloud, View
from splatseg.fit import Checkpoints, FitOptions, fit, refine
from splatseg.fit._checkpoint import read_checkpoint
from splatseg.io.images import save_png
from splatseg.render import render

STEPS = 120
BASE = FitOptions(
    minutes=None,
    steps=STEPS,
    max_gaussians=600,
    densify_from=20,
    densify_every=10,
    start="points",
)
CLASSIC = replace(BASE.with_strategy("classic"), reset_every=40, densify_gradient=1e-6)
EVERYTHING = {"exposure": True, "refine_poses": True, "masks": "alpha", "depth": "metric"}
VARIANTS = {
    "mcmc": BASE,
    "classic": CLASSIC,
    "random start": replace(BASE, start="random"),
    "no masks": replace(BASE, masks="off"),
    "alpha": replace(BASE, masks="alpha"),
    "alpha over white": replace(BASE, masks="alpha", background="white"),
    "exposure": replace(BASE, exposure=True),
    "poses": replace(BASE, refine_poses=True),
    "metric depth": replace(BASE, depth="metric"),
    "relative depth": replace(BASE, depth="relative"),
    "mcmc, everything": replace(BASE, **EVERYTHING),
    "classic, everything": replace(CLASSIC, **EVERYTHING),
}


def generated_scene(count: int = 150) -> Gaussians:
    """Coloured opaque blobs in a ball of radius 1."""
    rng = np.random.default_rng(1)
    means = rng.normal(size=(count, 3))
    means *= rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(means, axis=1, keepdims=True)
    rotations = rng.normal(size=(count, 4))
    rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
    values = {
        "means": means,
        "rotations": rotations,
        "scales": rng.uniform(0.06, 0.2, (count, 3)),
        "opacities": rng.uniform(0.6, 0.95, count),
        "sh": rng.uniform(-1.2, 1.2, (count, 1, 3)),
    }
    return Gaussians(**{k: torch.from_numpy(v.astype(np.float32)) for k, v in values.items()})


def camera_at(angle: float) -> Camera:
    """A camera 3.2 from the middle, looking at it."""
    centre = np.array([math.cos(angle), math.sin(angle), 0.4 * math.sin(3 * angle)])
    forward = -centre / np.linalg.norm(centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack((right, np.cross(forward, right), forward))
    pose[:3, 3] = 3.2 * pose[:3, :3] @ forward
    return Camera(
        width=84, height=72, fx=90.0, fy=90.0, cx=42.7, cy=35.6,
        cam_from_world=torch.from_numpy(pose),
    )  # fmt: skip


def generated_capture(folder: Path, *, views: int = 12) -> Capture:
    """Photographs of the scene, unequally bright, with masks and depth maps."""
    scene = generated_scene()
    rng = np.random.default_rng(7)
    made: list[View] = []
    for i in range(views):
        camera = camera_at(2 * math.pi * i / views)
        with torch.no_grad():
            drawn = render(scene, camera, backend="cpu")
        files = {kind: folder / f"{kind}_{i:02d}.png" for kind in ("image", "mask", "depth")}
        save_png(drawn.image.clamp(0, 1) * float(rng.uniform(0.6, 1.0)), files["image"])
        save_png(drawn.alpha.clamp(0, 1), files["mask"])
        depth = torch.where(drawn.alpha > 0.5, drawn.depth, 0.0)
        save_png((depth * 1000 + 0.5).int(), files["depth"])
        split = "test" if i % 6 == 2 else "train"
        made.append(View(name=f"{i:02d}", camera=camera, split=split, depth_unit=1e-3, **files))
    shift = torch.from_numpy(rng.normal(scale=0.03, size=(len(scene), 3)).astype(np.float32))
    colours = (scene.colours.clamp(0, 1) * 255).to(torch.uint8)
    points = PointCloud(points=scene.means + shift, colours=colours)
    return Capture(path=folder, format="generated", views=tuple(made), points=points)


def digest(tensors: Iterable[Tensor]) -> str:
    """Of all bytes, types and shapes."""
    found = hashlib.sha256()
    for tensor in tensors:
        array = tensor.detach().cpu().contiguous().numpy()
        found.update(f"{array.dtype}{array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()[:16]


def of_gaussians(gaussians: Gaussians) -> str:
    """Digest of the Gaussians."""
    names = ("means", "rotations", "scales", "opacities", "sh")
    return digest(getattr(gaussians, name) for name in names)


def measured(capture: Capture, folder: Path) -> dict[str, dict[str, str]]:
    """Digests of every variant."""
    found: dict[str, dict[str, str]] = {}
    for name, options in VARIANTS.items():
        checkpoints = Checkpoints(path=folder / "checkpoint.npz", at_end=True)
        result = fit(capture, options=options, backend="cpu", checkpoints=checkpoints)
        tensors = read_checkpoint(checkpoints.path).tensors
        found[name] = {
            "state": digest(tensors[key] for key in sorted(tensors)),
            "result": of_gaussians(result.gaussians),
        }
        print(f"{name}: {found[name]}", flush=True)
    refined = refine(
        generated_scene(),
        capture.train_views,
        steps=60,
        options=replace(BASE, masks="ignore"),
        backend="cpu",
    )
    found["refined"] = {"result": of_gaussians(refined)}
    print(f"refined: {found['refined']}")
    return found


def main() -> int:
    """Print, save or compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--save", type=Path)
    parser.add_argument("--compare", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = measured(generated_capture(Path(folder)), Path(folder))
    if arguments.save is not None:
        arguments.save.write_text(json.dumps(found, indent=1))
    if arguments.compare is None:
        return 0
    before = json.loads(arguments.compare.read_text())
    differing = [
        f"{name}: {kind}"
        for name in sorted({*before, *found})
        for kind in sorted({*before.get(name, {}), *found.get(name, {})})
        if before.get(name, {}).get(kind) != found.get(name, {}).get(kind)
    ]
    print("\n".join(f"DIFFERS {line}" for line in differing) or "all digests are the same")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
