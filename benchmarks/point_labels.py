"""How long labels of points take by eq. 9: a million points over a plane of primitives.

    python benchmarks/point_labels.py [--points 1000000] [--side 60] [--radius 0.25 0.5 1]

Primitives stand on a plane in voxels of 0.5 m and 1 m, 42 vertices each, as on a road; points lie
within 10 cm of it. Columns: radius, vertices in the ball of a point on average, seconds with and
without the index, and seconds of all threads together, which other work does not lengthen much.
"""

import argparse
import os
import time

import torch

from splatseg.neighbours import NeighbourIndex
from splatseg.street.field import BallQuery
from splatseg.street.shapes import primitive_scale

VERTICES = 42


def level(side: float, size: float, generator: torch.Generator) -> torch.Tensor:
    """Vertices of primitives in all voxels of a plane."""
    steps = torch.arange(0, side, size)
    corners = torch.cartesian_prod(steps, steps)
    centres = torch.cat((corners, torch.zeros(len(corners), 1)), dim=1)
    offsets = torch.randn(len(centres), VERTICES, 3, generator=generator)
    unit = torch.nn.functional.normalize(offsets, dim=-1)
    return (centres[:, None] + primitive_scale(size) * unit).reshape(-1, 3)


def main() -> None:
    """Print a row a radius."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--side", type=float, default=60.0)
    parser.add_argument("--classes", type=int, default=20)
    parser.add_argument("--radius", type=float, nargs="+", default=[0.25, 0.5, 1.0])
    given = parser.parse_args()
    generator = torch.Generator().manual_seed(0)
    vertices = torch.cat([level(given.side, size, generator) for size in (0.5, 1.0)])
    opacity = torch.rand(len(vertices), generator=generator)
    probabilities = torch.rand(len(vertices), given.classes, generator=generator)
    spread = torch.tensor([given.side, given.side, 0.1])
    points = torch.rand(given.points, 3, generator=generator) * spread
    print(f"{len(vertices):,} vertices, {given.points:,} points, {given.classes} classes")
    print(f"{torch.get_num_threads()} threads, load {os.getloadavg()[0]:.1f}")
    index = NeighbourIndex(vertices)
    for radius in given.radius:
        began, used = time.perf_counter(), time.process_time()
        query = BallQuery(vertices, opacity, probabilities, radius=radius)
        made = time.perf_counter()
        columns, _ = query.columns(points)
        done, used = time.perf_counter(), time.process_time() - used
        near = float(index.count_within(points[:20_000], radius).double().mean())
        unlabelled = int((columns < 0).sum())
        print(
            f"radius {radius:g}: {near:6.1f} vertices, {done - began:6.2f} s, "
            f"{done - made:6.2f} s without the index, {used:6.2f} s of CPU, "
            f"{unlabelled} without a label"
        )


if __name__ == "__main__":
    main()
