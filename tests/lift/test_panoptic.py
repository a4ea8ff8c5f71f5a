"""Instances and classes merged: scenes solved by hand, one for each rule."""

import pytest
import torch

from splatseg.core import (
    ClassInfo,
    ClassTable,
    Gaussians,
    InstanceFacts,
    InstanceTree,
    Labels,
    LayerInfo,
    RenderableLayer,
    TreeNode,
)
from splatseg.errors import InputError, ShapeError
from splatseg.evaluate.held_out import classes_of_instances
from splatseg.lift import merge_panoptic

FLOOR, WALL, CUP, CHAIR = 1, 2, 3, 4
SEEN = InstanceFacts(segments=4, views=9)
TABLE = ClassTable(
    rows=(
        ClassInfo(id=FLOOR, name="floor", isthing=False),
        ClassInfo(id=WALL, name="wall", isthing=False),
        ClassInfo(id=CUP, name="cup"),
        ClassInfo(id=CHAIR, name="chair"),
    )
)


def on_a_line(places) -> Gaussians:
    x = torch.tensor(places, dtype=torch.float32)
    n = len(x)
    rotations = torch.zeros(n, 4)
    rotations[:, 0] = 1
    return Gaussians(
        means=torch.stack((x, torch.zeros(n), torch.zeros(n)), -1),
        scales=torch.ones(n, 3),
        rotations=rotations,
        opacities=torch.ones(n),
        sh=torch.zeros(n, 1, 3),
    )


def labels(ids, confidence=None, **more) -> Labels:
    n = len(ids)
    says = torch.ones(n) if confidence is None else torch.tensor(confidence)
    return Labels(ids=torch.tensor(ids), confidence=says, **more)


def merged(instances: Labels, classes: Labels, places=None) -> Labels:
    return merge_panoptic(
        on_a_line(places or list(range(len(instances)))), instances, classes, TABLE
    )


def test_things_keep_their_ids_and_stuff_is_one_segment_a_class() -> None:
    # Instance 8 is a part of the floor, and so is what has no instance.
    found = merged(labels([5, 5, 8, -1, -1, 6]), labels([CUP, CUP, FLOOR, FLOOR, WALL, CHAIR]))
    assert found.ids.tolist() == [5, 5, 9, 9, 10, 6]
    assert found.info.class_of == {5: CUP, 6: CHAIR, 9: FLOOR, 10: WALL}
    assert found.info.names == {5: "cup 5", 6: "chair 6", 9: "floor", 10: "wall"}
    assert classes_of_instances(RenderableLayer.of(found)) == {5: CUP, 6: CHAIR, 9: FLOOR, 10: WALL}
    assert found.info.edit("merge_panoptic") == {
        "things": 2,
        "stuff": 2,
        "instances_of_stuff": 1,
        "classes_by": "unknown",
    }


def test_evidence_decides_the_class_and_the_instance_its_gaussians() -> None:
    """One Gaussian with much evidence outvotes two with little; without evidence it does not."""
    ids, kinds = [7, 7, 7], [CUP, CHAIR, CHAIR]
    loud = labels(kinds, [0.5, 1.0, 1.0], evidence=torch.tensor([9.0, 2.0, 2.0]))
    assert merged(labels(ids), loud).info.class_of == {7: CUP}
    assert merged(labels(ids), labels(kinds)).info.class_of == {7: CHAIR}
    # Equals go to the smaller class.
    even = merged(labels([7, 7]), labels([CHAIR, CUP]))
    assert even.info.class_of == {7: CUP}
    assert even.ids.tolist() == [7, 7]


