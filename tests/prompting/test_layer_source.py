"""What a click at a rim means: the pixels around it and the sizes of things, by hand."""

import math
from dataclasses import replace

import pytest
import torch

from splatseg.core import Features, InstanceTree, Labels, LayerInfo, Selection, TreeNode
from splatseg.errors import InputError, ShapeError
from splatseg.prompting.layer_source import (
    LayerSource,
    NearestId,
    agreed,
    nearest_id,
    neighbouring_pixels,
    shown_ids,
)
from splatseg.prompting.pipeline import MembershipSource, SimilaritySource
from splatseg.prompting.prompts import ViewPrompt
from splatseg.prompting.seen import see_prompts
from splatseg.render import weights

HEIGHT, WIDTH = 30, 40


def own(id: int) -> int:
    return id


def test_seven_by_seven_pixels_have_a_say_by_their_distance() -> None:
    pixels, votes = neighbouring_pixels(torch.tensor([12, 15]), HEIGHT, WIDTH)
    assert len(pixels) == 49
    say = dict(zip(map(tuple, pixels.tolist()), votes.tolist(), strict=True))
    assert say[12, 15] == 1
    assert say[13, 15] == say[12, 14] == pytest.approx(math.exp(-0.5))
    assert say[14, 16] == pytest.approx(math.exp(-2.5))
    assert say[15, 18] == pytest.approx(math.exp(-9))


def test_no_pixel_outside_the_picture_has_a_say() -> None:
    corner, _ = neighbouring_pixels(torch.tensor([0, 0]), HEIGHT, WIDTH)
    assert sorted(map(tuple, corner.tolist())) == [(x, y) for x in range(4) for y in range(4)]
    last, _ = neighbouring_pixels(torch.tensor([WIDTH - 1, HEIGHT - 1]), HEIGHT, WIDTH)
    assert tuple(last.amax(dim=0).tolist()) == (WIDTH - 1, HEIGHT - 1)
    assert len(last) == 16


@pytest.mark.parametrize(
    ("votes", "sizes", "meant"),
    [
        ([1.0, 0.6], {1: 100, 2: 100}, 1),
        ([1.0, 0.6], {1: 400, 2: 100}, 2),  # 1 / 20 against 0.6 / 10
        ([1.0, 0.6], {1: 250, 2: 100}, 1),  # 1 / 15.8 against 0.6 / 10
        ([1.0, 1.0], {1: 100, 2: 100}, 1),
        ([1.0, 0.5], {1: 400, 2: 100}, 2),  # equal votes: the smaller thing
        ([1.0, 0.5], {1: 3}, 1),  # of 2 nobody knows a Gaussian: it counts as one
    ],
)
def test_a_small_thing_is_likelier_meant(votes, sizes, meant) -> None:
    assert nearest_id([1, 2], votes, thing_of=own, sizes=sizes).id == meant


def test_parts_of_a_thing_speak_together_and_its_most_shown_part_answers() -> None:
    ids, votes = [1, 5, 6, 6], [1.0, 0.6, 0.3, 0.4]
    sizes = {1: 100, 2: 100, 5: 50, 6: 50}
    found = nearest_id(ids, votes, thing_of=lambda id: 2 if id > 4 else id, sizes=sizes)
    assert (found.id, found.thing) == (6, 2)
    assert found.shares == pytest.approx({1: 1 / 2.3, 2: 1.3 / 2.3})
    assert nearest_id(ids, votes, thing_of=own, sizes=sizes | {5: 100, 6: 100}).id == 1


def test_a_click_at_the_border_of_what_another_means_adds_nothing() -> None:
    middle = NearestId(id=1, thing=1, shares={1: 1.0})
    border = NearestId(id=2, thing=2, shares={1: 0.25, 2: 0.75})
    beyond = NearestId(id=3, thing=3, shares={1: 0.15, 3: 0.85})
    assert agreed([middle, border]) == agreed([border, middle]) == [1]
    assert agreed([border]) == [2]
    assert agreed([middle, beyond]) == [1, 3]
    again = NearestId(id=5, thing=1, shares={1: 0.6, 2: 0.4})
    assert agreed([middle, again]) == [1, 5]


