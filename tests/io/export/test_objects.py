"""Tables of objects and folders of splats, worked out by hand."""

import csv
import json
from dataclasses import replace

import pytest
import torch

from splatseg.core import Labels
from splatseg.errors import InputError, ShapeError
from splatseg.io.export import (
    classes_of,
    objects_of,
    write_labelled_splats,
    write_object_splats,
    write_object_table,
)
from splatseg.io.splats import SplatWarning, read_splats

UP = (0.0, 1.0, 0.0)


@pytest.fixture
def gaussians(make):
    return make(
        [[0, 0, 0], [4, 0, 0], [9, 9, 9], [1, 1, 1], [1, 3, 1]],
        opacities=[0.25, 0.75, 1.0, 0.5, 0.5],
        colours=[[1, 0, 0], [0, 0, 1], [1, 1, 1], [0.5, 0.5, 0.5], [2.0, 0, 0]],
    )


@pytest.fixture
def labels():
    return Labels(
        ids=torch.tensor([7, 7, -1, 1200, 1200]),
        confidence=torch.tensor([0.5, 1.0, 0.0, 0.8, 0.8]),
        background=3,
        evidence=torch.tensor([10.0, 20.0, 0.0, 1.0, 1.5]),
        inferred=torch.tensor([True, False, False, False, False]),
    )


def test_rows(gaussians, labels) -> None:
    first, second = objects_of(gaussians, labels, names={7: "red chair"}, up=UP)
    assert (first.id, first.name, first.gaussians, first.class_id) == (7, "red chair", 2, -1)
    assert first.centroid.tolist() == [3.0, 0, 0]
    assert first.colour.tolist() == pytest.approx([0.25, 0, 0.75])
    assert first.confidence == pytest.approx(0.75)
    assert (first.evidence, first.inferred) == (30.0, 0.5)
    assert first.box.size.tolist() == pytest.approx([4, 0, 0])
    assert (second.id, second.name, second.evidence) == (1200, "", 2.5)
    assert second.box.size.tolist() == pytest.approx([0, 0, 2])
    # A colour is clamped to what is shown before it is averaged.
    assert second.colour.tolist() == pytest.approx([0.75, 0.25, 0.25])


def test_classes_by_opacity_and_confidence(gaussians, labels) -> None:
    classes = Labels(
        ids=torch.tensor([1, 2, 5, 4, -1]), confidence=torch.tensor([1.0, 0.3, 1.0, 0.1, 1.0])
    )
    # 0.25 * 1.0 against 0.75 * 0.3; the unlabelled one does not vote.
    assert classes_of(gaussians, labels, classes) == {7: 1, 1200: 4}
    first, second = objects_of(
        gaussians, labels, classes=classes, class_names={1: "chair"}, class_of={1200: 9}
    )
    assert (first.class_id, first.class_name) == (1, "chair")
    assert (second.class_id, second.class_name) == (9, "")
    with pytest.raises(ShapeError, match="classes: expected 5 rows"):
        objects_of(gaussians, labels, classes=classes[:4])