def test_a_stray_gaussian_joins_its_kind_nearby() -> None:
    ids = labels([1, 1, -1, 2, 2, 2, -1])
    kinds = labels([CUP, CUP, CUP, CHAIR, CHAIR, CHAIR, WALL])
    # The stray cup stands among chairs: it is of the cup all the same.
    found = merged(ids, kinds, [0, 0.1, 5, 5.1, 4.9, 5.2, 9])
    assert found.ids.tolist() == [1, 1, 1, 2, 2, 2, 3]
    # Of two cups it is of the one that has more of its neighbours.
    two = merged(labels([1, 2, 2, -1]), labels([CUP] * 4), [0.0, 0.6, 0.7, 0.2])
    assert two.ids.tolist() == [1, 2, 2, 2]
    # Without any of its kind it has no label: it is neither a thing nor stuff.
    lonely = merged(labels([1, -1, -1]), labels([CUP, CHAIR, FLOOR]))
    assert lonely.ids.tolist() == [1, -1, 2]
    assert lonely.confidence.tolist() == [1.0, 0.0, 1.0]


def test_what_has_no_class_and_what_lies_behind() -> None:
    found = merged(labels([4, -1, 6]), labels([-1, -1, WALL], background=FLOOR))
    assert found.ids.tolist() == [-1, -1, 8]
    assert found.background == 7
    assert found.info.names == {7: "floor", 8: "wall"}
    # A background that is a thing is none.
    assert merged(labels([-1]), labels([WALL], background=CUP)).background == -1


def test_columns_come_from_where_the_label_does() -> None:
    both = {"evidence": torch.tensor([3.0, 4.0]), "inferred": torch.tensor([True, False])}
    other = {"evidence": torch.tensor([5.0, 6.0]), "inferred": torch.tensor([False, False])}
    both |= {"effective_views": torch.tensor([1.0, 2.0])}
    other |= {"effective_views": torch.tensor([7.0, 8.0])}
    found = merged(labels([1, -1], [0.2, 0.3], **both), labels([CUP, WALL], [0.6, 0.7], **other))
    torch.testing.assert_close(found.confidence, torch.tensor([0.2, 0.7]))
    assert found.evidence is not None
    assert found.evidence.tolist() == [3.0, 6.0]
    assert found.effective_views is not None
    assert found.effective_views.tolist() == [1.0, 8.0]
    assert found.inferred is not None
    assert found.inferred.tolist() == [True, False]
    assert merged(labels([1, -1]), labels([CUP, WALL], **other)).evidence is None


def test_facts_of_the_instances_stay() -> None:
    told = LayerInfo(method="associate", names={1: "object 1"}, instances={1: SEEN, 7: SEEN})
    found = merged(labels([1, -1], info=told), labels([CUP, WALL]))
    assert found.info.method == "associate"
    assert found.info.names == {1: "cup 1", 2: "wall"}
    assert found.info.instances == {1: SEEN, 2: InstanceFacts(stuff=True)}


def test_classes_come_from_all_that_a_record_tells() -> None:
    info = LayerInfo(class_of={1: CUP, 2: 0}, instances={2: SEEN, 5: SEEN})
    assert classes_of_instances(RenderableLayer.of(labels([1], info=info))) == {
        1: CUP,
        2: -1,
        5: -1,
    }
    nodes = (TreeNode(id=1, class_id=CUP), TreeNode(id=2, segments=3, views=2))
    tree = InstanceTree(nodes=nodes, labels=labels([1, 2]))
    assert classes_of_instances(RenderableLayer.of(tree.cut())) == {1: CUP, 2: -1}
    with pytest.raises(InputError, match="expected a layer whose info tells the class"):
        classes_of_instances(RenderableLayer.of(labels([1], info=LayerInfo(names={1: "cup"}))))


def test_bad_input_is_refused() -> None:
    with pytest.raises(ShapeError, match="instances: expected 2 rows"):
        merge_panoptic(on_a_line([0, 1]), labels([1]), labels([1, 1]), TABLE)
    with pytest.raises(ShapeError, match="classes: expected 2 rows"):
        merge_panoptic(on_a_line([0, 1]), labels([1, 1]), labels([1]), TABLE)
    with pytest.raises(InputError, match="classes: expected a layer with labels"):
        merged(labels([1, 1]), labels([-1, -1]))
