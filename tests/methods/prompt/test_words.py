"""Words to objects in the initial views."""

from dataclasses import replace
from typing import ClassVar

import pytest
import torch

from methods.prompt.conftest import APPLE, PEAR, vectors, write_features
from splatseg.core import MaskSet, Rle, View
from splatseg.core.models import TextMasks
from splatseg.errors import InputError, ShapeError
from splatseg.io.evidence import TextEmbeddings
from splatseg.lift import TextSpace
from splatseg.lift.phrases import ThingLooks
from splatseg.lift.vocabulary import Vocabulary
from splatseg.lift.words import WordMatches
from splatseg.methods.prompt import PromptOptions, PromptSession, PromptSources, masks
from splatseg.methods.prompt.masks import MaskTable, mask_table, painted
from splatseg.methods.prompt.words import MaskMatches, answering, linked, mask_groups
from support.red_square import SIZE, camera


@pytest.fixture(scope="module")
def table(fruit):
    return mask_table(fruit.gaussians, fruit.views[3:6], fruit.features, fruit.masks)


def rows_of(fruit, table, id: int) -> list[int]:
    """Rows whose mask is exactly that of a thing."""
    found = []
    for row in range(len(table)):
        view = table.views[int(table.view[row])]
        if torch.equal(table.rle(row).decode(), fruit.truth(view) == id):
            found.append(row)
    return found


def test_masks_of_one_thing_share_gaussians(fruit, table) -> None:
    apples, pears = rows_of(fruit, table, APPLE), rows_of(fruit, table, PEAR)
    assert len(apples) == len(pears) == 3
    for first in apples:
        # Gaussians reach over the rim of so small a mask: even its own is not 1.
        assert float(table.iou[first, apples].min()) > 0.4
        assert float(table.iou[first, pears].max()) < 0.1
    # The left half lies in the apple, and the apple in both fruits together.
    half = [row for row in range(len(table)) if float(table.contained[row, apples].max()) > 0.5]
    assert set(apples) < set(half)


def test_masks_that_hold_no_gaussian_look_like_nothing(fruit) -> None:
    """Of the pear alone, the half of the apple that comes last in every view is one."""
    pear = fruit.gaussians[fruit.ids == PEAR]
    table = mask_table(pear, fruit.views[3:6], fruit.features, fruit.masks)
    assert table.looks is not None
    pears, apples = rows_of(fruit, table, PEAR), rows_of(fruit, table, APPLE)
    assert int(table.index.max()) == 4
    assert bool((table.iou.diagonal()[pears] > 0).all())
    assert not bool(table.iou[apples].any())
    assert bool(table.looks.low[pears].isfinite().all())
    assert not bool(table.looks.low[apples].isfinite().any())


def test_features_of_small_things_are_not_those_of_the_wall(fruit, table) -> None:
    words = vectors()
    for id in (APPLE, PEAR):
        values = torch.nn.functional.normalize(table.values[rows_of(fruit, table, id)], dim=1)
        cosines = values @ words[:3].T
        assert cosines.argmax(dim=1).tolist() == [id - 1] * 3
        assert float(cosines[:, id - 1].min()) > 0.85


def test_the_smallest_mask_lies_on_top() -> None:
    masks = torch.zeros(3, 4, 5, dtype=torch.bool)
    masks[0, :3], masks[1, 1, 1:3], masks[2, 1:, 2:4] = True, True, True
    found = painted(MaskSet.from_dense(masks))
    assert found.tolist() == [[0, 0, 0, 0, 0], [0, 1, 1, 2, 0], [0, 0, 2, 2, 0], [-1, -1, 2, 2, -1]]


def test_masks_of_several_views_are_linked_one_of_each() -> None:
    iou = torch.tensor([[1, 0.8, 0.5, 0.0], [0.8, 1, 0, 0], [0.5, 0, 1, 0], [0, 0, 0, 1]])
    assert linked([0, 1, 1, 2], iou, [0.9, 0.1, 0.8, 0.3]) == [[0, 1], [2], [3]]


