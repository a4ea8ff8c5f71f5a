"""Masks, label maps, layers, selections, views: what they hold and what they refuse."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatseg.core import (
    Camera,
    Capture,
    ClassInfo,
    ClassTable,
    FeatureMap,
    Features,
    LabelMap,
    Labels,
    LayerInfo,
    MaskSet,
    Rle,
    Selection,
    View,
)
from splatseg.errors import InputError, RangeError, ShapeError


@given(
    height=st.integers(1, 12), width=st.integers(1, 12), seed=st.integers(0, 2**32 - 1),
    share=st.floats(0, 1),
)  # fmt: skip
def test_masks_survive_both_encodings(height: int, width: int, seed: int, share: float) -> None:
    g = torch.Generator().manual_seed(seed)
    mask = torch.rand(height, width, generator=g) < share
    rle = Rle.encode(mask)
    assert torch.equal(rle.decode(), mask)
    again = Rle.from_coco(rle.to_coco(), height=height, width=width)
    assert np.array_equal(again.counts, rle.counts)
    assert rle.area == int(mask.sum())
    rows, columns = torch.nonzero(mask, as_tuple=True)
    if len(rows):
        x, y = int(columns.min()), int(rows.min())
        expected = (x, y, int(columns.max()) - x + 1, int(rows.max()) - y + 1)
        assert rle.bbox == expected
    else:
        assert rle.bbox == (0, 0, 0, 0)


def test_runs_go_down_the_columns_and_start_with_zeros() -> None:
    """COCO's order, by hand: the left column is set, the right one is not."""
    rle = Rle.encode(torch.tensor([[True, False], [True, False]]))
    assert rle.counts.tolist() == [0, 2, 2]


def test_coco_text_by_hand() -> None:
    """5 bits a character from '0'; from the fourth run on, differences to the run before last."""
    rle = Rle(height=5, width=20, counts=np.array([6, 1, 40, 4, 49], np.uint32))
    # 6 -> '6'; 1 -> '1'; 40 = 8 + 32 * 1 -> 'X', '1'; 4 - 1 = 3 -> '3'; 49 - 40 = 9 -> '9'
    assert rle.to_coco() == "61X139"
    assert Rle.from_coco("61X139", height=5, width=20).counts.tolist() == [6, 1, 40, 4, 49]


