"""Annotations of other tools: the golden files, which those tools wrote."""

import shutil
from pathlib import Path

from splatseg.io.annotations import AnnotationEvidence, open_annotations
from splatseg.io.evidence import open_evidence
from splatseg.io.label_tables import label_table
from support.annotations import GOLDEN, views_of
from support.fuzz.targets.base import Target, target

_VIEWS = views_of("000", "001")


def _read(path: Path) -> None:
    """Everything that `see` asks of evidence."""
    evidence = open_annotations(path, views=_VIEWS) or open_evidence(path)
    _ = evidence.classes, evidence.source_ids, evidence.notes
    for view in evidence.view_names:
        evidence.masks(view)
        if isinstance(evidence, AnnotationEvidence):
            evidence.as_kind("labels").label_map(view)
            evidence.as_kind("panoptic").segments(view)
        elif evidence.kind == "labels":
            evidence.label_map(view)


def _golden(name: str, source: str, damaged: str) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        shutil.copytree(GOLDEN / source, folder / source)
        return Target(file=folder / source / damaged, read=lambda: _read(folder / source))


_golden("coco-instances.json", "coco-instances", "annotations/instances_default.json")
_golden("coco-panoptic.json", "coco-panoptic", "annotations/panoptic_default.json")
_golden("coco-panoptic.png", "coco-panoptic", "annotations/panoptic_default/000.png")
_golden("coco-results.json", "detectron2", "coco_instances_results.json")
_golden("coco-results-dataset.json", "detectron2", "dataset.json")
_golden("sem-seg-predictions.json", "detectron2-semantic", "sem_seg_predictions.json")
_golden("cvat.xml", "cvat", "default.xml")
_golden("labelme.json", "labelme", "000.json")
_golden("label-studio.json", "label-studio", "export.json")
_golden("labelmap.txt", "voc", "labelmap.txt")
_golden("label_colors.txt", "camvid", "label_colors.txt")
_golden("sam.json", "sam", "000.json")
_golden("sa-1b.json", "sa-1b", "000.json")
_golden("labels-32.tif", "tiff", "000.tif")


@target("colour-table.txt")
def colour_table(folder: Path) -> Target:
    """A table of colours by itself."""
    file = folder / "labelmap.txt"
    shutil.copy(GOLDEN / "voc" / "labelmap.txt", file)
    return Target(file=file, read=lambda: label_table(str(file)))
