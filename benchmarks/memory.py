"""Peak memory of big scenes, each in a process of its own.

    python benchmarks/memory.py

`wide`: 1 M Gaussians at 1296 x 840, 64 channels rendered and back-projected; what is counted is
the peak beyond the inputs (resident memory once scene, signal and image are there).
`large`: 5 M Gaussians of degree 3 are written to a PLY, loaded, rendered and back-projected with
3 channels; what is counted is the peak of the whole process that loads it.
`fit`: 1 M start points are fitted to eight photographs of 1296 x 840, at full size, with rounds
of relocation and checkpoints; what is counted is the peak of the whole process that fits.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

from splatseg.core import Camera, Capture, Gaussians, PointCloud, View
from splatseg.fit import Checkpoints, FitOptions, fit
from splatseg.io.images import save_png
from splatseg.io.splats import read_splats, write_splats
from splatseg.render import back_project, render
from splatseg.render.cpu import threads


def room(count: int, degree: int, seed: int = 0) -> Gaussians:
    """Flat Gaussians on the walls of a 6 x 5 x 2.8 m box, as a trained room has them."""
    rng = np.random.default_rng(seed)
    size = np.array([6.0, 5.0, 2.8])
    points = rng.random((count, 3)) * size
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = size[axis] * rng.integers(0, 2, count)
    spacing = np.sqrt(2 * (6 * 5 + 6 * 2.8 + 5 * 2.8) / count)
    scales = spacing * np.exp(rng.normal(-0.3, 0.6, (count, 3)))
    scales[np.arange(count), axis] *= 0.1
    rotations = np.zeros((count, 4))
    rotations[:, 0] = 1
    return Gaussians(
        means=torch.from_numpy(points.astype(np.float32)),
        rotations=torch.from_numpy(rotations.astype(np.float32)),
        scales=torch.from_numpy(scales.astype(np.float32)),
        opacities=torch.from_numpy((1 / (1 + np.exp(-rng.normal(0, 2, count)))).astype(np.float32)),
        sh=torch.from_numpy(rng.normal(0, 0.2, (count, (degree + 1) ** 2, 3)).astype(np.float32)),
    )


def camera(eye: tuple[float, ...] = (0.8, 0.7, 1.5)) -> Camera:
    """In a corner, at eye height, looking across the room."""
    target = np.array([4.5 if eye[0] < 3 else 1.5, 3.5 if eye[1] < 2.5 else 1.5, 0.8])
    z = (target - np.array(eye)) / np.linalg.norm(target - np.array(eye))
    x = np.cross(z, [0.0, 0, 1])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ np.array(eye)
    return Camera(
        width=1296, height=840, fx=660, fy=660, cx=648, cy=420,
        cam_from_world=torch.from_numpy(pose),
    )  # fmt: skip


def peak_gb() -> float:
    """Largest resident memory so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def wide() -> None:
    """1 M Gaussians, 64 channels."""
    scene, view = room(1_000_000, 3), camera()
    signal = torch.randn(len(scene), 64)
    image = torch.randn(view.height, view.width, 64)
    before = peak_gb()
    drawn = render(scene, view, signal)
    after_render = peak_gb()
    collected = back_project(scene, view, image)
    after = peak_gb()
    total = float(drawn.alpha.mean()), float(collected.weights.sum())
    print(
        f"1 M Gaussians, 1296x840, 64 channels, {threads()} threads: inputs {before:.2f} GB, "
        f"+{after_render - before:.2f} GB after rendering, +{after - before:.2f} GB after "
        f"back-projecting (limit 3 GB); mean alpha {total[0]:.3f}, weight {total[1]:.0f}"
    )


def large(path: Path) -> None:
    """5 M Gaussians from a file."""
    scene, view = read_splats(path), camera()
    loaded = peak_gb()
    drawn = render(scene, view)
    rendered = peak_gb()
    collected = back_project(scene, view, drawn.image)
    print(
        f"5 M Gaussians of degree 3 ({path.stat().st_size / 1e9:.2f} GB PLY): {loaded:.2f} GB "
        f"loaded, {rendered:.2f} GB rendered, {peak_gb():.2f} GB back-projected (limit 12 GB); "
        f"weight {float(collected.weights.sum()):.0f}"
    )


def fit_views(folder: Path) -> tuple[View, ...]:
    """From the four corners across the room, at two heights: each sees about half of it."""
    corners = [(x, y, z) for z in (1.1, 1.7) for x in (0.5, 5.5) for y in (0.5, 4.5)]
    return tuple(
        View(name=f"view_{i}", camera=camera(eye), image=folder / f"view_{i}.png")
        for i, eye in enumerate(corners)
    )


def photograph(folder: Path) -> None:
    """Photographs of a room of 1 M Gaussians."""
    scene = room(1_000_000, 0)
    for view in fit_views(folder):
        if view.image is not None:
            save_png(render(scene, view.camera).image.clamp(0, 1), view.image)


def fit_large(folder: Path) -> None:
    """1 M Gaussians of degree 2 fitted to the photographs."""
    start = room(1_000_000, 0, seed=1)
    colours = (255 * start.colours.clamp(0, 1)).to(torch.uint8)
    points = PointCloud(points=start.means, colours=colours)
    capture = Capture(path=folder, format="generated", views=fit_views(folder), points=points)
    del start, colours
    before = peak_gb()
    options = FitOptions(
        minutes=None, steps=24, max_gaussians=1_000_000, rates="published",
        densify_from=6, densify_every=6,
    )  # fmt: skip
    checkpoints = Checkpoints(path=folder / "checkpoint", steps=8)
    result = fit(capture, options=options, backend="cpu", checkpoints=checkpoints)
    print(
        f"fit of 1 M Gaussians of degree {result.gaussians.sh_degree} at 1296x840, {threads()} "
        f"threads: {before:.2f} GB before, peak {peak_gb():.2f} GB (limit 6 GB); "
        f"{len(result.gaussians)} Gaussians after {result.steps} steps of "
        f"{1e3 * result.seconds / result.steps:.0f} ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", nargs="?", choices=["wide", "large", "write", "photograph", "fit"])
    parser.add_argument("path", nargs="?", type=Path)
    args = parser.parse_args()
    if args.part == "wide":
        wide()
    elif args.part == "large":
        large(args.path)
    elif args.part == "write":
        write_splats(room(5_000_000, 3), args.path)
    elif args.part == "photograph":
        photograph(args.path)
    elif args.part == "fit":
        fit_large(args.path)
    else:
        subprocess.run([sys.executable, __file__, "wide"], check=True)
        with tempfile.TemporaryDirectory() as folder:
            subprocess.run([sys.executable, __file__, "photograph", folder], check=True)
            subprocess.run([sys.executable, __file__, "fit", folder], check=True)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "large.ply"
            subprocess.run([sys.executable, __file__, "write", str(path)], check=True)
            subprocess.run([sys.executable, __file__, "large", str(path)], check=True)


if __name__ == "__main__":
    main()
