"""Segments take the ids of the layer that they fit best: cases worked out by hand."""

from collections.abc import Mapping
from dataclasses import dataclass

import pytest
import torch

from splatseg.core import LabelMap, Labels, MaskSet, View
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift import MatchedMaps, ReducedMaps, label_map

from .conftest import BACKEND, Maps, camera_at, gaussians_at

A, B = 4, 9
"""Ids of the layer: the left and the right of two dots."""

VIEW = View(name="v", camera=camera_at())
SCENE = gaussians_at([[-0.4, 0.0, 2.0], [0.4, 0.0, 2.0]], scale=0.12)
LAYER = Labels(ids=torch.tensor([A, B], dtype=torch.int32), confidence=torch.ones(2))


@dataclass(frozen=True)
class Segments:
    """Segments in memory."""

    found: Mapping[str, LabelMap | MaskSet]
    overlapping: bool = False
    persistent: bool = False

    @property
    def view_names(self):
        return tuple(self.found)

    def segments_of(self, name):
        return self.found[name]

    def categories_of(self, name):
        return {}


@pytest.fixture(scope="module")
def drawn() -> torch.Tensor:
    """What the layer shows: A, B and -1."""
    ids = label_map(SCENE, VIEW.camera, LAYER, backend=BACKEND).ids
    assert {-1, A, B} == set(ids.unique().tolist())
    return ids


def matched(segments: LabelMap | MaskSet, **options) -> torch.Tensor:
    source = Segments({"v": segments}, overlapping=isinstance(segments, MaskSet))
    maps = MatchedMaps(
        gaussians=SCENE, views=[VIEW], source=source, labels=LAYER, backend=BACKEND, **options
    )
    assert list(maps.view_names) == ["v"]
    return maps.label_map("v").ids


def test_segments_take_the_id_they_overlap_most(drawn) -> None:
    """Own ids 1 and 2, exactly as the layer is: its ids, and none where there is none."""
    segments = torch.where(drawn == A, 2, torch.where(drawn == B, 1, -1)).int()
    assert torch.equal(matched(LabelMap(ids=segments)), drawn)


def test_the_boundary_is_that_of_the_segment(drawn) -> None:
    wider = drawn == A
    wider = wider | torch.roll(wider, 1, 0) | torch.roll(wider, -1, 0)
    found = matched(LabelMap(ids=torch.where(wider, 7, -1).int()))
    assert torch.equal(found, torch.where(wider, A, -1).int())
    assert int((found == A).sum()) > int((drawn == A).sum())


def test_what_fits_nothing_well_enough_says_nothing(drawn) -> None:
    """One segment over the whole image: its overlap with A is A's share of the image."""
    everything = LabelMap(ids=torch.zeros(drawn.shape, dtype=torch.int32))
    share = float((drawn == A).float().mean())
    assert bool((matched(everything, min_overlap=share + 1e-6) == -1).all())
    # A and B are as large as each other: the smaller id wins.
    assert bool((matched(everything, min_overlap=share - 1e-6) == A).all())


def test_a_segment_of_nothing_but_gaps_has_no_id(drawn) -> None:
    gaps = LabelMap(ids=torch.where(drawn == -1, 3, -1).int())
    assert bool((matched(gaps, min_overlap=0.0) == -1).all())