@pytest.fixture
def strip(gaussians, labels) -> Labels:
    """The wall is 1, but for a strip of 2 along the left side of its second field."""
    x = gaussians.means[:, 0]
    second = labels.ids == 2
    left, right = float(x[second].min()), float(x[second].max())
    within = second & (x < left + (right - left) / 3)
    return Labels(ids=torch.where(within, 2, 1).int(), confidence=torch.ones(len(x)))


def clicked(gaussians, view, layer, points, signs=None) -> set[int]:
    signs = signs or [True] * len(points)
    prompt = ViewPrompt(view=view, points=points, positive=signs)
    prompts = see_prompts(gaussians, [prompt], backend="cpu")
    ids = getattr(layer, "labels", layer).ids
    return set(ids[LayerSource(layer, gaussians).membership(prompts) > 0.5].tolist())


BESIDE, FAR, INSIDE, MIDDLE = (19.5, 15.5), (15.5, 15.5), (21.5, 15.5), (22.5, 15.5)


def test_a_click_beside_something_small_means_it(gaussians, view, labels, strip) -> None:
    assert shown_at(gaussians, view, strip, BESIDE) == 1
    assert clicked(gaussians, view, strip, [BESIDE]) == {2}
    assert clicked(gaussians, view, strip, [FAR]) == {1}
    assert clicked(gaussians, view, strip, [FAR, BESIDE]) == {1}
    assert clicked(gaussians, view, strip, [FAR, MIDDLE]) == {1, 2}
    # Of two fields of the same size, the one that was clicked.
    assert clicked(gaussians, view, labels, [BESIDE]) == {1}


def test_what_was_shown_not_to_be_it_is_not_meant(gaussians, view, strip) -> None:
    assert clicked(gaussians, view, strip, [BESIDE, INSIDE], [True, False]) == {1}


def test_things_of_a_tree_are_as_large_as_all_of_their_parts(
    gaussians, view, labels, strip
) -> None:
    """The same strip as a part of a thing that has much else."""
    ids = torch.where((labels.ids > 2) & (strip.ids == 1), 3, strip.ids)
    nodes = [
        TreeNode(id=1),
        TreeNode(id=9),
        *(TreeNode(id=i, parent=9, level="part") for i in (2, 3)),
    ]
    layer = InstanceTree(
        nodes=tuple(nodes), labels=Labels(ids=ids.int(), confidence=torch.ones(len(ids)))
    )
    assert clicked(gaussians, view, layer, [BESIDE]) == {1}
    assert clicked(gaussians, view, layer, [INSIDE]) == {2, 3}


def shown_at(gaussians, view, layer, point) -> int:
    pixel = torch.tensor([[int(point[0]), int(point[1])]])
    return int(shown_ids(layer, weights(gaussians, view.camera, pixel, backend="cpu"))[0])


# Layers as sources: which ids or nodes prompts mean, and how sure the answer is.


# Pixels of the four fields, and of what has no label, in the front view.
AT = {1: (12, 15), 2: (26, 15), 3: (12, 25), 4: (26, 25), -1: (38, 15)}


def asked(gaussians, view, positive, negative=(), **fields):
    points = [AT[id] for id in (*positive, *negative)]
    signs = [True] * len(positive) + [False] * len(negative)
    extra = {"points": points, "positive": signs} if points else {}
    return see_prompts(gaussians, [ViewPrompt(view=view, **extra, **fields)], backend="cpu")


def chosen(source, layer, prompts, granularity=None) -> set[int]:
    """Ids of what is selected; what is selected has one of them."""
    ids = getattr(layer, "labels", layer).ids
    mask = source.membership(prompts, granularity=granularity) > 0.5
    found = set(ids[mask].tolist())
    assert torch.equal(mask, torch.isin(ids, torch.tensor(sorted(found), dtype=ids.dtype)))
    return found


def region(rows: slice, columns: slice) -> torch.Tensor:
    mask = torch.zeros(30, 40, dtype=torch.bool)
    mask[rows, columns] = True
    return mask


def test_it_is_a_source_of_both_kinds(gaussians, labels) -> None:
    source = LayerSource(labels, gaussians)
    assert isinstance(source, MembershipSource)
    assert isinstance(source, SimilaritySource)


