"""From words, or points by hand, to a selection."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from methods.prompt.conftest import APPLE, PEAR, agreement
from splatseg.cli import main
from splatseg.core import Selection
from splatseg.errors import InputError, RangeError
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.methods import MethodInputs, find_method
from splatseg.methods.prompt import (
    PUBLISHED,
    PromptOptions,
    PromptSession,
    PromptSources,
    parsed_points,
    select,
    views,
)
from splatseg.tasks import SegmentOptions, segment


def test_words_select_their_thing(fruit) -> None:
    for word, id in (("apple", APPLE), ("pear", PEAR)):
        made = fruit.session().ask([word])
        assert agreement(made.confidence, fruit.ids == id) > 0.95
        (one,) = made.objects
        assert one.word == word
        assert one.projected == one.masked == 9
    both = fruit.session().ask(["apple", "pear"])
    assert agreement(both.confidence, fruit.ids < 3) > 0.95
    assert [one.word for one in both.objects] == ["apple", "pear"]


def test_the_same_whatever_the_order_of_views(fruit) -> None:
    def asked(views, **options):
        sources = PromptSources(features=fruit.features, masks=fruit.masks)
        session = PromptSession(
            fruit.gaussians, views, sources, options=PromptOptions(**options), seed=3
        )
        return session.ask(["apple"]).confidence

    for options in ({}, {"sampling": "random", "initial": "random"}):
        assert torch.equal(asked(fruit.views, **options), asked(fruit.views[::-1], **options))


@pytest.mark.parametrize(
    "change",
    [
        {"vote": "visible"},
        {"vote": "published"},
        {"threshold": 0.9},
        {"rounds": 1},
        {"view_share": 0.3},
        {"view_share": 0.3, "sampling": "random"},
    ],
)
def test_options_change_the_answer(fruit, change) -> None:
    base = {"view_share": 0.3} if "sampling" in change else {}
    usual = fruit.session(**base).ask(["wall"])
    other = fruit.session(**change).ask(["wall"])
    assert not torch.equal(usual.confidence, other.confidence) or "rounds" in change
    assert usual.mask_calls != other.mask_calls or "rounds" not in change


def test_points_are_recorded(fruit) -> None:
    def records(**options):
        (one,) = fruit.session(**options).ask(["apple"]).objects
        return one.record()["prompts"]

    usual = records()
    assert [place["view"] for place in usual] == [f"v{i}" for i in range(9)]
    assert all(len(place["points"]) == 2 for place in usual)
    assert all(len(place["negative_points"]) == 4 for place in usual)
    random = records(sampling="random")
    assert all(len(place["points"]) == 2 for place in random)
    assert all(not place["negative_points"] for place in random)
    assert random != usual
    assert len(records(initial="single")) == 1
    assert len(records(initial_views=2)) == 2
    assert len(records(initial="random", initial_views=3)) == 3


def test_hidden_points_are_not_given(fruit, monkeypatch) -> None:
    """Points on the wall that the apple hides from the left would rule out the apple's mask."""
    monkeypatch.setattr(select, "NEGATIVES", 8)
    counts = []
    for tolerance in (float("inf"), 0.05, 0.0):
        monkeypatch.setattr(select, "DEPTH_TOLERANCE", tolerance)
        counts.append(_points_given(fruit.session(rounds=1)))
    assert counts[0] > counts[1] > counts[2]


def _points_given(session: PromptSession) -> int:
    """How many points all views get."""
    given: list[int] = []
    maker = session._makers
    usual = maker.masks

    def counting(view, prompts, areas):
        given.extend(len(prompt.points) for prompt in prompts)
        return usual(view, prompts, areas)

    maker.masks = counting
    session.ask(["apple"])
    return sum(given)


def test_what_fits_no_mask_keeps_the_first_round(fruit) -> None:
    session = fruit.session(rounds=2)
    maker = session._makers
    usual = maker.masks

    def points_alone(view, prompts, areas):
        if any(prompt.mask is not None for prompt in prompts):
            return [None] * len(prompts)
        return usual(view, prompts, areas)

    maker.masks = points_alone
    found, once = session.ask(["apple"]), fruit.session(rounds=1).ask(["apple"])
    assert torch.equal(found.confidence, once.confidence)
    assert found.objects[0].masked == once.objects[0].masked == 9


