"""One click carried from view to view, with a model whose masks are written down."""

from collections.abc import Callable, Sequence

import pytest
import torch

from splatseg.core import Gaussians, Labels, MaskSet, Scene, View
from splatseg.core.models import Embedding
from splatseg.errors import InputError
from splatseg.lift import label_map
from splatseg.prompting.meanings import Candidate, chosen_meaning, meanings_of
from splatseg.prompting.pipeline import SceneIndex
from splatseg.prompting.prompts import ViewPrompt
from splatseg.prompting.propagation import MAX_VIEWS, PropagatedMasks
from splatseg.prompting.seen import ViewCache, see_prompts
from splatseg.tasks import SelectionSession, SelectOptions
from support.wall import camera, field_ids

FIELD, GROUP, PIECE, OTHER = "field", "group", "piece", "other"
Says = Callable[[int], Sequence[str]]


class Painter:
    """Knows the field of each pixel, and finds in each view what a test says that it does.

    Args:
        says: By number of the view: the field that a pixel is in, the group of the fields on its
            side, the left piece of the field, or another field.
    """

    name, note = "painter", ""

    def __init__(self, says: Says = lambda _: (FIELD,)) -> None:
        self._says = says
        self.asked: list[int] = []
        self.rough: list[bool] = []

    settings: dict[str, int] = {}  # noqa: RUF012

    def embed(self, image: torch.Tensor) -> Embedding:
        height, width = image.shape[:2]
        return Embedding(model=self.name, height=height, width=width, arrays={"image": image})

    def prompted_masks(self, embedding: Embedding, prompt) -> MaskSet:
        image = embedding.arrays["image"]
        view = int(image[0, 0, 2])
        self.asked.append(view)
        self.rough.append(prompt.mask is not None)
        ids = image[..., 0].int()
        x, y = prompt.points[prompt.signs][0].long().tolist()
        here = int(ids[y, x])
        columns = torch.arange(ids.shape[1]).expand_as(ids)
        masks = {
            FIELD: ids == here,
            GROUP: (ids == here) | (ids == (here + 1) % 4 + 1),
            PIECE: (ids == here) & (columns < x + 2),
            OTHER: ids == here % 4 + 1,
        }
        found = [masks[word] for word in self._says(view)]
        dense = torch.stack(found) if found else torch.zeros(0, *ids.shape, dtype=torch.bool)
        return MaskSet.from_dense(dense)


@pytest.fixture
def views() -> tuple[View, ...]:
    places = (0.0, 0.3, -0.3, 0.6, -0.6, 0.9, -0.9, 0.15, -0.15, 0.45, -0.45, 0.75)
    return tuple(View(name=f"v{i:02}", camera=camera(x)) for i, x in enumerate(places))


@pytest.fixture
def source_of(gaussians: Gaussians, views: Sequence[View]):
    labels = Labels(ids=field_ids(gaussians), confidence=torch.ones(len(gaussians)))

    def image_of(view: View) -> torch.Tensor:
        ids = label_map(gaussians, view.camera, labels).ids.clamp_min(0)
        image = ids[..., None].expand(*ids.shape, 3).to(torch.uint8).clone()
        image[0, 0, 2] = int(view.name[1:])
        return image

    def made(model: Painter, count: int = 3) -> PropagatedMasks:
        return PropagatedMasks(
            views[:count], model, cache=ViewCache(gaussians), neighbours=SceneIndex(gaussians),
            image_of=image_of,
        )  # fmt: skip

    made.image_of = image_of
    return made


def _click(gaussians, views, *, negative=None, point=(10.0, 15.0)):
    points = [point] if negative is None else [point, negative]
    signs = torch.tensor([True, False][: len(points)])
    prompt = ViewPrompt(view=views[0], points=torch.tensor(points), positive=signs)
    return see_prompts(gaussians, [prompt])


def _fields(gaussians, found) -> dict[int, float]:
    """Share of the seen Gaussians of each field that are selected."""
    ids, inside = field_ids(gaussians), gaussians.means[:, 0].abs() < 1.4
    return {
        field: float((found[(ids == field) & inside] > 0.5).float().mean())
        for field in (1, 2, 3, 4)
    }


def test_a_click_becomes_its_field(gaussians, views, source_of) -> None:
    source = source_of(Painter())
    found = source.membership(_click(gaussians, views), granularity=None)
    shares = _fields(gaussians, found)
    assert shares[1] > 0.9
    assert max(shares[2], shares[3], shares[4]) < 0.1
    assert [one.accepted for one in source.looked_at] == [True, True, True]
    hidden = gaussians.means[:, 0].abs() > 2.4
    assert source.unseen is not None
    assert bool(source.unseen[hidden].all())
    assert not bool(source.unseen[~hidden & (gaussians.means[:, 0].abs() < 2.0)].any())


