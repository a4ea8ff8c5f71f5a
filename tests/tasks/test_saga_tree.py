"""SAGA read as a tree: trained for it, or from a layer of features; in Python and by command."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from splatseg.cli import main
from splatseg.core import Features, InstanceTree
from splatseg.errors import InputError
from splatseg.io.layers import load_layer
from splatseg.io.scene import load_scene
from splatseg.methods import find_method
from splatseg.methods.saga import SagaOptions
from splatseg.methods.saga.decomposition import DecomposeOptions, decompose
from splatseg.tasks import SegmentOptions, segment


def run(capsys, *words: object) -> tuple[int, str]:
    status = main([str(word) for word in words])
    output = capsys.readouterr()
    return status, output.out + output.err


TRAINING = {"steps": 6, "batch": 200, "held_out": 0.0}
QUICK = [f"--{name.replace('_', '-')}={value}" for name, value in TRAINING.items()]
LOOSE = ["--object-increase", 0.02, "--part-increase", 0.05]


@pytest.fixture(scope="module")
def scene(fitted_room, tmp_path_factory) -> Path:
    """A scene with a layer of features, ``saga``."""
    folder = shutil.copytree(fitted_room, tmp_path_factory.mktemp("tree") / "scene")
    words = ["segment", folder, "--method", "saga", "--evidence", "masks_sam", *QUICK]
    assert main([str(word) for word in (*words, "--layer", "saga", "--quiet")]) == 0
    return folder


def test_a_layer_of_features_is_decomposed_without_training(scene, capsys) -> None:
    asked = ("segment", scene, "--method", "saga", "--readout", "tree", "--features", "saga")
    status, said = run(capsys, *asked, *LOOSE, "--layer", "tree", "--no-complete", "--json",
                       "--export", "--report")  # fmt: skip
    assert status == 0, said
    made = json.loads(said.splitlines()[0])
    tree, features = load_layer(Path(made["file"])), load_layer(scene / "layers" / "saga.npz")
    assert isinstance(tree, InstanceTree)
    assert isinstance(features, Features)
    assert made["kind"] == "tree"
    assert (tree.info.method, tree.info.evidence) == ("saga", "masks_sam")
    assert tree.info.views == features.info.views
    own = decompose(
        load_scene(scene).gaussians, features,
        options=DecomposeOptions(object_increase=0.02, part_increase=0.05),
    )  # fmt: skip
    assert own.nodes == tree.nodes
    assert torch.equal(own.labels.ids, tree.labels.ids)
    assert (scene / "reports" / "tree.html").is_file()
    status, said = run(capsys, "render", scene, "--what", "tree@part", "-o", scene / "drawn",
                       "--quiet")  # fmt: skip
    assert status == 0, said


def test_a_training_can_be_read_at_once(scene) -> None:
    """And its tree is that of the features that the same training gives."""
    opened = load_scene(scene)
    made = segment(
        opened,
        "saga",
        options=SegmentOptions(evidence="masks_sam", layer="new", complete=False),
        method_options=SagaOptions(**TRAINING, readout="tree"),
    )
    features = load_layer(scene / "layers" / "saga.npz")
    assert isinstance(features, Features)
    assert isinstance(made.layer, InstanceTree)
    expected = decompose(opened.gaussians, features)
    assert torch.equal(made.layer.labels.ids, expected.labels.ids)


def test_gaussians_that_no_view_shows_are_completed(scene) -> None:
    opened = load_scene(scene)
    features = load_layer(scene / "layers" / "saga.npz")
    assert isinstance(features, Features)
    assert features.weights is not None
    weights = features.weights.clone()
    weights[:20] = 0
    hidden = Features(values=features.values, weights=weights, info=features.info)
    made = segment(
        opened, "saga", options=SegmentOptions(evidence="masks_sam"), layers={"hidden": hidden},
        method_options=SagaOptions(readout="tree", features="hidden"),
    )  # fmt: skip
    assert isinstance(made.layer, InstanceTree)
    assert made.layer.labels.inferred is not None
    assert bool(made.layer.labels.inferred[:20].any())


def test_what_is_not_there_or_no_features_is_refused(scene, capsys) -> None:
    with pytest.raises(InputError, match="--readout tree"):
        SagaOptions(features="saga")
    with pytest.raises(InputError, match="readout"):
        SagaOptions(readout="leaves")
    asked = ("segment", scene, "--method", "saga", "--evidence", "masks_sam", "--layer", "x")
    status, said = run(capsys, *asked, "--readout", "tree", "--features", "no")
    assert status == 2
    assert "no" in said
    status, said = run(capsys, *asked, "--export")
    assert status == 2
    assert "saga gives features" in said
    status, _ = run(capsys, "segment", scene, "--method", "features", "--evidence",
                    "features_dino", "--layer", "dino", "--quiet")  # fmt: skip
    assert status == 0
    status, said = run(capsys, *asked, "--readout", "tree", "--features", "dino")
    assert status == 2
    assert "expected a layer of affinity features" in said


def test_a_layer_of_labels_is_refused(scene) -> None:
    opened = load_scene(scene)
    features = load_layer(scene / "layers" / "saga.npz")
    assert isinstance(features, Features)
    labels = decompose(opened.gaussians, features).cut()
    with pytest.raises(InputError, match="expected a layer of features, got 'ids' of labels"):
        segment(
            opened, "saga", options=SegmentOptions(evidence="masks_sam"), layers={"ids": labels},
            method_options=SagaOptions(readout="tree", features="ids"),
        )  # fmt: skip


def test_a_method_says_what_it_gives() -> None:
    method = find_method("saga")
    assert method.gives(SagaOptions()) == "features"
    assert method.gives(SagaOptions(readout="tree")) == "tree"
    assert find_method("associate").gives(None) == "labels"
