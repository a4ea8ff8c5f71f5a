"""COCO panoptic folders, decoded by the format's own rule."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.errors import InputError
from splatseg.io.export import Category, Frame, SegmentInfo, write_coco_panoptic

CATEGORIES = [
    Category(id=1, name="chair", isthing=True, colour=(1, 2, 3)),
    Category(id=9, name="wall", isthing=False, colour=(0, 0, 9)),
]
SEGMENTS = {
    5: SegmentInfo(category_id=1, name="red chair"),
    70_000: SegmentInfo(category_id=1, iscrowd=True),
    2**24 - 1: SegmentInfo(category_id=9),
}
IDS = torch.tensor([[-1, 5, 5, -1], [-1, 5, 70_000, 2**24 - 1], [-1, -1, -1, 2**24 - 1]])


def frame(name="a", ids=IDS) -> Frame:
    return Frame(name=name, image=f"{name}.jpg", ids=ids)


def test_what_is_written(tmp_path) -> None:
    empty = torch.full((2, 3), -1)
    frames = (frame(*x) for x in (("left/a", IDS), ("b", empty)))
    folder = tmp_path / "coco"
    assert write_coco_panoptic(frames, folder, segments=SEGMENTS, categories=CATEGORIES) == 2
    content = json.loads((folder / "panoptic.json").read_text())
    assert content["images"] == [
        {"id": 1, "file_name": "left/a.jpg", "width": 4, "height": 3},
        {"id": 2, "file_name": "b.jpg", "width": 3, "height": 2},
    ]
    assert content["categories"][1] == {
        "id": 9, "name": "wall", "supercategory": "wall", "isthing": 0, "color": [0, 0, 9],
    }  # fmt: skip
    first, second = content["annotations"]
    assert (first["image_id"], first["file_name"]) == (1, "left/a.png")
    assert second["segments_info"] == []
    assert [
        (s["id"], s["category_id"], s["area"], s["bbox"], s["iscrowd"], s["name"])
        for s in first["segments_info"]
    ] == [
        (5, 1, 3, [1, 0, 2, 2], 0, "red chair"),
        (70_000, 1, 1, [2, 1, 1, 1], 1, ""),
        (2**24 - 1, 9, 2, [3, 1, 1, 2], 0, ""),
    ]
    with Image.open(folder / "panoptic" / "left" / "a.png") as image:
        assert image.mode == "RGB"
        rgb = np.asarray(image).astype(np.int64)
    decoded = rgb[..., 0] + 256 * rgb[..., 1] + 65536 * rgb[..., 2]
    assert np.array_equal(decoded, torch.where(IDS < 0, 0, IDS).numpy())


def test_an_earlier_export_is_replaced(tmp_path) -> None:
    folder = tmp_path / "coco"
    for name in ("a", "b"):
        write_coco_panoptic([frame(name)], folder, segments=SEGMENTS, categories=CATEGORIES)
    assert [p.name for p in (folder / "panoptic").iterdir()] == ["b.png"]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "x").touch()
    with pytest.raises(InputError, match="other files"):
        write_coco_panoptic([frame()], tmp_path / "mine", segments=SEGMENTS, categories=CATEGORIES)


@pytest.mark.parametrize(
    ("frames", "segments", "categories", "word"),
    [
        ([frame(), frame()], SEGMENTS, CATEGORIES, "twice"),
        ([frame()], {5: SEGMENTS[5]}, CATEGORIES, "id 70000"),
        ([frame()], SEGMENTS | {2**24: SEGMENTS[5]}, CATEGORIES, "16777215"),
        ([frame()], SEGMENTS | {0: SEGMENTS[5]}, CATEGORIES, "got 0"),
        ([frame()], SEGMENTS, CATEGORIES[:1], "no category 9"),
        ([frame()], SEGMENTS, CATEGORIES * 2, "distinct"),
    ],
)
def test_refusals(tmp_path, frames, segments, categories, word) -> None:
    with pytest.raises(InputError, match=word):
        write_coco_panoptic(frames, tmp_path / "c", segments=segments, categories=categories)
    assert list(tmp_path.iterdir()) == []
