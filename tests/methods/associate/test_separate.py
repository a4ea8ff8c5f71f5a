"""Nodes that are two things, by hand: a shelf with two books, a pane with its frame."""

import importlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse

from splatseg.methods.associate._clustering import Agreement, Nesting, nesting
from splatseg.methods.associate._levels import GROUP, OBJECT, PART, separated_levels
from splatseg.methods.associate._tree import SegmentTree

GAUSSIANS = 25
EVERYTHING, SHELF = range(24), range(20)
BOARDS = (range(10), range(10, 20))
BOOKS = (range(20, 22), range(22, 24))
PAGES = ((20,), (21,), (22,), (23,))

# Rows of the nodes below: the shelf with or without its books, two boards, two books, their pages.
PARENTS = [-1, 0, 0, 0, 0, 3, 3, 4, 4]
MEMBERS = (*BOARDS, *BOOKS, *PAGES)

Masks = list[tuple[int, int, Sequence[int]]]
"""View, node and Gaussians of each mask."""


def shelf(views: int = 4, *, with_books: int | None = None, alone: int | None = None) -> Masks:
    """All masks in every view, or those of the shelf in the first few only."""
    found: Masks = []
    for view in range(views):
        if with_books is None or view < with_books:
            found.append((view, 0, EVERYTHING))
        if alone is None or view < alone:
            found.append((view, 0, SHELF))
        found += [(view, row + 1, member) for row, member in enumerate(MEMBERS)]
    return found


def separated(
    masks: Masks,
    parents: Sequence[int] = PARENTS,
    *,
    support: Sequence[float] | None = None,
    min_support: float = 0.3,
    min_views: int = 2,
    objectness: np.ndarray | None = None,
) -> tuple[SegmentTree, list[int]]:
    view = np.array([view for view, _, _ in masks])
    node = np.array([node for _, node, _ in masks])
    share = np.zeros((len(masks), GAUSSIANS))
    for row, (_, _, held) in enumerate(masks):
        share[row, list(held)] = 1
    count = len(parents)
    cores = [share[node == row].max(axis=0).sum() for row in range(count)]
    tree = SegmentTree(
        node=node,
        parent=np.array(parents),
        size=np.array(cores),
        support=np.ones(count) if support is None else np.array(support),
        views=np.array([len(np.unique(view[node == row])) for row in range(count)]),
        alone=np.zeros(count, bool),
    )
    nested = nested_of(share, view)
    found, level = separated_levels(
        tree, nested, objectness, min_support=min_support, min_views=min_views
    )
    assert len(level) == len(found.parent) == len(found.size) == len(found.alone)
    return found, level.tolist()


def nested_of(share: np.ndarray, view: np.ndarray) -> Nesting:
    seen = np.repeat(share.sum(axis=1)[:, None], int(view.max()) + 1, axis=1)
    return nesting(
        Agreement(
            shared=scipy.sparse.csr_matrix(share @ share.T),
            seen=scipy.sparse.csr_matrix(seen),
            view=view,
        )
    )


def test_a_shelf_and_the_shelf_with_its_books_are_a_group_and_an_object() -> None:
    masks = shelf()
    tree, level = separated(masks)
    assert tree.parent.tolist() == [-1, 9, 9, 0, 0, 3, 3, 4, 4, 0]
    assert level == [GROUP, PART, PART, OBJECT, OBJECT, PART, PART, PART, PART, OBJECT]
    held = {int(node): set() for node in tree.node}
    for node, (_, _, members) in zip(tree.node.tolist(), masks, strict=True):
        held[node].add(len(members))
    assert held[0] == {24}
    assert held[9] == {20}
    assert tree.size.tolist() == [24, 10, 10, 2, 2, 1, 1, 1, 1, 20]
    assert tree.alone.tolist() == [False] * 9 + [True]


