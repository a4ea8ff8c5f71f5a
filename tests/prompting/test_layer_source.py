"""Layers as sources: which ids or nodes prompts mean, and how sure the answer is."""

from dataclasses import replace

import pytest
import torch

from splatseg.core import Features, LayerInfo, Selection
from splatseg.errors import InputError, ShapeError
from splatseg.prompting.layer_source import LayerSource, shown_ids
from splatseg.prompting.pipeline import MembershipSource, SimilaritySource
from splatseg.prompting.prompts import ViewPrompt
from splatseg.prompting.seen import see_prompts
from splatseg.render import weights

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
