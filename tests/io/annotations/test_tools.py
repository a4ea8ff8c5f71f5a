"""What other tools wrote of two pictures, against the masks that went in."""

import numpy as np
import pytest

from splatseg.errors import InputError
from splatseg.io.annotations import AnnotationEvidence, open_annotations
from splatseg.io.evidence import Evidence, open_evidence
from support.annotations import GOLDEN, HEIGHT, TRUTH, WIDTH, views_of

CLASSES = ("car", "tree", "wall")
DECODED = np.load(GOLDEN / "decoded.npz")
SCORES = [0.9, 0.75, 0.5]
VIEWS = views_of("000", "001", "002")


def opened(name: str, **more: object) -> Evidence:
    path = GOLDEN / name
    found = open_annotations(path, views=VIEWS, **more) or open_evidence(path)
    assert found.view_names == ("000", "001")
    return found


def on_top(view: int) -> np.ndarray:
    """The object on top of each pixel, 1 the car, -1 for none."""
    ids = np.full((HEIGHT, WIDTH), -1)
    for k in (3, 2, 1):
        ids[TRUTH[view, k - 1]] = k
    return ids


def edge(mask: np.ndarray) -> np.ndarray:
    """Pixels that touch a border of a mask."""
    wide = np.pad(mask, 1, mode="edge")
    around = [wide[y : y + HEIGHT, x : x + WIDTH] for y in range(3) for x in range(3)]
    return np.any(around, axis=0) & ~np.all(around, axis=0)


def check(found: np.ndarray, wanted: np.ndarray, *, outlined: bool) -> None:
    """Equal; of what was drawn as an outline only its border may differ."""
    differ = found != wanted
    assert not (differ & ~edge(wanted)).any() if outlined else not differ.any()


# Which objects are outlines there, the order of the objects, and their scores.
SHAPES = {
    "coco-instances": ((0,), (0, 1, 2), None),
    "supervision": ((0, 2), (0, 1, 2), None),
    "cvat": ((0,), (2, 1, 0), None),
    "labelme": ((0,), (0, 1, 2), None),
    "label-studio": ((0,), (1, 2, 0), None),
    "detectron2": ((), (2, 1, 0), SCORES),
    "sam": ((), (0, 1, 2), SCORES),
}


@pytest.mark.parametrize("name", SHAPES)
def test_masks(name: str) -> None:
    outlines, order, scores = SHAPES[name]
    evidence = opened(name)
    assert evidence.kind == "masks"
    for i, view in enumerate(evidence.view_names):
        masks = evidence.masks(view)
        assert len(masks) == 3
        for place, k in enumerate(order):
            # supervision traces outlines through the centres of pixels, and loses some.
            wanted = DECODED[name][i, k] if name == "supervision" else TRUTH[i, k]
            check(masks.dense(place).numpy(), wanted, outlined=k in outlines)
        wanted = [1.0] * 3 if scores is None else [scores[k] for k in order]
        assert masks.scores.tolist() == pytest.approx(wanted)


def test_label_studio_converted_to_coco_has_outlines_alone() -> None:
    """Its converter leaves brushes out; ids start at 0, and names have eight letters before."""
    evidence = opened("label-studio-coco")
    for i, view in enumerate(evidence.view_names):
        masks = evidence.masks(view)
        assert len(masks) == 1
        check(masks.dense(0).numpy(), TRUTH[i, 0], outlined=True)
    assert isinstance(evidence, AnnotationEvidence)
    labels = evidence.as_kind("labels")
    assert labels.classes is not None
    assert [(row.id, row.name) for row in labels.classes.rows] == list(enumerate(CLASSES, 1))
    assert labels.source_ids == {1: 0, 2: 1, 3: 2}
    assert sorted(np.unique(labels.label_map("000").ids.numpy())) == [-1, 1]


def test_outlines_are_filled_as_pycocotools_does() -> None:
    """But for the border, where it rounds otherwise."""
    evidence = opened("coco-instances")
    for i, view in enumerate(evidence.view_names):
        masks = evidence.masks(view)
        for k in range(3):
            check(masks.dense(k).numpy(), DECODED["coco-instances"][i, k], outlined=k == 0)


