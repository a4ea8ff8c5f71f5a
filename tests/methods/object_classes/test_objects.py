"""Labels of objects on a wall of two halves, each an object."""

from dataclasses import replace

import pytest
import torch

from methods.cosseg.conftest import Maps
from splatseg.core import LabelMap, Labels, LayerInfo
from splatseg.errors import RangeError
from splatseg.methods.object_classes import (
    MAX_CORRELATION,
    ObjectLabelOptions,
    ObjectLabels,
    label_objects,
    named_by_tracks,
    own_share,
)
from splatseg.methods.object_classes.classify import PooledObjects


class Masks:
    """The masks of each view, as association takes them."""

    overlapping, persistent = True, False

    def __init__(self, halves) -> None:
        self.sets = {view.name: halves.masks(view) for view in halves.views}

    @property
    def view_names(self):
        return tuple(self.sets)

    def segments_of(self, name):
        return self.sets[name]

    def categories_of(self, name):
        return {}


def labelled(halves, maps, *, features=True, categories=None, **more) -> ObjectLabels:
    return label_objects(
        halves.gaussians, halves.views, maps, features=halves.blocks if features else None,
        masks=Masks(halves), options=ObjectLabelOptions(**more), categories=categories,
    )  # fmt: skip


def strip(halves, views=("v0", "v1")) -> Maps:
    """Some views give a part of the left half to the right one."""
    maps = dict(halves.evidence.maps)
    for name in views:
        ids = maps[name].ids.clone()
        ids[:, 4:10] = 8
        maps[name] = LabelMap(ids=ids)
    return Maps(maps)


def away(halves):
    return halves.means[:, 0].abs() > 0.15


def test_an_object_has_one_label_though_parts_of_it_are_outvoted(halves) -> None:
    found = labelled(halves, strip(halves, ("v0", "v1", "v2")), candidates=2, own_share=0.0)
    right = found.classes.ids.long() == halves.side
    assert bool(right[away(halves)].all())
    assert found.classes.candidates is not None
    assert found.classes.shares is not None
    assert float(found.classes.shares.sum(dim=1).max()) <= 1.001
    assert set(found.objects.info.class_of.values()) == {3, 8}
    sure = found.objects.info.details["class_probability"]
    assert set(sure) == {str(id) for id in found.objects.info.class_of}
    assert all(0.5 < one <= 1 for one in sure.values())
    told: list[tuple[int, int]] = []
    again = label_objects(
        halves.gaussians, halves.views[::-1], strip(halves, ("v0", "v1", "v2")),
        features=halves.blocks, masks=Masks(halves),
        options=ObjectLabelOptions(candidates=1, own_share=0.0),
        progress=lambda *step: told.append(step),
    )  # fmt: skip
    assert torch.equal(again.classes.ids, found.classes.ids)
    assert again.classes.candidates is None
    assert again.classes.shares is None
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_what_is_in_no_object_keeps_its_votes(halves) -> None:
    """The masks of the left half are missing."""
    masks = Masks(halves)
    for name, one in masks.sets.items():
        masks.sets[name] = type(one).from_dense(torch.stack([one.dense(1)]))
    found = label_objects(
        halves.gaussians, halves.views, strip(halves), features=None, masks=masks,
        options=ObjectLabelOptions(),
    )  # fmt: skip
    left = (halves.side == 3) & away(halves)
    ids = found.classes.ids[left]
    assert 3 in ids.tolist()
    right = (halves.side == 8) & away(halves)
    assert bool((found.classes.ids[right] == 8).all())


def test_labels_of_tracks_are_objects_with_classes(halves) -> None:
    found = labelled(halves, halves.evidence, categories={3: {30: 5.0, 80: 2.0}, 8: {80: 1.0}})
    assert found.classes is None
    kinds = found.objects.info.class_of
    of = torch.tensor([kinds.get(int(id), -1) for id in found.objects.ids])
    assert bool((of == halves.side * 10)[away(halves)].all())


def test_rounds_tell_the_objects_of_a_track_apart(halves, monkeypatch) -> None:
    sure = {}
    for rounds in (1, 10):
        monkeypatch.setattr("splatseg.methods.object_classes.classify.CATEGORY_ROUNDS", rounds)
        found = labelled(halves, strip(halves), categories={3: {30: 5.0}, 8: {80: 4.0, 30: 2.0}})
        sure[rounds] = found.objects.info.details["mean_class_probability"]
    assert sure[10] > sure[1]


def test_objects_have_the_ids_of_the_tracks_that_cover_them_best() -> None:
    objects = Labels(
        ids=torch.tensor([1, 2, 4, -1]), confidence=torch.ones(4),
        candidates=torch.tensor([[1, 2], [2, -1], [4, 1], [-1, -1]]), shares=torch.ones(4, 2) / 2,
    )  # fmt: skip
    pooled = PooledObjects(
        ids=torch.tensor([1, 2, 4]),
        classes=torch.tensor([5, 9]),
        votes=torch.tensor([[10.0, 8], [9, 1], [3, 0]]).double(),
        features=torch.tensor([[1.0], [2], [3]]).double(),
        known=torch.tensor([True, False, True]),
    )
    # 8 + 9 is more than 10 + 1, and nothing is left for the third.
    named, found = named_by_tracks(objects, pooled)
    assert named.ids.tolist() == [9, 5, 10, -1]
    assert named.candidates is not None
    assert named.candidates.tolist() == [[9, 5], [5, -1], [10, 9], [-1, -1]]
    assert found.ids.tolist() == [5, 9, 10]
    assert found.votes.tolist() == [[9, 1], [10, 8], [3, 0]]
    assert found.features[:, 0].tolist() == [2, 1, 3]
    assert found.known.tolist() == [False, True, True]


