"""The method as `segment` runs it, on a generated room."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from splatseg.cli import main
from splatseg.core import Labels, with_info
from splatseg.errors import InputError
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.methods.object_classes import ObjectLabelOptions
from splatseg.tasks import report_layer, save_segmentation
from splatseg.tasks.segment import SegmentOptions, segment

LABELS = SegmentOptions(evidence="labels_semantic")
TRACKS = SegmentOptions(evidence="labels_tracked")


@pytest.fixture(scope="module")
def scene(fitted_room, tmp_path_factory) -> Path:
    return Path(shutil.copytree(fitted_room, tmp_path_factory.mktemp("classes") / "scene"))


def test_classes_by_objects_and_features(scene, capsys) -> None:
    words = ["segment", str(scene), "--method", "object-classes", "--evidence", "labels_semantic"]
    assert main(words) == 2
    assert "masks: expected evidence of masks" in capsys.readouterr().err
    words += ["--masks", "masks_sam", "--features", "features_dino", "--layer", "classes"]
    assert main(words) == 0
    layer = load_scene_layer(scene, "classes")
    assert isinstance(layer, Labels)
    assert layer.info.method == "object-classes"
    known = load_scene(scene).classes
    assert known is not None
    assert {id for id in layer.ids.tolist() if id >= 0} <= {row.id for row in known.rows}
    assert float((layer.ids >= 0).float().mean()) > 0.95


def test_objects_of_tracks_have_classes(scene) -> None:
    options = ObjectLabelOptions(features="features_dino", masks="masks_sam")
    layer = segment(
        load_scene(scene), "object-classes", options=TRACKS, method_options=options
    ).layer
    assert isinstance(layer, Labels)
    present = {id for id in layer.ids.tolist() if id >= 0}
    assert len(present) > 5
    assert set(layer.info.class_of) <= present | set(layer.info.names)
    assert layer.info.class_of


def test_what_is_missing_is_told_in_one_sentence(scene) -> None:
    with pytest.raises(InputError, match="masks: expected evidence of masks, such as masks_sam"):
        segment(load_scene(scene), "object-classes", options=LABELS)
    wrong = ObjectLabelOptions(features="masks_sam", masks="masks_sam")
    with pytest.raises(InputError, match="features: expected evidence of features, got 'masks_sa"):
        segment(load_scene(scene), "object-classes", options=LABELS, method_options=wrong)
    nothing = ObjectLabelOptions(features="nothing", masks="masks_sam")
    with pytest.raises(
        InputError, match="^features: expected one of those at hand .*masks_sam.*'nothing'"
    ):
        segment(load_scene(scene), "object-classes", options=LABELS, method_options=nothing)


def test_panoptic_segments_become_objects_with_classes(scene) -> None:
    """No other masks are named: the segments themselves are associated."""
    shared = SegmentOptions(evidence="labels_panoptic")
    options = ObjectLabelOptions(features="features_dino")
    layer = segment(
        load_scene(scene), "object-classes", options=shared, method_options=options
    ).layer
    assert isinstance(layer, Labels)
    present = {id for id in layer.ids.tolist() if id >= 0}
    known = {row.id for row in load_scene(scene).classes.rows}
    assert len(present) > 5
    assert set(layer.info.class_of.values()) <= known
    assert set(layer.info.class_of) >= present


def test_layers_from_before_it_had_a_name_of_its_own_are_reported(scene) -> None:
    """They say that they are of cosseg, with an option that it has no more."""
    options = ObjectLabelOptions(masks="masks_sam")
    here = load_scene(scene)
    made = segment(here, "object-classes", options=LABELS, method_options=options)
    recorded = {**made.layer.info.options, "decide": "objects"}
    info = replace(made.layer.info, method="cosseg", options=recorded)
    old = replace(made, layer=with_info(made.layer, info), name="old")
    save_segmentation(old, scene)
    assert load_scene_layer(scene, "old").info == info
    page = report_layer(here, scene, old).read_text(encoding="utf-8")
    assert "cosseg" in page
    assert "decide" in page