@pytest.mark.parametrize("name", ["coco-instances", "cvat"])
def test_shapes_as_classes(name: str) -> None:
    """The names stay, and what lies on top hides the rest."""
    evidence = opened(name)
    assert isinstance(evidence, AnnotationEvidence)
    evidence = evidence.as_kind("labels")
    assert evidence.classes is not None
    assert [(row.id, row.name) for row in evidence.classes.rows] == list(enumerate(CLASSES, 1))
    for i, view in enumerate(evidence.view_names):
        ids = evidence.label_map(view).ids.numpy()
        wanted = on_top(i)
        if name != "cvat":  # no order is told: the later shape lies on top
            for k in (1, 2, 3):
                wanted[TRUTH[i, k - 1]] = k
        near = np.any([edge(mask) for mask in TRUTH[i]], axis=0)
        assert ((ids == wanted) | near).all()


@pytest.mark.parametrize("name", ["voc", "voc/SegmentationClass", "camvid", "detectron2-semantic"])
def test_class_maps(name: str) -> None:
    evidence = opened(name)
    assert evidence.kind == "labels"
    for i, view in enumerate(evidence.view_names):
        ids = evidence.label_map(view).ids.numpy()
        # Detectron2 names no ids, and 0 is one of them: all grow by one.
        wanted = np.maximum(on_top(i), 0) + 1 if name == "detectron2-semantic" else on_top(i)
        assert np.array_equal(ids, wanted)
    if name == "detectron2-semantic":
        assert evidence.classes is None
        assert evidence.source_ids == {1: 0, 2: 1, 3: 2, 4: 3}
    else:
        assert evidence.classes is not None
        assert [(row.id, row.name) for row in evidence.classes.rows] == list(enumerate(CLASSES, 1))


def test_ids_in_32_bits() -> None:
    evidence = opened("tiff")
    assert evidence.kind == "labels"
    for i, view in enumerate(evidence.view_names):
        assert np.array_equal(evidence.label_map(view).ids.numpy(), on_top(i))


def test_panoptic_segments() -> None:
    evidence = opened("coco-panoptic")
    assert isinstance(evidence, AnnotationEvidence)
    assert evidence.kind == "panoptic"
    for i, view in enumerate(evidence.view_names):
        assert np.array_equal(evidence.label_map(view).ids.numpy(), on_top(i))
        assert [(s.id, s.category) for s in evidence.segments(view)] == [(1, 1), (2, 2), (3, 3)]
    assert not any(segment.isthing for segment in evidence.segments("000")), "as the table says"
    assert len(evidence.masks("000")) == 3


def test_one_file_of_sa_1b_a_view() -> None:
    evidence = open_evidence(GOLDEN / "sa-1b")
    for i, view in enumerate(("000", "001")):
        masks = evidence.masks(view)
        found = [masks.dense(k).numpy() for k in range(3)]
        assert np.array_equal(found, [on_top(i) == k for k in (1, 2, 3)])
        assert masks.scores.tolist() == pytest.approx(SCORES)


@pytest.mark.parametrize(
    "name",
    [
        "coco-instances/annotations/instances_default.json", "cvat/default.xml",
        "detectron2/coco_instances_results.json", "label-studio/export.json",
        "supervision/annotations.json", "coco-panoptic/annotations/panoptic_default.json",
    ],
)  # fmt: skip
def test_a_file_says_what_its_folder_says(name: str) -> None:
    folder = opened(name.split("/", maxsplit=1)[0])
    file = opened(name)
    for view in folder.view_names:
        one, other = folder.masks(view), file.masks(view)
        assert [m.to_coco() for m in one.masks] == [m.to_coco() for m in other.masks]


def test_names_of_classes_that_a_file_lacks() -> None:
    evidence = opened("detectron2-semantic", classes="coco")
    assert evidence.classes is not None
    assert evidence.classes.name_of(2) == "person", "1 in the file"
    with pytest.raises(InputError, match="names its classes itself"):
        opened("coco-instances", classes="coco")


def test_datumaro_s_own_format_is_none() -> None:
    assert open_annotations(GOLDEN / "datumaro") is None


def test_without_views_a_picture_is_called_by_its_path() -> None:
    found = open_annotations(GOLDEN / "labelme")
    assert found is not None
    assert found.view_names == ("images/000", "images/001")
