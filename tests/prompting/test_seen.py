"""Prompts resolved to rows of W: which pixels, which Gaussians, and what is refused."""

from dataclasses import replace

import pytest
import torch

from splatseg.core import Edited, Gaussians, Labels, View
from splatseg.errors import InputError, RangeError
from splatseg.lift.label_maps import label_map, view_label_map
from splatseg.prompting import seen as seen_module
from splatseg.prompting.prompts import AxisBox, Lasso, ViewPrompt
from splatseg.prompting.seen import ViewCache, see_prompts, thinned
from splatseg.render import prepare, weights


def region(rows: slice, columns: slice) -> torch.Tensor:
    mask = torch.zeros(30, 40, dtype=torch.bool)
    mask[rows, columns] = True
    return mask


LEFT = region(slice(12, 28), slice(2, 18))
RIGHT = region(slice(12, 28), slice(22, 32))
SKY = region(slice(0, 6), slice(5, 35))


def test_points_are_the_rows_of_their_pixels(gaussians, view, side) -> None:
    prompts = (
        ViewPrompt(view=view, points=[[10.5, 20.5], [30.9, 15.0]], positive=[True, False]),
        ViewPrompt(view=side, points=[[5, 12]]),
    )
    first, second = see_prompts(gaussians, prompts, backend="cpu")
    assert first.pixels.tolist() == [[10, 20], [30, 15]]
    assert first.positive.tolist() == [True, False]
    assert not first.dense
    assert first.inside is None
    rows = weights(gaussians, view.camera, torch.tensor([[10, 20], [30, 15]]), backend="cpu")
    assert torch.equal(first.rows.ids, rows.ids)
    assert torch.equal(first.rows.weights, rows.weights)
    assert torch.equal(first.positive_rows.ids, rows.select(torch.tensor([0])).ids)
    assert torch.equal(first.negative_rows.ids, rows.select(torch.tensor([1])).ids)
    assert second.view is side


def test_masks_are_thinned_and_lit_and_say_where_the_thing_is(gaussians, view) -> None:
    mask = LEFT | SKY
    options = {"max_pixels": 50, "seed": 3}
    (seen,) = see_prompts(gaussians, [ViewPrompt(view=view, mask=mask)], **options)
    assert 10 < len(seen) <= 50
    assert seen.dense
    assert seen.positive.all()
    assert torch.equal(seen.inside, mask)
    columns, rows = seen.pixels.unbind(1)
    assert LEFT[rows, columns].all(), "pixels of the sky show nothing"
    (again,) = see_prompts(gaussians, [ViewPrompt(view=view, mask=mask)], **options)
    assert torch.equal(again.pixels, seen.pixels)
    other = {"max_pixels": 50, "seed": 4}
    (another,) = see_prompts(gaussians, [ViewPrompt(view=view, mask=mask)], **other)
    assert another.pixels.tolist() != seen.pixels.tolist()


def test_strokes_of_both_signs(gaussians, view) -> None:
    prompt = ViewPrompt(view=view, scribble=LEFT, negative_scribble=RIGHT, points=[[3, 14]])
    points, strokes = see_prompts(gaussians, [prompt])
    assert len(points) == 1
    columns = strokes.pixels[:, 0]
    assert torch.equal(strokes.positive, columns < 20)
    assert strokes.inside is None


def test_a_box_alone_guesses_its_middle_and_points_overrule_it(gaussians, view) -> None:
    box = [4, 12, 16, 28]
    (guessed,) = see_prompts(gaussians, [ViewPrompt(view=view, box=box)])
    assert guessed.guessed
    assert guessed.dense
    columns, rows = guessed.pixels.unbind(1)
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (7, 12, 16, 23)
    assert torch.equal(guessed.inside, region(slice(12, 28), slice(4, 16)))
    (pointed,) = see_prompts(gaussians, [ViewPrompt(view=view, box=box, points=[[5, 13]])])
    assert pointed.pixels.tolist() == [[5, 13]]
    assert not pointed.guessed
    assert torch.equal(pointed.inside, guessed.inside)
    (tiny,) = see_prompts(gaussians, [ViewPrompt(view=view, box=[5, 13, 6, 14])])
    assert tiny.pixels.tolist() == [[5, 13]]


def test_thinning_is_spread_over_the_region() -> None:
    generator = torch.Generator().manual_seed(0)
    pixels = thinned(torch.ones(60, 80, dtype=torch.bool), 100, generator)
    assert 60 <= len(pixels) <= 100
    quarters = (pixels[:, 0] >= 40).int() + 2 * (pixels[:, 1] >= 30).int()
    counts = torch.bincount(quarters, minlength=4)
    assert counts.min() > 0.6 * counts.max()
    line = torch.zeros(60, 80, dtype=torch.bool)
    line[7] = True
    assert len(thinned(line, 10, generator)) <= 10
    assert len(thinned(line, 80, generator)) == 80
    assert len(thinned(line, 1, generator)) == 1


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"points": [[10, 3]]}, r"points: expected one on something, got \(10, 3\).*the sky"),
        ({"mask": SKY}, "mask: expected pixels on something in view front.*the sky"),
        ({"scribble": SKY}, "scribble: .*the sky"),
        ({"box": [5, 0, 30, 6]}, "box: .*the sky"),
        ({"points": [[10, 20]], "positive": [False]}, "expected a positive point, a box"),
        ({"negative_scribble": LEFT}, "expected a positive point, a box"),
        ({"mask": LEFT, "box": [22, 12, 30, 20]}, "a mask and a box that meet in view front"),
        (
            {"points": [[10, 20], [10.4, 20.3]], "positive": [True, False]},
            r"\(10, 20\) in view front and \(10, 20\) in view front, which contradict each other",
        ),
        ({"scribble": LEFT, "negative_scribble": LEFT}, "contradict each other"),
        ({"mask": LEFT, "negative_scribble": LEFT}, "contradict each other"),
    ],
)
def test_what_cannot_be_answered(gaussians, view, fields, says) -> None:
    with pytest.raises(InputError, match=says):
        see_prompts(gaussians, [ViewPrompt(view=view, **fields)])


