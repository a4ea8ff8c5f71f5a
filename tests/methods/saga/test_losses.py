"""Each loss against its equation, pair by pair, in float64."""

import math

import pytest
import torch

from splatseg.methods.saga import model
from splatseg.methods.saga.model import (
    contrast_loss,
    correspondence_loss,
    guidance_loss,
    masked_means,
    mean_overlap,
    members,
    norm_loss,
    together_at,
)


@pytest.fixture
def drawn(rng):
    """Nine pixels' features, the masks they are in (two pixels in none), and their weights."""
    seen = torch.from_numpy(rng.normal(size=(9, 5))).float()
    inside = torch.from_numpy(rng.random((9, 4)) < 0.4)
    inside[:2] = False
    inside[2, 0] = True
    return seen, inside, torch.from_numpy(rng.uniform(1, 5, 9)).float()


def cosine(a, b) -> float:
    return float(a @ b / (a.norm() * b.norm()))


def test_the_query_of_a_mask_is_the_mean_in_it(drawn) -> None:
    """Equation 5, pixels counting as many as they stand for."""
    seen, inside, weight = drawn
    found = masked_means(seen, inside, weight)
    for mask in range(4):
        if not bool(inside[:, mask].any()):
            continue
        pixels = torch.nonzero(inside[:, mask]).squeeze(1)
        expected = sum(weight[p] * seen[p] for p in pixels) / sum(weight[p] for p in pixels)
        torch.testing.assert_close(found[mask], expected)


def test_the_guidance_loss_is_equation_7(drawn, rng) -> None:
    seen, inside, _ = drawn
    queries = torch.from_numpy(rng.normal(size=(4, 5))).float()
    total = 0.0
    for p in range(9):
        for mask in range(4):
            chance = 1 / (1 + math.exp(-float(queries[mask] @ seen[p])))
            total -= math.log(chance if inside[p, mask] else 1 - chance)
    assert float(guidance_loss(queries, seen, inside)) == pytest.approx(total / 36, rel=1e-5)


@pytest.mark.parametrize("block", [2, 4, 512])
def test_the_correspondence_loss_is_equations_8_to_10(drawn, monkeypatch, block) -> None:
    """Also its gradient, which is taken without keeping the pairs, in blocks of them."""
    monkeypatch.setattr(model, "_BLOCK", block)
    seen, inside, _ = drawn
    leaf = seen.double().requires_grad_()
    total = torch.zeros((), dtype=torch.float64)
    for p in range(9):
        for q in range(9):
            shared = int((inside[p] & inside[q]).sum())
            union = int((inside[p] | inside[q]).sum())
            overlap = shared / union if shared else -1.0
            similarity = leaf[p] @ leaf[q] / (leaf[p].norm() * leaf[q].norm())
            total = total - overlap * torch.relu(similarity) / 81
    total.backward()
    mine = seen.clone().requires_grad_()
    loss = correspondence_loss(mine, inside)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(float(total.detach()), rel=1e-4)
    torch.testing.assert_close(mine.grad.double(), leaf.grad, rtol=1e-3, atol=1e-6)


def test_pixels_belong_to_masks_up_to_the_scale() -> None:
    """A window in a wall, and the wall's pixels beside it; one pixel is in no mask."""
    #                       wall   window
    inside = torch.tensor([[True, True], [True, False], [True, False], [False, False]])
    ranks = torch.tensor([0.8, 0.3])
    # Below the window's scale both masks are too large, and each pixel takes what it has.
    together, apart = together_at(inside, ranks, 0.1)
    assert together[0].tolist() == [True, True, True, False]
    # At the window's own, its pixels leave the wall to the others.
    together, apart = together_at(inside, ranks, 0.5)
    assert together.tolist() == [
        [True, False, False, False],
        [False, True, True, False],
        [False, True, True, False],
        [False, False, False, False],
    ]
    assert apart[0].tolist() == [False, True, True, True]
    assert apart[3].tolist() == [True, True, True, False]  # of itself nothing is known
    # At the wall's, all three are wall.
    together, apart = together_at(inside, ranks, 0.8)
    assert bool(together[:3, :3].all())
    assert not bool(apart[:3, :3].any())


def test_only_hard_pairs_are_moved(drawn) -> None:
    """The mean of 1 - S over pairs together below 0.75, and of S over pairs apart above 0.5."""
    _, inside, _ = drawn
    angles = torch.tensor([0.0, 0.1, 0.4, 0.8, 1.2, 1.7, 2.4, 3.0, 3.1])
    directions = torch.stack((torch.cos(angles), torch.sin(angles)), dim=1)
    together, apart = together_at(inside, torch.tensor([0.1, 0.4, 0.6, 0.9]), 0.5)
    pulled, pushed = [], []
    for p in range(9):
        for q in range(9):
            similarity = cosine(directions[p], directions[q])
            if together[p, q] and similarity < 0.75:
                pulled.append(1 - similarity)
            if apart[p, q] and similarity > 0.5:
                pushed.append(similarity)
    expected = sum(pulled) / len(pulled) + sum(pushed) / len(pushed)
    found = contrast_loss(directions, together, apart)
    assert float(found) == pytest.approx(expected, rel=1e-4)
    easy = torch.tensor([[1.0, 0.0], [0.99, 0.14], [0.0, 1.0]])
    same = torch.tensor([[True, True, False], [True, True, False], [False, False, True]])
    assert float(contrast_loss(easy, same, ~same)) == 0.0


def test_the_norm_loss_asks_for_length_one() -> None:
    assert float(norm_loss(torch.tensor([[0.6, 0.8], [0.0, 0.5]]))) == pytest.approx(0.125)


def test_members_name_the_masks_that_occur() -> None:
    inside, numbers = members(torch.tensor([0, 2, 2]), torch.tensor([7, 7, 4]), 3)
    assert numbers.tolist() == [4, 7]
    assert inside.tolist() == [[False, True], [False, False], [True, True]]


def test_the_overlap_is_the_mean_over_queries(rng) -> None:
    inside = torch.from_numpy(rng.random(40) < 0.4)
    found = torch.from_numpy(rng.random((40, 3)) < 0.5)
    weight = torch.from_numpy(rng.random(40)).float()
    expected = []
    for query in range(3):
        both = sum(float(weight[i]) for i in range(40) if inside[i] and found[i, query])
        either = sum(float(weight[i]) for i in range(40) if inside[i] or found[i, query])
        expected.append(both / either)
    assert mean_overlap(found, inside, weight) == pytest.approx(sum(expected) / 3, rel=1e-5)
    assert mean_overlap(found, torch.zeros(40, dtype=torch.bool), weight) == 0.0


def test_pairs_with_a_pixel_of_which_nothing_is_known_are_not_apart() -> None:
    inside = torch.tensor([[True, False], [False, True], [True, False], [False, False]])
    ranks = torch.tensor([0.5, 0.5])
    known = torch.tensor([True, False, True, True])
    together, apart = together_at(inside, ranks, 0.5, known=known)
    assert torch.equal(together, together_at(inside, ranks, 0.5)[0])
    assert apart.nonzero().tolist() == [[0, 3], [2, 3], [3, 0], [3, 2]]
