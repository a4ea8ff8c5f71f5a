"""Makes the annotations in tests/golden/annotations with the tools of others, of two pictures.

    python -m venv F && F/bin/pip install datumaro==1.13.12 pycocotools==2.0.11 \\
        supervision==0.31.2 label-studio-sdk==2.1.2 labelme==6.3.1 segment-anything-py==1.0.1
    F/bin/python tests/golden/make_annotations.py

splatseg is not used. truth.npz has what went in: masks (pictures, objects, 48, 64) of a car (a
polygon), a tree (a disc with a hole) and a wall, which lie over each other in this order, the
car on top; decoded.npz what pycocotools makes of two of the files. versions.json has the tools.

CVAT, Detectron2 and Label Studio's server are on no package registry: what they write is put
together here out of what their own libraries give (the XML of datumaro, which CVAT exports with,
the run lengths of pycocotools and of label_studio_sdk). labelme needs Qt's libraries, and
QT_QPA_PLATFORM=offscreen where there is no screen.
"""

import importlib.util
import json
import shutil
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import labelme._label_file as labelme_file
import numpy as np
import supervision
import torch
from datumaro.components.annotation import (
    AnnotationType,
    LabelCategories,
    Mask,
    MaskCategories,
    Polygon,
)
from datumaro.components.dataset import Dataset
from datumaro.components.dataset_base import DatasetItem
from datumaro.components.media import Image
from label_studio_sdk.converter import Converter, brush
from PIL import Image as Picture
from PIL import ImageDraw
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO

FOLDER = Path(__file__).parent / "annotations"
WIDTH, HEIGHT = 64, 48
NAMES = ("000", "001")
CLASSES = ("car", "tree", "wall")
COLOURS = ((128, 0, 0), (0, 128, 0), (64, 64, 0))
POLYGONS = (
    ((4.0, 30.0), (30.5, 22.0), (33.0, 44.5), (8.0, 46.0)),
    ((20.0, 8.0), (50.5, 4.5), (58.0, 40.0)),
)
"""Corners of the car in each picture, x and y in pixels, 0 at the picture's edge."""

SCORES = (0.9, 0.75, 0.5)
TOOLS = (
    "datumaro",
    "labelme",
    "label-studio-sdk",
    "pycocotools",
    "segment-anything-py",
    "supervision",
)


