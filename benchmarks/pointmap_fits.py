"""Fits from pointmaps of a rendered scene against fits from its given cameras and points.

    python benchmarks/pointmap_fits.py ../shared/data/office --views 24 --window 4 --steps 500
    python benchmarks/pointmap_fits.py ../shared/data/office --steps 500 --densify on off

Pointmaps are those of `pointmaps.py`. Both fits get the same photographs, hold out every eighth of
them, and are scored twice: on those that were held out, with the cameras that the fit knows them
by, and on test views of the capture, whose given cameras are moved into the fitted world by the
best similarity between the cameras of the photographs (Umeyama). Without densification Gaussians
are neither added nor relocated (`FitOptions.densify_until` 0): they stay as many as the start
points, thinned to ``--max-gaussians``.
"""

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pointmaps import answers_for, chosen, file_name, pairs_of, written
from poses import umeyama

from splatseg.core import Camera, Capture, View
from splatseg.evaluate import evaluate_photographs
from splatseg.fit import FitOptions
from splatseg.io.captures import read_capture
from splatseg.lift import GaussianField
from splatseg.pose.pointmaps import recover_from_pointmaps
from splatseg.tasks import fit_capture


def moved(views: list[View], given: dict[str, Camera], found: dict[str, Camera]) -> list[View]:
    """Views of the given world in the found one."""
    names = sorted(given)
    theirs, ours = (
        np.stack([cameras[name].centre.numpy() for name in names]) for cameras in (given, found)
    )
    scale, rotation, translation = umeyama(theirs, ours)
    turn, shift = torch.from_numpy(rotation), torch.from_numpy(translation)
    out: list[View] = []
    for view in views:
        pose = view.camera.cam_from_world.clone()
        centre = scale * turn @ view.camera.centre + shift
        pose[:3, :3] = pose[:3, :3] @ turn.T
        pose[:3, 3] = -pose[:3, :3] @ centre
        out.append(replace(view, camera=replace(view.camera, cam_from_world=pose)))
    return out


def fitted(capture: Capture, tests: list[View], options: FitOptions) -> dict[str, Any]:
    """A fit, scored on the photographs it holds out and on test views."""
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as temporary:
        made = fit_capture(capture, Path(temporary) / "scene", fit_options=options, backend="cpu")
    seconds = round(time.monotonic() - begin)
    report = evaluate_photographs(GaussianField(made.result.gaussians), tests)
    return {
        "steps": made.result.steps,
        "densify": options.densify_until > 0,
        "gaussians": len(made.result.gaussians),
        "psnr held out": None if made.scores is None else round(made.scores.psnr, 2),
        "psnr test views": round(report.psnr, 2),
        "ssim test views": round(report.ssim, 3),
        "seconds": seconds,
    }


def main() -> int:
    """Fit, score, and print a line of JSON a fit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--window", type=int, default=4)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--max-gaussians", type=int, default=60_000)
    parser.add_argument("--tests", type=int, default=12)
    parser.add_argument("--densify", nargs="+", choices=("on", "off"), default=["on"])
    parser.add_argument("--poses", nargs="+", choices=("pointmaps", "given"), default=None)
    arguments = parser.parse_args()
    views = chosen(arguments.capture, arguments.views)
    given = {file_name(view): view.camera for view in views}
    pairs = pairs_of(sorted(given), arguments.window)
    answers = answers_for(arguments.capture, views, pairs, 0.1, 0)
    whole = read_capture(arguments.capture)
    rows = np.linspace(0, len(whole.test_views) - 1, arguments.tests).round().astype(int)
    tests = [whole.test_views[i] for i in rows]
    options = FitOptions.preset("quick").with_length(minutes=None, steps=arguments.steps)
    options = replace(options, max_gaussians=arguments.max_gaussians)
    with tempfile.TemporaryDirectory() as temporary:
        source = written(Path(temporary), views, answers, pairs)
        found = recover_from_pointmaps(Path(temporary) / "photos", source).capture
        cameras = {file_name(view): view.camera for view in found.views}
        held_out = {file_name(view) for view in found.test_views}
        same = replace(
            whole,
            views=tuple(
                replace(view, split="test" if file_name(view) in held_out else "train")
                for view in views
            ),
        )
        worlds = {
            "pointmaps": (found, moved(tests, given, cameras)),
            "given": (same, tests),
        }
        for densify in arguments.densify:
            until = options.densify_until if densify == "on" else 0.0
            for poses in arguments.poses or worlds:
                row = fitted(*worlds[poses], replace(options, densify_until=until))
                print(json.dumps({"poses": poses, **row}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
