"""reports/fit.html and fit.json: what they tell of a fit, and that they tell the truth."""

import json
import re
from dataclasses import asdict, replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

from splatseg.core import Capture, Scene
from splatseg.evaluate import evaluate_photographs
from splatseg.fit import FitOptions, FitResult, fit
from splatseg.io.scene import save_scene
from splatseg.lift import GaussianField
from splatseg.pose import PoseReport
from splatseg.report.fit_report import verdict_of
from splatseg.tasks.fit_scores import score_and_report

OPTIONS = FitOptions(minutes=None, steps=120, max_gaussians=70, seed=3, background="black")


@pytest.fixture
def fitted(capture: Capture, tmp_path: Path) -> tuple[Path, Capture, FitResult]:
    result = fit(capture, options=OPTIONS, backend="cpu")
    save_scene(Scene(gaussians=result.gaussians, views=capture.views), tmp_path / "scene")
    return tmp_path / "scene", capture, result


class Page(HTMLParser):
    """Words, tags, and whether everything is closed again."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words, self.tags, self.open = [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag not in ("meta", "img", "wbr"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def test_a_finished_fit(fitted) -> None:
    root, capture, result = fitted
    done, where = score_and_report(
        root,
        capture,
        result,
        options=OPTIONS,
        backend="cpu",
        scoring=True,
        timings={"optimisation": 61.5},
    )
    found = done.scores
    scores = evaluate_photographs(
        GaussianField(result.gaussians, backend="cpu"), capture.test_views
    )
    assert found is not None
    assert (found.psnr, found.ssim) == (scores.psnr, scores.ssim)
    assert where == root / "reports" / "fit.html"

    record = json.loads((root / "reports" / "fit.json").read_text())
    assert record["steps"] == 120
    assert record["interrupted"] is False
    assert record["gaussians"] == len(result.gaussians)
    assert record["file_bytes"] == (root / "gaussians.ply").stat().st_size
    assert record["seed"] == 3
    assert (record["sensible_steps"], record["too_short"]) == (1000, True)
    assert record["verdict"].startswith("Too short. 120 steps done, where 1000 or more")
    assert verdict_of(done).too_short
    assert record["seconds_by_part"].keys() == {"optimisation", "scores and report"}
    assert record["options"]["max_gaussians"] == 70
    assert record["held_out"]["psnr"] == pytest.approx(scores.psnr)
    assert record["held_out"]["psnr_min"] == pytest.approx(scores.psnr_min)
    assert [one["name"] for one in record["held_out"]["per_view"]] == list(scores.views)
    mean = sum(one["ssim"] for one in record["held_out"]["per_view"]) / 3
    assert mean == pytest.approx(scores.ssim)
    assert [one["step"] for one in record["history"]] == [50, 100]
    assert record["stages_seconds"].keys() == result.stages.keys()
    assert record["input"]["training views"] == "11"
    assert record["input"]["start points"] == "60"
    assert {"splatseg", "torch", "python"} <= record.keys()

    text = (root / "reports" / "fit.html").read_text()
    page = Page(text)
    words = " ".join(page.words)
    assert page.tags.count("img") == 9 + 2, "three views in three pictures each, two maps"
    assert page.tags.count("svg") == 3
    assert "script" not in page.tags
    assert not re.search(r'(src|href)="(?!data:|#)', text), "nothing from elsewhere"
    worst = min(scores.per_view, key=lambda score: score.psnr)
    best = max(scores.per_view, key=lambda score: score.psnr)
    for expected in (
        f"worst: {worst.name}",
        f"best: {best.name}",
        f"{worst.psnr:.2f} dB, SSIM {worst.ssim:.3f}",
        f"{scores.psnr:.2f} dB",
        "11",
        "SSIM",
        "mean of 3 held-out views",
        "second worst" if len(scores.views) > 4 else "median",
        "1 min 02 s",
        "Cameras and points",
        "14 of 56x48",
        "max_gaussians",
        "as asked for, which is too short",
    ):
        assert expected in words, expected
    for stage in result.stages:
        assert re.search(rf"{stage}, \d+\.\d ms", words), stage


def test_an_interrupted_fit_is_not_scored(fitted) -> None:
    root, capture, result = fitted
    stopped = replace(result, interrupted=True)
    done, _ = score_and_report(
        root, capture, stopped, options=OPTIONS, backend="cpu", scoring=False
    )
    assert done.scores is None
    record = json.loads((root / "reports" / "fit.json").read_text())
    assert record["interrupted"] is True
    assert record["held_out"] is None
    words = " ".join(Page((root / "reports" / "fit.html").read_text()).words)
    assert "stopped early" in words
    assert "interrupted" in words
    assert "No held-out view was scored" in words


def test_one_held_out_view_and_none(fitted) -> None:
    root, capture, result = fitted
    for count, images in ((1, 3 + 2), (0, 2)):
        views = (*capture.train_views, *capture.test_views[:count])
        fewer = replace(capture, views=views)
        done, _ = score_and_report(
            root, fewer, replace(result, views=views), options=OPTIONS, backend="cpu", scoring=True
        )
        assert (done.scores is not None) == (count > 0)
        page = Page((root / "reports" / "fit.html").read_text())
        assert page.tags.count("img") == images


def test_too_short_for_a_curve_and_poses_that_were_found(fitted) -> None:
    root, capture, result = fitted
    (root / "capture").mkdir()
    report = PoseReport(
        photographs=12,
        registered=("a", "b"),
        left_out=(),
        mapper="global",
        tries=(),
        error=0.61234,
        longest=1600,
        points=9,
        track_length=2.5,
        lenses=(),
        seconds={"copies": 1.5, "features": 20.25, "mapping": 8.0},
    )
    content = {"format": "splatseg-poses", "version": 1, "made_of": "x", "report": asdict(report)}
    (root / "capture" / "poses.json").write_text(json.dumps(content))
    noted = replace(capture, notes=("sizes were <odd> & fixed",))
    short = replace(result, history=(), notes=("exposure +0.1",))
    score_and_report(root, noted, short, options=OPTIONS, backend="cpu", scoring=True)
    text = (root / "reports" / "fit.html").read_text()
    page = Page(text)
    assert page.tags.count("svg") == 0
    words = " ".join(page.words)
    for expected in ("sizes were <odd> & fixed", "exposure +0.1", "poses: mapper", "0.612"):
        assert expected in words
    for expected in ("29.8 s (copies 1.5, features 20.2, mapping 8.0)", "poses: seconds"):
        assert expected in words
    assert "<odd>" not in text
    assert json.loads((root / "reports" / "fit.json").read_text())["poses"] == json.loads(
        json.dumps(asdict(report))
    )