def test_points_may_lie_in_views_that_are_not_used(fruit) -> None:
    sources = PromptSources(features=fruit.features, masks=fruit.masks)
    session = PromptSession(fruit.gaussians, fruit.views[:4], sources)
    pixel = torch.nonzero(fruit.truth(fruit.views[8]) == APPLE).double().mean(dim=0)
    point = ("v8", float(pixel[1]), float(pixel[0]))
    made = session.ask_points([point], views=fruit.views)
    assert agreement(made.confidence, fruit.ids == APPLE) > 0.9
    with pytest.raises(InputError, match="point: expected a view of the scene, got 'v8'"):
        session.ask_points([point])


def test_lifting_and_tolerance_matter(fruit, monkeypatch) -> None:
    def points(**options):
        chosen = PromptOptions(**options)
        found = fruit.session().find("apple")[0]
        given = [("apple", select.sampled_points(found, "apple", chosen, seed=0))]
        return select.world_prompts(fruit.gaussians, given, chosen, backend="auto")[0].points

    monkeypatch.setattr(select, "NEGATIVES", 0)
    weight, centre = points(), points(lifting="centre")
    assert not torch.equal(weight, centre)
    monkeypatch.setattr(views, "TOLERANCE", 2.0)
    assert not torch.equal(points(lifting="centre"), centre)
    monkeypatch.setattr(views, "TOLERANCE", 0.0)
    assert not len(points(lifting="centre"))
    # Both lie on the apple: it has a radius of 0.12 around (-0.5, 0, 2.5).
    for found in (weight, centre):
        away = (found - torch.tensor([-0.5, 0.0, 2.5], dtype=torch.float64)).norm(dim=1)
        assert float(away.max()) < 0.25


def test_a_thing_covers_in_each_view_what_its_mask_does(fruit) -> None:
    """Of points by hand nobody knows what they are of."""
    options = PromptOptions()
    found = fruit.session().find("apple")[0]
    points = select.sampled_points(found, "apple", options, seed=0)
    by_hand = [replace(one, area=None) for one in points]
    given = [("apple", points), ("points", by_hand)]
    known, unknown = select.world_prompts(fruit.gaussians, given, options, backend="auto")
    assert len(found.masks) == 9
    for view, rle in found.masks:
        assert known.area_in(view) == pytest.approx(rle.area, rel=0.3)
        assert unknown.area_in(view) is None
    assert unknown.size is None


def test_things_of_one_word_draw_points_of_their_own(fruit) -> None:
    session = fruit.session(sampling="random", rounds=1)
    found = session.find("apple")[0]
    made = session.select([found, found, found])
    for rank, one in enumerate(made.objects):
        key, options = f"apple/{rank}", PromptOptions(sampling="random")
        expected = select.sampled_points(found, key, options, seed=0)
        for own, other in zip(one.points, expected, strict=True):
            assert torch.equal(own.pixels, other.pixels)


def test_points_by_hand_are_one_object(fruit) -> None:
    view = fruit.views[4]
    inside = torch.nonzero(fruit.truth(view) == PEAR).double().mean(dim=0)
    text = f"v4:{float(inside[1]):.2f},{float(inside[0]):.2f}"
    points = parsed_points((text,))
    made = fruit.session().ask_points(points)
    assert agreement(made.confidence, fruit.ids == PEAR) > 0.95
    assert made.objects[0].word == ""
    with pytest.raises(InputError, match="point: expected a view of the scene, got 'x'"):
        fruit.session().ask_points([("x", 1, 1)])
    with pytest.raises(RangeError, match="pixels of view v4, 64x48, got \\(64, 2\\)"):
        fruit.session().ask_points([("v4", 64, 2)])
    with pytest.raises(InputError, match="point: expected at least one"):
        fruit.session().ask_points([])
    with pytest.raises(InputError, match="expected VIEW:X,Y, such as front:200,150, got 'v4,3'"):
        parsed_points(("v4,3",))


def test_no_mask_at_the_points(fruit, monkeypatch) -> None:
    monkeypatch.setattr(views, "TOLERANCE", 0.0)
    sky = fruit.session(lifting="centre")
    with pytest.raises(InputError, match="masks: expected a mask at the points in at least one"):
        sky.ask_points([("v4", 30.0, 20.0)])


