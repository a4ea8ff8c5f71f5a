"""Masses of segments on Gaussians, against the matrix spelt out."""

import pytest
import torch

from splatseg.core import LabelMap, MaskSet
from splatseg.errors import ShapeError
from splatseg.lift.voting import segment_masses
from splatseg.lift.voting.segment_masses import view_masses
from splatseg.render.warp import warp_into_photograph

from .conftest import BACKEND, BARREL, camera_at, gaussians_at, matrix_of, random_gaussians

TOLERANCE = {"rtol": 1e-3, "atol": 1e-5}
"""Stored weights have half precision."""


def dense(masses, segments: int, gaussians: int) -> torch.Tensor:
    table = torch.zeros(segments, gaussians)
    table[masses.segment, masses.gaussian] = masses.weight
    return table


def expected(gaussians, camera, images: torch.Tensor) -> torch.Tensor:
    """(m, H, W) weights of segments to (m, n) masses, by the definition."""
    stack = images.double().movedim(0, -1)
    if not camera.is_pinhole:
        stack = warp_into_photograph(camera, "nearest").adjoint(stack)
    return torch.einsum("hwn,hwm->mn", matrix_of(gaussians, camera), stack).float()


@pytest.mark.parametrize("band", [1 << 18, 50])
@pytest.mark.parametrize("lens", [{}, BARREL])
def test_overlapping_masks(rng, lens, band, monkeypatch) -> None:
    monkeypatch.setattr(segment_masses, "_BAND", band)
    camera = camera_at(0.1, **lens)
    gaussians = random_gaussians(rng)
    masks = torch.from_numpy(rng.random((7, 12, 16)) < 0.4)
    masks[3] = False
    masks[4] = True
    found = view_masses(gaussians, camera, MaskSet.from_dense(masks), backend=BACKEND)
    table = expected(gaussians, camera, masks)
    torch.testing.assert_close(dense(found, 7, len(gaussians)), table, **TOLERANCE)
    everywhere = expected(gaussians, camera, torch.ones(1, 12, 16))[0]
    torch.testing.assert_close(found.visible, everywhere, **TOLERANCE)
    assert 3 not in found.segment.tolist()
    assert bool((found.weight > 0).all())
    order = found.segment * len(gaussians) + found.gaussian
    assert bool((order[1:] > order[:-1]).all())
    assert found.segment.dtype == found.gaussian.dtype == torch.int64


@pytest.mark.parametrize("lens", [{}, BARREL])
def test_runs_of_masks_give_the_same_bits(rng, lens, monkeypatch) -> None:
    """Weights are half precision and sums exact, whatever masks are taken together."""
    camera, gaussians = camera_at(0.1, **lens), random_gaussians(rng)
    masks = MaskSet.from_dense(torch.from_numpy(rng.random((9, 12, 16)) < 0.4))
    together = view_masses(gaussians, camera, masks, backend=BACKEND)
    monkeypatch.setattr(segment_masses, "_LAYERS", 1)
    assert len(segment_masses.pieces_of(masks)) > 2
    apart = view_masses(gaussians, camera, masks, backend=BACKEND)
    for name in ("segment", "gaussian", "weight", "visible", "covered"):
        assert torch.equal(getattr(together, name), getattr(apart, name)), name


def test_label_maps_keep_their_ids_and_confidence(rng) -> None:
    camera = camera_at()
    gaussians = random_gaussians(rng)
    ids = torch.from_numpy(rng.choice([-1, 0, 5, 2_000_000_000], (12, 16)))
    confidence = torch.from_numpy(rng.random((12, 16))).float()
    found = view_masses(
        gaussians, camera, LabelMap(ids=ids, confidence=confidence), backend=BACKEND
    )
    names = [0, 5, 2_000_000_000]
    assert found.segment.unique().tolist() == names
    images = torch.stack([(ids == i) * confidence for i in names])
    row = torch.searchsorted(torch.tensor(names), found.segment)
    table = torch.zeros(3, len(gaussians))
    table[row, found.gaussian] = found.weight
    torch.testing.assert_close(table, expected(gaussians, camera, images), **TOLERANCE)


def test_nothing_in_gives_nothing_out() -> None:
    camera = camera_at()
    nothing = MaskSet.from_dense(torch.zeros(0, 12, 16, dtype=torch.bool))
    some = view_masses(gaussians_at([[0, 0, 2]]), camera, nothing, backend=BACKEND)
    assert len(some.segment) == 0
    assert float(some.visible) > 0
    void = LabelMap(ids=torch.full((12, 16), -1))
    none = view_masses(gaussians_at(torch.zeros(0, 3)), camera, void, backend=BACKEND)
    assert len(none.segment) == len(none.visible) == 0


def test_segments_of_another_size_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"segments: expected 16x12 .* got 12x16"):
        view_masses(
            gaussians_at([[0, 0, 2]]),
            camera_at(),
            LabelMap(ids=torch.ones(16, 12, dtype=torch.int32)),
            backend=BACKEND,
        )
