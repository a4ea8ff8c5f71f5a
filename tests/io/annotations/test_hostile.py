"""Annotations that lie end in one sentence, and take no memory that their size does not allow."""

import base64
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.annotations import AnnotationEvidence, open_annotations
from support.annotations import views_of

VIEWS = views_of("000", "001")
TRIANGLE = [4.0, 30.0, 30.5, 22.0, 33.0, 44.5]
Change = Callable[[dict[str, Any]], object]


def coco() -> dict[str, Any]:
    return {
        "images": [{"id": 1, "file_name": "000.jpg", "width": 64, "height": 48}],
        "categories": [{"id": 1, "name": "car"}],
        "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "segmentation": [TRIANGLE]}],
    }


def panoptic() -> dict[str, Any]:
    row = {"image_id": 1, "file_name": "000.png", "segments_info": [{"id": 1, "category_id": 1}]}
    return coco() | {"annotations": [row]}


def labelme() -> dict[str, Any]:
    stream = io.BytesIO()
    Image.new("L", (3, 2), 1).save(stream, "PNG")
    mask = {"label": "car", "shape_type": "mask", "points": [[1, 2], [3, 3]], "group_id": None}
    mask["mask"] = base64.b64encode(stream.getvalue()).decode()
    outline = {"label": "car", "shape_type": "polygon", "points": [[1, 2], [9, 2], [5, 9]]}
    return {
        "imagePath": "000.jpg", "imageHeight": 48, "imageWidth": 64, "shapes": [mask, outline],
    }  # fmt: skip


def cvat(shape: str, sides: str = 'width="64" height="48"') -> str:
    return f'<annotations><image id="0" name="000.jpg" {sides}>{shape}</image></annotations>'


def task(result: dict[str, Any]) -> list[dict[str, Any]]:
    common = {"original_width": 64, "original_height": 48, "type": "brushlabels", "id": "a"}
    made = {"result": [common | result]}
    return [{"data": {"image": "000.jpg"}, "annotations": [made]}]


def read(path: Path) -> None:
    found = open_annotations(path, views=VIEWS)
    assert isinstance(found, AnnotationEvidence)
    found.masks("000")
    found.as_kind("labels").label_map("000")
    found.as_kind("panoptic").segments("000")


def refused(path: Path, *, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read(path)
    assert str(path.parent) in str(caught.value)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 500


def annotation(**fields: Any) -> Change:
    return lambda c: c["annotations"][0].update(fields)


def runs(counts: object, size: object = (48, 64)) -> Change:
    return annotation(segmentation={"size": size, "counts": counts})


ZIGZAG = [value for i in range(20_000) for value in (i % 64, 48 * (i % 2))]
"""Every edge crosses every row of pixels."""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (runs([3000, 100]), "add up to 48 x 64"),
        (runs([3072, 2**40]), "at most 4294967295, got 1099511627776"),
        (runs([2**32 - 1] * 9), "add up to 48 x 64"),
        (runs([-3072, 6144]), "whole number of at least 0"),
        (runs([3072, None]), "a whole number, got None"),
        (runs("~~"), "other characters"),
        (runs("o" * 1000), "breaks off|32 bits"),
        (runs([3072], [480, 640]), "size .48, 64., got .480, 640."),
        (runs({"a": 1}), "counts: expected text or a list"),
        (annotation(segmentation=[[1, 2, 3, 4]]), "three corners"),
        (annotation(segmentation=[TRIANGLE[:5]]), "three corners"),
        (annotation(segmentation=[[*TRIANGLE, float("nan"), 1]]), "finite number up to .* got nan"),
        (annotation(segmentation=[[*TRIANGLE, 10**400, 1]]), "that can be held, got a number of"),
        (annotation(segmentation=[[*TRIANGLE, None, 1]]), "expected a number, got None"),
        (annotation(segmentation=[[*TRIANGLE, "1", 1]]), "expected a number, got '1'"),
        (annotation(segmentation=[{"x": 1}]), "segmentation.0.: expected a list"),
        (annotation(category_id=2**40), "category_id, got 1099511627776"),
        (annotation(category_id=None), "category_id, got none"),
        (annotation(image_id=2**40), "image_id 1099511627776, which it does not list"),
        (annotation(image_id=[1]), "image_id: expected a whole number or text"),
        (annotation(score=float("nan")), "score: expected a finite number"),
        (annotation(segmentation=[]), "1 boxes without any"),
        (lambda c: c["images"][0].update(width=640), "64x48 pixels as the photograph .* 640x48"),
        (lambda c: c["images"][0].update(width=2**40), "width: expected a whole number"),
        (lambda c: c["images"][0].update(file_name=7), "file_name: expected text, got 7"),
        (lambda c: c["images"].append(c["images"][0] | {"id": 2}), "one picture a view"),
        (lambda c: c["images"][0].update(file_name="../../etc/passwd"), "got none of them but 1"),
        (lambda c: c["categories"][0].update(id=-1), "id: expected a whole number"),
        (lambda c: c["categories"][0].update(name=""), "name: expected text of length at least 1"),
        (lambda c: c.update(annotations=[3]), "annotations.0.: expected an object"),
        (lambda c: c.update(images={}), "images: expected a list"),
    ],
)  # fmt: skip
def test_coco(tmp_path: Path, change: Change, message: str) -> None:
    content = coco()
    change(content)
    path = tmp_path / "a.json"
    path.write_text(json.dumps(content))
    refused(path, message=message)