def truth() -> np.ndarray:
    """Masks (pictures, objects, height, width)."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    masks = np.zeros((len(NAMES), len(CLASSES), HEIGHT, WIDTH), bool)
    for i, corners in enumerate(POLYGONS):
        picture = Picture.new("1", (WIDTH, HEIGHT))
        ImageDraw.Draw(picture).polygon([(px - 0.5, py - 0.5) for px, py in corners], fill=1)
        masks[i, 0] = np.asarray(picture)
        radius = np.hypot(x - 24 - 8 * i, y - 20)
        masks[i, 1] = (radius < 15) & (radius > 4)
        masks[i, 2] = x > 40 + 4 * i
    return masks


def covered(masks: np.ndarray) -> np.ndarray:
    """Class of each pixel (pictures, height, width), 0 for none: what lies on top."""
    ids = np.zeros((len(masks), HEIGHT, WIDTH), np.uint8)
    for k in reversed(range(len(CLASSES))):
        ids[masks[:, k]] = k + 1
    return ids


def main() -> None:
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir()
    masks = truth()
    np.savez_compressed(FOLDER / "truth.npz", masks=masks)
    with tempfile.TemporaryDirectory() as holder:
        photographs = Path(holder)
        for name in NAMES:
            Picture.new("RGB", (WIDTH, HEIGHT), (90, 90, 90)).save(photographs / f"{name}.jpg")
        with_datumaro(masks, photographs)
        with_supervision(masks, photographs)
        with_label_studio(masks, photographs)
    with_segment_anything(masks)
    with_pycocotools(masks)
    with_labelme(masks)
    (FOLDER / "tiff").mkdir()
    for name, ids in zip(NAMES, covered(masks), strict=True):
        Picture.fromarray(ids.astype(np.int32)).save(FOLDER / "tiff" / f"{name}.tif")
    versions = {tool: version(tool) for tool in TOOLS} | {"python": sys.version.split()[0]}
    (FOLDER / "versions.json").write_text(json.dumps(versions, indent=1) + "\n")


def with_datumaro(masks: np.ndarray, photographs: Path) -> None:
    categories: dict[Any, Any] = {AnnotationType.label: LabelCategories.from_iterable(CLASSES)}
    coloured: dict[Any, Any] = {
        AnnotationType.label: LabelCategories.from_iterable(("background", *CLASSES)),
        AnnotationType.mask: MaskCategories(dict(enumerate(((0, 0, 0), *COLOURS)))),
    }

    def dataset(of: Any, categories: dict[Any, Any] = categories) -> Dataset:
        items = [
            DatasetItem(
                id=name, media=Image.from_file(path=str(photographs / f"{name}.jpg")),
                annotations=of(i), attributes={"id": i + 1},
            )
            for i, name in enumerate(NAMES)
        ]  # fmt: skip
        return Dataset.from_iterable(items, categories=categories)

    def shapes(i: int) -> list[Any]:
        corners = [value for point in POLYGONS[i] for value in point]
        ids = [3 * i + k + 1 for k in range(3)]
        car = Polygon(corners, label=0, id=ids[0], group=ids[0], z_order=2)
        others = (
            Mask(masks[i, k], label=k, id=ids[k], group=ids[k], z_order=2 - k) for k in (1, 2)
        )
        return [car, *others]

    def segments(i: int, first: int = 0) -> list[Any]:
        ids = covered(masks)[i]
        return [
            Mask(
                ids == k, label=k - 1 + first, id=k, group=k,
                attributes={"predicted_iou": SCORES[k - 1], "stability_score": 0.96},
            )
            for k in (1, 2, 3)
        ]  # fmt: skip

    def classes(i: int) -> list[Any]:
        return segments(i, 1)

    def exported(name: str, data: Dataset, layout: str, **options: Any) -> None:
        data.export(str(FOLDER / name), layout, save_media=False, **options)

    exported("coco-instances", dataset(shapes), "coco_instances")
    exported("cvat", dataset(shapes), "cvat")
    exported("coco-panoptic", dataset(segments), "coco_panoptic")
    exported("voc", dataset(classes, coloured), "voc_segmentation", label_map="source")
    exported("camvid", dataset(classes, coloured), "camvid", label_map="source")
    exported("datumaro", dataset(shapes), "datumaro")
    exported("sa-1b", dataset(segments), "segment_anything")


def with_supervision(masks: np.ndarray, photographs: Path) -> None:
    found = {
        str(photographs / f"{name}.jpg"): supervision.Detections(
            xyxy=supervision.mask_to_xyxy(masks[i]), mask=masks[i], class_id=np.arange(3)
        )
        for i, name in enumerate(NAMES)
    }
    data = supervision.DetectionDataset(
        classes=list(CLASSES), images=list(found), annotations=found
    )
    data.as_coco(annotations_path=str(FOLDER / "supervision" / "annotations.json"))


def with_label_studio(masks: np.ndarray, photographs: Path) -> None:
    """A brush and a polygon a picture, as the server exports them, and its converter's COCO."""
    folder = FOLDER / "label-studio"
    folder.mkdir()
    tasks: list[dict[str, Any]] = []
    for i, name in enumerate(NAMES):
        results: list[dict[str, Any]] = []
        for k in (1, 2):
            picture = photographs / f"mask-{name}-{k}.png"
            Picture.fromarray(masks[i, k].astype(np.uint8) * 255).save(picture)
            made = brush.image2annotation(str(picture), CLASSES[k], "tag", "image")
            results += [row | {"id": f"{name}-{k}"} for row in made["result"]]
        points = [[x * 100 / WIDTH, y * 100 / HEIGHT] for x, y in POLYGONS[i]]
        common = {"original_width": WIDTH, "original_height": HEIGHT, "image_rotation": 0}
        outline = {"closed": True, "points": points, "polygonlabels": [CLASSES[0]]}
        results.append(
            common | {"value": outline, "id": f"{name}-0", "from_name": "outline",
            "to_name": "image", "type": "polygonlabels", "origin": "manual"}
        )  # fmt: skip
        tasks.append(
            {
                "id": i + 1, "project": 1,
                "data": {"image": f"/data/upload/1/5e2f0a1{i}-{name}.jpg"},
                "annotations": [
                    {"id": i + 11, "was_cancelled": False, "ground_truth": False, "result": results}
                ],
                "predictions": [],
            }
        )  # fmt: skip
    (folder / "export.json").write_text(json.dumps(tasks))
    config = (
        '<View><Image name="image" value="$image"/><BrushLabels name="tag" toName="image">'
        '<Label value="tree"/><Label value="wall"/></BrushLabels><PolygonLabels name="outline" '
        'toName="image"><Label value="car"/></PolygonLabels></View>'
    )
    converter = Converter(config, str(photographs), download_resources=False)
    target = FOLDER / "label-studio-coco"
    converter.convert_to_coco(str(folder / "export.json"), str(target), is_dir=False)
    shutil.rmtree(target / "images", ignore_errors=True)


