"""Cameras from pointmaps of a rendered scene, whose cameras and depths are known.

    python benchmarks/pointmaps.py ../shared/data/office --views 24 --seeds 3
    python benchmarks/pointmaps.py ../shared/data/office --views 6 --sfm
    python benchmarks/pointmaps.py ../shared/data/office --views 24 --window 4 --fit 500
    python benchmarks/pointmaps.py ../shared/data/office --views 24 --record ROOM

Photographs are taken evenly from the train views. Pointmaps of pairs of them are made from true
depth with noise of 2 % of it, a smooth warp of 3 %, units from 0.5 to 2, chance confidences in a
fifth of the maps and 10 % of outlier pairs (`PointmapErrors`). Cameras are moved onto the given
ones by the best similarity; centres count in % of the diagonal of the box around them. ``--sfm``
runs structure from motion on the same photographs first; ``--record`` writes photographs and
pointmaps for ``splatseg fit ROOM/photos --poses pointmaps``. Fails where a median is beyond
0.5 degrees, 1 % or a focal length beyond 1 %.
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

from splatseg.core import Camera, Capture, View
from splatseg.errors import SplatsegError
from splatseg.fit import FitOptions
from splatseg.io.captures import read_capture
from splatseg.io.depths import read_depth_map
from splatseg.io.pointmaps import RecordedPointmaps, create_pointmaps, open_pointmaps
from splatseg.pose import recover_poses
from splatseg.pose.pointmaps import PointmapOptions, recover_from_pointmaps
from splatseg.synthetic import PointmapErrors, SyntheticPointmaps, synthetic_pointmaps
from splatseg.tasks import fit_capture

GOALS = {"rotation median deg": 0.5, "centre median % of extent": 1.0, "focal off": 0.01}


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


def measured(folder: Path, source: RecordedPointmaps, given: dict[str, Camera], kind: Any) -> Any:
    """One run and how far its cameras are off."""
    begin = time.monotonic()
    found = recover_from_pointmaps(
        folder / "photos", source, options=PointmapOptions(alignment=kind, max_points=50_000)
    )
    cameras = {file_name(view): view.camera for view in found.capture.views}
    return {
        "alignment": kind,
        **compare(cameras, given),
        "contradictory": len(found.report.contradictory),
        "seconds": round(time.monotonic() - begin, 1),
    }


def fitted(capture: Capture, *, steps: int) -> dict[str, Any]:
    """A fit of so many steps, scored on the photographs it holds out."""
    options = FitOptions.preset("quick").with_length(minutes=None, steps=steps)
    options = replace(options, max_gaussians=60_000)
    with tempfile.TemporaryDirectory() as temporary:
        made = fit_capture(capture, Path(temporary) / "scene", fit_options=options, backend="cpu")
    return {
        "steps": made.result.steps,
        "gaussians": len(made.result.gaussians),
        "psnr": None if made.scores is None else round(made.scores.psnr, 2),
    }


def fits(capture: Path, views: list[View], folder: Path, steps: int) -> None:
    """Fits from recorded pointmaps and from the given cameras and points, same views held out."""
    source = open_pointmaps(folder / "photos" / "pointmaps")
    found = recover_from_pointmaps(folder / "photos", source).capture
    print(json.dumps({"poses": "pointmaps", **fitted(found, steps=steps)}), flush=True)
    held_out = {file_name(view) for view in found.test_views}
    given = [
        replace(view, split="test" if file_name(view) in held_out else "train") for view in views
    ]
    same = replace(read_capture(capture), views=tuple(given))
    print(json.dumps({"poses": "given", **fitted(same, steps=steps)}), flush=True)


def main() -> int:
    """Measure and print a line of JSON a run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--window", type=int, help="neighbours on the circle; all without it")
    parser.add_argument("--outliers", type=float, default=0.1)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--published", action="store_true", help="DUSt3R's alignment as well")
    parser.add_argument("--sfm", action="store_true")
    parser.add_argument("--record", type=Path)
    parser.add_argument("--fit", type=int, help="steps of fits from pointmaps and given poses")
    arguments = parser.parse_args()
    views = chosen(arguments.capture, arguments.views)
    given = {file_name(view): view.camera for view in views}
    names = sorted(given)
    pairs = pairs_of(names, arguments.window)
    missed = False
    for seed in range(arguments.seeds):
        answers = answers_for(arguments.capture, views, pairs, arguments.outliers, seed)
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) if arguments.record is None else arguments.record
            source = written(folder, views, answers, pairs)
            if arguments.sfm and seed == 0:
                try:
                    report = recover_poses(folder / "photos").report
                    placed = f"{len(report.registered)} of {report.photographs} placed"
                    print(json.dumps({"sfm": placed, "error_px": report.error}), flush=True)
                except SplatsegError as error:
                    print(json.dumps({"sfm": str(error).splitlines()[0]}), flush=True)
            for kind in ("robust", "published") if arguments.published else ("robust",):
                row = measured(folder, source, given, kind)
                row |= {"seed": seed, "pairs": len(pairs), "outliers": len(answers.outliers)}
                print(json.dumps(row), flush=True)
                off = {**row, "focal off": abs(row["focal ratio"] - 1)}
                missed |= kind == "robust" and any(off[k] > v for k, v in GOALS.items())
            if arguments.fit is not None:
                fits(arguments.capture, views, folder, arguments.fit)
        if arguments.record is not None:
            break
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
