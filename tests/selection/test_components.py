"""Connected pieces, and what a removal would leave behind."""

import importlib

import numpy as np
import pytest
import torch

from splatseg.core import Gaussians, Labels, Selection
from splatseg.errors import RangeError, ShapeError
from splatseg.selection import Where, components, leftovers, select_where

module = importlib.import_module("splatseg.selection.components")


def balls(*groups: tuple[tuple[float, float, float], int]) -> Gaussians:
    """Groups of round Gaussians of radius 0.1 in rows along x, 0.15 apart."""
    means = torch.cat(
        [
            torch.tensor(start) + torch.arange(count)[:, None] * torch.tensor([0.15, 0, 0])
            for start, count in groups
        ]
    )
    n = len(means)
    return Gaussians(
        means=means,
        rotations=torch.eye(4)[:1].expand(n, 4).clone(),
        scales=torch.full((n, 3), 0.1),
        opacities=torch.full((n,), 0.5),
        sh=torch.zeros(n, 1, 3),
    )


def everything(g: Gaussians) -> Selection:
    return Selection(mask=torch.ones(len(g), dtype=torch.bool))


def test_rows_of_balls_are_pieces() -> None:
    g = balls(((0, 0, 0), 5), ((0, 9, 0), 3), ((0.75, 0, 0), 2))
    assert components(g, everything(g)).tolist() == [0] * 5 + [1] * 3 + [0] * 2
    some = Selection(mask=torch.tensor([True, True, False, False, True] + [False] * 5))
    assert components(g, some).tolist() == [0, 0, -1, -1, 1, -1, -1, -1, -1, -1], "a gap parts them"


def test_thin_gaussians_touch_along_their_length_only() -> None:
    g = balls(((0, 0, 0), 1), ((1, 0, 0), 1), ((0, 1, 0), 1))
    long = g.replace(scales=torch.tensor([[0.4, 0.01, 0.01]]).expand(3, 3).clone())
    assert components(long, everything(g)).tolist() == [0, 0, 1]
    turned = torch.tensor([[0.5**0.5, 0, 0, 0.5**0.5]]).expand(3, 4).clone()  # x becomes y
    assert components(long.replace(rotations=turned), everything(g)).tolist() == [0, 1, 0]


def test_pieces_agree_with_a_search_by_hand(rng: np.random.Generator) -> None:
    """Against a flood over all pairs, where no Gaussian has more than 16 near ones."""
    n = 60
    g = balls(((0, 0, 0), n)).replace(
        means=torch.from_numpy(rng.uniform(0, 3, (n, 3)).astype(np.float32))
    )
    touch = (torch.cdist(g.means, g.means) <= 0.4).numpy()
    assert touch.sum(axis=1).max() <= 17
    expected = [-1] * n
    for start in range(n):
        if expected[start] >= 0:
            continue
        number, stack = max(expected) + 1, [start]
        while stack:
            row = stack.pop()
            if expected[row] < 0:
                expected[row] = number
                stack += np.flatnonzero(touch[row]).tolist()
    assert 3 < max(expected) < n - 1
    assert components(g, everything(g)).tolist() == expected


def test_pieces_of_pairs_that_come_some_at_a_time(monkeypatch) -> None:
    """Joined after every few pairs, numbered by their first row all the same."""
    g = balls(((0, 0, 0), 9), ((0, 9, 0), 7), ((1.35, 0, 0), 4), ((3, 3, 3), 1))
    order = torch.randperm(len(g), generator=torch.Generator().manual_seed(0))
    expected = components(g[order], everything(g))
    removed = Selection(mask=torch.isin(order, torch.tensor([9, 10])))
    specks = leftovers(g[order], removed, most=5)
    assert specks.count == 5
    monkeypatch.setattr(module, "_PAIRS", 3 * 16)
    monkeypatch.setattr(module, "_KEPT", 0)
    joins: list[int] = []
    whole = module.pieces
    monkeypatch.setattr(module, "pieces", lambda *args: joins.append(1) or whole(*args))
    assert torch.equal(components(g[order], everything(g)), expected)
    assert len(joins) > 1
    assert torch.equal(leftovers(g[order], removed, most=5).mask, specks.mask)


def test_one_piece_is_selected() -> None:
    g = balls(((0, 0, 0), 3), ((0, 9, 0), 5), ((0, 18, 0), 2))
    high = (0.0, -1.0, -1.0, 1.0, 10.0, 1.0)
    largest = select_where(g, {}, Where(box=high, largest_component=True))
    assert largest.ids.tolist() == [3, 4, 5, 6, 7]
    near = select_where(g, {}, Where(box=high, component_at=(0, 17, 0)))
    assert near.ids.tolist() == [3, 4, 5, 6, 7], "what does not fit is not asked"
    first = select_where(g, {}, Where(opacity=(0, 1), component_at=(0.1, 1, 0), invert=True))
    assert first.ids.tolist() == [3, 4, 5, 6, 7, 8, 9]
    nothing = select_where(g, {}, Where(opacity=(0.9, 1), largest_component=True))
    assert nothing.count == 0


def test_specks_touch_nothing_that_stays() -> None:
    """Of four rows on a removed one: small alone, small on the wall, large, small and far away."""
    g = balls(
        ((0, 0, 0), 8),  # removed
        ((0, 0.3, 0), 2),  # a speck
        ((1.2, 0, 0), 2),  # on its other side, at the wall
        ((1.5, 0, 0), 9),  # the wall
        ((0.3, -0.3, 0), 5),  # too large for a speck
        ((0, 5, 0), 2),  # elsewhere
    )
    removed = Selection(mask=torch.arange(len(g)) < 8)
    assert leftovers(g, removed, most=4).ids.tolist() == [8, 9]
    assert leftovers(g, removed, most=5).ids.tolist() == [8, 9, 21, 22, 23, 24, 25]
    assert leftovers(g, removed, most=1).count == 0
    assert leftovers(g, removed, most=0).count == 0


def test_a_small_thing_of_its_own_is_no_speck() -> None:
    g = balls(((0, 0, 0), 8), ((0, 0.3, 0), 2), ((0.6, -0.3, 0), 2), ((0, 9, 0), 9))
    removed = Selection(mask=torch.arange(len(g)) < 8)
    ids = torch.tensor([1] * 8 + [5] * 2 + [7] * 2 + [7] * 9).int()
    labels = Labels(ids=ids, confidence=torch.ones(len(g)))
    assert leftovers(g, removed, most=4).ids.tolist() == [8, 9, 10, 11]
    assert leftovers(g, removed, most=4, labels=labels).ids.tolist() == [10, 11], "5 is a cup"


def test_bad_arguments() -> None:
    g = balls(((0, 0, 0), 3))
    one = Selection(mask=torch.tensor([True]))
    with pytest.raises(ShapeError, match="among: expected 3 rows, got 1"):
        components(g, one)
    with pytest.raises(ShapeError, match="removed: expected 3 rows, got 1"):
        leftovers(g, one, most=1)
    with pytest.raises(RangeError, match="most: expected 0 or more"):
        leftovers(g, everything(g), most=-1)
    assert leftovers(g, everything(g), most=1).count == 0
