"""The method from `segment`, from Python and from the command line."""

import json
import shutil
from pathlib import Path

import pytest

from splatseg.cli import main
from splatseg.core import Selection
from splatseg.errors import InputError
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.methods.prompt import PromptOptions
from splatseg.tasks import SegmentOptions, segment


@pytest.fixture(scope="module")
def folder(fitted_room, tmp_path_factory) -> Path:
    return Path(shutil.copytree(fitted_room, tmp_path_factory.mktemp("prompt") / "scene"))


def test_words_from_the_command_line(folder, capsys) -> None:
    words = ("segment", folder, "--method", "prompt", "--evidence", "features_text", "--masks",
             "masks_sam", "--words", "table", "--layer", "tables", "--initial-views", 4,
             "--min-probability", 0, "--json")  # fmt: skip
    assert main([str(word) for word in words]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["kind"] == "selection"
    assert 0 < said["selected"] < said["gaussians"]
    layer = load_scene_layer(folder, "tables")
    assert isinstance(layer, Selection)
    assert layer.count == said["selected"]
    assert layer.info.method == "prompt"
    assert len(layer.info.details["initial_views"]) == 4
    assert all(name.startswith("train") for name in layer.info.details["initial_views"])
    assert main([*(str(word) for word in words[:-1])]) == 0
    assert f"{layer.count} of {len(layer)} Gaussians" in capsys.readouterr().out


def test_published_from_the_command_line(folder, capsys) -> None:
    words = ("segment", folder, "--method", "prompt", "--evidence", "masks_sam", "--point",
             "train_0000:160,150", "--published", "--layer", "hand", "--view-share", 1)  # fmt: skip
    assert main([str(word) for word in words]) == 0
    layer = load_scene_layer(folder, "hand")
    assert layer.info.options["vote"] == "published"
    assert layer.info.options["view_share"] == 1.0
    capsys.readouterr()
    assert main([str(word) for word in (*words, "--export")]) == 2
    assert "gives selection" in capsys.readouterr().err


def test_models_by_name(folder) -> None:
    scene = load_scene(folder)
    options = SegmentOptions(evidence="masks_sam")
    by_hand = PromptOptions(point=("train_0000:160,150",), view_share=0.2, rounds=1)
    made = segment(
        scene,
        "prompt",
        options=options,
        method_options=PromptOptions(
            point=by_hand.point, view_share=0.2, rounds=1, prompter="classical"
        ),
    ).layer
    assert isinstance(made, Selection)
    assert made.info.options["prompter"] == "classical"
    with pytest.raises(InputError, match="grounder: expected a model that is a GroundedMasks"):
        segment(
            scene,
            "prompt",
            options=options,
            method_options=PromptOptions(words=("table",), grounder="classical"),
        )
    with pytest.raises(InputError, match="encoder: expected a model that is a TextFeatures"):
        segment(
            scene,
            "prompt",
            options=options,
            method_options=PromptOptions(words=("table",), encoder="classical"),
        )
