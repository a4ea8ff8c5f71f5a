"""Classes out of a network's configuration."""

from splatseg.io.label_tables import label_table
from splatseg.models.networks.segmenters import network_classes


def names_of(table: str) -> dict[str, str]:
    rows = label_table(f"{table}-train").classes.rows
    return {str(row.id): row.name for row in rows}


def test_a_known_table_tells_things_and_colours() -> None:
    """Half the names may be synonyms; colours and things come by the place in the order."""
    labels = names_of("ade20k")
    labels |= {"8": "window ", "13": "earth, ground", "43": "signboard, sign"}
    found = network_classes({"id2label": labels}, count=150, things=True)
    assert found.note == "things and stuff as in ade20k"
    assert found.table.name_of(1) == "wall"
    assert found.table.name_of(9) == "window"
    assert found.table.name_of(14) == "earth"
    assert not found.is_thing(1)
    assert found.is_thing(9)
    assert found.table.rows[0].colour == (120, 120, 120)
    for name, count in (("coco", 133), ("cityscapes", 19)):
        found = network_classes({"id2label": names_of(name)}, count=count, things=True)
        assert found.note.endswith(name)
        assert {row.isthing for row in found.table.rows} == {True, False}


def test_other_classes_are_what_the_head_is_for() -> None:
    labels = {"0": "cup", "1": "spoon, ladle", "2": "spoon, tea", "4": "plate"}
    found = network_classes({"id2label": labels}, count=5, things=True)
    assert [row.name for row in found.table.rows] == [
        "cup", "spoon, ladle", "spoon, tea", "class 3", "plate",
    ]  # fmt: skip
    assert [row.id for row in found.table.rows] == [1, 2, 3, 4, 5]
    assert all(row.isthing for row in found.table.rows)
    assert "all taken for things" in found.note
    found = network_classes({"id2label": labels}, count=5, things=False)
    assert not any(row.isthing for row in found.table.rows)
    assert "all taken for stuff" in found.note
    shuffled = dict(zip(names_of("cityscapes"), reversed(names_of("cityscapes").values())))  # noqa: B905
    found = network_classes({"id2label": shuffled}, count=19, things=True)
    assert "no known table" in found.note
    assert network_classes({}, count=2, things=True).table.name_of(2) == "class 1"


def test_a_background_is_no_class() -> None:
    labels = {"0": "Background", "1": "skin"}
    found = network_classes({"id2label": labels}, count=2, things=False)
    assert found.void == 0
    assert [(row.id, row.name) for row in found.table.rows] == [(2, "skin")]
    assert network_classes({"id2label": {"0": "wall", "1": "b"}}, count=2, things=True).void is None
