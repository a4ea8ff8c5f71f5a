"""Scores of a finished fit on its held-out views, and the report on it."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from splatseg.core import Capture, View
from splatseg.evaluate import PhotographReport, evaluate_photographs, render_and_photograph
from splatseg.evaluate.photographs import MaskUse
from splatseg.fit import FitOptions, FitResult
from splatseg.io.scene_folder import GAUSSIANS_FILE, POSES_FOLDER, scene_path
from splatseg.lift import GaussianField
from splatseg.pose import load_pose_report
from splatseg.render import BackendName
from splatseg.report.fit_report import FitReportData, fit_record, fit_report
from splatseg.report.images import Gallery, GalleryImage, colour_difference
from splatseg.report.maps import camera_map
from splatseg.tasks.work import REPORTS_FOLDER, write_page

_NEXT = ("worst", "second worst", "third worst")

# Scoring the held-out views may take this long, seconds: writing belongs to the minutes too.
_SCORING = 20.0


def score_and_report(
    root: Path,
    capture: Capture,
    result: FitResult,
    *,
    options: FitOptions,
    backend: BackendName,
    scoring: bool,
    command: str = "",
    timings: Mapping[str, float] | None = None,
    poses: Mapping[str, Any] | None = None,
) -> tuple[FitReportData, Path]:
    """Score the held-out views, write SCENE/reports/fit.html and fit.json.

    As many views are scored as the time for it allows; with `scoring` False none is, for who
    stopped a fit does not want to wait.

    Args:
        root: Folder of the scene.
        capture: What it was fitted to.
        result: The fit.
        options: Of the fit.
        backend: Rendering backend.
        scoring: Whether held-out views are scored.
        command: The words that started it; may be empty.
        timings: Seconds by part of the command until now.
        poses: How cameras were found; None takes what is kept with the scene.

    Returns:
        What the page tells, and where it is.
    """
    began = time.monotonic()
    views = [view for view in capture.test_views if view.image is not None]
    scores = None
    if views and scoring:
        scores = evaluate_photographs(
            GaussianField(result.gaussians, backend=backend),
            views,
            masks=options.masks,
            seconds=_SCORING,
        )
    data = FitReportData(
        capture=replace(capture, views=result.views or capture.views),
        options=options,
        result=result,
        scores=scores,
        held_out=len(views),
        file_bytes=(root / GAUSSIANS_FILE).stat().st_size,
        command=command,
        poses=_poses(root) if poses is None else poses,
        facts={"backend": backend},
    )
    pairs = None
    if scores is not None:
        pairs = _pairs(result, views, scores, masks=options.masks, backend=backend)
    cameras = camera_map(result.gaussians, data.capture.views, up=capture.up)
    spent = {**(timings or {}), "scores and report": time.monotonic() - began}
    data = replace(data, timings=spent)
    page = fit_report(data, pairs=pairs, cameras=cameras)
    path = scene_path(root, REPORTS_FOLDER, "fit.html")
    return data, write_page(page, path, record=fit_record(data))


def _pairs(
    result: FitResult,
    views: Sequence[View],
    scores: PhotographReport,
    *,
    masks: MaskUse,
    backend: BackendName,
) -> Gallery:
    """Photograph, render and difference of the worst views, the median and the best one."""
    ordered = sorted(scores.per_view, key=lambda score: score.psnr)
    median, last = len(ordered) // 2, len(ordered) - 1
    # Of few views some are two of these; each is shown once.
    ranks = {0: "worst"} | {i: _NEXT[i] for i in range(1, min(len(_NEXT), median))}
    ranks |= {median: "median", last: "best"} if last else {0: "the only one"}
    names = {view.name: view for view in views}
    rows: list[tuple[str, tuple[GalleryImage, ...]]] = []
    for rank, label in ranks.items():
        score = ordered[rank]
        picture, photograph = render_and_photograph(
            GaussianField(result.gaussians, backend=backend), names[score.name], masks=masks
        )
        rows.append(
            (
                f"{label}: {score.name}",
                (
                    GalleryImage(image=photograph),
                    GalleryImage(
                        image=picture, caption=f"{score.psnr:.2f} dB, SSIM {score.ssim:.3f}"
                    ),
                    GalleryImage(image=colour_difference(picture, photograph)),
                ),
            )
        )
    return Gallery(
        title="Held-out views, the worst first",
        columns=("photograph", "rendered", "difference"),
        rows=tuple(rows),
        note="The difference is four times as bright as it is.",
    )


def _poses(root: Path) -> dict[str, Any] | None:
    report = load_pose_report(root / POSES_FOLDER)
    return None if report is None else asdict(report)