@pytest.mark.parametrize(
    ("granularity", "fields"), [(None, (1,)), (0.5, (1,)), (0.0, (1, 3)), (1.0, (1,))]
)
def test_the_best_supported_meaning_is_the_object(
    gaussians, views, source_of, granularity, fields
) -> None:
    """The group is found in two of three views, the field in all."""
    says = ((FIELD, GROUP), (FIELD,), (GROUP, FIELD))
    source = source_of(Painter(lambda view: says[view]))
    shares = _fields(
        gaussians, source.membership(_click(gaussians, views), granularity=granularity)
    )
    assert {field for field, share in shares.items() if share > 0.5} == set(fields)


@pytest.mark.parametrize(
    ("says", "whole"),
    [
        (((PIECE,), (PIECE,), (FIELD,)), True),
        (((PIECE, FIELD), (PIECE,), (PIECE,)), False),  # the model told of both, and chose
        (((PIECE, FIELD),) * 3, True),
        (((PIECE,), (PIECE,), (OTHER,)), False),
    ],
)
def test_an_object_is_the_whole_of_what_is_found_more_often(
    gaussians, views, source_of, says, whole
) -> None:
    """The left piece has a little more than half of the field."""
    source = source_of(Painter(lambda view: says[view]))
    chosen = source._meant(_click(gaussians, views), None, [])
    share = chosen.shares()[(field_ids(gaussians) == 1) & (gaussians.means[:, 0].abs() < 1.4)]
    assert bool(float((share > 0.5).float().mean()) > 0.9) == whole


def _masks(views: Sequence[View], first: int, end: int, *, score: float = 1.0) -> list[Candidate]:
    """A mask of Gaussians first to end in each view, of 600 that all of them show whole."""
    inside = torch.zeros(600)
    inside[first:end] = 1
    return [
        Candidate(view=view, inside=inside, total=torch.ones(600), score=score) for view in views
    ]


@pytest.mark.parametrize(
    ("whole", "seen", "size"),
    [
        ((0, 125), 4, 100),  # the same thing with a thicker rim
        ((0, 135), 4, 135),
        ((0, 395), 4, 395),
        ((0, 405), 4, 100),  # a group
        ((25, 300), 4, 100),  # another thing that it overlaps
        ((15, 300), 4, 285),
        ((0, 200), 2, 200),
        ((0, 200), 1, 100),  # one in ten found it
    ],
)
def test_what_may_be_the_whole_of_a_part(views, whole, seen, size) -> None:
    part = _masks(views[:6], 0, 100)
    found = chosen_meaning([part, _masks(views[6 : 6 + seen], *whole)], None, 10)
    assert float(found[0].inside.sum()) == size


@pytest.mark.parametrize(("score", "size"), [(0.8, 10), (0.7, 500)])
def test_of_what_was_found_once_the_small_has_an_advantage(views, score, size) -> None:
    """0.8 / 6 - 0.02 lg 10 = 0.113 and 1 / 6 - 0.02 lg 500 = 0.113."""
    small, large = _masks(views[:1], 0, 10, score=score), _masks(views[1:2], 0, 500)
    assert float(chosen_meaning([large, small], None, 6)[0].inside.sum()) == size


@pytest.mark.parametrize(("share", "joined"), [(0.62, False), (0.66, True)])
def test_masks_that_are_alike_mean_the_same(views, share, joined) -> None:
    """0.7 - 1 / sqrt(area): 0.644 for an area of 324."""
    pair = _masks(views[:1], 0, 500) + _masks(views[1:2], 0, round(500 * share))
    assert len(meanings_of(pair)) == (1 if joined else 2)
    small = _masks(views[:1], 0, 50) + _masks(views[1:2], 0, round(50 * share))
    assert len(meanings_of(small)) == 1  # rims of small ones are much of them
    assert len(meanings_of(_masks(views[:1], 0, 9) + _masks(views[1:2], 9, 18))) == 2


def test_a_part_is_the_smallest_supported_meaning(gaussians, views, source_of) -> None:
    source = source_of(Painter(lambda _: (FIELD, PIECE)))
    click = _click(gaussians, views)
    part = source.membership(click, granularity=1.0)
    whole = source.membership(click, granularity=0.5)
    assert 0 < int((part > 0.5).sum()) < 0.9 * int((whole > 0.5).sum())


def test_a_view_in_which_nothing_is_found_at_the_click_is_asked_again(
    gaussians, views, source_of
) -> None:
    model = Painter()
    model._says = lambda view: (FIELD,) if view != 0 or model.rough[-1] else ()
    source = source_of(model)
    shares = _fields(gaussians, source.membership(_click(gaussians, views), granularity=None))
    assert shares[1] > 0.9
    assert len(source.looked_at) == 3
    assert model.asked.count(0) == 2
    assert all(one.accepted for one in source.looked_at)


