"""The table of votes: exact columns, slots after Misra and Gries, and the bound on what is lost."""

from collections import defaultdict

import numpy as np
import pytest
import torch

from splatseg.lift.voting.votes import SlotTable, VoteTable

COUNT = 9


def random_triples(rng, size: int, ids: int):
    return (
        torch.from_numpy(rng.integers(0, ids, size)),
        torch.from_numpy(rng.integers(0, COUNT - 1, size)),
        torch.from_numpy(rng.random(size)).float(),
    )


def readable(batches) -> dict[int, dict[int, float]]:
    """Votes by Gaussian and id."""
    votes: dict[int, dict[int, float]] = defaultdict(lambda: defaultdict(float))
    for batch in batches:
        for id, gaussian, weight in zip(*(t.tolist() for t in batch), strict=True):
            votes[gaussian][id] += weight
    return votes


def misra_gries(batch, slots: dict[int, float], size: int) -> tuple[dict[int, float], float]:
    """One Gaussian's batch, by the textbook, heaviest first; slots and what each lost."""
    lost = 0.0
    for id, weight in sorted(batch.items(), key=lambda pair: (-pair[1], pair[0])):
        if id in slots or len(slots) < size:
            slots[id] = slots.get(id, 0.0) + weight
            continue
        taken = min(weight, *slots.values())
        lost += taken
        slots = {i: w - taken for i, w in slots.items() if w - taken > 1e-9}
        if weight - taken > 1e-9:
            slots[id] = weight - taken
    return slots, lost


def as_dict(ranking, row: int) -> dict[int, float]:
    pairs = zip(ranking.ids[row].tolist(), ranking.votes[row].tolist(), strict=True)
    return {id: weight for id, weight in pairs if id != -1}


def test_columns_are_exact(rng) -> None:
    table = VoteTable(COUNT, memory=1 << 20, slots=2)
    batches = [random_triples(rng, 40, 6) for _ in range(3)]
    for ids, gaussians, weights in batches:
        table.add_sparse(ids, gaussians, weights)
    assert table.exact
    ranking = table.rank(6)
    for row, votes in readable(batches).items():
        assert as_dict(ranking, row) == pytest.approx(votes, rel=1e-5)
        assert float(ranking.total[row]) == pytest.approx(sum(votes.values()), rel=1e-5)
        assert ranking.votes[row].tolist() == sorted(ranking.votes[row].tolist(), reverse=True)
    assert ranking.ids[COUNT - 1].tolist() == [-1] * 6
    assert float(ranking.total[COUNT - 1]) == float(ranking.error_bound.sum()) == 0


def test_few_ids_stay_exact_in_slots(rng) -> None:
    """The table gives up its columns in the second batch; no Gaussian has more than 4 ids."""
    table = VoteTable(COUNT, memory=4 * COUNT * 3, slots=4)
    batches = []
    for first in (0, 2):
        ids, gaussians, weights = random_triples(rng, 60, 2)
        batches.append((ids + first, gaussians, weights))
        table.add_sparse(*batches[-1])
        assert table.exact == (first == 0)
    ranking = table.rank(4)
    for row, votes in readable(batches).items():
        assert as_dict(ranking, row) == pytest.approx(votes, rel=1e-5)
    assert float(ranking.error_bound.max()) == 0


def test_slots_follow_the_textbook(rng) -> None:
    size = 3
    table = SlotTable(COUNT, size)
    slots: dict[int, dict[int, float]] = defaultdict(dict)
    lost: dict[int, float] = defaultdict(float)
    for _ in range(6):
        batch = random_triples(rng, 50, 8)
        table.add(*batch)
        for row, votes in readable([batch]).items():
            slots[row], more = misra_gries(votes, slots[row], size)
            lost[row] += more
    ranking = table.rank(size)
    for row, kept in slots.items():
        assert as_dict(ranking, row) == pytest.approx(kept, rel=1e-4, abs=1e-4)
        assert float(ranking.error_bound[row]) == pytest.approx(lost[row], rel=1e-4)


