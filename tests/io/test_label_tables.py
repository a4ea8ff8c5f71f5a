"""Class tables of known data sets: counts, spot checks that the data sets publish, no clash."""

import pytest

from splatseg.errors import InputError
from splatseg.io.label_tables import TABLES, label_table, learned_as


@pytest.mark.parametrize(
    ("name", "count", "things", "known"),
    [
        ("ade20k", 150, 100, {1: "wall", 13: "person", 21: "car", 150: "flag"}),
        ("ade20k-train", 150, 100, {0: "wall", 12: "person", 149: "flag"}),
        ("coco", 133, 80, {1: "person", 90: "toothbrush", 92: "banner", 200: "rug-merged"}),
        ("coco-train", 133, 80, {0: "person", 79: "toothbrush", 80: "banner", 132: "rug-merged"}),
        ("cityscapes", 33, 10, {7: "road", 24: "person", 33: "bicycle"}),
        ("cityscapes-train", 19, 8, {0: "road", 11: "person", 18: "bicycle"}),
        ("kitti360", 44, 21, {7: "road", 11: "building", 34: "garage", 44: "unknown object"}),
        ("kitti360-train", 19, 12, {0: "road", 2: "building", 4: "fence", 5: "pole"}),
        ("scannet", 40, 37, {1: "wall", 22: "ceiling", 39: "otherfurniture"}),
        ("scannet-train", 20, 18, {0: "wall", 13: "curtain", 19: "otherfurniture"}),
    ],
)
def test_tables(name: str, count: int, things: int, known: dict[int, str]) -> None:
    table = label_table(name)
    rows = table.classes.rows
    assert len(rows) == count
    assert sum(row.isthing for row in rows) == things
    assert {id: table.classes.name_of(id) for id in known} == known
    assert all(row.name == row.name.strip() for row in rows)
    assert table.zero_is_class == name.endswith("-train") == (rows[0].id == 0)
    assert table.void == (255 if name.endswith("-train") else None)


def test_training_tables_are_the_same_classes() -> None:
    for name in TABLES:
        by_name = {row.name: row for row in label_table(name).classes.rows}
        for row in label_table(f"{name}-train").classes.rows:
            assert by_name[row.name].colour == row.colour


def test_semantic_kitti_is_learned_from_one_on() -> None:
    """Its learning_map has 0 for what is no class."""
    table, train = label_table("semantic-kitti"), label_table("semantic-kitti-train")
    assert (len(table.classes.rows), len(train.classes.rows)) == (32, 19)
    assert [row.id for row in train.classes.rows] == list(range(1, 20))
    assert (train.zero_is_class, train.void) == (False, None)
    assert train.classes.name_of(5) == "other-vehicle"
    known = {10: "car", 40: "road", 81: "traffic-sign", 259: "moving-other-vehicle"}
    assert {id: table.classes.name_of(id) for id in known} == known


def test_classes_that_are_learned_as_one() -> None:
    kitti = learned_as("kitti360")
    assert {id: kitti[id] for id in (11, 34, 13, 35, 17, 37)} == {
        11: 11, 34: 11, 13: 13, 35: 13, 17: 17, 37: 17,
    }  # fmt: skip
    assert len(set(kitti.values())) == 19
    assert not {0, 9, 29, 44} & set(kitti)
    assert learned_as("semantic-kitti")[252] == 10
    with pytest.raises(InputError, match="classes: expected one of ade20k, .*, got 'kitti'"):
        learned_as("kitti")
