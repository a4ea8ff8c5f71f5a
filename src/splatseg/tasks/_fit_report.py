"""The end of a fit: held-out views are scored and reports/fit.html is written."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatseg.core import Capture, View
from splatseg.evaluate import PhotographReport, evaluate_photographs, render_and_photograph
from splatseg.evaluate.photographs import MaskUse
from splatseg.fit import FitOptions, FitResult
from splatseg.io.atomic import atomic_file
from splatseg.io.json_files import read_json, write_json
from splatseg.io.scene import GAUSSIANS_FILE, POSES_FOLDER
from splatseg.lift import GaussianField
from splatseg.render import BackendName
from splatseg.report.fit_report import FitReportData, fit_record, fit_report
from splatseg.report.html import report_html
from splatseg.report.images import Gallery, GalleryImage, colour_difference

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
) -> tuple[PhotographReport | None, Path]:
    """Score the held-out views, write SCENE/reports/fit.html and fit.json.

    As many views are scored as the time for it allows; with `scoring` False none is, for who
    stopped a fit does not want to wait.

    Returns:
        The scores, None where no view was scored, and the report.
    """
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
        poses=_poses(root),
        facts={"backend": backend},
    )
    pairs = None
    if scores is not None:
        pairs = _pairs(result, views, scores, masks=options.masks, backend=backend)
    folder = root / "reports"
    folder.mkdir(exist_ok=True)
    with atomic_file(folder / "fit.html") as path:
        page = report_html(fit_report(data, pairs=pairs))
        path.write_text(page, encoding="utf-8", newline="\n")
    write_json(fit_record(data), folder / "fit.json")
    return scores, folder / "fit.html"


def _pairs(
    result: FitResult,
    views: Sequence[View],
    scores: PhotographReport,
    *,
    masks: MaskUse,
    backend: BackendName,
) -> Gallery:
    """Photograph, picture and difference of the worst, the median and the best view."""
    ordered = sorted(scores.per_view, key=lambda score: score.psnr)
    median, last = len(ordered) // 2, len(ordered) - 1
    # Of few views some are two of the three; each is shown once.
    ranks = {0: "worst", median: "median", last: "best"} if last else {0: "the only one"}
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
        title="Held-out views",
        columns=("photograph", "rendered", "difference"),
        rows=tuple(rows),
        note="The difference is four times as bright as it is.",
    )


def _poses(root: Path) -> dict[str, Any] | None:
    path = root / POSES_FOLDER / "poses.json"
    return read_json(path).get("report") if path.is_file() else None
