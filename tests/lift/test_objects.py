"""Objects learnt with the geometry: what lies on two of them is split, and each part takes one."""

from dataclasses import replace

import pytest
import torch

from splatseg.core import UNLABELLED, Gaussians, LabelMap
from splatseg.errors import InputError
from splatseg.lift import ObjectLabels, SharpenOptions, uplift
from splatseg.lift.boundaries.cut import sides_of
from splatseg.lift.boundaries.objects import pair_directions

from .conftest import Maps
from .test_sharpen import LEFT, RIGHT, wall

ALL = SharpenOptions(trust_pixels=-1)
STRADDLING = slice(10, 15)
"""The column of the wall that lies 4 cm right of the border, 13 cm wide."""


def decided(gaussians, views, maps, *, room: int = 100):
    labels = ObjectLabels(views, maps, options=ALL, backend="cpu")
    return labels.decide(gaussians, room=room), labels


def test_one_gaussian_on_two_slabs_becomes_one_on_each() -> None:
    gaussians, views, maps = wall()
    edited, objects = decided(gaussians, views, maps)
    straddling = list(range(25))[STRADDLING]
    assert edited.rows.tolist() == [i for i in range(25) if i not in straddling] + [
        i for i in straddling for _ in range(2)
    ]
    parts = edited.gaussians[torch.arange(20, 30)]
    ids = objects.labels[20:].reshape(5, 2)
    assert ids.sort(dim=1).values.tolist() == [[LEFT, RIGHT]] * 5
    x = parts.means[:, 0].reshape(5, 2)
    # Six tenths of a standard deviation to either side, and narrower across.
    assert torch.allclose(x.sort(dim=1).values, 0.04 + 0.078 * torch.tensor([-1.0, 1.0]), atol=3e-3)
    assert torch.equal(x < 0.04, ids == LEFT)
    assert torch.allclose(parts.scales.amin(dim=1), torch.tensor(0.8 * 0.13), atol=1e-3)
    kept = edited.gaussians[torch.arange(20)]
    assert torch.equal(kept.means, gaussians.means[edited.rows[:20]])
    assert torch.equal(objects.labels[:20], uplift(gaussians, views, maps).ids[edited.rows[:20]])


def test_directions_of_pairs_are_those_of_a_cut_between_them() -> None:
    gaussians, views, maps = wall()
    pairs = torch.tensor([[LEFT, RIGHT]]).expand(len(gaussians), 2)
    found = pair_directions(gaussians, views, maps, pairs, backend="cpu")
    sides = sides_of(gaussians, views, maps, [LEFT], border_weight=0.1, backend="cpu")
    assert float(sides.direction.abs().max()) > 0
    assert torch.allclose(found, sides.direction, rtol=1e-4, atol=1e-9)
    swapped = pair_directions(gaussians, views, maps, pairs.flip(1), backend="cpu")
    assert torch.allclose(swapped, -found, rtol=1e-4, atol=1e-9)
    alone = pair_directions(gaussians, views, maps, torch.full_like(pairs, LEFT), backend="cpu")
    assert not bool(alone.any())


def test_as_many_are_split_as_there_is_room_for() -> None:
    gaussians, views, maps = wall()
    for room in (0, 2):
        edited, objects = decided(gaussians, views, maps, room=room)
        assert len(edited) == len(objects.labels) == 25 + room
    smaller = gaussians.replace(scales=gaussians.scales * 0.05)
    edited, _ = decided(smaller, views, maps)
    assert len(edited) == 25, "what is below half a pixel stays whole"


def test_pixels_that_contradict_the_layer_do_not_count() -> None:
    gaussians, views, maps = wall()
    wrong = maps.label_map("v1").ids.clone()
    wrong[:, :4] = 9
    maps.maps["v1"] = LabelMap(ids=wrong)
    seen = {}
    for trust in (-1, 2):
        labels = ObjectLabels(views, maps, options=SharpenOptions(trust_pixels=trust))
        labels.decide(gaussians, room=0)
        seen[trust] = labels._maps.label_map("v1").ids[:, :4]
    assert bool((seen[-1] == 9).all())
    assert bool((seen[2] == UNLABELLED).all())


def test_views_without_evidence_have_no_loss_and_all_without_are_refused() -> None:
    gaussians, views, maps = wall()
    few = Maps({name: maps.maps[name] for name in ("v0", "v2")})
    _, labels = decided(gaussians, views, few)
    after = labels.decide(gaussians, room=0)
    assert len(after) == len(gaussians)
    rows = torch.arange(len(gaussians))
    losses = {
        view.name: float(labels.loss(torch.Generator().manual_seed(1))(view, gaussians, rows))
        for view in views
    }
    assert losses["v1"] == 0
    assert losses["v0"] > 0
    assert losses["v2"] > 0
    with pytest.raises(InputError, match="evidence: expected some of the 3 training views"):
        ObjectLabels(views, Maps({"other": maps.maps["v0"]}))


def test_a_restored_copy_gives_the_same_losses() -> None:
    gaussians, views, maps = wall()
    edited, labels = decided(gaussians, views, maps)
    asked: list[Gaussians] = []

    def matched(of: Gaussians) -> Maps:
        asked.append(of)
        return maps

    copy = ObjectLabels(views, maps, matched=matched, options=ALL, backend="cpu")
    assert copy.state().keys() == labels.state().keys()
    copy.restore(labels.state())
    rows = torch.arange(len(edited))
    for seed in range(3):
        one, other = (
            which.loss(torch.Generator().manual_seed(seed))(views[1], edited.gaussians, rows)
            for which in (labels, copy)
        )
        assert torch.equal(one, other)
    copy.decide(edited.gaussians, room=0)
    assert not asked, "label maps are matched once"
    fresh = ObjectLabels(views, maps, matched=matched, options=ALL, backend="cpu")
    fresh.decide(gaussians, room=0)
    fresh.decide(gaussians, room=0)
    assert asked == [gaussians]


def test_what_counts_is_in_the_digest() -> None:
    _, views, maps = wall()
    options = (ALL, replace(ALL, label_weight=0.2), SharpenOptions())
    marks = {ObjectLabels(views, maps, options=one, digest="a").digest for one in options}
    assert len(marks) == 3
    assert ObjectLabels(views, maps, digest="b").digest not in marks