def test_outlines_cost_what_their_file_allows(tmp_path: Path) -> None:
    """Edges that each cross the whole picture stand for more than the file may."""
    content = coco() | {"images": [{"id": 1, "file_name": "000.jpg", "width": 64, "height": 480}]}
    content["annotations"][0]["segmentation"] = [
        [1000 * v if i % 2 else v for i, v in enumerate(ZIGZAG)]
    ]
    path = tmp_path / "a.json"
    path.write_text(json.dumps(content))
    found = open_annotations(path)
    assert found is not None
    with pytest.raises(FileFormatError, match="outlines that cross 9600000 rows"):
        found.masks("000")


def test_a_picture_costs_what_its_file_allows(tmp_path: Path) -> None:
    content = coco()
    content["images"][0] |= {"width": 1 << 20, "height": 1 << 20}
    (tmp_path / "a.json").write_text(json.dumps(content))
    found = open_annotations(tmp_path / "a.json")
    assert found is not None
    with pytest.raises(FileFormatError, match="a picture of 1048576x1048576 pixels"):
        found.masks("000")


def test_many_corners_are_read(tmp_path: Path) -> None:
    """A circle of 100 000 corners in a small picture."""
    angle = np.linspace(0, 2 * np.pi, 100_000, endpoint=False)
    corners = np.stack([32 + 20 * np.cos(angle), 24 + 20 * np.sin(angle)], 1)
    content = coco()
    content["annotations"][0]["segmentation"] = [corners.ravel().tolist()]
    (tmp_path / "a.json").write_text(json.dumps(content))
    found = open_annotations(tmp_path / "a.json", views=VIEWS)
    assert found is not None
    y, x = np.mgrid[:48, :64] + 0.5
    wanted = np.hypot(x - 32, y - 24) < 20
    assert np.array_equal(found.masks("000").dense(0).numpy(), wanted)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["annotations"][0].update(file_name="../000.png"), "name of a file below it"),
        (lambda c: c["annotations"][0].update(file_name="/etc/passwd"), "name of a file below it"),
        (
            lambda c: c["annotations"][0].update(file_name="a" * 5000),
            "file_name: expected text",
        ),
        (lambda c: c["annotations"][0].update(file_name="gone.png"), "no such image"),
        (
            lambda c: c["annotations"][0].update(segments_info=[{"id": "1"}]),
            "id: expected a whole number",
        ),
        (lambda c: c["annotations"][0]["segments_info"][0].pop("category_id"), "category_id"),
        (lambda c: c["annotations"][0]["segments_info"].append(3), "segments_info"),
    ],
)
def test_panoptic(tmp_path: Path, change: Change, message: str) -> None:
    content = panoptic()
    change(content)
    (tmp_path / "panoptic").mkdir()
    Image.new("RGB", (64, 48), (1, 0, 0)).save(tmp_path / "panoptic" / "000.png")
    (tmp_path / "a.json").write_text(json.dumps(content))
    refused(tmp_path / "a.json", message=message)