@pytest.mark.parametrize(
    ("larger", "unknown", "divided"),
    [(0.74, False, True), (0.76, False, False), (0.76, True, True)],
)
def test_a_larger_one_that_is_a_thing_to_the_model_is_no_group(larger, unknown, divided) -> None:
    """Masks of a floor with a rim of what lies on it and without are all of the floor."""
    masks = shelf()
    objectness = np.array(
        [larger if len(members) == 24 else 0.9 if node == 0 else 0.2 for _, node, members in masks]
    )
    if unknown:
        objectness[-1] = np.nan
    tree, level = separated(masks, objectness=objectness)
    assert (len(tree.parent) == 10) == divided
    if not divided:
        assert level == [OBJECT] + [PART] * 8


def test_support_and_views_of_the_two_are_those_of_their_masks() -> None:
    # In the last view there is the shelf alone.
    tree, _ = separated(shelf(with_books=3), support=[0.8] + [1.0] * 8)
    assert tree.views[[0, 9]].tolist() == [3, 4]
    assert tree.support[[0, 9]] == pytest.approx([0.6, 0.8])
    assert tree.support[1:9].tolist() == [1] * 8


@pytest.mark.parametrize(
    "options",
    [{"min_views": 4}, {"min_support": 0.9}],
)
def test_each_of_the_two_needs_what_any_node_needs(options) -> None:
    for masks in (shelf(with_books=3), shelf(alone=3)):
        assert separated(masks, **options)[0].parent.tolist() == PARENTS
    assert len(separated(shelf(), **options)[0].parent) == 10


def test_a_mask_that_shows_no_book_is_of_the_shelf_alone() -> None:
    masks = [*shelf(), (4, 0, SHELF)]
    tree, _ = separated(masks)
    assert int(tree.node[-1]) == 9
    assert tree.views[9] == 5


def test_what_no_mask_of_the_shelf_alone_tells_of_stays_outside() -> None:
    # A third book, in two views in which the shelf has no mask of its own.
    masks = [*shelf(), *[(view, 0, EVERYTHING) for view in (4, 5)]]
    masks += [(view, 9, (19,)) for view in (4, 5)]
    masks += [(view, 3, BOOKS[0]) for view in (4, 5)]
    tree, level = separated(masks, [*PARENTS, 0])
    assert tree.parent.tolist() == [-1, 10, 10, 0, 0, 3, 3, 4, 4, 0, 0]
    assert level[9] == OBJECT


def test_what_lies_in_a_part_and_not_in_the_shelf_is_beside_the_shelf() -> None:
    # A board with the first book on it is a node of its own, a fragment of some views.
    parents = [-1, 0, 0, 9, 0, 3, 3, 4, 4, 0]
    masks = [*shelf(), *[(view, 9, (*range(12), *BOOKS[0])) for view in range(4)]]
    # What the shelf alone holds of the fragment is 12 of 14: most of it.
    tree, level = separated(masks, parents)
    assert tree.parent.tolist() == [-1, 10, 10, 0, 0, 3, 3, 4, 4, 10, 0]
    assert [level[row] for row in (0, 3, 4, 9, 10)] == [GROUP, OBJECT, OBJECT, PART, OBJECT]
    assert tree.size[10] == 20


def test_an_object_without_one_of_its_parts_is_nothing_and_is_not_divided() -> None:
    # The two parts that some masks leave out have no parts: a group would cost 2 + 2 / 2.
    masks = [one for one in shelf() if one[1] <= len(BOARDS) + len(BOOKS)]
    tree, level = separated(masks, PARENTS[:5])
    assert tree.parent.tolist() == PARENTS[:5]
    assert level == [OBJECT] + [PART] * 4
    assert not tree.alone.any()


@pytest.mark.parametrize(("books", "level"), [(4, OBJECT), (5, GROUP)])
def test_many_that_masks_leave_out_are_no_parts(books: int, level: int) -> None:
    # They are exceptions of an object, 4 or 5, and half as much as things without parts of a
    # group, which costs 2: 4 or 4.5.
    masks: Masks = []
    for view in range(4):
        masks += [(view, 0, (*SHELF, *range(20, 20 + books))), (view, 0, SHELF)]
        masks += [(view, 1 + row, board) for row, board in enumerate(BOARDS)]
        masks += [(view, 3 + row, (20 + row,)) for row in range(books)]
    tree, levels = separated(masks, [-1] + [0] * (2 + books))
    assert levels[0] == level
    assert len(tree.parent) == 3 + books + (level == GROUP)


