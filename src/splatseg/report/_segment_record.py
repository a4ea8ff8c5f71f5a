"""The report of a segmentation as values that JSON holds."""

from dataclasses import asdict
from typing import Any

from splatseg.core import UNLABELLED, layer_info_to_json
from splatseg.evaluate.metrics import SemanticScore
from splatseg.evaluate.overlaps import InstanceScore
from splatseg.report._object_facts import objects_record
from splatseg.report._segment_page import SegmentationReportData


def segmentation_record(data: SegmentationReportData) -> dict[str, Any]:
    """What the page tells, for programs: NAME.json beside NAME.html."""
    labels = data.labels
    return {
        "made_by": "splatseg segment",
        "command": data.command,
        "layer": data.layer,
        "warnings": list(data.warnings),
        "views": data.views,
        "labels": len(data.classes.rows),
        "gaussians": None if labels is None else len(labels),
        "labelled": None if labels is None else int((labels.ids != UNLABELLED).sum()),
        "inferred": None if labels is None or labels.inferred is None
        else int(labels.inferred.sum()),
        "scored": data.scored or None,
        "score": _score(data.score),
        "evidence_that_differs": [
            {"view": panel.name, **asdict(panel.agreement)}
            for panel in data.compared
            if panel.agreement is not None
        ],
        "objects": objects_record(data.objects),
        "seconds": {name: round(spent, 3) for name, spent in data.timings.items()},
        "peak_bytes": data.peak_bytes,
        "made": layer_info_to_json(data.summary.info),
        **data.facts,
    }  # fmt: skip


def _score(score: SemanticScore | InstanceScore | None) -> dict[str, Any] | None:
    if score is None:
        return None
    if isinstance(score, SemanticScore):
        return {
            "mIoU": score.miou,
            "accuracy": score.accuracy,
            "per_class": {str(id): value for id, value in score.per_class.items()},
        }
    return {
        "mIoU_of_instances": score.miou,
        "recall50": score.recall50,
        "precision50": score.precision50,
        "truth_instances": score.truth_instances,
        "predicted_instances": score.predicted_instances,
    }
