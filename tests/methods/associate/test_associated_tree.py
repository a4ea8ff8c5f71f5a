"""Masks that are nested in every view become a tree of groups, objects and parts."""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from splatseg.core import TREE_LEVELS, InstanceTree, Labels, MaskSet, Rle, View
from splatseg.errors import InputError, RangeError
from splatseg.methods.associate import DEFAULT_CONFUSION, AssociateOptions, associate
from splatseg.methods.associate._clustering import Agreement, cluster
from splatseg.methods.associate._levels import GROUP, OBJECT, PART
from splatseg.methods.associate._tree import SegmentTree
from splatseg.render.cpu import set_threads, threads

from .test_associate import BACKEND, GAUSSIANS, VIEWS, Segments, columns, table_of

# What the strips between these borders hold: the halves of the left square, those of the middle
# one, and the right square.
BORDERS = (-1.2, -0.6, -0.3, 0.0, 0.3, 1.2)
HALVES = [frozenset({0, 2}), frozenset({1, 3}), frozenset({4, 6}), frozenset({5, 7})]
LEFT, MIDDLE, RIGHT = frozenset(range(4)), frozenset(range(4, 8)), frozenset(range(8, 12))

# Strips of each mask: four halves, two wholes, the group of both, and a neighbour of one piece.
NESTED = ((0,), (1,), (2,), (3,), (0, 1), (2, 3), (0, 1, 2, 3), (4,))


def masks(view: View, strips: Sequence[Sequence[int]]) -> MaskSet:
    strip = columns(view, *BORDERS)
    found = [torch.isin(strip, torch.tensor(list(wanted))) for wanted in strips]
    return MaskSet(
        height=view.camera.height,
        width=view.camera.width,
        masks=tuple(Rle.encode(mask) for mask in found),
        scores=torch.ones(len(found)),
        levels=torch.zeros(len(found), dtype=torch.int32),
    )


def nested(strips: Mapping[str, Sequence[Sequence[int]]] | None = None, views=VIEWS) -> Segments:
    strips = strips or {}
    return Segments(
        {view.name: masks(view, strips.get(view.name, NESTED)) for view in views},
        overlapping=True,
    )


def run(source: Segments, views=VIEWS, confusion=DEFAULT_CONFUSION, **options):
    return associate(
        GAUSSIANS,
        views,
        source,
        options=AssociateOptions(**options),
        confusion=confusion,
        backend=BACKEND,
    )


def tree_of(source: Segments, views=VIEWS, **options) -> InstanceTree:
    found = run(source, views, **options)
    assert isinstance(found, InstanceTree)
    return found


def sets(labels: Labels) -> set[frozenset[int]]:
    """The Gaussians of each id."""
    return {
        frozenset((labels.ids == id).nonzero().squeeze(1).tolist())
        for id in labels.ids.unique().tolist()
        if id > 0
    }


def test_halves_wholes_group_and_neighbour_are_four_levels_of_one_tree() -> None:
    tree = tree_of(nested())
    assert sets(tree.cut()) == {LEFT, MIDDLE, RIGHT}
    assert sets(tree.cut("part")) == {*HALVES, RIGHT}
    assert sets(tree.cut("group")) == {LEFT | MIDDLE, RIGHT}
    assert int(tree.labels.ids[12]) == -1
    assert sorted(node.level for node in tree.nodes) == [*["group"], *["object"] * 3, *["part"] * 4]
    assert all(node.views == 4 and node.support == 1 for node in tree.nodes)
    assert tree.info.details["associate"] == {
        "segments": 32,
        "instances": 3,
        "left_out": 0,
        "joined_within_views": 0,
        "nodes": 8,
    }


def test_two_wholes_alone_are_objects_with_parts() -> None:
    tree = tree_of(nested({view.name: NESTED[:6] + NESTED[7:] for view in VIEWS}))
    assert sets(tree.cut()) == sets(tree.cut("group")) == {LEFT, MIDDLE, RIGHT}
    assert sets(tree.cut("part")) == {*HALVES, RIGHT}


def test_masks_without_any_nesting_are_objects() -> None:
    tree = tree_of(nested({view.name: ((0, 1), (2, 3), (4,)) for view in VIEWS}))
    assert {node.level for node in tree.nodes} == {"object"}
    assert sets(tree.cut()) == {LEFT, MIDDLE, RIGHT}


