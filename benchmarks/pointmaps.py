"""Cameras from pointmaps of a rendered scene, whose cameras and depths are known.

    python benchmarks/pointmaps.py ../shared/data/office --views 16 --seeds 3 --all
    python benchmarks/pointmaps.py ../shared/data/office --views 6 --seeds 6 --sfm
    python benchmarks/pointmaps.py ../shared/data/office --views 24 --record ROOM

Photographs are taken evenly from the train views. Pointmaps of pairs of them are made from true
depth with noise of 2 % of it, a smooth warp of 3 %, units from 0.5 to 2, chance confidences in a
fifth of the maps and 10 % of outlier pairs (`PointmapErrors`). Cameras are moved onto the given
ones by the best similarity of their centres; those count in % of the diagonal of the box around
them. A few centres tell badly how the whole world is turned, so the rotation between two cameras
is compared too, of all pairs of them, which needs no similarity. ``--all`` aligns without
refinement as well; ``--sfm`` runs structure from motion on the same photographs
first; ``--record`` writes photographs and pointmaps for ``splatseg fit ROOM/photos --poses
pointmaps``. Fails where a camera is beyond 0.5 degrees or 1 %, or a focal length beyond 1 %.
"""

import argparse
import json
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from poses import compare

from splatseg.core import Camera, View
from splatseg.errors import SplatsegError
from splatseg.io.captures import read_capture
from splatseg.io.depths import read_depth_map
from splatseg.io.pointmaps import RecordedPointmaps, create_pointmaps
from splatseg.pose import recover_poses
from splatseg.pose.pointmaps import PointmapOptions, recover_from_pointmaps
from splatseg_bench.worlds import PointmapErrors, SyntheticPointmaps, synthetic_pointmaps

GOALS = {"rotation max deg": 0.5, "centre max % of extent": 1.0, "focal off": 0.01}
KINDS = {
    "default": PointmapOptions(),
    "not refined": PointmapOptions(refine=False),
}


def chosen(capture: Path, count: int) -> list[View]:
    """Train views with photographs, evenly."""
    views = [view for view in read_capture(capture).train_views if view.image is not None]
    rows = np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int)
    return [views[i] for i in rows]


def pairs_of(names: list[str], window: int | None) -> list[tuple[str, str]]:
    """Both orders of pairs at most `window` apart around the circle of names; None is all."""
    count = len(names)
    reach = count if window is None else window
    return [
        (names[i], names[j])
        for i in range(count)
        for j in range(count)
        if i != j and min((i - j) % count, (j - i) % count) <= reach
    ]


def answers_for(
    capture: Path, views: list[View], pairs: list[tuple[str, str]], outliers: float, seed: int
) -> SyntheticPointmaps:
    """Pointmaps of the views."""
    depths = {
        file_name(view): read_depth_map(capture / "depth" / f"{view.name}.png", unit=1e-3).values
        for view in views
    }
    cameras = {file_name(view): view.camera for view in views}
    errors = PointmapErrors(outliers=outliers)
    return synthetic_pointmaps(cameras, depths, pairs, errors=errors, seed=seed)


def file_name(view: View) -> str:
    """Of its photograph."""
    assert view.image is not None
    return view.image.name


def written(
    folder: Path, views: list[View], answers: SyntheticPointmaps, pairs: list[tuple[str, str]]
) -> RecordedPointmaps:
    """Photographs and what is said of them, as files."""
    photographs = folder / "photos"
    photographs.mkdir(parents=True)
    for view in views:
        assert view.image is not None
        shutil.copy(view.image, photographs)
    names = sorted(file_name(view) for view in views)
    kept = create_pointmaps(
        photographs / "pointmaps", photographs=names, metadata={"model": "generated"}
    )
    for one, two in pairs:
        kept.save(one, two, answers.pointmaps(one, two))
    return kept


def between(found: dict[str, Camera], given: dict[str, Camera]) -> dict[str, float]:
    """How far the rotation from each camera to each other one is off, degrees."""
    names = sorted(given)
    ours, theirs = (
        np.stack([cameras[name].cam_from_world[:3, :3].numpy() for name in names])
        for cameras in (found, given)
    )
    rows, columns = np.triu_indices(len(names), 1)
    one, two = (x[rows] @ x[columns].transpose(0, 2, 1) for x in (ours, theirs))
    sine = np.linalg.norm(one - two, axis=(1, 2)) / np.sqrt(8)
    angles = np.degrees(2 * np.arcsin(np.clip(sine, 0, 1)))
    return {
        "between two median deg": float(np.median(angles)),
        "between two max deg": float(angles.max()),
    }


def measured(
    photographs: Path, source: RecordedPointmaps, given: dict[str, Camera], kind: str
) -> dict[str, Any]:
    """One run and how far its cameras are off."""
    begin = time.monotonic()
    options = replace(KINDS[kind], max_points=50_000)
    found = recover_from_pointmaps(photographs, source, options=options)
    cameras = {file_name(view): view.camera for view in found.capture.views}
    off = compare(cameras, given) | between(cameras, given)
    return {
        "alignment": kind,
        **{name: round(value, 4) for name, value in off.items()},
        "contradictory": found.report.contradictory,
        "seconds": round(time.monotonic() - begin, 1),
    }


def say(row: dict[str, Any]) -> None:
    """A line of JSON."""
    print(json.dumps(row), flush=True)


def sfm(photographs: Path) -> None:
    """Structure from motion on the photographs alone."""
    try:
        report = recover_poses(photographs).report
        placed = f"{len(report.registered)} of {report.photographs} placed"
        say({"sfm": placed, "error_px": report.error})
    except SplatsegError as error:
        say({"sfm": str(error).splitlines()[0]})


def main() -> int:
    """Measure and print a line of JSON a run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--window", type=int, help="neighbours on the circle; all without it")
    parser.add_argument("--outliers", type=float, default=0.1)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--all", action="store_true", help="other alignments as well")
    parser.add_argument("--sfm", action="store_true")
    parser.add_argument("--record", type=Path)
    arguments = parser.parse_args()
    views = chosen(arguments.capture, arguments.views)
    given = {file_name(view): view.camera for view in views}
    pairs = pairs_of(sorted(given), arguments.window)
    missed = False
    for seed in range(arguments.seeds):
        answers = answers_for(arguments.capture, views, pairs, arguments.outliers, seed)
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) if arguments.record is None else arguments.record
            source = written(folder, views, answers, pairs)
            if arguments.sfm and seed == 0:
                sfm(folder / "photos")
            for kind in KINDS if arguments.all else ("default",):
                row = measured(folder / "photos", source, given, kind)
                named = answers.outliers & set(row.pop("contradictory"))
                row |= {"seed": seed, "pairs": len(pairs)}
                say(row | {"outliers named": f"{len(named)} of {len(answers.outliers)}"})
                off = {**row, "focal off": abs(row["focal ratio"] - 1)}
                missed |= kind == "default" and any(off[k] > v for k, v in GOALS.items())
        if arguments.record is not None:
            break
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
