"""Words become a selection, from Python and from the command line."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from splatseg.cli import main
from splatseg.core import Features, LayerInfo, Selection
from splatseg.core.models import GroundedMasks, PromptableMasks, TextFeatures
from splatseg.errors import InputError
from splatseg.io.evidence import FeatureEvidence, open_evidence
from splatseg.io.scene import load_scene, load_scene_layer, save_scene_layer
from splatseg.lift.vocabulary import vocabulary_of
from splatseg.methods.prompt import PromptOptions
from splatseg.prompting.prompts import Ball
from splatseg.tasks import (
    QueryOptions,
    SelectOptions,
    TextModels,
    TextOptions,
    query,
    select_text,
    text_prompts,
)

WORD = "table"


@pytest.fixture(scope="module")
def folder(fitted_room, tmp_path_factory) -> Path:
    return Path(shutil.copytree(fitted_room, tmp_path_factory.mktemp("text") / "scene"))


@pytest.fixture(scope="module")
def scene(folder):
    return load_scene(folder)


def options(**prompt) -> TextOptions:
    chosen = {"initial_views": 4, "min_probability": 0.0, "rounds": 1} | prompt
    return TextOptions(evidence="masks_sam", prompt=PromptOptions(**chosen))


@pytest.fixture(scope="module")
def table(scene):
    return select_text(scene, [WORD], options=options())


def test_a_selection_as_clicks_give_it(scene, table) -> None:
    assert isinstance(table.selection, Selection)
    assert table.source == "text"
    assert 0 < table.selection.count < len(scene.gaussians)
    confidence = table.selection.confidence
    assert confidence is not None
    assert torch.equal(table.selection.mask, confidence > 0.5)
    assert {"open", "find", "select", "filter", "fill_holes"} <= set(table.seconds)
    info = table.selection.info
    assert info.method == "prompt"
    assert info.evidence == "features_text"
    assert info.details["prompts"][0]["word"] == WORD
    again = select_text(scene, [WORD], options=options())
    assert torch.equal(again.selection.confidence, confidence)


def test_points_that_stood_for_words(scene, table) -> None:
    prompts = text_prompts(table.selection, scene)
    names = [prompt.view.name for prompt in prompts]
    assert names == sorted(names)
    assert set(names) <= set(table.selection.info.details["initial_views"])
    assert all(int(prompt.signs.sum()) == 2 for prompt in prompts)


def test_places_bound_and_earlier_selections_combine(scene, table) -> None:
    centre = scene.gaussians.means[table.selection.mask].median(dim=0).values.tolist()
    ball = Ball(centre=tuple(centre), radius=0.3)
    within = select_text(scene, [WORD], options=options(), places=[ball])
    inside = ball.contains(scene.gaussians)
    assert torch.equal(within.selection.mask, table.selection.mask & inside)
    base = Selection(mask=inside)
    added = select_text(
        scene, [WORD], options=options(), base=base, select_options=SelectOptions(mode="add")
    )
    assert torch.equal(added.selection.mask, table.selection.mask | inside)
    assert added.selection.info.details["mode"] == "add"
    with pytest.raises(InputError, match="base: expected a selection"):
        select_text(scene, [WORD], options=options(), base=base)


def test_steps_and_seed_count(scene, table) -> None:
    off = SelectOptions(post_processing="none")
    plain = select_text(scene, [WORD], options=options(), select_options=off)
    assert "filter" not in plain.seconds
    random = options(sampling="random", initial="random")
    seeds = [
        select_text(scene, [WORD], options=random, select_options=SelectOptions(seed=seed))
        for seed in (1, 2)
    ]
    records = [one.selection.info.details["prompts"] for one in seeds]
    assert records[0] != records[1]
    assert [one.selection.info.seed for one in seeds] == [1, 2]


def test_what_is_asked_for_is_there(scene) -> None:
    with pytest.raises(InputError, match="evidence: expected one of those at hand"):
        select_text(scene, [WORD], options=TextOptions(evidence="nothing"))
    with pytest.raises(InputError, match="evidence: expected one of the sets of masks by name"):
        select_text(scene, [WORD], options=TextOptions(features="features_text"))
    with pytest.raises(InputError, match="features: expected features"):
        select_text(scene, [WORD], options=TextOptions(features="masks_sam", evidence="masks_sam"))
    with pytest.raises(InputError, match="evidence: expected masks or segments"):
        select_text(scene, [WORD], options=TextOptions(evidence="features_dino"))
    with pytest.raises(InputError, match="recorded words, got 'tabel'; near are 'table'"):
        select_text(scene, ["tabel"], options=options())
    with pytest.raises(InputError, match="words: expected words or phrases, got none"):
        select_text(scene, [], options=options())


class Everything:
    """A grounder, prompter and encoder that answers with the middle of the image."""

    name, note = "everything", ""
    settings: dict[str, int] = {}  # noqa: RUF012

    def __init__(self) -> None:
        self.asked: list[str] = []

    def grounded_masks(self, image, words):
        from splatseg.core.models import TextMasks

        self.asked += words
        return TextMasks(masks=self._middle(*image.shape[:2]), words=(0,))

    def embed(self, image):
        from splatseg.core.models import Embedding

        height, width = image.shape[:2]
        return Embedding(model=self.name, height=height, width=width, arrays={})

    def prompted_masks(self, embedding, prompt):
        return self._middle(embedding.height, embedding.width)

    def text_features(self, image):
        raise NotImplementedError

    def encode_text(self, words):
        vectors = torch.zeros(len(words), 32)
        vectors[:, 0] = 1
        return vectors

    @staticmethod
    def _middle(height, width):
        from splatseg.core import MaskSet

        mask = torch.zeros(1, height, width, dtype=torch.bool)
        mask[:, height // 3 : 2 * height // 3, width // 3 : 2 * width // 3] = True
        return MaskSet.from_dense(mask)


def test_models_answer_instead_of_what_was_recorded(scene) -> None:
    model = Everything()
    assert isinstance(model, GroundedMasks | PromptableMasks | TextFeatures)
    both = TextModels(grounder=model, prompter=model)
    made = select_text(scene, ["anything at all"], options=TextOptions(), models=both)
    assert model.asked == ["anything at all"] * len(made.selection.info.details["initial_views"])
    assert made.selection.info.evidence is None
    asked = replace(options(), features="features_text")
    encoded = select_text(scene, ["anything"], options=asked, models=TextModels(encoder=model))
    assert encoded.selection.count > 0


def test_text_from_the_command_line(folder, tmp_path, capsys) -> None:
    words = ("select", folder, "--text", WORD, "--evidence", "masks_sam", "--layer", "tables",
             "--picture", tmp_path / "found", "--json")  # fmt: skip
    assert main([str(word) for word in words]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["source"] == "text"
    assert said["words"][0]["word"] == WORD
    layer = load_scene_layer(folder, "tables")
    assert isinstance(layer, Selection)
    assert layer.count == said["selected"]
    assert len(said["pictures"]) >= 1
    assert main([str(word) for word in (*words[:-3], "--objects", "all", "--quiet")]) == 0
    assert f"{WORD}: " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--text", WORD, "--view", "train_0000", "--point", "9,9"), "text: goes with places"),
        (("--text", WORD, "--source", "layer"), "go with clicks"),
        (("--text", WORD, "--grounder", "classical"), "a model that finds words in images"),
        (("--text", WORD, "--encoder", "classical"), "a model that encodes words"),
        (("--text", WORD, "--features", "masks_sam"), "expected features"),
        (("--objects", "all", "--sphere", "0", "0", "0", "1"), "goes with --text"),
        (("--grounder", "classical", "--sphere", "0", "0", "0", "1"), "goes with --text"),
        ((), "--like or --text, got none"),
    ],
)
def test_bad_command_lines(folder, capsys, flags, message) -> None:
    assert main(["select", str(folder), "--evidence", "masks_sam", *flags]) == 2
    assert message in capsys.readouterr().err


def test_masks_are_asked_for_by_the_option_that_select_has(folder, capsys) -> None:
    assert main(["select", str(folder), "--text", WORD]) == 2
    said = capsys.readouterr().err
    assert (
        "--evidence: expected one of the sets of masks by name (masks_nested, masks_sam), got none"
        in said
    )


@pytest.fixture(scope="module")
def things(folder, scene) -> Path:
    """The scene with a layer `objects`: two chairs at either end, and a table between them."""
    evidence = open_evidence(scene.source / "features_text")
    assert isinstance(evidence, FeatureEvidence)
    vocabulary = vocabulary_of(evidence)
    space = vocabulary.space
    vectors = vocabulary.vectors(["chair", WORD, "chair"])
    values = (vectors - space.mean) @ space.basis.T if space.basis is not None else vectors
    values[2] *= 1 + 1e-6
    place = scene.gaussians.means[:, 0].argsort().argsort() * 3 // len(scene.gaussians)
    layer = Features(
        values=values[place],
        weights=torch.ones(len(place)),
        info=LayerInfo(method="objects", evidence="features_text", options={"masks": "masks_sam"}),
    )
    made = Path(shutil.copytree(folder, folder.parent / "things"))
    save_scene_layer(layer, made, "objects")
    return made


def test_a_phrase_that_refers_selects_its_object(things) -> None:
    scene = load_scene(things)
    place = scene.gaussians.means[:, 0].argsort().argsort() * 3 // len(scene.gaussians)
    off = SelectOptions(post_processing="none")
    ends = []
    for view in scene.train_views:
        chosen = replace(options(), view=view.name)
        phrase = f"the chair left of the {WORD}"
        answers = query(
            scene, [phrase], options=QueryOptions(features="features_text", view=view.name)
        )
        if answers.references[phrase].status != "found":
            with pytest.raises(InputError, match=f"{phrase}: "):
                select_text(scene, [phrase], options=chosen, select_options=off)
            continue
        made = select_text(scene, [phrase], options=chosen, select_options=off)
        (record,) = made.selection.info.details["prompts"]
        assert record["status"] == "found"
        assert f"left of {WORD} " in record["explanation"]
        assert f"from view {view.name}" in record["explanation"]
        assert made.selection.info.method == "query"
        assert text_prompts(made.selection, scene) == ()
        members = place[made.selection.mask].unique().tolist()
        assert len(members) == 1
        assert int(made.selection.mask.sum()) == int((place == members[0]).sum())
        ends += members
    assert set(ends) <= {0, 2}
    assert ends


def test_ambiguous_phrases_are_errors_unless_all_are_wanted(things) -> None:
    scene = load_scene(things)
    off = SelectOptions(post_processing="none")
    with pytest.raises(InputError, match="ambiguous, 2 candidates: chair .*--objects all"):
        select_text(scene, ["the one chair"], options=options())
    with pytest.raises(InputError, match="nothing, expected 3, found 2"):
        select_text(scene, ["three chairs"], options=options(objects="all"))
    both = select_text(scene, ["the one chair"], options=options(objects="all"), select_options=off)
    two = select_text(scene, ["two chairs"], options=options(), select_options=off)
    assert torch.equal(both.selection.mask, two.selection.mask)
    place = scene.gaussians.means[:, 0].argsort().argsort() * 3 // len(scene.gaussians)
    assert torch.equal(two.selection.mask, place != 1)


def test_words_and_phrases_together(things, table) -> None:
    scene = load_scene(things)
    off = SelectOptions(post_processing="none")
    word = select_text(scene, [WORD], options=options(), select_options=off)
    phrase = select_text(scene, ["two chairs"], options=options(), select_options=off)
    both = select_text(scene, [WORD, "two chairs"], options=options(), select_options=off)
    assert torch.equal(both.selection.mask, word.selection.mask | phrase.selection.mask)
    records = both.selection.info.details["prompts"]
    assert [one["word"] for one in records] == [WORD, "two chairs"]
    # A grounder reads phrases itself.
    model = Everything()
    select_text(
        scene,
        ["two chairs"],
        options=options(),
        models=TextModels(grounder=model, prompter=model),
    )
    assert set(model.asked) == {"two chairs"}


def test_the_command_selects_by_a_phrase(things, capsys) -> None:
    call = ["select", str(things), "--evidence", "masks_sam", "--layer", "ends", "--text"]
    assert main([*call, "two chairs"]) == 0
    out = capsys.readouterr().out
    assert "two chairs: chair " in out
    assert main([*call, "two chairs", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["references"][0]["status"] == "found"
    assert facts["words"] == []
    assert main([*call, "the one chair"]) == 2
    err = capsys.readouterr().err
    assert "ambiguous, 2 candidates" in err
    assert err.count("\n") == 1
    assert main([*call, "the one chair", "--objects", "all"]) == 0
    view = load_scene(things).train_views[0].name
    capsys.readouterr()
    main([*call, f"the {WORD} left of the chairs", "--view", view])
    captured = capsys.readouterr()
    assert f"from view {view}" in captured.out + captured.err
