"""Poses from bare photographs against those that came with a capture.

    python benchmarks/poses.py ../shared/data/real/llff_fern --threads 1
    python benchmarks/poses.py ../shared/data/real/banana --least 15

Runs structure from motion on the photographs alone, moves the result onto the given cameras by
the best similarity (Umeyama), and prints how many photographs were placed, how far rotations and
centres are off, and the time of each stage. ``--least`` makes it fail below a number of placed
photographs.
"""

import argparse
import json
import platform
import sys
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Camera
from splatseg.io.captures import find_formats, read_capture
from splatseg.pose import PoseOptions, PoseProgress, PoseResult, recover_poses


def umeyama(
    source: NDArray[np.float64], target: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Scale, rotation and translation that bring points nearest to others (least squares).

    References:
        Umeyama, Least-squares estimation of transformation parameters between two point
        patterns, PAMI 1991.
    """
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    a, b = source - mean_source, target - mean_target
    left, values, right = np.linalg.svd(b.T @ a / len(a))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left @ sign @ right
    scale = float((values * np.diag(sign)).sum() / (a**2).sum(axis=1).mean())
    return scale, rotation, mean_target - scale * rotation @ mean_source


def compare(found: dict[str, Camera], given: dict[str, Camera]) -> dict[str, float]:
    """Differences of cameras of the same names after alignment."""
    names = sorted(set(found) & set(given))
    ours = np.stack([found[n].centre.numpy() for n in names])
    theirs = np.stack([given[n].centre.numpy() for n in names])
    scale, rotation, translation = umeyama(ours, theirs)
    moved = scale * ours @ rotation.T + translation
    extent = float(np.linalg.norm(np.ptp(theirs, axis=0)))
    off = np.linalg.norm(moved - theirs, axis=1) / extent
    angles: list[float] = []
    for name in names:
        between = found[name].cam_from_world[:3, :3].numpy() @ rotation.T
        between = between @ given[name].cam_from_world[:3, :3].numpy().T
        skew = (between - between.T)[[2, 0, 1], [1, 2, 0]]
        angles.append(np.degrees(np.arctan2(np.linalg.norm(skew) / 2, (np.trace(between) - 1) / 2)))
    ratios = [found[n].fx / given[n].fx for n in names]
    return {
        "compared": len(names),
        "rotation median deg": float(np.median(angles)),
        "rotation max deg": float(np.max(angles)),
        "centre median % of extent": 100 * float(np.median(off)),
        "centre max % of extent": 100 * float(np.max(off)),
        "focal ratio": float(np.median(ratios)),
    }


def show(now: PoseProgress) -> None:
    """One line on stderr that is written over."""
    sys.stderr.write(f"\r{now.stage} {now.done}/{now.total}      ")


def cameras_by_file(result: PoseResult) -> dict[str, Camera]:
    """Cameras by the file names of photographs."""
    views = result.capture.views
    return {view.image.name: view.camera for view in views if view.image is not None}


def main() -> int:
    """Recover, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--least", type=int, default=3)
    parser.add_argument("--folder", type=Path, default=None, help="where to keep the result")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE")
    arguments = parser.parse_args()
    changes = dict(item.split("=", 1) for item in arguments.set)
    values = {name: json.loads(value) for name, value in changes.items()}
    options = PoseOptions(threads=arguments.threads, **values)
    begin, cpu = time.monotonic(), time.process_time()
    result = recover_poses(arguments.data, folder=arguments.folder, options=options, progress=show)
    report = result.report
    summary = {
        "data": str(arguments.data.name),
        "machine": platform.processor() or platform.machine(),
        "options": changes,
        "photographs": report.photographs,
        "registered": len(report.registered),
        "left out": {left.name: left.why for left in report.left_out},
        "mapper": report.mapper,
        "tries": [
            f"{t.mapper}: {t.registered} ({t.error:.3f} px, {t.seconds:.1f} s, models {t.models})"
            for t in report.tries
        ],
        "error px": report.error,
        "points": report.points,
        "track length": report.track_length,
        "lenses": [f"{x.photographs} at {x.focal:.1f} px, k1 {x.k1:.4f}" for x in report.lenses],
        "seconds": {stage: round(value, 1) for stage, value in report.seconds.items()},
        "all seconds": round(time.monotonic() - begin, 1),
        "own cpu": round(time.process_time() - cpu, 1),
    }
    if find_formats(arguments.data):
        given = read_capture(arguments.data).views
        theirs = {view.image.name: view.camera for view in given if view.image is not None}
        summary |= compare(cameras_by_file(result), theirs)
    sys.stderr.write("\n")
    print(json.dumps(summary, indent=1))
    return 0 if len(report.registered) >= arguments.least else 1


if __name__ == "__main__":
    sys.exit(main())
