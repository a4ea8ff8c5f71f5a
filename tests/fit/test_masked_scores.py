"""Held-out views are scored where their masks keep them."""

from dataclasses import replace

import pytest
import torch

from splatseg.errors import InputError
from splatseg.evaluate import evaluate_photographs
from splatseg.io.images import load_image, save_png
from splatseg.lift import GaussianField


@pytest.fixture
def spoilt(scene_photographed, photograph, tmp_path):
    """Views whose left third is black in the photograph and masked out, and one masked whole."""
    capture = photograph()
    views = []
    for number, view in enumerate(capture.views[:3]):
        pixels = load_image(view)
        third = pixels.shape[1] // 3
        pixels[:, :third] = 0
        image, mask = tmp_path / f"{view.name}.png", tmp_path / f"{view.name}_mask.png"
        keep = torch.ones(pixels.shape[:2])
        keep[:, : third if number else None] = 0
        save_png(pixels, image)
        save_png(keep, mask)
        views.append(replace(view, image=image, mask=mask))
    return views


def test_views_are_scored_where_their_masks_keep_them(spoilt, scene_photographed) -> None:
    as_they_are = evaluate_photographs(GaussianField(scene_photographed), spoilt)
    kept = evaluate_photographs(GaussianField(scene_photographed), spoilt, masks="ignore")
    assert len(as_they_are.views) == 3
    assert kept.views == tuple(view.name for view in spoilt[1:])
    assert kept.psnr_min > as_they_are.psnr + 3
    assert kept.ssim > as_they_are.ssim + 0.2
    with pytest.raises(InputError, match="masks keep none of 1"):
        evaluate_photographs(GaussianField(scene_photographed), spoilt[:1], masks="ignore")


def test_time_that_is_up_ends_the_scoring_after_one_view(spoilt, scene_photographed) -> None:
    assert (
        len(evaluate_photographs(GaussianField(scene_photographed), spoilt, seconds=0.0).views) == 1
    )
