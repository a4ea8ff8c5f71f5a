"""What lies outside all masks belongs to nothing, though masks touch it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.core import InstanceTree, LabelMap, Labels, MaskSet
from splatseg.lift.completion import complete
from splatseg.lift.voting.segment_masses import view_masses
from splatseg.methods.associate import AssociateOptions, associate
from splatseg.methods.associate._table import segment_table
from splatseg.methods.associate._tree import SegmentTree
from splatseg.methods.associate._votes import TreeVotes, without_outside

from .test_associate import BACKEND, GAUSSIANS, VIEWS, Segments, columns

# The strip that alone has masks, a quarter of a piece too wide, and what it spills over.
BORDERS = (-1.2, -0.6, 0.05, 1.2)
THING = 1


def masks(view) -> MaskSet:
    return MaskSet.from_dense((columns(view, *BORDERS) == THING)[None])


def found(**options) -> InstanceTree:
    source = Segments({view.name: masks(view) for view in VIEWS}, overlapping=True)
    tree = associate(GAUSSIANS, VIEWS, source, options=AssociateOptions(**options), backend=BACKEND)
    assert isinstance(tree, InstanceTree)
    return tree


@pytest.fixture
def table():
    source = Segments({view.name: masks(view) for view in VIEWS}, overlapping=True)
    return segment_table(GAUSSIANS, VIEWS, source, longest_side=640, backend=BACKEND)


def test_a_view_says_what_of_each_gaussian_is_covered_once_however_masks_overlap() -> None:
    view = VIEWS[0]
    inside = masks(view).dense(0)
    both = MaskSet.from_dense(torch.stack((inside, inside, torch.zeros_like(inside))))
    ids = LabelMap(ids=torch.where(inside, 3, -1).int())
    one, two, labels = (
        view_masses(GAUSSIANS, view.camera, it, backend=BACKEND) for it in (masks(view), both, ids)
    )
    expected = torch.zeros(len(GAUSSIANS)).index_add(0, one.gaussian, one.weight)
    for found in (one, two, labels):
        torch.testing.assert_close(found.covered, expected, rtol=1e-3, atol=1e-4)
        assert bool((found.covered <= found.visible + 1e-4).all())


def test_the_table_has_the_share_of_all_views(table) -> None:
    covered, visible = torch.zeros(2, len(GAUSSIANS))
    for view in VIEWS:
        one = view_masses(GAUSSIANS, view.camera, masks(view), backend=BACKEND)
        covered, visible = covered + one.covered, visible + one.visible
    seen = visible > 0.05
    np.testing.assert_allclose(table.covered[seen], (covered / visible)[seen], rtol=1e-3, atol=1e-4)
    assert (table.covered[~seen] == 1).all()


def test_pixels_without_a_label_tell_nothing() -> None:
    """Of label maps -1 is unknown, and not outside."""
    maps = {
        view.name: LabelMap(ids=torch.where(columns(view, *BORDERS) == THING, 1, -1).int())
        for view in VIEWS
    }
    source = Segments(maps)
    table = segment_table(GAUSSIANS, VIEWS, source, longest_side=640, backend=BACKEND)
    assert (table.covered == 1).all()


@pytest.fixture
def votes():
    """Gaussians of objects 1 (support 1) and 2 (support 0.4), and two of none."""
    ids = torch.tensor([1, 1, 2, 2, -1, -1], dtype=torch.int32)
    return TreeVotes(
        objects=Labels(ids=ids, confidence=torch.full((6,), 0.9)),
        node=np.array([0, 0, 1, 1, -1, -1]),
        object_rows=np.array([0, 1]),
        object_of_segment=np.array([0, 1]),
        own=None,
        soft=(np.tile([0, 1], (6, 1)), np.full((6, 2), 0.4, np.float32)),
    )


TREE = SegmentTree(
    node=np.array([0, 1]),
    parent=np.array([-1, -1]),
    support=np.array([1.0, 0.4]),
    views=np.array([3, 3]),
    size=np.array([2.0, 1.0]),
    alone=np.array([False, False]),
)


def test_cover_is_held_against_the_support_of_the_object(table, votes) -> None:
    # Half of the support: 0.5 and 0.2; of what has no object half of min_support: 0.15.
    covered = np.array([0.51, 0.49, 0.21, 0.19, 0.16, 0.14], np.float32)
    left = without_outside(votes, replace(table, covered=covered), TREE, min_support=0.3)
    assert left.objects.ids.tolist() == [1, -1, 2, -1, -1, -1]
    assert left.node.tolist() == [0, -1, 1, -1, -1, -1]
    expected = torch.tensor([0.9, 0.51, 0.9, 0.81, 0.9, 0.86])
    torch.testing.assert_close(left.objects.confidence, expected)
    assert left.soft is not None
    assert left.soft[0].tolist() == [[0, 1], [-1, -1], [0, 1], [-1, -1], [0, 1], [-1, -1]]
    assert left.soft[1][:, 0].tolist() == pytest.approx([0.4, 0, 0.4, 0, 0.4, 0])


def test_what_is_covered_enough_stays_as_it_was(table, votes) -> None:
    covered = np.full(6, 0.6, np.float32)
    assert without_outside(votes, replace(table, covered=covered), TREE, min_support=0.3) is votes


def test_masks_of_one_thing_do_not_make_the_scene_that_thing() -> None:
    tree = found()
    x = GAUSSIANS.means[:, 0]
    thing = (x > -0.6) & (x < 0.0)
    ids = tree.labels.ids
    assert ids[thing].unique().tolist() == [1]
    far = (x < -0.7) | (x > 0.2)
    assert ids[far].unique().tolist() == [-1]
    assert bool((tree.labels.confidence[far] > 0.5).all())
    assert bool((tree.labels.shares[far] == 0).all())
    # Completion fills what is unknown, and leaves what is nothing.
    done = complete(GAUSSIANS, tree.labels)
    assert torch.equal(done.ids[far], ids[far])
    assert not bool(done.inferred[far].any())


def test_nothing_spreads_as_labels_do() -> None:
    row = GAUSSIANS[torch.arange(5)].replace(
        means=torch.arange(5.0)[:, None] * torch.tensor([[1.0, 0.0, 0.0]])
    )
    labels = Labels(
        ids=torch.tensor([7, -1, -1, -1, -1]), confidence=torch.tensor([1.0, 0, 0, 0, 0])
    )
    assert complete(row, labels).ids.tolist() == [7] * 5
    sure = replace(labels, confidence=torch.tensor([1.0, 0, 0, 0, 0.8]))
    done = complete(row, sure)
    assert done.ids.tolist()[0] == 7
    assert done.ids.tolist()[3:] == [-1, -1]
    assert done.confidence.tolist()[4] == pytest.approx(0.8)
    soft = replace(
        sure,
        candidates=torch.tensor([[7, -1]] + [[-1, -1]] * 4),
        shares=torch.tensor([[1.0, 0]] + [[0.0, 0]] * 4),
    )
    both = complete(row, soft)
    assert both.ids.tolist() == done.ids.tolist()
    assert bool((both.shares[both.candidates == -1] == 0).all())