def test_pixels_show_the_id_of_most_light(gaussians, view, labels) -> None:
    pixels = torch.tensor([*AT.values(), (20, 2)])
    rows = weights(gaussians, view.camera, pixels, backend="cpu")
    dark = -1
    assert shown_ids(labels, rows.select(slice(0, 5))).tolist() == list(AT)
    assert shown_ids(labels, rows.select(torch.tensor([], dtype=torch.int64))).tolist() == []
    assert len(rows.select(torch.tensor([5])).ids) == 0
    assert shown_ids(labels, rows.select(torch.tensor([5]))).tolist() == [dark]


@pytest.mark.parametrize(
    ("positive", "negative", "ids"),
    [((1,), (), {1}), ((1, 4), (), {1, 4}), ((1, 2), (-1,), {1, 2}), ((1, -1), (), {1})],
)
def test_points_on_labels_mean_all_their_ids(
    gaussians, view, labels, positive, negative, ids
) -> None:
    source = LayerSource(labels, gaussians)
    assert chosen(source, labels, asked(gaussians, view, positive, negative)) == ids


def test_strokes_masks_and_boxes_on_labels(gaussians, view, labels) -> None:
    source = LayerSource(labels, gaussians)
    # A tenth of the stroke slips into the field below.
    stroke = region(slice(12, 21), slice(5, 12))
    assert chosen(source, labels, asked(gaussians, view, (), scribble=stroke)) == {1}
    # A seventh of what the stroke shows most of is a slip, a third is meant.
    assert chosen(
        source, labels, asked(gaussians, view, (), scribble=region(slice(12, 24), slice(5, 12)))
    ) == {1, 3}
    both = region(slice(10, 30), slice(0, 20))
    assert chosen(source, labels, asked(gaussians, view, (), mask=both)) == {1, 3}
    little = region(slice(14, 18), slice(5, 12))
    assert chosen(source, labels, asked(gaussians, view, (), mask=little)) == {1}
    assert chosen(source, labels, asked(gaussians, view, (), box=[19, 9, 36, 21])) == {2}
    prompts = asked(gaussians, view, (4,), (3,), mask=both)
    assert chosen(source, labels, prompts) == {1, 4}


@pytest.mark.parametrize(
    ("positive", "negative", "granularity", "ids"),
    [
        ((1,), (), None, {1, 3}),
        ((1,), (), 0.0, {1, 2, 3, 6}),
        ((1,), (), 0.5, {1, 3}),
        ((1,), (), 1.0, {1}),
        ((1, 3), (), None, {1, 3}),
        ((1, 3), (), 1.0, {1, 3}),
        ((1, 2), (), None, {1, 2, 3, 6}),
        ((1,), (3,), None, {1}),
        ((1,), (3,), 0.0, {1}),
        ((1,), (2,), 0.0, {1, 3}),
        ((4,), (2,), None, {6}),
        ((1, 2), (3,), None, {1, 2, 6}),
    ],
)
def test_points_on_a_tree_mean_the_smallest_node_that_fits(
    gaussians, view, tree, positive, negative, granularity, ids
) -> None:
    source = LayerSource(tree, gaussians)
    prompts = asked(gaussians, view, positive, negative)
    assert chosen(source, tree, prompts, granularity) == ids


def test_masks_and_boxes_on_a_tree_mean_the_node_that_fits_best(gaussians, view, tree) -> None:
    source = LayerSource(tree, gaussians)
    left = region(slice(10, 30), slice(0, 20))
    upper = region(slice(10, 20), slice(0, 20))
    assert chosen(source, tree, asked(gaussians, view, (), mask=left)) == {1, 3}
    assert chosen(source, tree, asked(gaussians, view, (), mask=upper)) == {1}
    assert chosen(source, tree, asked(gaussians, view, (), mask=upper), 0.5) == {1, 3}
    assert chosen(source, tree, asked(gaussians, view, (), (3,), mask=left)) == {1}
    assert chosen(source, tree, asked(gaussians, view, (), box=[0, 10, 19.5, 30])) == {1, 3}
    assert chosen(source, tree, asked(gaussians, view, (), box=[0, 10, 36, 30])) == {1, 2, 3, 6}