@pytest.mark.parametrize("region", ["masks", "cells"])
def test_words_find_their_thing_in_every_view(fruit, region) -> None:
    session = fruit.session(region=region, initial_views=4)
    assert len(session.initial) == 4
    for word, id in (("apple", APPLE), (" pear ", PEAR)):
        (found,) = session.find(word)
        assert found.word == word.strip()
        assert len(found.masks) == 4
        for view, rle in found.masks:
            assert torch.equal(rle.decode(), fruit.truth(view) == id)


@pytest.mark.parametrize("region", ["masks", "cells"])
def test_nothing_answers_to_what_is_not_there(fruit, region) -> None:
    session = fruit.session(region=region)
    assert session.find("dog") == []
    with pytest.raises(InputError, match="nothing in the 9 initial views answers to 'dog'"):
        session.ask(["apple", "dog"])


def test_a_probability_may_be_asked_for(fruit) -> None:
    sure = fruit.session().find("pear")[0].probability
    assert fruit.session(min_probability=min(1.0, sure + 1e-4)).find("pear") == []
    assert len(fruit.session(min_probability=sure - 1e-4).find("pear")) == 1


def test_all_objects_or_one(fruit, tmp_path) -> None:
    """Both fruits look like apples."""
    truth = {view.name: fruit.truth(view) for view in fruit.views}
    alike = {name: torch.where(ids == PEAR, APPLE, ids) for name, ids in truth.items()}
    both = write_features(tmp_path / "text", alike)
    for region in ("masks", "cells"):
        counts = []
        for objects in ("one", "all"):
            session = PromptSession(
                fruit.gaussians,
                fruit.views,
                PromptSources(features=both, masks=fruit.masks),
                options=PromptOptions(objects=objects, region=region, initial_views=3),
            )
            counts.append(len(session.find("apple")))
        assert counts == [1, 2], region


def test_bad_words(fruit) -> None:
    session = fruit.session()
    with pytest.raises(InputError, match="5 recorded words, got 'aple'; near are 'apple'"):
        session.ask(["aple"])
    with pytest.raises(InputError, match="words: expected words or phrases, got an empty one"):
        session.ask([" "])
    with pytest.raises(InputError, match="words: expected words or phrases, got none"):
        session.ask([])


def test_what_words_need(fruit) -> None:
    def asked(**sources):
        return PromptSession(fruit.gaussians, fruit.views, PromptSources(**sources))

    with pytest.raises(InputError, match="features in the space of words, or a grounder"):
        asked(masks=fruit.masks).ask(["apple"])
    with pytest.raises(InputError, match="masks: expected evidence of masks"):
        asked(features=fruit.features)
    with pytest.raises(InputError, match="views: expected at least one"):
        PromptSession(fruit.gaussians, (), PromptSources(masks=fruit.masks))
    stranger = replace(fruit.views[0], name="stranger")
    with pytest.raises(InputError, match="a view with both features and masks"):
        PromptSession(
            fruit.gaussians, [stranger], PromptSources(features=fruit.features, masks=fruit.masks)
        ).ask(["apple"])


def test_features_that_are_no_numbers_or_of_another_size(fruit) -> None:
    class Broken:
        view_names = fruit.features.view_names

        def __init__(self, change) -> None:
            self.change = change

        def features(self, name):
            return self.change(fruit.features.features(name))

    def spoilt(grid):
        values = grid.features.clone()
        values[2, 3, 1] = float("nan")
        return replace(grid, features=values)

    with pytest.raises(InputError, match="finite features of view v3, 1 of"):
        mask_table(fruit.gaussians, fruit.views[3:4], Broken(spoilt), fruit.masks)
    with pytest.raises(ShapeError, match="view v3"):
        mask_table(
            fruit.gaussians,
            fruit.views[3:4],
            Broken(lambda grid: replace(grid, features=grid.features[:5])),
            fruit.masks,
        )
    narrow = Broken(lambda grid: replace(grid, features=grid.features[..., :3]))
    session = PromptSession(
        fruit.gaussians, fruit.views, PromptSources(features=fruit.features, masks=fruit.masks)
    )
    object.__setattr__(session, "_sources", PromptSources(features=narrow, masks=fruit.masks))
    session.__dict__["vocabulary"] = fruit.session().vocabulary
    with pytest.raises(ShapeError, match=r"values: expected shape"):
        session.find("apple")