def test_a_pane_that_is_one_node_with_its_window_is_a_part_of_it() -> None:
    masks: Masks = []
    for view in range(4):
        masks += [(view, 0, EVERYTHING), (view, 0, SHELF), (view, 1, BOOKS[0]), (view, 2, BOOKS[1])]
    tree, level = separated(masks, [-1, 0, 0])
    assert tree.parent.tolist() == [-1, 0, 0, 0]
    assert level == [OBJECT, PART, PART, PART]
    assert tree.node.tolist() == [0, 3, 1, 2] * 4


@pytest.mark.parametrize(("inside", "of", "divided"), [(3, 4, False), (5, 7, True)])
def test_children_in_three_of_four_masks_are_parts(inside: int, of: int, divided: bool) -> None:
    # A view has several masks of the shelf, of which some hold the books.
    masks: Masks = []
    for view in range(4):
        masks += [(view, 0, EVERYTHING)] * inside + [(view, 0, SHELF)] * (of - inside)
        masks += [(view, row + 1, member) for row, member in enumerate(MEMBERS)]
    assert (len(separated(masks)[0].parent) == 10) == divided


def test_what_two_divisions_leave_out_ends_beside_the_larger_thing() -> None:
    module = importlib.import_module("splatseg.methods.associate._levels")
    # 0 holds 1, a fragment, and 2; 1 holds 3 and 4; 4 holds 5. Neither the smaller thing of 1 nor
    # that of 0 holds 5.
    parents = [-1, 0, 0, 1, 1, 4]
    members = [(1, (*range(12), *range(20, 24))), (1, range(12)), (2, (19,)), (3, (20, 21))]
    members += [(4, (*range(9), 22, 23)), (5, (22, 23)), (0, EVERYTHING), (0, range(19))]
    masks = [(view, node, held) for view in range(3) for node, held in members]
    share = np.zeros((len(masks), GAUSSIANS))
    for row, (_, _, held) in enumerate(masks):
        share[row, list(held)] = 1
    node, view = (np.array([mask[column] for mask in masks]) for column in (1, 0))
    tree = SegmentTree(
        node=node,
        parent=np.array(parents),
        size=np.array([24.0, 16, 1, 2, 11, 2]),
        support=np.ones(6),
        views=np.full(6, 3),
        alone=np.zeros(6, bool),
    )
    found = module._divisions(tree, nested_of(share, view), min_support=0.3, min_views=2)
    assert [division.row for division in found] == [1, 0]
    assert module._divided(tree, found).parent.tolist() == [-1, 7, 0, 0, 6, 0, 1, 0]


def test_masks_too_small_to_be_compared_say_nothing() -> None:
    # So little is seen of books and pages that nothing shared with the shelf is on record.
    masks = shelf()
    node, view = (np.array([mask[column] for mask in masks]) for column in (1, 0))
    share = np.zeros((len(masks), GAUSSIANS))
    for row, (_, _, held) in enumerate(masks):
        share[row, list(held)] = 1 if node[row] < 3 else 0.01
    found = nested_of(share, view)
    on_record = scipy.sparse.diags((node < 3).astype(float)) @ found.inside
    tree = SegmentTree(
        node=node,
        parent=np.array(PARENTS),
        size=np.ones(9),
        support=np.ones(9),
        views=np.full(9, 4),
        alone=np.zeros(9, bool),
    )
    nested = replace(found, inside=on_record.tocsr())
    assert nested.inside.nnz == 4 * 2 * 2
    divided, _ = separated_levels(tree, nested, min_support=0.3, min_views=2)
    assert divided.parent.tolist() == PARENTS
