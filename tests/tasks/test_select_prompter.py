"""Clicks that a promptable model turns into masks first: which one, and what of the rest."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from splatseg.core import InstanceTree, Labels, MaskSet, TreeNode
from splatseg.core.models import Embedding
from splatseg.errors import InputError
from splatseg.io.scene import load_scene, load_scene_layer, save_scene_layer
from splatseg.prompting.meanings import segmented_prompts
from splatseg.prompting.prompts import AxisBox, ViewPrompt
from splatseg.tasks import SelectOptions, select
from splatseg.tasks.see import prompter_of


class Squares:
    """Answers any prompt by squares round its first point; the middle size is the best."""

    name, settings, note = "squares", {}, "of a test"

    def __init__(self, sides=(6, 3, 12)) -> None:
        self.sides, self.asked = sides, []

    def embed(self, image) -> Embedding:
        return Embedding(model="squares", height=image.shape[0], width=image.shape[1], arrays={})

    def prompted_masks(self, embedding, prompt) -> MaskSet:
        self.asked.append(prompt)
        x, y = (int(v) for v in (prompt.points[0] if len(prompt.points) else prompt.box[:2]))
        dense = torch.zeros(len(self.sides), embedding.height, embedding.width, dtype=torch.bool)
        for mask, side in zip(dense, self.sides, strict=True):
            mask[max(0, y - side) : y + side + 1, max(0, x - side) : x + side + 1] = True
        return MaskSet.from_dense(dense)


@pytest.fixture
def room(fitted_room: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(fitted_room, tmp_path / "room"))


@pytest.fixture
def view(room):
    return load_scene(room).train_views[0]


@pytest.mark.parametrize(
    ("granularity", "side"), [(None, 6), (0.5, 6), (0.25, 12), (0.0, 12), (0.75, 3), (1.0, 3)]
)
def test_the_best_mask_stands_for_a_click_or_the_one_of_a_granularity(
    view, granularity, side
) -> None:
    click = ViewPrompt(view=view, points=[[40, 30], [60, 50]], positive=[True, False])
    (found,) = segmented_prompts([click], Squares(), granularity=granularity)
    assert isinstance(found, ViewPrompt)
    assert int(found.mask.sum()) == (2 * side + 1) ** 2
    assert bool(found.mask[30 - side, 40 + side])
    # The mask stands for what is on the thing; what is not stays.
    assert (found.points.tolist(), found.signs.tolist()) == ([[60, 50]], [False])
    assert found.box is None


def test_the_model_is_asked_with_all_points_and_the_box_of_a_prompt(view) -> None:
    model = Squares()
    click = ViewPrompt(
        view=view, points=[[40, 30], [60, 50]], positive=[True, False], box=[20, 10, 70, 60]
    )
    segmented_prompts([click], model, granularity=None)
    (asked,) = model.asked
    assert asked.points.tolist() == [[40, 30], [60, 50]]
    assert asked.signs.tolist() == [True, False]
    assert asked.box.tolist() == [20, 10, 70, 60]
    (found,) = segmented_prompts(
        [ViewPrompt(view=view, box=[20, 10, 70, 60])], model, granularity=None
    )
    assert int(found.mask.sum()) == 13 * 13


def test_prompts_that_say_where_the_thing_is_are_left_alone(view) -> None:
    camera = view.camera
    mask = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    mask[20:40, 20:40] = True
    model = Squares()
    given = [
        ViewPrompt(view=view, mask=mask, points=[[30, 30]]),
        ViewPrompt(view=view, scribble=mask),
        ViewPrompt(view=view, points=[[30, 30]], positive=[False]),
        AxisBox(low=(0, 0, 0), high=(1, 1, 1)),
    ]
    assert segmented_prompts(given, model, granularity=None) == tuple(given)
    assert not model.asked


def test_nothing_found_and_no_photograph_are_said(view) -> None:
    from dataclasses import replace

    click = ViewPrompt(view=view, points=[[40, 30]])
    with pytest.raises(InputError, match=f"in view {view.name}, squares found none"):
        segmented_prompts([click], Squares(sides=()), granularity=None)
    blind = ViewPrompt(view=replace(view, image=None), points=[[40, 30]])
    with pytest.raises(InputError, match="a view with a photograph, which squares sees"):
        segmented_prompts([blind], Squares(), granularity=None)


def test_a_selection_is_made_of_the_mask_and_says_by_whom(room) -> None:
    """Left and right of the middle of the view are two things; the mask lies on the right one."""
    scene = load_scene(room)
    view = scene.train_views[0]
    pixels, depth = view.camera.project(scene.gaussians.means.double())
    right = (pixels[:, 0] > view.camera.width / 2) & (depth > 0)
    ids = torch.where(right, 2, 1).int()
    tree = InstanceTree(
        nodes=(TreeNode(id=1), TreeNode(id=2)),
        labels=Labels(ids=ids, confidence=torch.ones(len(ids))),
    )

    class Other(Squares):
        def prompted_masks(self, embedding, prompt) -> MaskSet:
            dense = torch.zeros(1, embedding.height, embedding.width, dtype=torch.bool)
            dense[:, :, embedding.width // 2 :] = True
            return MaskSet.from_dense(dense)

    click = ViewPrompt(view=view, points=[[view.camera.width / 4, view.camera.height / 2]])
    options = SelectOptions(post_processing="none")
    layers = {"sides": tree}
    plain = select(scene, click, layers=layers, options=options)
    asked = select(scene, click, layers=layers, options=options, prompter=Other())
    assert not bool(plain.selection.mask[right].any())
    assert float(asked.selection.mask[right].float().mean()) > 0.9
    assert not bool(asked.selection.mask[~right].any())
    assert plain.selection.info.options["prompter"] is None
    assert asked.selection.info.options["prompter"] == "squares"
    assert asked.selection.info.details["prompts"] == plain.selection.info.details["prompts"]
    assert asked.seconds["prompter"] > 0


def test_recorded_masks_answer_by_name_and_by_folder(room) -> None:
    scene = load_scene(room)
    view = scene.train_views[0]
    click = ViewPrompt(view=view, points=[[view.camera.width / 2, view.camera.height / 2]])
    found = [
        segmented_prompts([click], prompter_of(named, scene, report=print), granularity=None)[
            0
        ].mask
        for named in ("masks_sam", str(scene.source / "masks_sam"))
    ]
    assert torch.equal(*found)
    x, y = (int(v) for v in click.points[0])
    assert bool(found[0][y, x])
    with pytest.raises(InputError, match="expected a model that answers points, got features_dino"):
        prompter_of("features_dino", scene, report=print)
    with pytest.raises(InputError, match="a file or folder of recorded evidence, got 'masks_sma'"):
        prompter_of("masks_sma", scene, report=print)


def test_the_command_asks_the_prompter(room, capsys) -> None:
    from splatseg.cli import main

    scene = load_scene(room)
    count = len(scene.gaussians)
    labels = Labels(ids=torch.ones(count, dtype=torch.int32), confidence=torch.ones(count))
    save_scene_layer(labels, room, "all")
    words = ["select", room, "--view", scene.train_views[0].name, "--point", "80,60", "--json"]
    words += ["--from-layer", "all", "--prompter", "classical", "--device", "cpu"]
    assert main([str(word) for word in words]) == 0
    assert "prompter" in json.loads(capsys.readouterr().out)["stage_seconds"]
    assert load_scene_layer(room, "selection").info.options["prompter"] == "classical"
