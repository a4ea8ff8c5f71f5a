"""Levels of trees spelt out: what has parts is an object, what has objects a group."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse

from splatseg.methods.associate._clustering import Agreement, Nesting, cluster, nesting
from splatseg.methods.associate._levels import GROUP, OBJECT, PART, node_levels
from splatseg.methods.associate._tree import SegmentTree


def tree(parents: list[int], support: list[float] | None = None) -> SegmentTree:
    count = len(parents)
    return SegmentTree(
        node=np.arange(count),
        parent=np.array(parents),
        size=np.ones(count),
        support=np.ones(count) if support is None else np.array(support),
        views=np.full(count, 5),
        alone=np.zeros(count, bool),
    )


def nested_share(nested: Nesting) -> float:
    """Share of the segments that lie inside another or have another inside."""
    both = (nested.inside + nested.inside.T).tocsr()
    return float(np.mean(np.diff(both.indptr) > 0))


def levels(*arguments) -> list[int]:
    return node_levels(tree(*arguments)).tolist()


@pytest.mark.parametrize(
    ("objectness", "support", "expected"),
    [
        # A shelf with two books of one piece each: the shape alone takes them for parts of it.
        ([0.5, 0.6, 0.7], None, [GROUP, OBJECT, OBJECT]),
        ([0.9, 0.3, 0.3], None, [OBJECT, PART, PART]),
        # 0.5^1.5 = 0.354 against 2 x 0.3^1.5 = 0.329, 2 x 0.32^1.5 = 0.362.
        ([0.5, 0.3, 0.3], None, [OBJECT, PART, PART]),
        ([0.5, 0.32, 0.32], None, [GROUP, OBJECT, OBJECT]),
        ([0.5, 0.32, 0.32], [1, 0.9, 0.9], [OBJECT, PART, PART]),
        ([0.0, 0.0, 0.0], None, [OBJECT, PART, PART]),
        ([0.5, 0.6, np.nan], None, [OBJECT, PART, PART]),
    ],
)
def test_masks_that_tell_objects_decide_what_shapes_cannot(objectness, support, expected) -> None:
    nodes = tree([-1, 0, 0], support)
    assert node_levels(nodes, np.array(objectness)).tolist() == expected


def test_objectness_is_the_mean_of_a_nodes_masks() -> None:
    nodes = replace(tree([-1, 0, 0]), node=np.array([0, 1, 1, 2, 2, -1]))
    # Means 0.5, 0.3, 0.3; the mask of no node counts nowhere.
    objectness = np.array([0.5, 0.0, 0.6, 0.2, 0.4, 1.0])
    assert node_levels(nodes, objectness).tolist() == [OBJECT, PART, PART]
    objectness[1] = 0.2
    assert node_levels(nodes, objectness).tolist() == [GROUP, OBJECT, OBJECT]


def test_what_is_above_objects_are_groups_and_below_them_parts() -> None:
    nodes = tree([-1, 0, 0, 1, 1, 3])
    found = node_levels(nodes, np.array([0.6, 0.7, 0.7, 0.2, 0.2, 0.2]))
    assert found.tolist() == [GROUP, OBJECT, OBJECT, PART, PART, PART]
    deep = node_levels(nodes, np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.9]))
    assert deep.tolist() == [GROUP, GROUP, OBJECT, GROUP, OBJECT, OBJECT]


@pytest.mark.parametrize(
    ("parents", "expected"),
    [
        ([], []),
        ([-1], [OBJECT]),
        ([-1, 0, 0], [OBJECT, PART, PART]),
        # A desk with a top and a leg, and a cup of one piece and a lamp of two on it.
        (
            [-1, 0, 1, 1, 0, 0, 5, 5],
            [GROUP, OBJECT, PART, PART, OBJECT, OBJECT, PART, PART],
        ),
        # A drum whose skin fell into two is no group of a skin and a shell.
        ([-1, 0, 0, 1, 1], [OBJECT, PART, PART, PART, PART]),
        # A chain of one child each is an object with parts.
        ([-1, 0, 1, 2], [OBJECT, PART, PART, PART]),
        # One thing by itself is no group, however many parts it has.
        ([-1, 0, 1, 1, 1], [OBJECT, PART, PART, PART, PART]),
        # A room of two desks with two lamps each.
        (
            [-1, 0, 0, 1, 1, 1, 2, 2, 2, *(k for k in range(3, 9) for _ in range(2))],
            [GROUP] * 3 + [OBJECT] * 6 + [PART] * 12,
        ),
    ],
)
def test_levels_by_hand(parents, expected) -> None:
    assert levels(parents) == expected


def test_parts_count_by_their_support() -> None:
    # Two things of two parts in one: a group if the parts are surely there, else an object.
    parents = [-1, 0, 0, 1, 1, 2, 2]
    assert levels(parents, [1, 1, 1, 1, 1, 1, 1])[0] == GROUP
    assert levels(parents, [1, 1, 1, 0.4, 0.4, 0.4, 0.4])[0] == OBJECT


def test_a_lone_thing_in_a_group_is_half_an_exception() -> None:
    # Three sub-parts against two and one half for each of two lone things.
    assert levels([-1, 0, 1, 1, 1, 0])[0] == GROUP
    assert levels([-1, 0, 1, 1, 1, 0, 0])[0] == OBJECT


def test_a_lone_thing_counts_by_its_support() -> None:
    # Three sub-parts against two, and halves of what two lone things are supported by.
    parents = [-1, 0, 1, 1, 1, 0, 0]
    assert levels(parents, [1, 1, 1, 1, 1, 1, 1])[0] == OBJECT
    assert levels(parents, [1, 1, 1, 1, 1, 0.9, 0.9])[0] == GROUP


def test_a_group_in_a_group_costs_what_a_group_does() -> None:
    # A room with a cup, and a desk of two lamps of three parts: taken for an object the desk would
    # be six exceptions, and the room no group.
    room = [-1, 0, 1, 1, 2, 2, 2, 3, 3, 3, 0]
    assert levels(room) == [GROUP, GROUP, OBJECT, OBJECT, *[PART] * 6, OBJECT]


def agreement(share: np.ndarray, view: list[int]) -> Agreement:
    """Of segments that hold shares of Gaussians which all views see alike."""
    seen = scipy.sparse.csr_matrix(np.repeat(share.sum(axis=1)[:, None], max(view) + 1, axis=1))
    return Agreement(
        shared=scipy.sparse.csr_matrix(share @ share.T), seen=seen, view=np.array(view)
    )


# A half and the whole in each of three views.
HALF, WHOLE = [1, 1, 1, 0, 0], [1, 1, 1, 1, 1]
SHARE = np.array([HALF, WHOLE] * 3, dtype=np.float64)
VIEW = [0, 0, 1, 1, 2, 2]


@pytest.mark.parametrize("rows", [1, 4, 256])
def test_what_lies_inside_another_of_its_view_is_of_another_level(monkeypatch, rows) -> None:
    """However many segments are looked at at a time."""
    monkeypatch.setattr("splatseg.methods.associate._clustering._ROWS", rows)
    found = nesting(agreement(SHARE, VIEW))
    assert sorted(zip(*found.inside.nonzero(), strict=True)) == [(0, 1), (2, 3), (4, 5)]
    assert nested_share(found) == 1
    assert found.agreement.shared[0, 1] == 0
    assert found.agreement.shared[0, 3] == 3
    assert cluster(agreement(SHARE, VIEW), 0.2).tolist() == [0] * 6
    together = cluster(found.agreement, 0.2, conflicts=found.conflicts)
    assert together.tolist() == [0, 1, 0, 1, 0, 1]


def test_the_same_mask_twice_in_a_view_is_no_conflict() -> None:
    found = nesting(agreement(np.array([WHOLE, WHOLE], dtype=np.float64), [0, 0]))
    assert found.inside.nnz == 0
    assert nested_share(found) == 0
    assert found.agreement.shared[0, 1] == 5


def test_one_contradiction_among_many_views_keeps_nothing_apart() -> None:
    # The same thing in six views; one of them has a fragment of it besides.
    share = np.array([WHOLE] * 6 + [[1, 1, 1, 0, 0]], dtype=np.float64)
    found = nesting(agreement(share, [0, 1, 2, 3, 4, 5, 0]))
    together = cluster(found.agreement, 0.2, conflicts=found.conflicts)
    assert together[:6].tolist() == [0] * 6
    assert together[6] == 1


LEVEL = np.array([0, 1] * 3)


def test_masks_of_different_levels_of_one_view_are_never_one_instance() -> None:
    # The whole twice in each view, once as a part and once as an object: shapes say nothing.
    share = np.array([WHOLE] * 6, dtype=np.float64)
    plain, said = nesting(agreement(share, VIEW)), nesting(agreement(share, VIEW), LEVEL)
    assert cluster(plain.agreement, 0.2, conflicts=plain.conflicts).tolist() == [0] * 6
    together = cluster(said.agreement, 0.2, conflicts=said.conflicts)
    assert together.tolist() == [0, 1, 0, 1, 0, 1]
    assert sorted(zip(*said.inside.nonzero(), strict=True)) == [(0, 1), (2, 3), (4, 5)]


def test_levels_keep_apart_what_views_would_outvote() -> None:
    # One view of six has a fragment besides, at another level, beside what is seen of the whole.
    share = np.array([WHOLE] * 5 + [[1, 1, 1, 0, 0], [0, 0, 0, 1, 1]], dtype=np.float64)
    view = [0, 1, 2, 3, 4, 5, 5]
    plain = nesting(agreement(share, view))
    assert cluster(plain.agreement, 0.2, conflicts=plain.conflicts).tolist() == [0] * 7
    said = nesting(agreement(share, view), np.array([1] * 6 + [0]))
    assert cluster(said.agreement, 0.2, conflicts=said.conflicts).tolist() == [0] * 6 + [1]
    assert said.inside.nnz == 0
    assert nested_share(said) == 0


def test_of_two_levels_the_finer_lies_inside_even_where_it_holds_more() -> None:
    share = np.array([WHOLE, [1, 1, 1, 1, 0]], dtype=np.float64)
    assert list(zip(*nesting(agreement(share, [0, 0])).inside.nonzero(), strict=True)) == []
    finer = nesting(agreement(share, [0, 0]), np.array([0, 1]))
    assert list(zip(*finer.inside.nonzero(), strict=True)) == [(0, 1)]
    # What is mostly outside lies in nothing, whatever its level.
    apart = np.array([[1, 1, 1, 1, 0], [0, 0, 0, 1, 1]], dtype=np.float64)
    assert nesting(agreement(apart, [0, 0]), np.array([0, 1])).inside.nnz == 0


def test_levels_all_alike_say_nothing() -> None:
    one, other = nesting(agreement(SHARE, VIEW)), nesting(agreement(SHARE, VIEW), np.full(6, 2))
    assert (one.inside != other.inside).nnz == 0
    assert (one.conflicts != other.conflicts).nnz == 0
    assert other.forbidden.nnz == 0


def test_masks_of_different_views_may_have_different_levels() -> None:
    share = np.array([WHOLE] * 3, dtype=np.float64)
    found = nesting(agreement(share, [0, 1, 2]), np.array([0, 1, 2]))
    assert found.conflicts.nnz == 0
    assert cluster(found.agreement, 0.2, conflicts=found.conflicts).tolist() == [0, 0, 0]


def test_containment_counts_from_seven_tenths_on_and_the_same_from_eight() -> None:
    ten = np.ones(10)

    def holds(count: int, start: int = 0) -> np.ndarray:
        return np.array([start <= i < start + count for i in range(16)], dtype=np.float64)

    for inside, count in ((7, 1), (6, 0)):
        # Ten Gaussians of which `inside` lie in a set of twelve.
        share = np.stack((holds(10), holds(12, 10 - inside)))
        assert nesting(agreement(share, [0, 0])).inside.nnz == count
    for smaller, count in ((8, 0), (7, 1)):
        share = np.stack((np.append(ten, np.zeros(6)), holds(smaller)))
        assert nesting(agreement(share, [0, 0])).inside.nnz == count


def test_one_pair_of_levels_among_many_views_keeps_two_groups_apart() -> None:
    # Two sets that share four of six Gaussians, each in five views of its own and both in one.
    one, other = [1, 1, 1, 1, 1, 0], [0, 1, 1, 1, 1, 1]
    share = np.array([one, other] + [one] * 5 + [other] * 5, dtype=np.float64)
    view = [0, 0, *range(1, 11)]
    plain = nesting(agreement(share, view))
    assert cluster(plain.agreement, 0.2, conflicts=plain.conflicts).tolist() == [0] * 12
    said = nesting(agreement(share, view), np.array([0, 1] + [0] * 5 + [1] * 5))
    together = cluster(said.agreement, 0.2, conflicts=said.conflicts)
    assert together.tolist() == [0, 1] + [0] * 5 + [1] * 5
