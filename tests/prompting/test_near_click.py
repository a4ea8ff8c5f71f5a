"""What a click at a rim means: the pixels around it and the sizes of things, by hand."""

import math

import pytest
import torch

from splatseg.core import InstanceTree, Labels, TreeNode
from splatseg.prompting.layer_source import (
    LayerSource,
    NearestId,
    agreed,
    nearest_id,
    pixels_around,
    shown_ids,
)
from splatseg.prompting.prompts import ViewPrompt
from splatseg.prompting.seen import see_prompts
from splatseg.render import weights

HEIGHT, WIDTH = 30, 40


def own(id: int) -> int:
    return id


def test_seven_by_seven_pixels_have_a_say_by_their_distance() -> None:
    pixels, votes = pixels_around(torch.tensor([12, 15]), HEIGHT, WIDTH)
    assert len(pixels) == 49
    say = dict(zip(map(tuple, pixels.tolist()), votes.tolist(), strict=True))
    assert say[12, 15] == 1
    assert say[13, 15] == say[12, 14] == pytest.approx(math.exp(-0.5))
    assert say[14, 16] == pytest.approx(math.exp(-2.5))
    assert say[15, 18] == pytest.approx(math.exp(-9))


def test_no_pixel_outside_the_picture_has_a_say() -> None:
    corner, _ = pixels_around(torch.tensor([0, 0]), HEIGHT, WIDTH)
    assert sorted(map(tuple, corner.tolist())) == [(x, y) for x in range(4) for y in range(4)]
    last, _ = pixels_around(torch.tensor([WIDTH - 1, HEIGHT - 1]), HEIGHT, WIDTH)
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