@pytest.mark.parametrize(
    ("text", "message"),
    [("61X13", "add up"), ("6\x7f", "other characters"), ("X", "breaks off"), ("O", "negative")],
)
def test_broken_masks_are_refused(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Rle.from_coco(text, height=5, width=20)


def test_mask_sets_keep_scores_and_sizes_in_step() -> None:
    masks = torch.zeros(2, 4, 5, dtype=torch.bool)
    masks[1, 2, 3] = True
    made = MaskSet.from_dense(masks, scores=[0.5, 0.9], levels=[1, 0])
    assert torch.equal(made.dense(1), masks[1])
    assert made.scores.tolist() == pytest.approx([0.5, 0.9])
    with pytest.raises(ShapeError, match=r"levels: expected shape \(1\), got \(2,\)"):
        MaskSet.from_dense(masks, scores=[0.5])
    with pytest.raises(ShapeError, match=r"scores: expected shape \(2\), got \(1,\)"):
        MaskSet.from_dense(masks, scores=[0.5], levels=[1])
    with pytest.raises(ShapeError, match=r"masks\[0\]: expected 4 x 6 pixels, got 4 x 5"):
        MaskSet(height=4, width=6, masks=made.masks, scores=made.scores, levels=made.levels)


def test_label_maps_have_ids_of_minus_one_or_more() -> None:
    assert LabelMap(ids=torch.tensor([[-1, 3]])).ids.dtype == torch.int32
    with pytest.raises(RangeError, match="-1 or more, got -2"):
        LabelMap(ids=torch.tensor([[-2]]))
    with pytest.raises(ShapeError, match="confidence"):
        LabelMap(ids=torch.zeros(2, 3), confidence=torch.zeros(2, 2))
    with pytest.raises(RangeError, match="stride"):
        FeatureMap(features=torch.zeros(1, 1, 2), stride=0, height=1, width=1)


def test_layers_slice_in_step() -> None:
    labels = Labels(
        ids=torch.tensor([3, -1, 5]),
        confidence=torch.tensor([0.9, 0.0, 0.6]),
        background=7,
        candidates=torch.tensor([[3, 5], [-1, -1], [5, 3]], dtype=torch.int32),
        shares=torch.tensor([[0.9, 0.1], [0, 0], [0.6, 0.4]]),
        evidence=torch.tensor([4.0, 0.0, 2.5]),
        effective_views=torch.tensor([3.0, 0.0, 1.5]),
        inferred=torch.tensor([False, True, False]),
        info=LayerInfo(method="by hand"),
    )
    part = labels[torch.tensor([2, 0])]
    assert part.evidence is not None
    assert part.evidence.tolist() == [2.5, 4.0]
    assert part.effective_views is not None
    assert part.effective_views.tolist() == [1.5, 3.0]
    assert labels.inferred is not None
    assert part.inferred is not None
    assert labels[1:].inferred.tolist() == [True, False]
    with pytest.raises(ShapeError, match="evidence"):
        Labels(ids=labels.ids, confidence=labels.confidence, evidence=torch.zeros(2))
    with pytest.raises(ShapeError, match="effective_views"):
        Labels(ids=labels.ids, confidence=labels.confidence, effective_views=torch.zeros(2))
    with pytest.raises(InputError, match="inferred: expected booleans"):
        Labels(ids=labels.ids, confidence=labels.confidence, inferred=torch.zeros(3))
    assert part.ids.tolist() == [5, 3]
    assert part.candidates is not None
    assert part.candidates.tolist() == [[5, 3], [3, 5]]
    assert part.background == 7
    assert part.info.method == "by hand"
    assert labels.present.tolist() == [3, 5, 7]
    with pytest.raises(InputError, match="both or neither"):
        Labels(ids=labels.ids, confidence=labels.confidence, shares=labels.shares)
    features = Features(values=torch.arange(6.0).reshape(3, 2), weights=torch.arange(3.0))
    assert features[1:].values.tolist() == [[2, 3], [4, 5]]
    with pytest.raises(ShapeError, match="weights"):
        Features(values=torch.zeros(3, 2), weights=torch.zeros(2))


@given(seed=st.integers(0, 2**32 - 1))
def test_selections_are_a_boolean_algebra(seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    a, b, c = (Selection(mask=torch.rand(9, generator=g) < 0.5) for _ in range(3))

    def same(left: Selection, right: Selection) -> bool:
        return torch.equal(left.mask, right.mask)

    assert same(~(a & b), ~a | ~b)
    assert same(a - b, a & ~b)
    assert same(a ^ b, (a | b) - (a & b))
    assert same(a & (b | c), (a & b) | (a & c))
    assert (a | b).count == a.count + b.count - (a & b).count


def test_selections_of_other_scenes_do_not_mix() -> None:
    with pytest.raises(ShapeError, match="over 2 Gaussians, got one over 3"):
        Selection(mask=torch.ones(2, dtype=torch.bool)) & Selection(
            mask=torch.ones(3, dtype=torch.bool)
        )
    with pytest.raises(InputError, match="expected booleans"):
        Selection(mask=torch.ones(2))


def view(name: str, split: str = "train") -> View:
    camera = Camera(width=4, height=3, fx=4, fy=4, cx=2, cy=1.5, cam_from_world=torch.eye(4))
    return View(name=name, camera=camera, split=split)


def test_captures_find_their_views() -> None:
    capture = Capture(
        path=Path("somewhere"), format="colmap", views=(view("a"), view("b", "test"), view("c"))
    )
    assert [v.name for v in capture.train_views] == ["a", "c"]
    assert [v.name for v in capture.test_views] == ["b"]
    assert capture.view("c").name == "c"
    with pytest.raises(InputError, match=r"no 'd' among 3 views \(a, b, c"):
        capture.view("d")
    with pytest.raises(InputError, match="'a' more than once"):
        Capture(path=Path("x"), format="colmap", views=(view("a"), view("a")))


def test_class_tables_name_ids() -> None:
    table = ClassTable(
        rows=(ClassInfo(id=1, name="sky", isthing=False), ClassInfo(id=4, name="car"))
    )
    assert table.name_of(4) == "car"
    assert table.name_of(9) == "id 9"
    assert table.by_name("sky").id == 1
    with pytest.raises(InputError, match="expected one of sky, car, got 'cat'"):
        table.by_name("cat")
    with pytest.raises(InputError, match=r"distinct ids, got \[1\]"):
        ClassTable(rows=(ClassInfo(id=1, name="a"), ClassInfo(id=1, name="b")))