def test_tables(gaussians, labels, tmp_path) -> None:
    rows = objects_of(gaussians, labels, names={7: "=HYPERLINK(1)", 1200: "Sofa, rot ä"}, up=UP)
    write_object_table(rows, tmp_path / "a.json", about={"scene": "S"})
    content = json.loads((tmp_path / "a.json").read_text())
    assert content["scene"] == "S"
    first, second = content["objects"]
    assert first["class_id"] is None
    assert first["colour"] == [64, 0, 191]
    assert first["box"]["centre"] == [2.0, 0.0, 0.0]
    assert second["volume"] == 0.0
    write_object_table(rows, tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(encoding="utf-8-sig", newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["id"] for row in table] == ["7", "1200"]
    assert table[0]["name"] == "'=HYPERLINK(1)"  # a spreadsheet shows it and does not run it
    assert table[1]["name"] == "Sofa, rot ä"
    assert (table[0]["centroid_x"], table[0]["class_id"]) == ("3.0", "")
    assert (table[0]["size_1"], table[0]["evidence"], table[0]["inferred"]) == (
        "4.0",
        "30.0",
        "0.5",
    )
    with pytest.raises(InputError, match=r"\.csv or \.json"):
        write_object_table(rows, tmp_path / "a.xlsx")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.csv", "a.json"]


@pytest.mark.parametrize(
    ("format", "ending"),
    [("ply", "ply"), ("compressed.ply", "compressed.ply"), ("splat", "splat"), ("spz", "spz")],
)
def test_one_file_an_object(gaussians, labels, tmp_path, format, ending) -> None:
    # Nothing that a format has to clamp.
    gaussians = gaussians.replace(
        scales=torch.full((5, 3), 0.05), sh=gaussians.sh.clamp(-1, 1), extra={}
    )
    rows = objects_of(gaussians, labels, names={7: "Red Chair / ../ ☃", 1200: "ünïcode"})
    folder = tmp_path / "objects"
    columns = {"class_id": torch.tensor([1, 2, 0, 4, 5], dtype=torch.int32)}
    files = write_object_splats(
        gaussians, labels, folder, rows=rows, format=format, columns=columns, unlabelled=True
    )
    names = [f"0007_red-chair.{ending}", f"1200_unicode.{ending}"]
    assert [file.name for file in files] == names
    assert sorted(p.name for p in folder.iterdir()) == sorted(
        [*names, "objects.json", f"unlabelled.{ending}"]
    )
    first = read_splats(files[0])
    assert torch.allclose(first.means.sort(dim=0).values[:, 0], torch.tensor([0.0, 4.0]), atol=1e-2)
    if format == "ply":
        assert first.extra["class_id"].tolist() == [1, 2]
    assert len(read_splats(folder / f"unlabelled.{ending}")) == 1
    content = json.loads((folder / "objects.json").read_text())
    assert [row["file"] for row in content["objects"]] == names
    assert content["unlabelled"] == {"gaussians": 1, "file": f"unlabelled.{ending}"}


def test_a_folder_of_an_earlier_export_is_replaced_and_others_are_not(
    gaussians, labels, tmp_path
) -> None:
    rows = objects_of(gaussians, labels)
    folder = tmp_path / "objects"
    write_object_splats(gaussians, labels, folder, rows=rows)
    write_object_splats(gaussians, labels, folder, rows=rows[1:])
    assert sorted(p.name for p in folder.iterdir()) == ["1200.ply", "objects.json"]
    other = tmp_path / "holiday"
    other.mkdir()
    (other / "photo.jpg").write_bytes(b"x")
    with pytest.raises(InputError, match="other files"):
        write_object_splats(gaussians, labels, other, rows=rows)
    assert [p.name for p in other.iterdir()] == ["photo.jpg"]


def test_a_failure_leaves_nothing(gaussians, labels, tmp_path) -> None:
    rows = objects_of(gaussians, labels)
    broken = gaussians.replace(means=gaussians.means * torch.tensor([1, 1, float("nan")]))
    with pytest.raises(InputError):
        write_object_splats(broken, labels, tmp_path / "objects", rows=rows)
    renamed = replace(labels, ids=torch.tensor([8, 8, -1, 1200, 1200]))
    with pytest.raises(InputError, match="id 7"):
        write_object_splats(gaussians, renamed, tmp_path / "objects", rows=rows)
    with pytest.raises(ShapeError, match="expected 5 rows"):
        write_object_splats(gaussians, labels[2:], tmp_path / "objects", rows=rows)
    assert list(tmp_path.iterdir()) == []


def test_warnings_name_the_file_that_stays(gaussians, labels, tmp_path) -> None:
    deep = gaussians.replace(extra={"class_id": labels.ids})
    with pytest.warns(SplatWarning) as told:
        write_object_splats(
            deep, labels, tmp_path / "o", rows=objects_of(deep, labels), format="spz"
        )
    assert all(str(tmp_path / "o") in str(w.message) for w in told)


def test_splats_and_table_appear_together(gaussians, labels, tmp_path) -> None:
    columns = {"class_id": labels.ids}
    path = tmp_path / "scene.ply"
    (tmp_path / "scene.json").write_text('{"precious": 1}')
    with pytest.raises(InputError, match=r"scene\.json: expected no file or a table"):
        write_labelled_splats(gaussians, path, columns=columns, table={"gaussians": 5})
    assert [p.name for p in tmp_path.iterdir()] == ["scene.json"]
    for _ in range(2):
        beside = write_labelled_splats(
            gaussians, tmp_path / "b.ply", columns=columns, table={"gaussians": 5}
        )
    assert beside == tmp_path / "b.json"
    with pytest.raises(InputError, match="ply file, other formats drop them"):
        write_labelled_splats(gaussians, tmp_path / "b.spz", columns=columns)
    with pytest.raises(InputError, match="folder"):
        write_labelled_splats(gaussians, tmp_path / "no" / "b.ply", columns={})