def test_a_mask_that_disagrees_does_not_count(gaussians, views, source_of) -> None:
    source = source_of(Painter(lambda view: (OTHER,) if view == 2 else (FIELD,)))
    shares = _fields(gaussians, source.membership(_click(gaussians, views), granularity=None))
    assert shares[1] > 0.9
    assert shares[2] < 0.1
    by_view = {one.view: one for one in source.looked_at}
    assert not by_view["v02"].accepted
    assert by_view["v02"].agreement < 0.1
    assert by_view["v00"].accepted
    assert by_view["v01"].accepted


def test_nothing_at_the_click_in_any_view_is_an_error(gaussians, views, source_of) -> None:
    source = source_of(Painter(lambda _: ()))
    with pytest.raises(InputError, match="painter found none there, nor at the same place in 2"):
        source.membership(_click(gaussians, views), granularity=None)


def test_a_mask_is_carried_on_as_it_is(gaussians, views, source_of) -> None:
    mask = torch.zeros(30, 40, dtype=torch.bool)
    mask[10:20, :20] = True  # field 1, while at its pixels the group would be found too
    prompt = see_prompts(gaussians, [ViewPrompt(view=views[0], mask=mask)])
    model = Painter(lambda _: (GROUP, FIELD))
    source = source_of(model)
    shares = _fields(gaussians, source.membership(prompt, granularity=None))
    assert shares[1] > 0.9
    assert shares[3] < 0.1
    assert 0 not in model.asked
    assert all(model.rough)


def test_what_a_negative_point_shows_is_out(gaussians, views, source_of) -> None:
    source = source_of(Painter(lambda _: (GROUP,)))
    found = source.membership(_click(gaussians, views, negative=(10.5, 25.5)), granularity=None)
    (prompt,) = _click(gaussians, views, negative=(10.5, 25.5))
    rows = prompt.negative_rows
    shown = rows.ids[rows.weights > 0.1].long()
    assert bool((found[shown] <= 0.5).all())
    assert _fields(gaussians, found)[1] > 0.9


def test_no_more_views_than_eight(gaussians, views, source_of) -> None:
    model = Painter(lambda view: (FIELD,) if view == 0 else (OTHER,))
    source = source_of(model, count=12)
    source.membership(_click(gaussians, views), granularity=None)
    assert len(source.looked_at) == MAX_VIEWS
    assert len(set(model.asked)) == MAX_VIEWS


def test_it_ends_when_members_stay_the_same(gaussians, views, source_of) -> None:
    mask = torch.zeros(30, 40, dtype=torch.bool)
    mask[10:20, 5:15] = True
    prompt = see_prompts(gaussians, [ViewPrompt(view=views[0], mask=mask)])

    class Agreeing(Painter):
        def prompted_masks(self, embedding, prompt):
            self.asked.append(0)
            return MaskSet.from_dense(prompt.mask[None])

    model = Agreeing()
    source_of(model, count=12).membership(prompt, granularity=None)
    assert 2 <= len(model.asked) < MAX_VIEWS - 1


def test_a_session_asks_the_source_not_the_views_first(gaussians, views, source_of) -> None:
    """And what a click left unseen is not what the next one takes for it."""
    scene = Scene(gaussians=gaussians, views=views[:3])
    source = source_of(Painter())
    options = SelectOptions(source="propagate")
    left = ViewPrompt(view=views[0], points=torch.tensor([[10.0, 15.0]]))
    right = ViewPrompt(view=views[0], points=torch.tensor([[30.0, 15.0]]))
    with SelectionSession(scene, options=options, source=source, prompter=Painter()) as session:
        first = session.select(left).selection
        session.select(right)
        again = session.select(left).selection
    asked = again.info.details["views_asked"]
    assert [one["view"] for one in asked] == [one.view for one in source.looked_at]
    assert all(one["counts"] for one in asked)
    assert torch.equal(first.mask, again.mask)
    assert _fields(gaussians, first.mask.float())[1] > 0.9


def test_without_a_prompter_the_source_says_what_it_needs(gaussians, views) -> None:
    scene = Scene(gaussians=gaussians, views=views[:2])
    click = ViewPrompt(view=views[0], points=torch.tensor([[10.0, 15.0]]))
    with (
        SelectionSession(scene, options=SelectOptions(source="propagate")) as session,
        pytest.raises(InputError, match="prompter: expected a model for source propagate"),
    ):
        session.select(click)


def test_auto_takes_the_prompter_where_a_scene_has_nothing_else(gaussians, views) -> None:
    scene = Scene(gaussians=gaussians, views=views[:2])
    with SelectionSession(scene, prompter=Painter()) as session:
        assert isinstance(session.source, PropagatedMasks)