def test_published_is_the_setting_of_the_paper() -> None:
    """Written out from the paper: sections 3.2 to 3.4, 4.1; the vote of SA-GS is over 0.7."""
    assert (PUBLISHED.initial, PUBLISHED.initial_views) == ("kmeans", 4)
    assert (select.POINTS, PUBLISHED.sampling) == (2, "random")
    assert (PUBLISHED.lifting, views.TOLERANCE) == ("centre", 10.0), "eq. 6"
    assert (PUBLISHED.view_share, PUBLISHED.rounds) == (0.5, 1)
    assert (PUBLISHED.vote, PUBLISHED.tau) == ("published", 0.6), "eq. 8"
    assert (PUBLISHED.region, PUBLISHED.objects, PUBLISHED.phrases) == ("cells", "one", "whole")
    assert PromptOptions(vote="published", point=("v:1,1",)).tau == 0.7
    assert PromptOptions(threshold=0.3).tau == 0.3
    assert PromptOptions(objects="all").probability_limit == 0.3
    assert find_method("prompt").published_options == PUBLISHED


def test_published_finds_the_apple(fruit) -> None:
    sources = PromptSources(features=fruit.features, masks=fruit.masks)
    session = PromptSession(fruit.gaussians, fruit.views, sources, options=PUBLISHED)
    made = session.ask(["apple"])
    assert len(session.initial) == 4
    assert made.objects[0].projected == 5
    assert agreement(made.confidence, fruit.ids == APPLE) > 0.5


def test_the_method_gives_a_selection_with_a_record(fruit) -> None:
    method = find_method("prompt")
    options = PromptOptions(words=("apple",))
    made = method.run(
        MethodInputs(
            gaussians=fruit.gaussians,
            views=fruit.views,
            evidence=fruit.features,
            companions={"masks": fruit.masks},
        ),
        options,
    )
    assert isinstance(made, Selection)
    assert made.info.method == "prompt"
    assert made.info.options["words"] == ["apple"]
    assert made.info.details["initial_views"] == [f"v{i}" for i in range(9)]
    assert made.info.details["mask_calls"] == 18
    assert made.info.details["prompts"][0]["word"] == "apple"
    assert method.gives(options) == "selection"


def test_masks_alone_will_do_for_points(fruit) -> None:
    pixel = torch.nonzero(fruit.truth(fruit.views[4]) == APPLE).double().mean(dim=0)
    options = PromptOptions(point=(f"v4:{float(pixel[1])},{float(pixel[0])}",))
    inputs = MethodInputs(gaussians=fruit.gaussians, views=fruit.views, evidence=fruit.masks)
    made = find_method("prompt").run(inputs, options)
    assert agreement(made.confidence, fruit.ids == APPLE) > 0.95
    with pytest.raises(InputError, match="words: expected words or phrases, or points by hand"):
        find_method("prompt").run(inputs, PromptOptions())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"words": ("a",), "point": ("v:1,1",)}, "words, point: expected one of them"),
        ({"initial": "some"}, "initial: expected"),
        ({"region": "boxes"}, "region: expected"),
        ({"objects": "two"}, "objects: expected"),
        ({"sampling": "rim"}, "sampling: expected"),
        ({"lifting": "nearest"}, "lifting: expected"),
        ({"view_choice": "first"}, "view_choice: this option was removed; it follows sampling"),
        ({"occlusion": "none"}, "occlusion: this option was removed; it follows sampling"),
        ({"vote": "all"}, "vote: expected"),
        ({"initial_views": 0}, "initial_views: expected at least 1"),
        ({"points": 1}, "points: this option was removed"),
        ({"rounds": 0}, "rounds: expected at least 1"),
        ({"least_light": 0.1}, "least_light: this option was removed"),
        ({"view_share": 0.0}, "view_share: expected"),
        ({"threshold": 1.5}, "threshold: expected"),
        ({"min_probability": -0.1}, "min_probability: expected"),
    ],
)
def test_bad_options(options, message) -> None:
    with pytest.raises(InputError, match=message):
        PromptOptions(**options)


def test_published_votes_are_shares_of_all_views(fruit) -> None:
    """The wall behind the apple is in its mask in a few views of nine."""
    made = fruit.session(vote="published", rounds=1).ask(["apple"])
    assert agreement(made.confidence, fruit.ids == APPLE) > 0.9


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