def test_names_are_those_of_classes(halves) -> None:
    from splatseg.core import ClassInfo, ClassTable

    table = ClassTable(rows=(ClassInfo(id=3, name="board"), ClassInfo(id=8, name="door")))
    found = label_objects(
        halves.gaussians, halves.views, halves.evidence, features=halves.blocks,
        masks=Masks(halves), options=ObjectLabelOptions(), classes=table,
    )  # fmt: skip
    assert found.classes.info.names == {3: "board", 8: "door"}
    names = set(found.objects.info.names.values())
    assert {name.split()[0] for name in names} == {"board", "door"}
    assert replace(found.objects).info.names == found.objects.info.names


def test_own_votes_share_in_the_class_where_views_err_independently(halves, monkeypatch) -> None:
    """All views give a strip of the left half to the right one: objects repair it, votes do not."""
    maps = strip(halves, ("v0", "v1", "v2"))
    own = labelled(halves, maps, own_share=1.0, candidates=2).classes
    none = labelled(halves, maps, own_share=0.0, candidates=2).classes
    assert none.info.details["own_share"] == 0
    wrong = (own.ids.long() != halves.side) & away(halves)
    assert bool(wrong.any())
    assert not bool(((none.ids.long() != halves.side) & away(halves)).any())
    both = labelled(halves, maps, own_share=0.25, candidates=2).classes
    share = both.shares[wrong, 0] + both.shares[wrong, 1]
    assert torch.allclose(share, torch.ones_like(share), atol=1e-4)
    row = torch.nonzero(wrong)[0, 0]

    def of(layer, id):
        return float(layer.shares[row][layer.candidates[row] == id].sum())

    for id in (3, 8):
        expected = 0.25 * of(own, id) + 0.75 * of(none, id)
        assert abs(of(both, id) - expected) < 1e-4


def sure(ids, correlation=None) -> Labels:
    """Each Gaussian has all its votes for one id."""
    ids = torch.tensor(ids)
    return Labels(
        ids=ids, confidence=torch.ones(len(ids)), candidates=ids[:, None].repeat(1, 2),
        shares=torch.tensor([[1.0, 0.0]]).repeat(len(ids), 1), evidence=torch.ones(len(ids)),
        info=LayerInfo(view_correlation=correlation),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("correlation", "expected"),
    [(MAX_CORRELATION / 4, 0.75), (MAX_CORRELATION, 0.0), (0.9, 0.0), (-0.2, 1.0), (None, 0.0)],
)
def test_the_share_of_own_votes_falls_with_the_correlation_of_views(correlation, expected) -> None:
    votes = sure([5, 5, 7, 7], correlation)
    objects = sure([1, 1, 2, 2])
    found = own_share(ObjectLabelOptions(), objects, votes)
    assert found.share == pytest.approx(expected)
    assert found.heterogeneity == 0
    assert own_share(ObjectLabelOptions(own_share=0.3), objects, votes).share == 0.3


def test_own_votes_count_where_objects_are_none(monkeypatch) -> None:
    """Half of what Gaussians disagree about is between those of one object: (0 + 1/2) / 1."""
    votes, objects = sure([5, 7, 5, 7], 0.9), sure([1, 1, 2, 3])
    assert own_share(ObjectLabelOptions(), objects, votes).heterogeneity == 1
    mixed = replace(votes, shares=torch.tensor([[0.5, 0.5]]).repeat(4, 1),
                    candidates=torch.tensor([[5, 7]]).repeat(4, 1))  # fmt: skip
    assert own_share(ObjectLabelOptions(), objects, mixed).heterogeneity == 0
    shares = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5], [0.5, 0.5]])
    half = replace(mixed, shares=shares)
    # Objects 1, 2 and 3 have 2, 1 and 1 of the mass and half of it each disagrees.
    for limit, share in ((0.4, 0.25), (0.2, 1.0), (0.6, 0.0)):
        monkeypatch.setattr("splatseg.methods.object_classes.MAX_HETEROGENEITY", limit)
        found = own_share(ObjectLabelOptions(), objects, half)
        assert found.heterogeneity == pytest.approx(0.5)
        assert found.share == pytest.approx(share)


def test_options_are_held_to_their_ranges() -> None:
    with pytest.raises(RangeError, match=r"^own_share: expected"):
        ObjectLabelOptions(own_share=1.5)
    with pytest.raises(RangeError, match="^candidates: expected at least 1, got 0"):
        ObjectLabelOptions(candidates=0)