def test_a_mask_round_what_no_node_holds_together_means_several(gaussians, view, tree) -> None:
    """Parts of two objects; a box, which says less, still means one node."""
    source = LayerSource(tree, gaussians)
    upper = region(slice(10, 19), slice(0, 36))
    assert chosen(source, tree, asked(gaussians, view, (), mask=upper)) == {1, 2}
    # Objects of which half is in the mask are not mostly in it: the group fits as well.
    assert chosen(source, tree, asked(gaussians, view, (), mask=upper), 0.0) == {1, 2, 3, 6}
    # What goes barely over the border of a node means the node.
    more = region(slice(10, 30), slice(0, 20))
    more[10:13, 20:40] = True
    assert chosen(source, tree, asked(gaussians, view, (), mask=more)) == {1, 3}
    assert chosen(source, tree, asked(gaussians, view, (), box=[0, 10, 36, 20])) == {1}


def test_a_stroke_over_many_small_things_means_them_all(gaussians, view, labels) -> None:
    x = gaussians.means[:, 0]
    stripes = replace(labels, ids=(1 + ((x + 2.5) / 0.5).long().clamp(0, 9)).int())
    stroke = region(slice(14, 16), slice(5, 35))
    found = chosen(
        LayerSource(stripes, gaussians), stripes, asked(gaussians, view, (), scribble=stroke)
    )
    assert found == {3, 4, 5, 6, 7, 8}


def test_how_sure_it_is_comes_from_the_evidence(gaussians, view, labels) -> None:
    count = len(labels)
    other = torch.where(labels.ids == 1, 3, 1).int()
    candidates = torch.stack((labels.ids, other), dim=1)
    candidates[labels.ids == -1] = -1
    shares = torch.tensor([[0.6, 0.2]]).expand(count, 2) * (candidates != -1)
    soft = replace(labels, candidates=candidates, shares=shares)
    found = LayerSource(soft, gaussians).membership(asked(gaussians, view, (1,)))
    expected = torch.where(labels.ids == 1, 0.6, 0.2)
    torch.testing.assert_close(found, torch.where(labels.ids == -1, 0.0, expected))
    # One that won by a hair, or by fewer than half of the evidence, is selected all the same.
    unsure = replace(labels, confidence=torch.full((count,), 0.3))
    found = LayerSource(unsure, gaussians).membership(asked(gaussians, view, (1,)))
    assert torch.equal(found > 0.5, labels.ids == 1)


def test_things_like_one(gaussians, labels, tree) -> None:
    one = Selection(mask=labels.ids == 1)
    assert set(labels.ids[LayerSource(labels, gaussians).similar(one) > 0.5].tolist()) == {1}
    named = replace(labels, info=LayerInfo(class_of={1: 7, 4: 7, 2: 8}))
    found = LayerSource(named, gaussians).similar(one) > 0.5
    assert set(labels.ids[found].tolist()) == {1, 4}
    with pytest.raises(InputError, match="expected a class of id 3"):
        LayerSource(named, gaussians).similar(Selection(mask=labels.ids == 3))
    found = LayerSource(tree, gaussians).similar(one) > 0.5
    assert set(tree.labels.ids[found].tolist()) == {1, 2, 3, 6}
    with pytest.raises(InputError, match="labels where something is selected"):
        LayerSource(labels, gaussians).similar(Selection(mask=labels.ids == -1))
    with pytest.raises(ShapeError, match="another scene"):
        LayerSource(labels, gaussians).similar(one[:9])


def test_what_a_layer_cannot_answer(gaussians, view, labels, tree) -> None:
    with pytest.raises(ShapeError, match=r"layer 'mine': expected 1000 rows.*of another scene"):
        LayerSource(labels[:9], gaussians, name="mine")
    with pytest.raises(InputError, match="expected labels or a tree, got features"):
        LayerSource(Features(values=torch.zeros(1000, 2)), gaussians)
    for layer in (labels, tree):
        source = LayerSource(layer, gaussians)
        with pytest.raises(InputError, match="a label where the positive prompts are, got none"):
            source.membership(asked(gaussians, view, (-1,)))
    points = [AT[1], (5, 12)]
    prompts = see_prompts(gaussians, [ViewPrompt(view=view, points=points, positive=[True, False])])
    with pytest.raises(InputError, match="on different ids, got both on 1"):
        LayerSource(labels, gaussians).membership(prompts)
    with pytest.raises(InputError, match="on different nodes, got both on 1"):
        LayerSource(tree, gaussians).membership(prompts)