def test_a_mask_that_one_view_lacks_is_made_up_for_by_the_others() -> None:
    without_whole = tuple(wanted for wanted in NESTED if wanted != (0, 1))
    tree = tree_of(nested({"v1": without_whole}))
    assert sets(tree.cut()) == {LEFT, MIDDLE, RIGHT}
    support = {node.id: node.support for node in tree.nodes}
    left = int(tree.cut().ids[0])
    assert support[left] == 0.75


def test_masks_of_few_views_are_no_nodes_where_more_support_is_asked_for() -> None:
    # The left square has parts in two of the four views only.
    rare = {view.name: NESTED[2:] for view in VIEWS[2:]}
    whole = {LEFT, *HALVES[2:], RIGHT}
    assert sets(tree_of(nested(rare), min_support=0.4).cut("part")) == {*HALVES, RIGHT}
    assert sets(tree_of(nested(rare), min_support=0.6).cut("part")) == whole
    assert sets(tree_of(nested(rare), min_views=3).cut("part")) == whole


def test_neither_the_order_of_views_nor_that_of_masks_matters() -> None:
    one = tree_of(nested())
    other = tree_of(
        nested({view.name: NESTED[i:] + NESTED[:i] for i, view in enumerate(VIEWS)}), VIEWS[::-1]
    )
    assert one.nodes == other.nodes
    assert torch.equal(one.labels.ids, other.labels.ids)
    assert torch.equal(one.labels.confidence, other.labels.confidence)


def test_the_largest_part_of_what_leaves_a_part_out_is_a_part() -> None:
    # A frame in the first strip, the pane in the others, and the window: nearly the same as the
    # pane, so that the masks of both are one node at first.
    window = {view.name: ((0,), (1, 2, 3, 4), (0, 1, 2, 3, 4)) for view in VIEWS}
    tree = tree_of(nested(window))
    frame, pane = frozenset({0, 2}), frozenset(range(12)) - {0, 2}
    assert sets(tree.cut()) == {frame | pane}
    assert sets(tree.cut("part")) == {frame, pane}
    assert [node.level for node in tree.nodes] == ["object", "part", "part"]
    assert {node.support for node in tree.nodes} == {1.0}


def test_relabelling_of_a_tree_counts_no_more_views_than_saw_a_gaussian(monkeypatch) -> None:
    """Objects and parts alike."""
    module = importlib.import_module("splatseg.methods.associate._votes")
    asked = []
    monkeypatch.setattr(
        module, "correct_confusion", lambda labels, options: asked.append(labels) or labels
    )
    tree = tree_of(nested())
    expected = [4.0] * 12 + [0.0]
    assert len(asked) == 2
    for labels in (*asked, tree.labels):
        assert labels.effective_views is not None
        assert labels.effective_views.tolist() == expected


def test_the_rest_of_an_object_has_no_part() -> None:
    # One half of the left square has masks; a twentieth of the other half's light falls in them.
    half = {view.name: ((0,), (0, 1), (2, 3), (4,)) for view in VIEWS}
    tree = tree_of(nested(half))
    assert sets(tree.cut()) == {LEFT, MIDDLE, RIGHT}
    assert sets(tree.cut("part")) == {HALVES[0], HALVES[1], MIDDLE, RIGHT}
    assert [node.level for node in tree.nodes] == ["object"] * 3 + ["part"]


def test_votes_for_the_own_node_count_as_the_others_do() -> None:
    module = importlib.import_module("splatseg.methods.associate._votes")
    table = table_of(nested())
    count = len(table.view)
    node = np.arange(count) % 8
    node[node == 7] = -1
    own = np.resize([4, 5, -1], table.gaussians)
    voter = module._TreeVoter(table=table, tree=None, level=None, confusion=None, views=None)
    found = voter.own(node, own)
    of = node[table.segment]
    mine = (of == own[table.gaussian]) & (of >= 0)
    expected = np.bincount(table.gaussian[mine], table.mass[mine], minlength=table.gaussians)
    assert found == pytest.approx(expected)
    assert found[own == 4].max() > 0


