"""Trees of instances: what they refuse, and what their cuts are."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatseg.core import (
    TREE_LEVELS,
    Edited,
    Gaussians,
    InstanceTree,
    Labels,
    LayerInfo,
    Selection,
    TreeNode,
    apply_rows,
    flat_layer,
    layer_address,
    tree_level,
)
from splatseg.errors import InputError, RangeError

# A table (1) with a lamp (2: shade 4, whose rim is 6, and foot 5) and a cup (3) on it; a wall (7).
NODES = (
    TreeNode(id=1, level="group", name="group 1"),
    TreeNode(id=2, parent=1, name="lamp", class_id=8, support=0.5),
    TreeNode(id=3, parent=1, name="cup"),
    TreeNode(id=4, parent=2, level="part", name="shade"),
    TreeNode(id=5, parent=2, level="part", name="foot"),
    TreeNode(id=6, parent=4, level="part", name="rim"),
    TreeNode(id=7, name="wall"),
)
IDS = [6, 4, 5, 2, 3, 1, 7, -1]


def labels(ids, **more) -> Labels:
    ids = torch.tensor(ids, dtype=torch.int32)
    return Labels(ids=ids, confidence=torch.linspace(0.5, 1, len(ids)), **more)


TREE = InstanceTree(nodes=NODES, labels=labels(IDS, info=LayerInfo(method="associate")))


@pytest.mark.parametrize(
    ("level", "expected"),
    [
        ("group", [1, 1, 1, 1, 1, 1, 7, -1]),
        ("object", [2, 2, 2, 2, 3, -1, 7, -1]),
        ("part", [6, 4, 5, 2, 3, 1, 7, -1]),
        (0.0, [1, 1, 1, 1, 1, 1, 7, -1]),
        (0.49, [1, 1, 1, 1, 1, 1, 7, -1]),
        (0.5, [2, 2, 2, 2, 3, 1, 7, -1]),
        (0.75, [4, 4, 2, 2, 3, 1, 7, -1]),
        (1.0, [6, 4, 5, 2, 3, 1, 7, -1]),
    ],
)
def test_cuts_by_hand(level, expected) -> None:
    assert TREE.cut(level).ids.tolist() == expected


def test_a_cut_is_of_objects_unless_another_is_asked_for() -> None:
    assert torch.equal(TREE.cut().ids, TREE.cut("object").ids)


def test_a_cut_says_what_its_ids_are_and_is_unsure_of_none() -> None:
    cut = TREE.cut("object")
    assert cut.info.cut == "object"
    assert cut.info.method == "associate"
    assert cut.info.names == {2: "lamp", 3: "cup", 7: "wall"}
    assert cut.info.class_of == {2: 8}
    assert cut.info.instances == {}, "nothing is known of what nodes by hand were made of"
    expected = TREE.labels.confidence.clone()
    expected[[5, 7]] = 0
    assert torch.equal(cut.confidence, expected)


def test_the_background_is_cut_as_well() -> None:
    tree = replace(TREE, labels=replace(TREE.labels, background=6))
    assert tree.cut("group").background == 1
    assert tree.cut("object").background == 2
    assert TREE.cut("part").background == -1


def test_granularity_grows_from_groups_over_objects_to_the_last_parts() -> None:
    assert TREE.granularity() == {1: 0.0, 2: 0.5, 3: 0.5, 4: 0.75, 5: 1.0, 6: 1.0, 7: 0.5}
    deep = (
        TreeNode(id=1, level="group"),
        TreeNode(id=2, parent=1, level="group"),
        TreeNode(id=3, parent=2),
    )
    assert InstanceTree(nodes=deep, labels=labels([3])).granularity() == {1: 0.0, 2: 0.25, 3: 0.5}


def test_paths_and_depth() -> None:
    assert TREE.path(6) == (1, 2, 4, 6)
    assert TREE.depth == 4
    assert TREE.node(4).name == "shade"
    with pytest.raises(InputError, match="9"):
        TREE.node(9)


@pytest.mark.parametrize("wrong", [{"id": 0}, {"id": 1, "support": 1.5}, {"id": 1, "views": -1}])
def test_nodes_out_of_their_ranges_are_refused(wrong) -> None:
    with pytest.raises(RangeError, match=f"^{list(wrong)[-1]}: expected"):
        TreeNode(**wrong)


@pytest.mark.parametrize(
    ("nodes", "error", "text"),
    [
        ((TreeNode(id=1), TreeNode(id=1)), InputError, "twice"),
        ((TreeNode(id=1, parent=5),), InputError, "parent that is there"),
        ((TreeNode(id=1, level="part"),), InputError, "in nothing"),
        ((TreeNode(id=1), TreeNode(id=2, parent=1)), InputError, "in object"),
        ((TreeNode(id=1), TreeNode(id=2, parent=1, level="group")), InputError, "in object"),
        (
            (TreeNode(id=1, parent=2, level="group"), TreeNode(id=2, parent=1, level="group")),
            InputError,
            "above itself",
        ),
    ],
)
def test_what_is_no_tree_is_refused(nodes, error, text) -> None:
    with pytest.raises(error, match=text):
        InstanceTree(nodes=nodes, labels=labels([]))


def test_gaussians_without_a_node_of_the_tree_are_refused() -> None:
    with pytest.raises(InputError, match="9"):
        InstanceTree(nodes=NODES, labels=labels([9]))


@pytest.mark.parametrize("level", ["things", -0.1, 1.1, float("nan")])
def test_levels_that_are_none_are_refused(level) -> None:
    with pytest.raises((InputError, RangeError), match="level"):
        TREE.cut(level)


def test_addresses() -> None:
    assert layer_address("masks") == ("masks", None)
    assert layer_address("masks@group") == ("masks", "group")
    assert layer_address("masks@0.3") == ("masks", 0.3)
    for wrong in ("masks@", "masks@whole", "masks@2", "masks@nan"):
        with pytest.raises(InputError, match="level"):
            layer_address(wrong)
    assert tree_level("object") == "object"


def test_flat_layers_have_no_levels() -> None:
    assert flat_layer(TREE, None, name="t").ids.tolist() == TREE.cut().ids.tolist()  # type: ignore[union-attr]
    assert flat_layer(TREE, "part", name="t").ids.tolist() == IDS  # type: ignore[union-attr]
    chosen = Selection(mask=torch.tensor([True]))
    assert flat_layer(chosen, None, name="s") is chosen
    with pytest.raises(InputError, match="expected a tree"):
        flat_layer(chosen, "part", name="s")


def test_changes_of_a_cut_leave_what_stays_in_its_part() -> None:
    changed = replace(TREE.cut(), ids=torch.tensor([2, 3, 2, 2, 3, -1, 7, 7], dtype=torch.int32))
    tree = TREE.with_cut(changed)
    assert tree.labels.ids.tolist() == [6, 3, 5, 2, 3, 1, 7, 7]
    assert tree.cut().ids.tolist() == changed.ids.tolist()
    assert tree.info == TREE.info, "names are those of the nodes again"


def test_rows_follow_an_edit() -> None:
    gaussians = Gaussians(
        means=torch.zeros(3, 3),
        rotations=torch.eye(4)[:1].expand(3, 4),
        scales=torch.ones(3, 3),
        opacities=torch.ones(3),
        sh=torch.zeros(3, 1, 3),
    )
    tree = apply_rows(TREE, Edited(gaussians=gaussians, rows=torch.tensor([1, -1, 6])))
    assert tree.labels.ids.tolist() == [4, -1, 7]
    assert tree.nodes == NODES
    assert TREE[2:4].labels.ids.tolist() == [5, 2]


@st.composite
def trees(draw) -> InstanceTree:
    nodes: list[TreeNode] = []
    for id in range(1, draw(st.integers(1, 12)) + 1):
        parents = [None, *nodes]
        parent = draw(st.sampled_from(parents))
        level = {None: ("group", "object"), "group": ("group", "object")}.get(
            None if parent is None else parent.level, ("part",)
        )
        nodes.append(
            TreeNode(
                id=id,
                parent=-1 if parent is None else parent.id,
                level=draw(st.sampled_from(level)),
            )
        )
    ids = draw(st.lists(st.sampled_from([-1, *range(1, len(nodes) + 1)]), max_size=30))
    return InstanceTree(nodes=tuple(nodes), labels=labels(ids))


@given(tree=trees(), one=st.floats(0, 1), other=st.floats(0, 1))
def test_finer_cuts_lie_inside_coarser_ones(tree: InstanceTree, one: float, other: float) -> None:
    fine, coarse = tree.cut(max(one, other)).ids, tree.cut(min(one, other)).ids
    for id in fine.unique().tolist():
        inside = coarse[fine == id].unique().tolist()
        assert len(inside) == 1
        assert id == -1 or inside[0] in tree.path(id)


@given(tree=trees())
def test_levels_are_cuts_of_one_laminar_family(tree: InstanceTree) -> None:
    ids = tree.labels.ids.tolist()
    members = {
        node.id: {i for i, id in enumerate(ids) if id > 0 and node.id in tree.path(id)}
        for node in tree.nodes
    }
    for a in members.values():
        for b in members.values():
            assert a <= b or b <= a or not (a & b)
    for level in TREE_LEVELS:
        cut = tree.cut(level)
        for id in cut.present.tolist():
            found = set((cut.ids == id).nonzero().squeeze(1).tolist())
            assert found <= members[id]
    objects = tree.cut("object").ids
    assert all(tree.node(id).level == "object" for id in objects[objects > 0].tolist())
    granularity = tree.granularity()
    for node in tree.nodes:
        assert 0 <= granularity[node.id] <= 1
        if node.parent > 0:
            assert granularity[node.parent] < granularity[node.id]
