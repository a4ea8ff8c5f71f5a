"""Labels are put on what looks like its photographs, and a warning on what does not."""

from dataclasses import replace

import pytest
import torch

from splatseg.io.images import save_png
from splatseg.report.fit_report import MIN_PSNR
from splatseg.tasks import SegmentOptions, segment
from splatseg.tasks.segment_inputs import fit_quality
from support.observers import Stopping

ASKED = SegmentOptions(evidence="labels_semantic")


class Noting(Stopping):
    """Keeps notes."""

    def note(self, message: str) -> None:
        self.heard.append(message)


def dimmed(scene, share: float):
    """The scene with its Gaussians nearly transparent: it looks like a poor fit."""
    gaussians = scene.gaussians.replace(opacities=share * scene.gaussians.opacities)
    return replace(scene, gaussians=gaussians)


def like_its_photographs(scene, folder):
    """The scene with renders for photographs: no fit could be better."""
    from splatseg.render import render

    views = []
    for view in scene.views:
        image = folder / f"{view.name}.png"
        save_png(render(scene.gaussians, view.camera, backend="cpu").image.clamp(0, 1), image)
        views.append(replace(view, image=image))
    return replace(scene, views=tuple(views))


def test_a_poor_fit_is_told_with_the_threshold(scene) -> None:
    poor = dimmed(scene, 0.02)
    quality = fit_quality(poor, backend="cpu")
    assert quality is not None
    assert quality.psnr < MIN_PSNR
    assert (quality.views, quality.held_out) == (2, True)
    observer = Noting()
    made = segment(poor, "uplift", options=ASKED, backend="cpu", observer=observer)
    (warning,) = made.warnings
    assert f"{quality.psnr:.1f} dB PSNR on 2 held-out views" in warning
    assert "below 20 dB" in warning
    assert any(warning.rstrip(".") == heard for heard in observer.heard)
    assert "check fit" in made.timings


def test_a_good_fit_is_not(scene, tmp_path) -> None:
    observer = Noting()
    good = like_its_photographs(scene, tmp_path)
    made = segment(good, "uplift", options=ASKED, backend="cpu", observer=observer)
    assert made.warnings == ()
    assert not [heard for heard in observer.heard if "dB" in heard]


def test_training_views_are_looked_at_where_none_is_held_out(scene) -> None:
    train = replace(scene, views=scene.train_views)
    quality = fit_quality(train, backend="cpu")
    assert quality is not None
    assert (quality.views, quality.held_out) == (5, False)
    assert quality.warning is None or "training views" in quality.warning


def test_nothing_to_compare_with(scene, tmp_path) -> None:
    bare = replace(scene, views=tuple(replace(view, image=None) for view in scene.views))
    assert fit_quality(bare, backend="cpu") is None
    gone = tuple(replace(view, image=tmp_path / "no.png") for view in scene.views)
    assert fit_quality(replace(scene, views=gone), backend="cpu") is None


def test_a_photograph_that_cannot_be_read_is_told_and_labels_are_made(scene, tmp_path) -> None:
    broken = tmp_path / "broken.jpg"
    broken.write_bytes(b"no photograph")
    views = tuple(
        replace(view, image=broken) if view.split == "test" else view for view in scene.views
    )
    made = segment(replace(scene, views=views), "uplift", options=ASKED, backend="cpu")
    (warning,) = made.warnings
    assert "was not held against its photographs" in warning
    assert "broken.jpg" in warning
    assert bool((made.labels.ids >= 0).any())


@pytest.mark.parametrize("longest", [None, 24])
def test_scores_of_reduced_photographs(scene, longest) -> None:
    from splatseg.evaluate.photographs import render_and_photograph
    from splatseg.lift import GaussianField

    view = scene.views[0]
    shapes = {
        tuple(image.shape)
        for image in render_and_photograph(
            GaussianField(scene.gaussians, backend="cpu"), view, longest=longest
        )
    }
    assert shapes == {(48, 64, 3) if longest is None else (18, 24, 3)}
    assert torch.is_tensor(scene.gaussians.means)
