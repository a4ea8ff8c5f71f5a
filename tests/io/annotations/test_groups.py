"""What counts as one object, which annotation of several counts, and which file of a folder."""

import base64
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatseg.core import MaskSet
from splatseg.io.annotations import AnnotationEvidence, open_annotations
from splatseg.io.evidence import open_evidence
from support.annotations import views_of

VIEWS = views_of("000", "001")
LEFT = [[0, 0], [10, 0], [10, 48], [0, 48]]
RIGHT = [[50, 0], [64, 0], [64, 48], [50, 48]]


def masks(path: Path) -> MaskSet:
    found = open_annotations(path, views=VIEWS)
    assert isinstance(found, AnnotationEvidence)
    return found.masks("000")


@pytest.mark.parametrize(("groups", "areas"), [((1, 1), [1152]), ((1, 2), [480, 672])])
def test_shapes_of_labelme_with_one_group_id_are_one_object(
    tmp_path: Path, groups: tuple[int, int], areas: list[int]
) -> None:
    shapes = [
        {"label": "car", "shape_type": "polygon", "points": points, "group_id": group}
        for points, group in zip((LEFT, RIGHT), groups, strict=True)
    ]
    shapes.append({"label": "car", "shape_type": "circle", "points": [[1, 2], [3, 4]]})
    content = {"imagePath": "000.jpg", "imageHeight": 48, "imageWidth": 64, "shapes": shapes}
    (tmp_path / "000.json").write_text(json.dumps(content))
    (tmp_path / "001.json").write_text(json.dumps({"a": "of another tool"}))
    assert [mask.area for mask in masks(tmp_path).masks] == areas
    found = open_annotations(tmp_path, views=VIEWS)
    assert found is not None
    assert found.view_names == ("000",)
    assert found.notes == (
        "Shapes that do not say which pixels are inside were left out (1 circles): polygons and "
        "masks do.",
    )


@pytest.mark.parametrize(("groups", "areas"), [((4, 4), [1152]), ((0, 0), [480, 672])])
def test_shapes_of_cvat_with_one_group_are_one_object(
    tmp_path: Path, groups: tuple[int, int], areas: list[int]
) -> None:
    texts = [";".join(f"{x},{y}" for x, y in points) for points in (LEFT, RIGHT)]
    shapes = "".join(
        f'<polygon label="car" group_id="{group}" points="{text}"/>'
        for text, group in zip(texts, groups, strict=True)
    )
    image = f'<image id="0" name="000.jpg" width="64" height="48">{shapes}<box label="a"/></image>'
    (tmp_path / "a.xml").write_text(f"<annotations>{image}</annotations>")
    assert [mask.area for mask in masks(tmp_path).masks] == areas
    found = open_annotations(tmp_path, views=VIEWS)
    assert found is not None
    assert "left out (1 boxes)" in found.notes[0]


def outline(points: list[list[int]], **more: Any) -> dict[str, Any]:
    percent = [[x / 0.64, y / 0.48] for x, y in points]
    value = {"points": percent, **more.pop("value", {"polygonlabels": ["car"]})}
    common = {"original_width": 64, "original_height": 48, "type": "polygonlabels"}
    return common | {"value": value} | more


def tasks(path: Path, **fields: Any) -> Path:
    (path / "a.json").write_text(
        json.dumps([{"data": {"image": "000.jpg"}, "annotations": [], **fields}])
    )
    return path / "a.json"


def test_the_first_annotation_of_label_studio_that_was_not_cancelled(tmp_path: Path) -> None:
    made = [
        {"was_cancelled": True, "result": [outline(LEFT), outline(RIGHT)]},
        {"was_cancelled": False, "result": [outline(RIGHT)]},
        {"was_cancelled": False, "result": [outline(LEFT)]},
    ]
    assert [mask.area for mask in masks(tasks(tmp_path, annotations=made)).masks] == [672]


def test_predictions_of_label_studio_count_where_nobody_annotated(tmp_path: Path) -> None:
    found = masks(tasks(tmp_path, predictions=[{"score": 0.25, "result": [outline(LEFT)]}]))
    assert [mask.area for mask in found.masks] == [480]
    assert found.scores.tolist() == [0.25]