def test_ids_follow_what_is_seen_and_not_where_masks_begin() -> None:
    # Two, six and four Gaussians from left to right.
    tree = tree_of(nested({view.name: ((0,), (1, 2, 3), (4,)) for view in VIEWS}))
    assert tree.cut().ids.tolist() == [3, 1, 3, *[1] * 5, *[2] * 4, -1]


def test_parts_of_parts_are_of_the_part_next_to_the_object() -> None:
    module = importlib.import_module("splatseg.methods.associate._votes")
    table = table_of(nested())
    found = SegmentTree(
        node=np.zeros(len(table.view), int),
        parent=np.array([-1, 0, 1, 2, -1, 4]),
        size=np.ones(6),
        support=np.ones(6),
        views=np.ones(6, int),
        alone=np.zeros(6, bool),
    )
    level = np.array([GROUP, OBJECT, PART, PART, OBJECT, PART])
    object_of, top_part = module._above(found, level)
    assert object_of.tolist() == [-1, 1, 1, 1, 4, 4, -1]
    assert top_part.tolist() == [-1, -1, 2, 2, -1, 5, -1]


def test_parts_of_parts_are_nodes_of_their_own() -> None:
    strips = ((0,), (1,), (0, 1), (2, 3), (0, 1, 2, 3), (4,))
    tree = tree_of(nested({view.name: strips for view in VIEWS}))
    assert sets(tree.cut()) == {LEFT | MIDDLE, RIGHT}
    assert sets(tree.cut("part")) == {HALVES[0], HALVES[1], MIDDLE, RIGHT}
    assert tree.depth == 3


def test_a_cut_can_be_asked_for_instead_of_the_tree() -> None:
    parts = run(nested(), level="part")
    assert isinstance(parts, Labels)
    assert sets(parts) == {*HALVES, RIGHT}
    assert parts.info.cut == "part"
    coarse = run(nested(), level="0")
    assert isinstance(coarse, Labels)
    assert sets(coarse) == {LEFT | MIDDLE, RIGHT}


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"level": "things"}, InputError),
        ({"min_support": 1.5}, RangeError),
    ],
)
def test_options_that_mean_nothing_are_refused(options, error) -> None:
    with pytest.raises(error):
        AssociateOptions(**options)


def test_ids_count_objects_first_by_what_is_seen_of_them() -> None:
    tree = tree_of(nested())
    assert [node.level for node in tree.nodes[:4]] == ["object", "object", "object", "group"]
    assert [node.id for node in tree.nodes] == list(range(1, len(tree.nodes) + 1))
    evidence = tree.labels.evidence
    assert evidence is not None
    mass = [float(evidence[tree.cut().ids == id].sum()) for id in (1, 2, 3)]
    assert np.all(np.diff(mass) <= 0)


def with_levels(source: Segments, levels: Sequence[int]) -> Segments:
    given = torch.tensor(levels, dtype=torch.int32)
    return replace(source, of={name: replace(m, levels=given) for name, m in source.of.items()})


def test_levels_that_a_model_gives_keep_masks_of_a_view_apart() -> None:
    # The right square twice in every view: once as a part, once as an object.
    twice = nested({view.name: ((4,), (0, 1), (4,)) for view in VIEWS})
    plain = tree_of(twice)
    assert {node.level for node in plain.nodes} == {"object"}
    assert sets(plain.cut()) == {LEFT, RIGHT}
    said = tree_of(with_levels(twice, (0, 1, 1)))
    assert [node.level for node in said.nodes] == ["object", "object", "part"]
    right = said.nodes[2].parent
    assert set(said.cut("object").ids[8:12].tolist()) == {right}
    assert set(said.cut("part").ids[8:12].tolist()) == {3}
    # Whichever of the two comes first in the file.
    turned = tree_of(with_levels(nested({v.name: ((4,), (0, 1), (4,)) for v in VIEWS}), (1, 1, 0)))
    assert turned.nodes == said.nodes
    assert torch.equal(turned.labels.ids, said.labels.ids)


def test_levels_that_agree_with_shapes_change_no_node() -> None:
    levels = [0] * 4 + [1, 1, 2, 1]
    assert tree_of(with_levels(nested(), levels)).nodes == tree_of(nested()).nodes


def bits(tree: InstanceTree) -> list[bytes]:
    labels = tree.labels
    assert labels.evidence is not None
    columns = (labels.ids, labels.confidence, labels.evidence)
    return [column.contiguous().numpy().tobytes() for column in columns]


