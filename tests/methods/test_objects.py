"""The method `objects`: every Gaussian of an object has its vector."""

from dataclasses import replace

import pytest
import torch

from splatseg.core import Features
from splatseg.errors import InputError
from splatseg.io.scene import load_scene
from splatseg.lift.words import UnmixOptions
from splatseg.methods import find_method
from splatseg.methods.objects import ObjectFeaturesOptions
from splatseg.tasks import SegmentOptions, segment

FEATURES = SegmentOptions(evidence="features_text")


def made(scene, **options) -> Features:
    chosen = ObjectFeaturesOptions(masks="masks_sam", **options)
    layer = segment(scene, "objects", options=FEATURES, method_options=chosen).layer
    assert isinstance(layer, Features)
    return layer


@pytest.fixture(scope="module")
def scene(fitted_room):
    return load_scene(fitted_room)


def test_gaussians_of_an_object_have_one_vector(scene) -> None:
    layer = made(scene)
    info = layer.info
    assert info.method == "objects"
    assert info.options["masks"] == "masks_sam"
    distinct = torch.unique(layer.values[layer.weights > 0], dim=0)
    assert len(distinct) == info.details["objects"] > 5
    assert not layer.values[layer.weights == 0].any()
    # Cells that show an object, over all its Gaussians, are no more than there are.
    assert 0 < float(layer.weights.sum()) <= len(scene.train_views) * 30 * 40
    assert 0 < float(info.details["residual"]) < 1


def test_unmixing_counts(scene) -> None:
    usual = made(scene, unmixing=UnmixOptions(blur=0.0))
    for change in (UnmixOptions(blur=1.4), UnmixOptions(blur=0.0, ridge=50.0)):
        assert not torch.equal(made(scene, unmixing=change).values, usual.values)


def test_masks_are_needed(scene) -> None:
    options = find_method("objects").options()
    with pytest.raises(InputError, match="masks: expected evidence of masks"):
        segment(scene, "objects", options=FEATURES, method_options=options)
    with pytest.raises(InputError, match="masks: expected one of those at hand"):
        segment(scene, "objects", options=FEATURES, method_options=replace(options, masks="none"))