def test_results_of_one_id_are_one_area_with_its_label(tmp_path: Path) -> None:
    """An area and its label may be two results."""
    plain = outline(LEFT, id="a", type="polygon", value={})
    labelled = outline(LEFT, id="a", type="labels", value={"labels": ["car"]})
    chosen = {"id": "a", "type": "choices", "value": {"choices": ["day"]}}
    for rows in ([plain, labelled], [labelled, plain]):
        path = tasks(tmp_path, annotations=[{"result": [*rows, chosen]}])
        found = open_annotations(path, views=VIEWS)
        assert isinstance(found, AnnotationEvidence)
        assert len(found.masks("000")) == 1
        assert int(found.as_kind("labels").label_map("000").ids.max()) == 1


def test_an_area_without_a_label_is_of_no_class(tmp_path: Path) -> None:
    rows = [outline(LEFT, id="a", type="polygon", value={}), outline(RIGHT, id="b")]
    found = open_annotations(tasks(tmp_path, annotations=[{"result": rows}]), views=VIEWS)
    assert isinstance(found, AnnotationEvidence)
    ids = found.as_kind("labels").label_map("000").ids
    assert ids[0, [0, 30, 63]].tolist() == [-1, -1, 1]


def test_a_mask_of_cvat_may_have_one_row(tmp_path: Path) -> None:
    mask = '<mask label="car" rle="1, 2" left="4" top="5" width="3" height="1"/>'
    image = f'<image id="0" name="000.jpg" width="64" height="48">{mask}</image>'
    (tmp_path / "a.xml").write_text(f"<annotations>{image}</annotations>")
    assert [mask.bbox for mask in masks(tmp_path).masks] == [(5, 5, 2, 1)]


def test_soft_edges_of_a_brush_count_from_half(tmp_path: Path) -> None:
    """One run of 127, one of 128 opaque, the rest nothing: (r, g, b, alpha) row by row."""
    alphas = np.zeros(64 * 48, int)
    alphas[:3], alphas[3:5] = 127, 128
    fields = [(64 * 48 * 4, 32), (7, 5), (0, 4), (0, 4), (0, 4), (13, 4)]
    fields += [(0, 1), (3, 2), (20 - 1, 14)]
    fields += [(int(v), 8) for alpha in alphas[:5] for v in (0, 0, 0, alpha)]
    fields += [(1, 1), (3, 2), (64 * 48 * 4 - 20 - 1, 14), (0, 8)]
    text = "".join(f"{value:0{count}b}" for value, count in fields)
    text += "0" * (-len(text) % 8)
    rle = [int(text[i : i + 8], 2) for i in range(0, len(text), 8)]
    value = {"rle": rle, "format": "rle", "brushlabels": ["car"]}
    row = outline([], value=value, type="brushlabels")
    del row["value"]["points"]
    found = masks(tasks(tmp_path, annotations=[{"result": [row]}]))
    assert found.masks[0].bbox == (3, 0, 2, 1)


def test_segments_beside_their_table_and_label_maps_beside_another(tmp_path: Path) -> None:
    """Detectron2 writes predictions.json into the folder of its PNGs."""
    Image.new("RGB", (64, 48), (1, 0, 0)).save(tmp_path / "000.png")
    row = {"image_id": 1, "file_name": "000.png", "segments_info": [{"id": 1, "category_id": 3}]}
    content = {"images": [{"id": 1, "file_name": "000.jpg"}], "annotations": [row]}
    (tmp_path / "predictions.json").write_text(json.dumps(content))
    found = open_annotations(tmp_path, views=VIEWS)
    assert isinstance(found, AnnotationEvidence)
    assert found.kind == "panoptic"
    assert int(found.label_map("000").ids.min()) == 1
    (tmp_path / "predictions.json").rename(tmp_path / "settings.json")
    assert open_annotations(tmp_path, views=VIEWS) is None
    assert open_evidence(tmp_path).kind == "labels"


def test_a_mask_of_one_bit_in_base64(tmp_path: Path) -> None:
    stream = io.BytesIO()
    Image.fromarray(np.array([[True, False, True]])).save(stream, "PNG")
    shape = {"label": "car", "shape_type": "mask", "points": [[2, 4], [4, 4]]}
    shape["mask"] = base64.b64encode(stream.getvalue()).decode()
    content = {"imagePath": None, "imageHeight": 48, "imageWidth": 64, "shapes": [shape]}
    (tmp_path / "000.json").write_text(json.dumps(content))
    found = masks(tmp_path / "000.json").dense(0)
    assert found.nonzero().tolist() == [[4, 2], [4, 4]]