def test_of_masks_that_overlap_the_better_one_tells(drawn) -> None:
    a, b = drawn == A, drawn == B
    part = a.clone()
    part[: part.shape[0] // 2] = False
    both = a | b
    # Half of A by itself (1/2) and A with B (1/2) are worse than A: wherever A is, it tells.
    masks = MaskSet.from_dense(torch.stack((part, both, a)))
    found = matched(masks, min_overlap=0.4)
    assert bool((found[a] == A).all())
    assert bool((found[b] == A).all()), "of A and B with equal overlap the smaller id"
    assert bool((found[~both] == -1).all())
    # Order does not matter, and what overlaps too little is left out.
    turned = MaskSet.from_dense(torch.stack((a, both, part)))
    assert torch.equal(found, matched(turned, min_overlap=0.4))
    alone = matched(turned, min_overlap=0.6)
    assert torch.equal(alone, torch.where(a, A, -1).int())


def test_where_two_masks_disagree_the_better_one_tells(drawn) -> None:
    """A alone, and B with half of A, whose overlap with B is 2/3."""
    a, b = drawn == A, drawn == B
    half = a.clone()
    half[: half.shape[0] // 2] = False
    wanted = torch.where(a, A, torch.where(b, B, -1)).int()
    for order in ((a, b | half), (b | half, a)):
        assert torch.equal(matched(MaskSet.from_dense(torch.stack(order))), wanted)


def test_empty_masks_are_harmless(drawn) -> None:
    masks = MaskSet.from_dense(torch.stack((drawn == -2, drawn == B)))
    assert torch.equal(matched(masks), torch.where(drawn == B, B, -1).int())


def test_large_photographs_are_read_smaller() -> None:
    """Twice the pixels, read at the size of the small ones: maps are of the small size."""
    large = View(name="v", camera=camera_at(width=32, height=24))
    ids = label_map(SCENE, large.camera, LAYER, backend=BACKEND).ids
    maps = MatchedMaps(
        gaussians=SCENE,
        views=[large],
        source=Segments({"v": LabelMap(ids=ids)}),
        labels=LAYER,
        longest_side=16,
        backend=BACKEND,
    )
    found = maps.label_map("v")
    assert (found.height, found.width) == (12, 16)
    assert set(found.ids.unique().tolist()) == {-1, A, B}


def test_a_coarser_pixel_takes_what_is_at_its_middle() -> None:
    from splatseg.lift.segments import reduced_segments

    ids = torch.arange(12, dtype=torch.int32).view(2, 6)
    found = reduced_segments(LabelMap(ids=ids), 3)
    assert isinstance(found, LabelMap)
    assert found.ids.tolist() == [[7, 9, 11]]
    masks = MaskSet.from_dense(torch.stack((ids == 9, ids == 8)))
    coarse = reduced_segments(masks, 3)
    assert isinstance(coarse, MaskSet)
    assert coarse.dense(0).tolist() == [[False, True, False]]
    assert not bool(coarse.dense(1).any())


def test_views_without_segments_are_not_named_and_not_there() -> None:
    other = View(name="w", camera=camera_at(0.2))
    source = Segments({"v": LabelMap(ids=torch.zeros(12, 16, dtype=torch.int32))})
    maps = MatchedMaps(gaussians=SCENE, views=[VIEW, other], source=source, labels=LAYER)
    assert list(maps.view_names) == ["v"]
    with pytest.raises(InputError, match="expected a view x"):
        maps.label_map("x")


def test_refused() -> None:
    source = Segments({})
    with pytest.raises(RangeError, match="min_overlap"):
        MatchedMaps(gaussians=SCENE, views=[], source=source, labels=LAYER, min_overlap=1.5)
    short = Labels(ids=LAYER.ids[:1], confidence=LAYER.confidence[:1])
    with pytest.raises(ShapeError, match="labels: expected 2 rows"):
        MatchedMaps(gaussians=SCENE, views=[], source=source, labels=short)


def test_reduced_maps_take_the_middle_of_each_cell_with_its_confidence() -> None:
    ids = torch.arange(24, dtype=torch.int32).reshape(4, 6)
    source = Maps({"v": LabelMap(ids=ids, confidence=ids / 24)})
    for longest in (6, 100):
        assert ReducedMaps(source=source, longest_side=longest).label_map("v") is source.maps["v"]
    found = ReducedMaps(source=source, longest_side=3).label_map("v")
    assert found.ids.tolist() == [[7, 9, 11], [19, 21, 23]]
    assert torch.equal(found.confidence, found.ids / 24)
    plain = ReducedMaps(source=Maps({"v": LabelMap(ids=ids)}), longest_side=3).label_map("v")
    assert plain.confidence is None
