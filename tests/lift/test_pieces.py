"""Partitions of an image that no segment divides."""

import numpy as np
import pytest
import torch

from splatseg.core import LabelMap, MaskSet
from splatseg.lift.voting import segment_masses as module
from splatseg.lift.voting.segment_masses import covered_pieces, pieces_of, refined


@pytest.mark.parametrize("sets", [0, 1, 7, 200])
def test_refined_is_the_partition_by_membership(rng, sets) -> None:
    """Two items are in one part when they are in the same sets; 200 sets number parts anew."""
    inside = rng.random((sets, 300)) < 0.5 if sets < 9 else rng.random((sets, 300)) < 0.02
    part = refined([np.flatnonzero(row) for row in inside], 300)
    patterns, expected = np.unique(inside, axis=1, return_inverse=True)
    assert sorted(np.unique(part)) == list(range(patterns.shape[1] if sets else 1))
    pairs = np.unique(np.stack((part, expected.reshape(-1) if sets else part)), axis=1)
    assert len(pairs[0]) == len(np.unique(part)) == len(np.unique(pairs[1]))


def test_masks_are_made_of_whole_pieces(rng) -> None:
    masks = torch.from_numpy(rng.random((9, 12, 16)) < 0.3)
    masks[2] = False
    masks[4] = masks[3] | masks[5]
    (pieces,) = pieces_of(MaskSet.from_dense(masks))
    masks_drawn = pieces.segments.toarray()[:, pieces.piece].reshape(9, 12, 16)
    assert np.array_equal(masks_drawn, masks.numpy().astype(np.float32))
    assert pieces.segment_ids.tolist() == list(range(9))
    assert pieces.weight is None


def test_pieces_of_a_label_map_are_its_segments(rng) -> None:
    ids = torch.from_numpy(rng.choice([-1, 0, 5, 2_000_000_000], (12, 16)))
    confidence = torch.from_numpy(rng.random((12, 16))).float()
    (pieces,) = pieces_of(LabelMap(ids=ids, confidence=confidence))
    assert pieces.segment_ids.tolist() == [0, 5, 2_000_000_000]
    masks_drawn = pieces.segments.toarray()[:, pieces.piece].reshape(3, 12, 16)
    for mask, segment_id in zip(masks_drawn, pieces.segment_ids.tolist(), strict=True):
        assert np.array_equal(mask == 1, (ids == segment_id).numpy())
    assert pieces.weight is not None
    assert np.array_equal(pieces.weight, confidence.numpy().reshape(-1))


def test_nothing_has_one_piece() -> None:
    (empty,) = pieces_of(MaskSet.from_dense(torch.zeros(0, 3, 4, dtype=torch.bool)))
    assert empty.segments.shape == (0, 1)
    assert empty.piece.tolist() == [0] * 12


def test_pieces_of_many_large_masks_go_with_the_masks(rng) -> None:
    """Twice the masks have twice the pieces and twice the entries, where all together have four."""
    y, x = np.mgrid[:48, :64]
    discs = [
        (x - 64 * rng.random()) ** 2 + (y - 48 * rng.random()) ** 2 < 15**2 for _ in range(256)
    ]
    counts = {}
    for number in (128, 256):
        runs = pieces_of(MaskSet.from_dense(torch.from_numpy(np.stack(discs[:number]))))
        ids = [name for run in runs for name in run.segment_ids.tolist()]
        assert ids == list(range(number))
        counts[number] = sum(run.segments.nnz for run in runs)
    assert counts[256] < 2.3 * counts[128]


def test_what_runs_cover_together(rng, monkeypatch) -> None:
    masks = torch.from_numpy(rng.random((6, 12, 16)) < 0.2)
    monkeypatch.setattr(module, "_LAYERS", 0.3)
    runs = pieces_of(MaskSet.from_dense(masks))
    assert len(runs) > 1
    cover = covered_pieces(runs)
    assert np.array_equal(cover.covered[cover.piece], masks.any(dim=0).reshape(-1).numpy())