def test_points_of_two_views_on_the_same_gaussians_contradict_each_other(
    gaussians, view, side, monkeypatch
) -> None:
    """The wall is at z = 2 and the cameras half a unit apart: five pixels."""
    prompts = [
        ViewPrompt(view=view, points=[[20.5, 20.5]]),
        ViewPrompt(view=side, points=[[15.5, 20.5]], positive=[False]),
    ]
    with pytest.raises(InputError, match="in view front and .* in view side, which contradict"):
        see_prompts(gaussians, prompts)
    monkeypatch.setattr(seen_module, "_MAX_OVERLAP", 1.0)
    assert see_prompts(gaussians, prompts)


def test_what_counts_as_sky(gaussians, view) -> None:
    prompt = ViewPrompt(view=view, points=[[10, 20]])
    assert see_prompts(replace(gaussians, opacities=torch.full((len(gaussians),), 0.03)), [prompt])
    with pytest.raises(InputError, match="the sky"):
        see_prompts(replace(gaussians, opacities=torch.full((len(gaussians),), 0.005)), [prompt])
    with pytest.raises(RangeError, match="max_pixels: expected at least 1"):
        see_prompts(gaussians, [prompt], max_pixels=0)


def test_views_are_kept_and_used_again(gaussians, view, side) -> None:
    with ViewCache(gaussians, backend="cpu", capacity=1) as views:
        see_prompts(gaussians, [ViewPrompt(view=view, points=[[10, 20]])], views=views)
        kept = views.prepared(view)
        see_prompts(gaussians, [ViewPrompt(view=view, points=[[12, 20]])], views=views)
        assert views.prepared(view) is kept
        views.prepared(side)
        assert len(views) == 1
        assert views.prepared(view) is not kept
    assert len(views) == 0
    with pytest.raises(RangeError, match="capacity"):
        ViewCache(gaussians, capacity=0)


def test_a_view_of_what_an_edit_made_speaks_of_the_rows_before_it(gaussians, view, side) -> None:
    """A copy one ball's width nearer, without the right half; the side view shows no edit."""
    count = len(gaussians)
    left = torch.nonzero(gaussians.means[:, 0] < 0).squeeze(1)
    lift = torch.tensor([0.0, 0.1, -0.3])
    parts = [gaussians[left], gaussians[left].replace(means=gaussians.means[left] + lift)]
    edited = Edited(gaussians=Gaussians.concatenate(parts), rows=torch.cat((left, left)))
    labels = Labels(ids=torch.arange(count).int() % 7, confidence=torch.ones(count))
    pixels = torch.tensor([[10, 20], [12, 24], [30, 20]])
    asked: list[View | None] = []

    def shown(one: View | None) -> Edited | None:
        asked.append(one)
        return None if one is side else edited

    with ViewCache(gaussians, backend="cpu", edited=shown) as views:
        with prepare(edited.gaussians, view.camera, backend="cpu") as drawn:
            there = views.weights(view, pixels)
            wanted = torch.zeros(3, count).index_add_(
                1, edited.rows, torch.from_numpy(drawn.weights(pixels).to_scipy().toarray())
            )
            assert torch.allclose(torch.from_numpy(there.to_scipy().toarray()), wanted, atol=1e-6)
            assert float(wanted[2].sum()) == 0, "the right half is gone"
            assert float(wanted[0].sum()) > 0.9
            drawn_labels = view_label_map(drawn, labels[edited.rows])
            assert torch.equal(views.label_map(view, labels).ids, drawn_labels.ids)
        assert views.shown(view) is edited
        assert torch.equal(views.shown(side).rows, torch.arange(count))
        plain = weights(gaussians, side.camera, pixels, backend="cpu")
        assert torch.equal(views.weights(side, pixels).ids, plain.ids)
        assert torch.equal(
            views.label_map(side, labels).ids, label_map(gaussians, side.camera, labels).ids
        )
        nearer = AxisBox(low=(-9, -9, 1.6), high=(9, 9, 1.8))
        assert torch.equal(views.inside(nearer).nonzero().squeeze(1), left)
        assert asked[-1] is None, "a box is in the world"
        corners = torch.tensor([[0.0, 0], [40, 0], [40, 30], [0, 30]])
        assert int(views.inside(Lasso(view=side, polygon=corners)).sum()) > len(left)
        dark = edited.gaussians.replace(opacities=torch.zeros(2 * len(left)))
        edited = Edited(gaussians=dark, rows=edited.rows)
        assert not views.inside(nearer).any(), "what is not shown is nowhere"


def test_views_of_another_edit_are_prepared_anew_and_those_before_let_go(
    gaussians, view, side
) -> None:
    edits = [Edited.unchanged(gaussians), Edited.unchanged(gaussians)]

    def shown(one: View | None) -> Edited | None:
        return None if one is side else edits[-1]

    with ViewCache(gaussians, backend="cpu", edited=shown) as views:
        plain, first = views.prepared(side), views.prepared(view)
        assert views.prepared(view) is first
        assert len(views) == 2
        edits.pop()
        assert views.prepared(view) is not first
        assert len(views) == 2
        assert views.prepared(side) is plain
