"""splatseg see --model ANNOTATIONS: what other tools exported, from the command line."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatseg.io.evidence import PanopticEvidence, open_evidence

WIDTH, HEIGHT = 28, 20
TRAIN = ("train_0", "train_1", "train_3")
LEFT = [0.0, 0.0, 14.0, 0.0, 14.0, 20.0, 0.0, 20.0]
LOWER = [0.0, 10.0, 28.0, 10.0, 28.0, 20.0, 0.0, 20.0]


def coco(names: tuple[str, ...] = TRAIN) -> dict[str, Any]:
    """Two areas a picture, the later over the earlier."""
    images = [
        {"id": i, "file_name": f"export/{name}.jpg", "width": WIDTH, "height": HEIGHT}
        for i, name in enumerate(names)
    ]
    annotations = [
        {"image_id": i, "category_id": category, "segmentation": [outline], "score": score}
        for i in range(len(names))
        for category, outline, score in ((7, LEFT, 0.5), (90000, LOWER, 0.75))
    ]
    categories = [{"id": 7, "name": "chair"}, {"id": 90000, "name": "floor", "isthing": 0}]
    return {"images": images, "annotations": annotations, "categories": categories}


def refused(result: tuple[int, str, str]) -> str:
    status, out, err = result
    assert (status, out) == (2, ""), err
    (error,) = [line for line in err.splitlines() if line.startswith("error: ")]
    return error


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "export.json"
    path.write_text(json.dumps(coco((*TRAIN, "elsewhere"))))
    return path


def see(small, splatseg, model: Path, *more: object) -> tuple[int, str, str]:
    return splatseg("see", small.scene, "--model", model, "--evidence", "e", *more)


def test_masks_with_their_scores(small, splatseg, file) -> None:
    status, out, err = see(small, splatseg, file)
    assert status == 0, err
    assert out.startswith("masks of 3 views by export.json, 2.0 masks a view")
    assert "note: 1 of 4 annotated pictures are of no view ('export/elsewhere.jpg')." in err
    evidence = open_evidence(small.scene / "evidence" / "e")
    assert evidence.view_names == TRAIN
    for name in TRAIN:
        masks = evidence.masks(name)
        assert masks.scores.tolist() == [0.5, 0.75]
        left, lower = (masks.dense(k).numpy() for k in (0, 1))
        assert left[:, :14].all()
        assert not left[:, 14:].any()
        assert lower[10:].all()
        assert not lower[:10].any()
    status, out, _ = see(small, splatseg, file)
    assert status == 0
    assert "3 of them were there" in out


def test_classes_and_segments_of_the_same_file(small, splatseg, file) -> None:
    status, _, err = see(small, splatseg, file, "--what", "labels,panoptic")
    assert status == 0, err
    wanted = np.full((HEIGHT, WIDTH), -1)
    wanted[:, :14], wanted[10:] = 1, 2
    labels = open_evidence(small.scene / "evidence" / "e")
    assert labels.kind == "labels"
    assert labels.classes is not None
    rows = [(row.id, row.name, row.isthing) for row in labels.classes.rows]
    assert rows == [(1, "chair", True), (2, "floor", False)]
    assert labels.source_ids == {1: 7, 2: 90000}
    panoptic = open_evidence(small.scene / "evidence" / "e.panoptic")
    assert isinstance(panoptic, PanopticEvidence)
    for name in TRAIN:
        assert np.array_equal(labels.label_map(name).ids.numpy(), wanted)
        assert np.array_equal(panoptic.label_map(name).ids.numpy(), wanted)
        told = [(s.id, s.category, s.isthing, s.score) for s in panoptic.segments(name)]
        assert told == [(1, 1, True, 0.5), (2, 2, False, 0.75)]


def test_views_without_a_picture_are_refused_or_passed_over(small, splatseg, file) -> None:
    file.write_text(json.dumps(coco(TRAIN[:2])))
    sentence = refused(see(small, splatseg, file))
    assert "1 of the 3 views asked for are missing (train_3)" in sentence
    status, out, err = see(small, splatseg, file, "--allow-missing")
    assert status == 0
    assert "masks of 2 views" in out
    assert "1 views have no evidence (train_3)" in err


def test_colours_with_their_table(small, splatseg, tmp_path) -> None:
    folder = tmp_path / "task"
    (folder / "SegmentationClass").mkdir(parents=True)
    (folder / "labelmap.txt").write_text(
        "# label:color_rgb:parts:actions\nbackground:0,0,0::\nchair:9,0,0::\nfloor:0,9,0::\n"
    )
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[:, :14, 0], pixels[10:, 14:, 1] = 9, 9
    for name in (*TRAIN, "elsewhere"):
        Image.fromarray(pixels).save(folder / "SegmentationClass" / f"{name}.png")
    status, out, err = see(small, splatseg, folder)
    assert status == 0, err
    assert out.startswith("labels of 3 views by task")
    assert "1 of 4 annotated pictures are of no view ('elsewhere.png')" in err
    evidence = open_evidence(small.scene / "evidence" / "e")
    assert evidence.classes is not None
    assert {row.id: row.name for row in evidence.classes.rows} == {1: "chair", 2: "floor"}
    assert np.array_equal(evidence.label_map("train_0").ids[[0, 15]][:, [0, 20]], [[1, -1], [1, 2]])
    sentence = refused(see(small, splatseg, folder, "--classes", "voc", "--overwrite"))
    assert "names the classes of its pictures itself" in sentence


def test_boxes_beside_masks_are_left_out_and_said(small, splatseg, file) -> None:
    content = coco()
    content["annotations"] += [{"image_id": 0, "category_id": 7, "bbox": [1, 2, 3, 4]}]
    file.write_text(json.dumps(content))
    status, _, err = see(small, splatseg, file)
    assert status == 0
    assert "which pixels are inside were left out (1 boxes): polygons and masks do." in err


@pytest.mark.parametrize(
    ("content", "more", "message"),
    [
        (None, (), "there is no such file or folder"),
        ("{", (), "cannot be parsed"),
        ("[]", (), "got another JSON"),
        (json.dumps(coco(("elsewhere",))), (), "got none of them but 1 others ('export/elsewhere"),
        (json.dumps(coco()), ("--what", "depth"), "expected evidence of depth, got masks"),
        (json.dumps(coco()), ("--void", "255"), "expected with a file a view, got"),
        (json.dumps(coco()), ("--suffix", "_a"), "expected with a file a view, got"),
        (json.dumps(coco()), ("--zero-is-class",), "expected with a file a view, got"),
        (json.dumps(coco()), ("--depth-unit", "1"), "expected with a file a view, got"),
        (json.dumps(coco()), ("--classes", "coco"), "names its classes itself"),
        (json.dumps(coco() | {"annotations": [{"image_id": 0}]}), (), "1 boxes without any"),
        (json.dumps(coco()).replace("28,", "14,"), (), "28x20 pixels as the photograph"),
    ],
)
def test_refusals_leave_nothing(small, splatseg, file, content, more, message) -> None:
    if content is None:
        file.unlink()
    else:
        file.write_text(content)
    sentence = refused(see(small, splatseg, file, *more))
    assert message in sentence
    assert not (small.scene / "evidence" / "e").exists()