class Pointing:
    """A grounding model that knows the true masks of fruit by the image's size."""

    name, note = "pointing", ""
    settings: ClassVar[dict[str, int]] = {}

    def __init__(self, fruit) -> None:
        self.fruit, self.asked = fruit, []

    def grounded_masks(self, image, words) -> TextMasks:
        view = self.fruit.views[len(self.asked) % 2]
        self.asked.append(words)
        truth = self.fruit.truth(view)
        masks = MaskSet.from_dense(torch.stack((truth == APPLE, truth == PEAR)), scores=[0.6, 0.9])
        return TextMasks(masks=masks, words=(0, 0))


def test_a_grounding_model_finds_words(fruit) -> None:
    def session(**options):
        model = Pointing(fruit)
        made = PromptSession(
            fruit.gaussians,
            fruit.views[:2],
            PromptSources(grounder=model, masks=fruit.masks),
            options=PromptOptions(initial_views=2, **options),
        )
        return made, model

    one, model = session()
    (found,) = one.find("fruit")
    assert found.probability == pytest.approx(0.9)
    assert [view.name for view, _ in found.masks] == ["v0", "v1"]
    for view, rle in found.masks:
        assert isinstance(rle, Rle)
        assert torch.equal(rle.decode(), fruit.truth(view) == PEAR)
    assert model.asked == [["fruit"], ["fruit"]]
    both, _ = session(objects="all")
    found = both.find("fruit")
    assert [round(one.probability, 3) for one in found] == [0.9, 0.6]
    assert all(len(one.masks) == 2 for one in found)
    sure, _ = session(objects="all", min_probability=0.7)
    assert len(sure.find("fruit")) == 1
    prompted = one.ask(["fruit"])
    # Two views for the words, and two in each of two rounds.
    assert prompted.mask_calls == 2 + 2 * 2


def test_a_phrase_is_asked_by_its_parts(fruit) -> None:
    """As a whole it means the apple more; but the apple is pink."""
    known = vectors()
    phrase = torch.nn.functional.normalize(0.9 * known[:1] + 0.2 * known[1:2], dim=1)
    vocabulary = Vocabulary(
        space=TextSpace(width=known.shape[1]),
        recorded=TextEmbeddings(
            labels=("apple", "pear", "wall", "green fruit"),
            vectors=torch.cat((known[:3], phrase)),
            kinds=("class", "class", "class", "instance"),
            target_ids=(1, 2, 3, 2),
        ),
    )
    colours = torch.full((4, 3), 0.5)
    colours[APPLE], colours[PEAR] = torch.tensor([0.9, 0.0, 0.7]), torch.tensor([0.2, 0.6, 0.25])
    sh = ((colours[fruit.ids.long()] - 0.5) / 0.28209479)[:, None]
    table = mask_table(
        fruit.gaussians.replace(sh=sh), fruit.views[3:6], fruit.features, fruit.masks
    )
    for how, id in (("whole", APPLE), ("parts", PEAR)):
        options = PromptOptions(phrases=how, min_probability=0.0)
        (found,) = MaskMatches(table, vocabulary, options).find("green fruit")
        for view, rle in found.masks:
            assert torch.equal(rle.decode(), fruit.truth(view) == id), how
    with pytest.raises(InputError, match="phrases: expected one of parts, whole"):
        PromptOptions(phrases="half")


