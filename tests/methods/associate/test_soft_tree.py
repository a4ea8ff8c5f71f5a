"""Votes of a tree sharpened: shares of nodes, and cuts that stay soft."""

import numpy as np
import pytest
import torch

from splatseg.core import InstanceTree, Labels, MaskSet, TreeNode
from splatseg.io.layers import load_layer, save_layer
from splatseg.methods.associate import associate
from splatseg.methods.associate._memberships import painted
from splatseg.methods.associate._table import segment_table
from support.wall import SKY_ROWS, camera, wall


class Fields:
    """Masks of the left and the right half of a wall, and of the upper left quarter."""

    overlapping = True
    persistent = False

    def __init__(self, views) -> None:
        self._views = {view.name: view for view in views}

    @property
    def view_names(self):
        return tuple(self._views)

    def segments_of(self, name: str) -> MaskSet:
        place = self._views[name].camera
        column, row = torch.meshgrid(
            torch.arange(place.width) + 0.5, torch.arange(place.height) + 0.5, indexing="xy"
        )
        middle, _ = place.project(torch.tensor([[0.0, 1.0, 2.0]], dtype=torch.float64))
        left = (column < float(middle[0, 0])) & (row > SKY_ROWS)
        right = (column >= float(middle[0, 0])) & (row > SKY_ROWS)
        return MaskSet.from_dense(torch.stack((left, right, left & (row < float(middle[0, 1])))))

    def categories_of(self, name: str):
        return {}


@pytest.fixture
def views():
    from splatseg.core import View

    return [View(name=f"v{i}", camera=camera(0.1 * i)) for i in range(-2, 3)]


def made(views, **changes) -> InstanceTree:
    tree = associate(wall(), views, Fields(views), **changes)
    assert isinstance(tree, InstanceTree)
    return tree


def test_a_tree_has_shares_and_its_cuts_have_them(views) -> None:
    tree = made(views)
    assert tree.labels.candidates is not None
    assert tree.labels.shares is not None
    assert set(tree.labels.candidates.unique().tolist()) <= {node.id for node in tree.nodes} | {-1}
    cut = tree.cut()
    assert cut.candidates is not None
    assert cut.shares is not None
    named = cut.ids >= 0
    own = (cut.shares * (cut.candidates == cut.ids[:, None])).sum(dim=1)
    assert (own[named] >= 0.5).float().mean() > 0.95
    left = wall().means[:, 0] < -0.3
    ids, counts = cut.ids[left & named].unique(return_counts=True)
    assert counts.max() / counts.sum() > 0.99
    assert len(ids) <= 2


def test_maps_that_memberships_are_fitted_to_have_the_smallest_object_on_top(views) -> None:
    """The quarter is the object 0, the left half the object 1, the right one is none."""
    fields = Fields(views)
    table = segment_table(wall(), views, fields, longest_side=640, backend="auto")
    found = painted(table, np.array([1, -1, 0])[table.name], fields, 640)
    for view in views:
        masks = fields.segments_of(view.name)
        expected = torch.where(masks.dense(0), 1, -1)
        expected[masks.dense(2)] = 0
        assert torch.equal(found(view).ids, expected.int())


def test_without_memberships_a_tree_is_hard(views) -> None:
    assert made(views, sharpen_votes=False).labels.candidates is None


def test_shares_of_nodes_inside_one_are_added_up() -> None:
    nodes = (
        TreeNode(id=1), TreeNode(id=2, parent=1, level="part"),
        TreeNode(id=3, parent=1, level="part"), TreeNode(id=4),
    )  # fmt: skip
    labels = Labels(
        ids=torch.tensor([2, 4]),
        confidence=torch.ones(2),
        candidates=torch.tensor([[2, 3, 4], [4, 1, -1]]),
        shares=torch.tensor([[0.5, 0.25, 0.125], [0.75, 0.25, 0.0]]),
    )
    tree = InstanceTree(nodes=nodes, labels=labels)
    cut = tree.cut()
    assert cut.candidates is not None
    assert cut.candidates.tolist() == [[1, -1, 4], [4, 1, -1]]
    assert cut.shares is not None
    assert cut.shares.tolist() == [[0.75, 0.0, 0.125], [0.75, 0.25, 0.0]]


def test_a_file_of_a_tree_keeps_its_shares(views, tmp_path) -> None:
    tree = made(views)
    save_layer(tree, tmp_path / "tree.npz")
    again = load_layer(tmp_path / "tree.npz")
    assert isinstance(again, InstanceTree)
    for name in ("ids", "candidates", "shares"):
        np.testing.assert_array_equal(getattr(again.labels, name), getattr(tree.labels, name))