@pytest.mark.parametrize(
    ("size", "mode", "message"),
    [((64, 47), "RGB", "64x48 pixels in colours, got 64x47"), ((64, 48), "L", "in mode L")],
)
def test_panoptic_pictures(tmp_path: Path, size: tuple[int, int], mode: str, message: str) -> None:
    (tmp_path / "panoptic").mkdir()
    Image.new(mode, size).save(tmp_path / "panoptic" / "000.png")
    (tmp_path / "a.json").write_text(json.dumps(panoptic()))
    refused(tmp_path / "a.json", message=message)
    (tmp_path / "panoptic" / "000.png").unlink()
    refused(tmp_path / "a.json", message="the PNGs of its segments in the folder 'a' beside it")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s[0].update(points=[[1, 2], [9, 3]]), "mask of 9x2 pixels as its corners say"),
        (lambda s: s[0].update(points=[[63, 2], [65, 3]]), "within 64x48 pixels, got one of 3x2"),
        (lambda s: s[0].update(points=[[1, 2]]), "the corners of its box"),
        (lambda s: s[0].update(points=[[-1, 2], [1, 3]]), "whole pixels"),
        (lambda s: s[0].update(points=[[0, 0], [2**40, 1]]), "a mask of 1099511627777x2"),
        (lambda s: s[0].update(mask="not base64!"), "PNG in base64, but it cannot be read"),
        (lambda s: s[0].update(mask=base64.b64encode(b"GIF89a").decode()), "PNG in base64"),
        (lambda s: s[1].update(points=[[1, 2], [3]]), "points.1.: expected a list of length 2"),
        (lambda s: s[1].update(points=[[1, 2], [3, float("inf")], [4, 5]]), "got inf"),
        (lambda s: s[1].update(label=3), "shapes.1..label: expected text"),
        (lambda s: s.append("x"), "shapes.2.: expected an object, got 'x'"),
    ],
)
def test_labelme(tmp_path: Path, change: Change, message: str) -> None:
    content = labelme()
    change(content["shapes"])
    (tmp_path / "a.json").write_text(json.dumps(content))
    refused(tmp_path / "a.json", message=message)


def test_a_mask_of_a_picture_beyond_the_photograph_is_not_decoded(tmp_path: Path) -> None:
    stream = io.BytesIO()
    Image.new("1", (20_000, 20_000)).save(stream, "PNG")
    content = labelme()
    content["shapes"][0] |= {
        "points": [[0, 0], [19_999, 19_999]], "mask": base64.b64encode(stream.getvalue()).decode(),
    }  # fmt: skip
    (tmp_path / "a.json").write_text(json.dumps(content))
    refused(tmp_path / "a.json", message="of 20000x20000 pixels, got Image size")
    content["shapes"][0] |= {"points": [[0, 0], [199, 199]]}
    stream = io.BytesIO()
    Image.new("1", (200, 200)).save(stream, "PNG")
    content["shapes"][0] |= {"mask": base64.b64encode(stream.getvalue()).decode()}
    (tmp_path / "a.json").write_text(json.dumps(content))
    refused(tmp_path / "a.json", message="of 200x200 pixels as its corners say, in 64x48")