def with_segment_anything(masks: np.ndarray) -> None:
    """Files of the automatic generator with output_mode coco_rle, and of uncompressed_rle."""
    spec = importlib.util.find_spec("segment_anything")
    path = Path(spec.submodule_search_locations[0]) / "utils" / "amg.py"
    loaded = importlib.util.spec_from_file_location("amg", path)  # without what needs torchvision
    amg = importlib.util.module_from_spec(loaded)
    loaded.loader.exec_module(amg)
    (FOLDER / "sam").mkdir()
    for i, name in enumerate(NAMES):
        rows = []
        for k, rle in enumerate(amg.mask_to_rle_pytorch(torch.from_numpy(masks[i]))):
            box = amg.batched_mask_to_box(torch.from_numpy(masks[i, k : k + 1]))[0]
            rows.append(
                {
                    "segmentation": amg.coco_encode_rle(rle) if i == 0 else rle,
                    "area": amg.area_from_rle(rle),
                    "bbox": amg.box_xyxy_to_xywh(box).tolist(),
                    "predicted_iou": SCORES[k],
                    "point_coords": [[1.0, 2.0]],
                    "stability_score": 0.96,
                    "crop_box": [0, 0, WIDTH, HEIGHT],
                }
            )
        (FOLDER / "sam" / f"{name}.json").write_text(json.dumps(rows))


def with_pycocotools(masks: np.ndarray) -> None:
    """Results as Detectron2's COCOEvaluator and SemSegEvaluator write them, of the pictures of
    coco-instances."""
    folder = FOLDER / "detectron2"
    folder.mkdir()

    def run_lengths(mask: np.ndarray) -> dict[str, Any]:
        rle = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
        return {"size": rle["size"], "counts": rle["counts"].decode()}

    results = [
        {"image_id": i + 1, "category_id": k + 1, "bbox": [0.0, 0.0, 1.0, 1.0],
         "score": SCORES[k], "segmentation": run_lengths(masks[i, k])}
        for i in range(len(NAMES)) for k in range(len(CLASSES))
    ]  # fmt: skip
    (folder / "coco_instances_results.json").write_text(json.dumps(results))
    dataset = json.loads((FOLDER / "coco-instances/annotations/instances_default.json").read_text())
    (folder / "dataset.json").write_text(json.dumps(dataset | {"annotations": []}))
    semantic = [
        {"file_name": f"datasets/street/{name}.jpg", "category_id": k,
         "segmentation": run_lengths(ids == k)}
        for name, ids in zip(NAMES, covered(masks), strict=True) for k in range(4)
    ]  # fmt: skip
    decoded: dict[str, np.ndarray] = {}
    for name in ("coco-instances", "supervision"):
        (file,) = (FOLDER / name).rglob("*.json")
        coco = COCO(str(file))
        rows = [coco.loadAnns(coco.getAnnIds([i])) for i in (1, 2)]
        decoded[name] = np.array([[coco.annToMask(row) for row in image] for image in rows]) > 0
    np.savez_compressed(FOLDER / "decoded.npz", **decoded)
    (FOLDER / "detectron2-semantic").mkdir()
    path = FOLDER / "detectron2-semantic" / "sem_seg_predictions.json"
    path.write_text(json.dumps(semantic))


def with_labelme(masks: np.ndarray) -> None:
    (FOLDER / "labelme").mkdir()
    for i, name in enumerate(NAMES):
        common = {"description": "", "flags": {}}
        shapes = [
            common | {"label": "car", "points": [list(p) for p in POLYGONS[i]], "group_id": None,
                      "shape_type": "polygon", "mask": None}
        ]  # fmt: skip
        for k in (1, 2):
            rows, columns = np.nonzero(masks[i, k])
            top, bottom, left, right = rows.min(), rows.max(), columns.min(), columns.max()
            crop = masks[i, k, top : bottom + 1, left : right + 1].astype(np.uint8)
            corners = [[float(left), float(top)], [float(right), float(bottom)]]
            encoded = labelme_file.utils.img_arr_to_b64(crop)
            shapes.append(
                common | {"label": CLASSES[k], "points": corners, "group_id": k,
                          "shape_type": "mask", "mask": encoded}
            )  # fmt: skip
        labelme_file.LabelFile().save(
            filename=str(FOLDER / "labelme" / f"{name}.json"), shapes=shapes,
            image_path=f"..\\images\\{name}.jpg", image_height=HEIGHT, image_width=WIDTH,
        )  # fmt: skip


if __name__ == "__main__":
    main()