@pytest.mark.parametrize(
    ("options", "wanted"),
    [({}, True), ({"phrases": "whole"}, False), ({"region": "cells"}, False)],
)
def test_looks_are_found_where_they_are_asked_for(fruit, monkeypatch, options, wanted) -> None:
    made = []
    original = masks._looks
    monkeypatch.setattr(masks, "_looks", lambda *given: made.append(1) or original(*given))
    fruit.session(**options, initial_views=2).find("apple")
    assert bool(made) == wanted


PART, THING, GROUP, OTHER = range(4)
SIDES = (4, 10, 24, 6)
HELD = torch.tensor(
    [[1, 0.9, 1, 0], [0.1, 1, 1, 0], [0.05, 0.3, 1, 0], [0, 0, 0, 1]], dtype=torch.float32
)
"""Share of the row's mask that the column's has."""


@pytest.fixture
def table_of_groups() -> MaskTable:
    """Two views of a part in a thing in a group, and something else."""
    masks = torch.zeros(4, SIZE, SIZE, dtype=torch.bool)
    for row, side in enumerate(SIDES[:OTHER]):
        masks[row, :side, :side] = True
    masks[OTHER, -SIDES[OTHER] :, -SIDES[OTHER] :] = True
    same = torch.eye(4).tile(2, 2)
    return MaskTable(
        views=tuple(View(name=name, camera=camera(0)) for name in ("a", "b")),
        masks=(MaskSet.from_dense(masks),) * 2,
        view=torch.tensor([0] * 4 + [1] * 4),
        index=torch.arange(4).tile(2),
        values=torch.eye(4).tile(2, 1),
        cells=torch.tensor([float(side**2) for side in SIDES]).tile(2),
        iou=same,
        contained=HELD.tile(2, 2),
        looks=ThingLooks(
            colours=torch.zeros(8, 3), low=torch.zeros(8, 3), high=torch.ones(8, 3), has_up=False
        ),
    )


def meant(
    table_of_groups: MaskTable, cosines: list[float], probabilities: list[float]
) -> int | None:
    answers = WordMatches(
        words=("mug",),
        cosines=torch.tensor(cosines * 2)[:, None],
        probabilities=torch.tensor(probabilities * 2)[:, None],
    )
    found = answering(
        table_of_groups, mask_groups(table_of_groups), answers, several=False, least=0.05
    )
    if not found:
        return None
    (one,) = found
    assert [view.name for view, _ in one.masks] == ["a", "b"]
    return [side**2 for side in SIDES].index(one.masks[0][1].area)


def test_a_thing_is_meant_and_not_its_part(table_of_groups) -> None:
    sure = [0.9] * 4
    assert meant(table_of_groups, [0.98, 0.97, 0.3, 0.1], sure) == THING
    assert meant(table_of_groups, [0.97, 0.98, 0.3, 0.1], sure) == THING


def test_a_part_is_meant_where_the_whole_answers_less(table_of_groups) -> None:
    assert meant(table_of_groups, [0.98, 0.90, 0.3, 0.1], [0.9] * 4) == PART
    assert meant(table_of_groups, [0.98, 0.97, 0.3, 0.1], [0.9, 0.01, 0.01, 0.0]) == PART


def test_what_does_not_hold_it_is_no_whole_of_it(table_of_groups) -> None:
    assert meant(table_of_groups, [0.95, 0.2, 0.3, 0.96], [0.9] * 4) == OTHER
    assert meant(table_of_groups, [0.96, 0.2, 0.3, 0.95], [0.9] * 4) == PART


def test_the_whole_may_be_a_group(table_of_groups) -> None:
    assert meant(table_of_groups, [0.97, 0.97, 0.96, 0.1], [0.9] * 4) == GROUP


def test_nothing_answers(table_of_groups) -> None:
    assert meant(table_of_groups, [0.98, 0.97, 0.3, 0.1], [0.01] * 4) is None