@pytest.mark.bits
def test_same_bits_at_one_two_and_three_threads() -> None:
    before = torch.get_num_threads(), threads()
    found = []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            set_threads(count)
            tree = associate(GAUSSIANS, VIEWS, ragged(7), backend="cpu")
            assert isinstance(tree, InstanceTree)
            found.append(tree)
    finally:
        torch.set_num_threads(before[0])
        set_threads(before[1])
    assert len(found[0].nodes) > 3
    for other in found[1:]:
        assert other.nodes == found[0].nodes
        assert bits(other) == bits(found[0])
        assert other.info == found[0].info


def ragged(seed: int, views: Sequence[View] = VIEWS) -> Segments:
    """Masks as models err: each view lacks some, and has unions of strips that nothing is."""
    rng = np.random.default_rng(seed)
    strips = {}
    for view in views:
        kept = [wanted for wanted in NESTED if rng.random() < 0.8] or [NESTED[0]]
        first, count = int(rng.integers(0, 4)), int(rng.integers(1, 4))
        strips[view.name] = [*kept, tuple(range(first, min(first + count, 5)))]
    return nested(strips, views)


def shuffled(source: Segments, rng: np.random.Generator) -> Segments:
    """The masks of every view in another order, so that each has another name."""
    found = {}
    for name, masks_of in source.of.items():
        order = rng.permutation(len(masks_of))
        found[name] = replace(masks_of, masks=tuple(masks_of.masks[i] for i in order))
    return replace(source, of=found)


@settings(max_examples=10)
@given(seed=st.integers(0, 10**6))
def test_the_whole_tree_follows_neither_order_nor_names(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source = ragged(seed)
    one = tree_of(source)
    other = tree_of(shuffled(source, rng), [VIEWS[i] for i in rng.permutation(len(VIEWS))])
    assert one.nodes == other.nodes
    assert bits(one) == bits(other)
    assert one.info == other.info


def test_names_of_views_are_in_the_info_alone() -> None:
    source, names = ragged(3), {"v0": "z", "v1": "c", "v2": "m", "v3": "a"}
    renamed = [replace(view, name=names[view.name]) for view in VIEWS]
    other = tree_of(
        replace(source, of={names[name]: found for name, found in source.of.items()}), renamed
    )
    one = tree_of(source)
    assert one.info.views != other.info.views
    for level in TREE_LEVELS:
        assert sets(one.cut(level)) == sets(other.cut(level))
    kinds = [
        sorted((n.level, n.support, n.segments, n.views) for n in t.nodes) for t in (one, other)
    ]
    assert kinds[0] == kinds[1]


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6), min_support=st.sampled_from([0.0, 0.3, 0.6]))
@example(seed=73, min_support=0.0)
@example(seed=32767, min_support=0.3)
def test_whatever_masks_come_cuts_lie_inside_each_other(seed: int, min_support: float) -> None:
    """Part inside object inside group as sets, children inside parents, siblings apart."""
    tree = tree_of(ragged(seed), min_support=min_support)
    cuts = {level: tree.cut(level).ids for level in TREE_LEVELS}
    members = {
        node.id: frozenset(
            i
            for i, id in enumerate(tree.labels.ids.tolist())
            if id > 0 and node.id in tree.path(id)
        )
        for node in tree.nodes
    }
    # One that no Gaussian is mostly of still has shares of some (two of one thing, at seed 73).
    shared = {
        above
        for id in tree.labels.candidates[tree.labels.shares > 0].unique().tolist()
        if id > 0
        for above in tree.path(id)
    }
    empty = {id for id, of_node in members.items() if not of_node}
    assert empty <= shared, "a node without a Gaussian says nothing"
    for node in tree.nodes:
        if node.parent > 0:
            assert members[node.id] <= members[node.parent]
    for fine, coarse in (("part", "object"), ("object", "group")):
        inside = cuts[fine] > 0 if fine == "object" else cuts["object"] > 0
        for id in cuts[fine][inside].unique().tolist():
            above = cuts[coarse][cuts[fine] == id].unique().tolist()
            assert len(above) == 1
            assert above[0] in tree.path(id)
        # Nothing gets lost on the way up.
        assert bool((cuts[coarse][inside] > 0).all())
    for node in tree.nodes:
        if node.level == "object":
            assert (
                frozenset((cuts["object"] == node.id).nonzero().squeeze(1).tolist())
                == members[node.id]
            )


