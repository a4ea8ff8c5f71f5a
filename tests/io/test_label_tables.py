"""Class tables of known data sets: counts, spot checks that the data sets publish, no clash."""

import pytest

from splatseg.io.label_tables import TABLES, label_table


@pytest.mark.parametrize(
    ("name", "count", "things", "known"),
    [
        ("ade20k", 150, 100, {1: "wall", 13: "person", 21: "car", 150: "flag"}),
        ("ade20k-train", 150, 100, {0: "wall", 12: "person", 149: "flag"}),
        ("coco", 133, 80, {1: "person", 90: "toothbrush", 92: "banner", 200: "rug-merged"}),
        ("coco-train", 133, 80, {0: "person", 79: "toothbrush", 80: "banner", 132: "rug-merged"}),
        ("cityscapes", 33, 10, {7: "road", 24: "person", 33: "bicycle"}),
        ("cityscapes-train", 19, 8, {0: "road", 11: "person", 18: "bicycle"}),
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
