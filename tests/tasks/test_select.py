"""Selecting in a scene: sources, modes, places, steps, and what is refused."""

import importlib
from dataclasses import dataclass
from functools import partial

import pytest
import torch

from splatseg.core import Features, InstanceFacts, Labels, LayerInfo, Scene, Selection, View
from splatseg.errors import InputError, ShapeError
from splatseg.prompting import pipeline
from splatseg.prompting.prompts import AxisBox, Ball, Lasso, Similar, ViewPrompt
from splatseg.tasks import SelectOptions, open_selector, select
from support.wall import camera, field_ids, wall

IN_1, IN_4 = (12.5, 15.5), (26.5, 25.5)


@dataclass(frozen=True, kw_only=True)
class World:
    scene: Scene
    layers: dict[str, Labels]

    @property
    def ids(self) -> torch.Tensor:
        return self.layers["fields"].ids

    def click(self, *points: tuple[float, float]) -> ViewPrompt:
        return ViewPrompt(view=self.scene.views[0], points=torch.tensor(points))

    def select(self, prompts, **more):
        return select(self.scene, prompts, layers=self.layers, backend="cpu", **more)


@pytest.fixture
def world() -> World:
    gaussians = wall()
    views = (View(name="front", camera=camera()), View(name="side", camera=camera(0.5)))
    ids = field_ids(gaussians)
    return World(
        scene=Scene(gaussians=gaussians, views=views),
        layers={"fields": Labels(ids=ids, confidence=(ids > 0).float())},
    )


def test_a_click_selects_what_the_layer_has_there(world) -> None:
    made = world.select(world.click(IN_1))
    assert torch.equal(made.selection.mask, world.ids == 1)
    assert made.selection.confidence[world.ids == 1].eq(1).all()
    assert made.source == "layer"
    assert set(made.seconds) >= {"open", "see", "layer"}
    assert made.warnings == ()
    assert made.next_click is None
    info = made.selection.info
    assert (info.method, info.views, info.seed) == ("select", ("front",), 0)
    assert info.options["layer"] == "fields"
    (recorded,) = info.details["prompts"]
    assert recorded == {"kind": "view", "view": "front", "points": [list(IN_1)]}


def test_places_bound_a_click_and_select_alone(world) -> None:
    x, y, _ = world.scene.gaussians.means.unbind(1)
    box = AxisBox(low=(-1.0, 0.0, 0.0), high=(1.0, 0.5, 9.0))
    within = (x.abs() < 1) & (y < 0.5)
    assert torch.equal(world.select(box).selection.mask, within)
    made = world.select([world.click(IN_1), box])
    assert torch.equal(made.selection.mask, within & (world.ids == 1))
    ball = Ball(centre=(0.0, 0.0, 2.0), radius=0.7)
    both = within & ball.contains(world.scene.gaussians)
    assert torch.equal(world.select([box, ball]).selection.mask, both)
    lasso = Lasso(view=world.scene.views[0], polygon=torch.tensor([[0, 0], [20, 0], [0.0, 20]]))
    assert world.select(lasso).selection.count
    assert world.select(lasso).source == ""
    nothing = world.select([box, Ball(centre=(9.0, 0, 0), radius=1.0)])
    assert nothing.selection.count == 0
    assert nothing.warnings == ("Nothing is selected.",)
    kinds = [
        row["kind"] for row in world.select([box, ball, lasso]).selection.info.details["prompts"]
    ]
    assert kinds == ["box", "sphere", "lasso"]


@pytest.mark.parametrize(
    ("mode", "expected"), [("add", {1, 2, 4}), ("subtract", {1, 2}), ("intersect", {4})]
)
def test_a_selection_changes_another(world, mode, expected) -> None:
    ids = world.ids
    base = Selection(mask=torch.isin(ids, torch.tensor([1, 2, 4] if mode != "add" else [1, 2])))
    made = world.select(world.click(IN_4), base=base, options=SelectOptions(mode=mode))
    assert set(ids[made.selection.mask].tolist()) == expected
    assert made.selection.info.details["mode"] == mode


def test_bases_that_do_not_fit(world) -> None:
    base = Selection(mask=world.ids == 1)
    with pytest.raises(InputError, match="base: expected a selection with mode add"):
        world.select(world.click(IN_1), base=base)
    with pytest.raises(InputError, match="got none with add"):
        world.select(world.click(IN_1), options=SelectOptions(mode="add"))
    with pytest.raises(ShapeError, match="of another scene"):
        world.select(world.click(IN_1), base=base[:9], options=SelectOptions(mode="add"))


def test_the_layer_that_says_most_of_instances_is_taken(world) -> None:
    ids = torch.where(world.ids > 2, 9, 8).int()
    coarse = Labels(
        ids=ids,
        confidence=torch.ones(len(ids)),
        info=LayerInfo(instances={8: InstanceFacts(segments=2)}),
    )
    world.layers["z"] = coarse
    world.layers["a"] = Features(values=torch.zeros(len(ids), 2))
    made = world.select(world.click(IN_1))
    assert made.selection.info.options["layer"] == "z"
    assert torch.equal(made.selection.mask, ids == 8)
    named = world.select(world.click(IN_1), options=SelectOptions(from_layer="fields"))
    assert torch.equal(named.selection.mask, world.ids == 1)
    with pytest.raises(InputError, match="from_layer: expected labels or a tree, 'a' is of feat"):
        world.select(world.click(IN_1), options=SelectOptions(source="layer", from_layer="a"))