@pytest.mark.parametrize("same", [[0, 1, 1, 2, 0, 3, 4, 5], [0, 1, 2, 3, 4, 5, 6, 0]])
def test_cores_of_joined_groups_are_those_found_from_nothing(monkeypatch, same) -> None:
    """Groups that were not joined keep their cores, whichever row they move to."""
    module = importlib.import_module("splatseg.methods.associate._tree")
    table = table_of(nested())
    seen = table.visibility().power(2).tocsr()
    group = np.arange(len(table.view)) % 8
    joined = np.array(same)[group]
    cores = module._cores(table, seen, group)
    kept = module._joined_cores(table, seen, cores, joined, np.array(same))
    monkeypatch.setattr(module, "_ROWS", 1)
    anew = module._cores(table, seen, joined)
    assert anew.nnz > 0
    assert np.array_equal(kept.toarray(), anew.toarray())


def _dense_cluster(agreement, threshold, conflicts):
    """Every pair compared anew in every round."""
    count = len(agreement.view)
    seen = agreement.seen.toarray().astype(float)
    shared = np.triu(agreement.shared.toarray().astype(float), 1)
    shared += shared.T
    member = np.zeros(seen.shape)
    member[np.arange(count), agreement.view] = 1
    groups = [[row] for row in range(count)]
    while True:
        m = np.array([member[g].sum(axis=0) for g in groups])
        s = np.array([seen[g].sum(axis=0) for g in groups])
        both = np.array([[shared[np.ix_(a, b)].sum() for b in groups] for a in groups])
        against = np.array([[conflicts[np.ix_(a, b)].sum() for b in groups] for a in groups])
        views = (m > 0).sum(axis=1)
        ratio = both / np.maximum(s @ m.T + m @ s.T - both, 1e-12)
        ratio[against > 0.2 * np.minimum(views[:, None], views)] = 0
        np.fill_diagonal(ratio, 0)
        best = ratio.argmax(axis=1)
        enough = ratio.max(axis=1) >= threshold
        pairs = [(a, int(b)) for a, b in enumerate(best) if a < b and enough[a] and best[b] == a]
        if not pairs:
            break
        for a, b in pairs:
            groups[a] = groups[a] + groups[b]
        gone = {b for _, b in pairs}
        groups = [g for row, g in enumerate(groups) if row not in gone]
    found = np.empty(count, int)
    for index, group in enumerate(groups):
        found[group] = index
    return found


@pytest.mark.parametrize("seed", range(4))
def test_rounds_that_keep_what_is_unchanged_are_rounds_from_nothing(seed) -> None:
    import scipy.sparse

    rng = np.random.default_rng(seed)
    count, views = 60, 7
    view = np.sort(rng.integers(0, views, count))
    kind = rng.integers(0, 9, count)
    shared = rng.random((count, count)) * np.where(kind[:, None] == kind, 1.0, 0.1)
    shared = np.where(rng.random((count, count)) < 0.5, shared, 0)
    shared = np.maximum(shared, shared.T)
    conflicts = np.triu((view[:, None] == view) & (rng.random((count, count)) < 0.2), 1)
    conflicts = (conflicts | conflicts.T).astype(float)
    agreement = Agreement(
        shared=scipy.sparse.csr_matrix(shared),
        seen=scipy.sparse.csr_matrix(0.5 + rng.random((count, views))),
        view=view,
    )
    found = cluster(agreement, 0.15, conflicts=scipy.sparse.csr_matrix(conflicts))
    assert 1 < found.max() + 1 < count - 10
    assert np.array_equal(found, _dense_cluster(agreement, 0.15, conflicts))
    free = cluster(agreement, 0.15)
    assert not np.array_equal(found, free)
    assert np.array_equal(free, _dense_cluster(agreement, 0.15, 0 * conflicts))


def test_masks_that_no_two_views_share_are_a_tree_of_nothing() -> None:
    strips = {view.name: ((place,),) for place, view in enumerate(VIEWS)}
    tree = tree_of(nested(strips))
    assert tree.nodes == ()
    assert set(tree.labels.ids.tolist()) == {-1}
