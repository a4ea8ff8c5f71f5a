"""Label maps of views, from layers of labels."""

import pytest
import torch

from splatseg.core import Labels
from splatseg.errors import ShapeError
from splatseg.lift import label_map
from splatseg.render.warp import warp_into_photograph

from .conftest import BACKEND, BARREL, camera_at, gaussians_at, matrix_of, random_gaussians


def hard(ids, background: int = -1) -> Labels:
    ids = torch.as_tensor(ids)
    return Labels(ids=ids, confidence=(ids >= 0).float(), background=background)


def expected_map(matrix, shares, ids, background):
    """The definition, with no label as the last of the ids; (H, W) ids and scores."""
    scores = torch.einsum("hwn,nc->hwc", matrix, shares)
    none = torch.einsum("hwn,n->hw", matrix, 1 - shares.sum(dim=1))
    scores = torch.cat((scores, none.unsqueeze(-1)), dim=-1)
    column = ids.index(background) if background >= 0 else -1
    scores[..., column] += 1 - matrix.sum(dim=-1)
    score, winner = scores.max(dim=-1)
    return torch.tensor([*ids, -1])[winner], score


@pytest.mark.parametrize("background", [-1, 4, 50])
@pytest.mark.parametrize("lens", [{}, BARREL])
def test_hard_layers_follow_the_definition(rng, background, lens) -> None:
    gaussians = random_gaussians(rng, 20)
    camera = camera_at(0.1, **lens)
    drawn = rng.choice([-1, 2, 4, 9, 13, 77], 20)
    names = sorted({int(i) for i in drawn if i >= 0} | ({background} if background >= 0 else set()))
    shares = (torch.from_numpy(drawn).unsqueeze(1) == torch.tensor(names)).double()
    ids, score = expected_map(matrix_of(gaussians, camera), shares, names, background)
    if lens:
        warp = warp_into_photograph(camera, "nearest")
        both = warp.apply(torch.stack((ids.double(), score), dim=-1))
        ids, score = both[..., 0], both[..., 1]

    shown = label_map(gaussians, camera, hard(drawn, background), backend=BACKEND)

    assert shown.ids.tolist() == ids.int().tolist()
    assert shown.confidence is not None
    torch.testing.assert_close(shown.confidence.double(), score, rtol=0, atol=1e-5)
    assert len(torch.unique(shown.ids)) > 2


def test_confidence_is_at_most_one_where_shares_are_not() -> None:
    labels = Labels(
        ids=[1], confidence=[1.0], candidates=torch.tensor([[1]]), shares=torch.tensor([[1.5]])
    )
    shown = label_map(gaussians_at([[0, 0, 2.0]], scale=0.5), camera_at(), labels, backend=BACKEND)
    assert shown.confidence is not None
    assert float(shown.confidence.max()) == 1


def test_soft_layers_share_their_weight(rng) -> None:
    gaussians = random_gaussians(rng, 20)
    camera = camera_at()
    names = [1, 2, 6]
    drawn = torch.from_numpy(rng.dirichlet([1, 1, 1, 1], 20))  # the fourth share is no label's
    strength, order = drawn[:, :3].sort(dim=1, descending=True)
    candidates = torch.tensor(names)[order]
    # The weakest candidate of every second Gaussian was not kept.
    candidates[::2, 2] = -1
    strength[::2, 2] = 0
    drawn = torch.zeros(20, 3, dtype=torch.float64).scatter(1, order, strength)
    labels = Labels(
        ids=candidates[:, 0],
        confidence=strength[:, 0].float(),
        candidates=candidates,
        shares=strength.float(),
    )
    ids, score = expected_map(matrix_of(gaussians, camera), drawn, names, -1)

    shown = label_map(gaussians, camera, labels, backend=BACKEND)

    assert shown.ids.tolist() == ids.int().tolist()
    torch.testing.assert_close(shown.confidence.double(), score, rtol=0, atol=1e-5)


def test_soft_and_hard_layers_agree_where_shares_are_whole(rng) -> None:
    gaussians = random_gaussians(rng, 20)
    drawn = torch.from_numpy(rng.choice([-1, 2, 4], 20))
    soft = Labels(
        ids=drawn,
        confidence=(drawn >= 0).float(),
        candidates=drawn.unsqueeze(1),
        shares=(drawn >= 0).float().unsqueeze(1),
    )
    a = label_map(gaussians, camera_at(), hard(drawn), backend=BACKEND)
    b = label_map(gaussians, camera_at(), soft, backend=BACKEND)
    assert torch.equal(a.ids, b.ids)


def test_residual_light_by_hand() -> None:
    """One Gaussian of opacity 0.4 at a pixel: its label has 0.4, the background 0.6."""
    gaussians = gaussians_at([[0, 0, 2]], scale=5.0, opacity=0.4)
    camera = camera_at(width=1, height=1)
    for background, winner in ((8, 8), (-1, -1), (3, 3)):
        shown = label_map(gaussians, camera, hard([3], background), backend=BACKEND)
        assert shown.ids.tolist() == [[winner]]
        expected = 1.0 if background == 3 else 0.6
        assert float(shown.confidence) == pytest.approx(expected, abs=1e-4)
    unlabelled = label_map(gaussians, camera, hard([-1], 8), backend=BACKEND)
    assert unlabelled.ids.tolist() == [[8]]


def test_no_label_loses_ties() -> None:
    """Opacity one half, no background: the label and nothing share the pixel equally."""
    gaussians = gaussians_at([[0, 0, 2]], scale=500.0, opacity=0.5)
    camera = camera_at(width=1, height=1)
    shown = label_map(gaussians, camera, hard([3]), backend=BACKEND)
    assert float(shown.confidence) == pytest.approx(0.5, abs=1e-6)
    assert shown.ids.tolist() == [[3]]


def test_ids_that_are_not_in_view_change_nothing(rng) -> None:
    gaussians = random_gaussians(rng, 14)
    away = gaussians_at([[0, 0, -2.0 - i] for i in range(90)])
    both = type(gaussians).concatenate([gaussians, away])
    ids = torch.arange(1, 105)
    shown = label_map(both, camera_at(), hard(ids), backend=BACKEND)
    alone = label_map(gaussians, camera_at(), hard(ids[:14]), backend=BACKEND)
    assert torch.equal(shown.ids, alone.ids)


def test_nothing_to_show_is_shown() -> None:
    gaussians = gaussians_at(torch.zeros(0, 3))
    assert bool((label_map(gaussians, camera_at(), hard([]), backend=BACKEND).ids == -1).all())
    shown = label_map(gaussians, camera_at(), hard([], 6), backend=BACKEND)
    assert bool((shown.ids == 6).all())
    assert bool((shown.confidence == 1).all())


def test_bad_input_is_refused() -> None:
    gaussians = gaussians_at([[0, 0, 2]])
    with pytest.raises(ShapeError, match="expected 1 rows, one a Gaussian, got 2"):
        label_map(gaussians, camera_at(), hard([1, 2]), backend=BACKEND)
