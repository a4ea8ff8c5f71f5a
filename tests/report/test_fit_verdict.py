"""What is said of a fit: too short, poor, or good enough, and of how many views."""

import pytest

from splatseg.evaluate import PhotographReport
from splatseg.evaluate.photographs import ViewScore
from splatseg.fit import sensible_steps
from splatseg.report.fit_report import MIN_PSNR, fit_verdict, scored_of


def scores(*values: float) -> PhotographReport:
    rows = tuple(ViewScore(name=f"v{i}", psnr=p, ssim=0.5) for i, p in enumerate(values))
    return PhotographReport(
        psnr=sum(values) / len(values),
        psnr_min=min(values),
        ssim=0.5,
        views=tuple(row.name for row in rows),
        per_view=rows,
    )


def judged(steps: int, found: PhotographReport | None, *, views: int = 60, **words):
    given = {"interrupted": False, "held_out": 2} | words
    return fit_verdict(steps=steps, train_views=views, scores=found, **given)


def test_what_makes_sense_grows_with_the_views() -> None:
    assert sensible_steps(1) == sensible_steps(50) == 1000
    assert sensible_steps(60) == 1200
    assert sensible_steps(300) == 6000


def test_seven_steps_are_too_few_however_good_they_look() -> None:
    said = judged(7, scores(31.0, 28.0))
    assert (said.words, said.too_short, said.warns) == ("Too short", True, True)
    assert "7 steps done, where 1200 or more make sense for 60 training views" in said.sentence
    assert "--steps 1200" in said.sentence
    assert (
        "PSNR 29.50 dB, SSIM 0.500 on 2 held-out views; the worst, v1, has 28.00" in said.sentence
    )
    assert judged(1199, None).too_short
    assert not judged(1200, None).too_short


def test_a_stopped_fit_is_told_to_go_on() -> None:
    said = judged(1, None, interrupted=True, views=1)
    assert "1 step done" in said.sentence
    assert "1 training view;" in said.sentence
    assert "--resume" in said.sentence


@pytest.mark.parametrize(("psnr", "words"), [(MIN_PSNR - 0.1, "Poor"), (MIN_PSNR, "Good enough")])
def test_renders_unlike_the_photographs_are_poor(psnr: float, words: str) -> None:
    said = judged(5000, scores(psnr, psnr))
    assert said.words.startswith(words)
    assert said.warns == (words == "Poor")


def test_of_how_many_views_scores_are() -> None:
    assert scored_of(scores(20.0), 1) == "1 held-out view"
    assert scored_of(scores(20.0, 21.0), 12) == "2 of 12 held-out views"
    assert judged(5000, None).words == "Not judged"