@pytest.mark.parametrize("memory", [1, 4 * COUNT * 20])
def test_what_is_lost_is_bounded(rng, memory) -> None:
    """Votes lie in [s, s + E] and E <= total / (K + 1), from columns given up or from nothing."""
    slots = 4
    table = VoteTable(COUNT, memory=memory, slots=slots)
    batches = [random_triples(rng, 200, ids) for ids in (5, 20, 40, 40)]
    for batch in batches:
        table.add_sparse(*batch)
    assert not table.exact
    ranking = table.rank(slots)
    votes = readable(batches)
    assert float(ranking.error_bound.max()) > 0
    for row, true in votes.items():
        kept = as_dict(ranking, row)
        error_bound = float(ranking.error_bound[row])
        for id, weight in true.items():
            assert kept.get(id, 0.0) <= weight + 1e-4
            assert kept.get(id, 0.0) + error_bound >= weight - 1e-4
        total = sum(true.values())
        assert float(ranking.total[row]) == pytest.approx(total, rel=1e-5)
        assert error_bound <= (total - sum(kept.values())) / (slots + 1) + 1e-4


def test_a_heavy_id_survives_any_number_of_light_ones() -> None:
    """More than 1 / (K + 1) of the votes, against a stream of ids that come once each."""
    table = VoteTable(1, memory=1, slots=2)
    for i in range(100):
        names = torch.tensor([7, 100 + i])
        table.add_sparse(names, torch.zeros(2, dtype=torch.int64), torch.tensor([0.6, 1.0]))
    ranking = table.rank(1)
    assert ranking.ids.tolist() == [[7]]
    assert float(ranking.votes[0, 0]) + float(ranking.error_bound[0]) >= 60 - 1e-3


def test_names_of_ids_change_nothing_but_their_names(rng) -> None:
    names = torch.from_numpy(rng.permutation(1000)[:30])
    plain, renamed = VoteTable(COUNT, memory=1, slots=3), VoteTable(COUNT, memory=1, slots=3)
    for _ in range(3):
        ids, gaussians, weights = random_triples(rng, 100, 30)
        plain.add_sparse(ids, gaussians, weights)
        renamed.add_sparse(names[ids], gaussians, weights)
    a, b = plain.rank(3), renamed.rank(3)
    real = a.ids != -1
    assert torch.equal(names[a.ids[real].long()], b.ids[real].long())
    torch.testing.assert_close(a.votes, b.votes)


@pytest.mark.parametrize("memory", [1, 1 << 20])
def test_equals_go_to_the_smaller_id(memory) -> None:
    table = VoteTable(2, memory=memory, slots=3)
    ids = torch.tensor([9, 4, 6, 4, 9])
    table.add_sparse(ids, torch.tensor([0, 0, 0, 1, 1]), torch.tensor([1.0, 1, 2, 1, 1]))
    ranking = table.rank(3)
    assert ranking.ids.tolist() == [[6, 4, 9], [4, 9, -1]]
    assert table.rank(1).ids.tolist() == [[6], [4]]
    assert table.rank(5).ids.tolist() == [[6, 4, 9, -1, -1], [4, 9, -1, -1, -1]]


def held(table: VoteTable) -> int:
    """Bytes of a table."""
    slots = table._summary
    return sum(c.nbytes for c in table._columns.values()) + (slots.nbytes if slots else 0)


def test_memory_is_bounded_whatever_the_number_of_ids() -> None:
    """20 000 ids on 1000 Gaussians: the columns would take 80 MB, the slots take 64 kB."""
    count, slots = 1000, 8
    table = VoteTable(count, memory=1 << 16, slots=slots)
    everyone = torch.arange(count)
    for id in range(0, 20_000, 4):
        table.add_sparse(torch.full((count,), id), everyone, torch.ones(count))
        assert held(table) <= (1 << 16) + count * (8 * slots + 8)
    assert np.isclose(float(table.rank(1).total[0]), 5000)