MASK = '<mask label="a" rle="{}" left="{}" top="{}" width="{}" height="{}"/>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (cvat(MASK.format("1, 3", 1, 1, 2, 3)), "add up to its box .* 4 pixels for one of 2x3"),
        (cvat(MASK.format("0, 6", 63, 1, 2, 3)), "got one of 2x3 at"),
        (cvat(MASK.format("0, 6", -1, 1, 2, 3)), "got one of 2x3 at"),
        (cvat(MASK.format("1, x", 1, 1, 2, 3)), "rle.1.: expected a whole"),
        (
            cvat(MASK.format("1, 9999999999999999999999", 1, 1, 2, 3)),
            "rle.1.: expected a whole",
        ),
        (cvat(MASK.format("0, 4294967295", 0, 0, 65535, 65537)), "within the picture"),
        (cvat(MASK.format("0, 6", 1, 1, "9" * 500, 3)), "its box within the picture"),
        (cvat('<polygon label="a" points="1,2;3,nan;4,5"/>'), "finite numbers each, got others"),
        (cvat('<polygon label="a" points="1,2;3,b;4,5"/>'), "finite numbers each, got other words"),
        (cvat('<polygon label="a" points=""/>'), "three corners"),
        (cvat("", 'width="0" height="48"'), "width: expected a whole number of at least 1"),
        (cvat("", 'height="48"'), "expected a field width"),
        (cvat("").replace(' name="000.jpg"', ""), "expected a field name"),
        ("<annotation/>", "boxes of Pascal VOC do not say"),
        ("<annotations><track id='0'/></annotations>", "CVAT for video; export the task as"),
        ("<annotations>", "cannot be read"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><annotations/>', "without a document type"),
        ("<annotations>" + "<a>" * 100_000, "cannot be read"),
    ],
)
def test_cvat(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.xml").write_text(text)
    refused(tmp_path / "a.xml", message=message)


def bits(*fields: tuple[int, int]) -> list[int]:
    """Bytes of numbers of so many bits each, filled up with zeros."""
    text = "".join(f"{value:0{count}b}" for value, count in fields)
    text += "0" * (-len(text) % 8)
    return [int(text[i : i + 8], 2) for i in range(0, len(text), 8)]


HEAD = ((64 * 48 * 4, 32), (7, 5), (2, 4), (3, 4), (7, 4), (15, 4))


@pytest.mark.parametrize(
    ("rle", "message"),
    [
        (bits((2**32 - 1, 32), *HEAD[1:]), "brush of 12288 bytes, got one of 4294967295 words"),
        (bits(HEAD[0], (31, 5), *HEAD[2:]), "words of 32 bits"),
        (bits(*HEAD, (1, 1), (3, 2), (65535, 16), (255, 8)), "12288 bytes, got more"),
        (bits(*HEAD, (1, 1), (3, 2), (99, 16), (255, 8)), "breaks off inside a run"),
        (bits(*HEAD, (0, 1), (3, 2), (9999, 16), (255, 8)), "breaks off inside a run"),
        ([], "breaks off"),
        ([256], "rle.*: expected a"),
        ("abc", "rle.*: expected a"),
        ([1.5], "rle.*: expected a"),
    ],
)
def test_brushes(tmp_path: Path, rle: object, message: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps(task({"value": {"rle": rle, "brushlabels": ["a"]}})))
    refused(path, message=message)


OUTLINE = {"value": {"points": [[0, 0], [50, 0], [50, 50]], "polygonlabels": ["a"]}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image_rotation": 90}, "turned by 90"),
        ({"original_width": 2**40}, "original_width: expected a whole number"),
        ({"original_width": 63}, "64x48 pixels as the photograph"),
        ({"value": {"points": [[0, 0], [1, None], [2, 2]]}}, "points.1..1.: expected a number"),
    ],
)
def test_label_studio(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    (tmp_path / "a.json").write_text(json.dumps(task(OUTLINE | {"type": "polygonlabels"} | change)))
    refused(tmp_path / "a.json", message=message)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.zip", b"PK", "in .zip files are not read; export COCO"),
        ("a.pkl", b"\x80", "in .pkl files are not read"),
        ("a.pth", b"PK", "in .pth files are not read"),
        ("a.txt", b"0 0.1 0.2", "in .txt files are not read"),
        ("a.csv", b"a,b", "in .csv files are not read"),
        ("a.png", b"", "give the folder"),
        ("a.bin", b"", "docs/models.md has a table"),
        ("a.json", b'{"a": 1}', "annotations .COCO, Label Studio, labelme., got another JSON"),
        ("a.json", b"[" * 100_000, "cannot be parsed"),
        ("a.json", b'[{"id": 1, "annotation_id": 2, "lead_time": 3}]', "got another JSON"),
        ("a.json", b'[{"image_id": 1, "category_id": 2, "bbox": [], "score": 1}]', "without any"),
        ("a.json", b'[{"image_id": 1, "category_id": 2}, 3]', ".1.: expected an object, got 3"),
        (
            "a.json",
            b'[{"image_id": 1, "category_id": 2}, null]',
            ".1.: expected an object",
        ),
    ],
)
def test_what_is_not_read_says_what_to_export(
    tmp_path: Path, name: str, content: bytes, message: str
) -> None:
    (tmp_path / name).write_bytes(content)
    refused(tmp_path / name, message=message)
    if name.endswith((".zip", ".pkl", ".pth", ".txt", ".csv")):
        with pytest.raises(InputError, match=message):
            open_annotations(tmp_path, views=VIEWS)


def test_a_path_to_nothing(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="no such file or folder"):
        open_annotations(tmp_path / "gone.json")


def test_several_files_are_not_guessed_among(tmp_path: Path) -> None:
    for name in ("train", "val"):
        (tmp_path / f"{name}.json").write_text(json.dumps(coco()))
    with pytest.raises(InputError, match=r"got 2 \('train.json', 'val.json'\): give the one"):
        open_annotations(tmp_path, views=VIEWS)