def test_nothing_to_select_by(world) -> None:
    with pytest.raises(InputError, match="`splatseg see` and a layer with `splatseg segment`"):
        select(world.scene, world.click(IN_1))
    with pytest.raises(InputError, match="source: expected one of auto, .*got 'magic'"):
        world.select(world.click(IN_1), options=SelectOptions(source="magic"))
    with pytest.raises(InputError, match="prompts: expected at least one"):
        world.select([])


class Everything:
    """A source of one's own, which remembers what it was asked."""

    def __init__(self, count: int) -> None:
        self.count, self.asked = count, []

    def membership(self, prompts, *, granularity):
        self.asked.append((prompts, granularity))
        return torch.full((self.count,), 0.75)


@pytest.mark.parametrize(
    ("granularity", "level"),
    [("auto", None), ("group", 0), ("object", 0.5), ("part", 1), ("0.3", 0.3), (0.3, 0.3)],
)
def test_a_source_of_ones_own_is_told_the_granularity(world, granularity, level) -> None:
    source = Everything(len(world.ids))
    options = SelectOptions(granularity=granularity)
    made = world.select(world.click(IN_1), source=source, options=options)
    assert source.asked[0][1] == level
    assert made.source == "Everything"
    assert made.selection.mean_confidence == pytest.approx(0.75)
    with pytest.raises(InputError, match="similar: expected a source that knows"):
        world.select(Similar(selection=made.selection), source=source)


@pytest.mark.parametrize("granularity", ["fine", "1.5", -1.0])
def test_a_granularity_that_is_none(world, granularity) -> None:
    options = SelectOptions(granularity=granularity)
    with pytest.raises(InputError, match="granularity: expected auto, group, object, part or"):
        select(world.scene, world.click(IN_1), options=options)


def test_more_like_this(world) -> None:
    like = Similar(selection=Selection(mask=world.ids == 2))
    assert torch.equal(world.select(like).selection.mask, world.ids == 2)
    both = world.select([like, world.click(IN_1)])
    assert set(world.ids[both.selection.mask].tolist()) == {1, 2}


@pytest.mark.parametrize("step", ["filter", "grow", "refine", "fill_holes", "hidden"])
def test_each_step_follows_unless_none_is_to(world, step, monkeypatch) -> None:
    seen = []

    def record(confidence, context):
        seen.append(context.source)
        return confidence

    monkeypatch.setattr(pipeline, "STEPS", ((step, record),))
    made = world.select(world.click(IN_1))
    assert seen == ["layer"]
    assert step in made.seconds
    world.select(world.click(IN_1), options=SelectOptions(post_processing="none"))
    assert seen == ["layer"]


def test_the_seed_reaches_the_prompts(world, monkeypatch) -> None:
    module = importlib.import_module("splatseg.tasks.select")
    monkeypatch.setattr(module, "see_prompts", partial(module.see_prompts, max_pixels=40))
    mask = torch.zeros(30, 40, dtype=torch.bool)
    mask[11:29, 2:18] = True
    prompt = ViewPrompt(view=world.scene.views[0], mask=mask)
    pixels = []
    for options in (SelectOptions(), SelectOptions(), SelectOptions(seed=1)):
        source = Everything(len(world.ids))
        world.select(prompt, source=source, options=options)
        pixels.append(source.asked[0][0][0].pixels)
    assert len(pixels[0]) <= 40
    assert torch.equal(pixels[0], pixels[1])
    assert not torch.equal(pixels[0], pixels[2])


def test_a_session_opens_its_source_once_and_keeps_nothing_else(world) -> None:
    with open_selector(world.scene, layers=world.layers, backend="cpu") as session:
        source = session.source
        first = session.select(world.click(IN_1))
        session.select(world.click(IN_4))
        again = session.select(world.click(IN_1))
        assert session.source is source
        assert torch.equal(first.selection.confidence, again.selection.confidence)
        assert first.selection.info == again.selection.info
        finer = session.select(world.click(IN_1), options=SelectOptions(granularity="part"))
        assert finer.selection.info.options["granularity"] == 1
        with pytest.raises(InputError, match="open another session"):
            session.select(world.click(IN_1), options=SelectOptions(from_layer="x"))
        with pytest.raises(InputError, match="open another session"):
            session.select(world.click(IN_1), options=SelectOptions(evidence="x"))


def test_who_advises_is_asked_with_the_final_confidence(world, monkeypatch) -> None:
    heard = []
    module = importlib.import_module("splatseg.tasks.select")
    monkeypatch.setattr(module, "next_click", lambda c, context: heard.append((c, context)))
    made = world.select(world.click(IN_1), advise=True)
    ((confidence, context),) = heard
    assert torch.equal(confidence, made.selection.confidence)
    assert [view.name for view in context.scene_views] == ["front", "side"]
