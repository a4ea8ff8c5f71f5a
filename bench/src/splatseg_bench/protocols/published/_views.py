"""Held-out views of rooms: classes and instances in Replica, ScanNet and ScanNet++."""

from dataclasses import replace

from splatseg_bench.protocols._protocol import PublishedFigure
from splatseg_bench.protocols.published import _cosseg
from splatseg_bench.protocols.published._rows import SECOND_HAND, Table

_GROUPING = (
    "Gaussian Grouping on Replica: 66.84 (classes) and 71.15 (panoptic) in CoSSegGaussians, Tables "
    "1 and 2; second-hand 83.36 (panoptic IoU), 54.12 (mIoU in 3D) and 29.6 (extraction in 3D). "
    "These are different evaluations."
)


def _second(evaluation: str, *measures: str) -> Table:
    return Table(protocol="replica", measures=measures, source=f"{SECOND_HAND}, {evaluation}")


_EXTRACTION = _second("extraction in 3D", "iou", "psnr")
_OBJECTS = _second("objects in novel views", "iou")
_PANOPTIC_IOU = _second("panoptic IoU", "miou")
_IOU_3D = _second("mIoU in 3D", "miou")
_EXTRACTED = "Objects rendered alone by Trace3D's protocol; PSNR inside their boxes."
_NOVEL = "Objects in novel views by Trace3D's protocol."


def _second_hand() -> tuple[PublishedFigure, ...]:
    """Evaluations on Replica that are not the protocol's."""
    return (
        _EXTRACTION.row("Gaussian Grouping", 29.6, 13.4, note=f"{_EXTRACTED} {_GROUPING}"),
        _EXTRACTION.row("FlashSplat", 39.3, 16.9, note=_EXTRACTED),
        _EXTRACTION.row("EgoLifter", 55.6, 20.1, note=_EXTRACTED),
        _EXTRACTION.row("Trace3D", 72.1, 22.6, note=_EXTRACTED),
        _OBJECTS.row("SA3D-GS", 79.1, note=_NOVEL),
        _OBJECTS.row("EgoLifter", 82.1, note=_NOVEL),
        _OBJECTS.row("SA3D", 83.0, note=_NOVEL),
        _OBJECTS.row("OmniSeg3D", 84.4, note=_NOVEL),
        _OBJECTS.row("Trace3D", 85.5, note=_NOVEL),
        _PANOPTIC_IOU.row("Gaussian Grouping", 83.36, note=_GROUPING),
        _PANOPTIC_IOU.row("ObjectGS", 88.39, note="The source calls it panoptic IoU."),
        _IOU_3D.row("CCGS", 65.46, note="In 3D, not in views."),
        _IOU_3D.row("Gaussian Grouping", 54.12, note=f"In 3D, not in views. {_GROUPING}"),
    )


REPLICA = (
    *(
        replace(one, note=f"{one.note} {_GROUPING}") if one.method == "Gaussian Grouping" else one
        for one in _cosseg.qualities("replica", "replica")
    ),
    *_second_hand(),
)

SCANNET = _cosseg.qualities("scannet", "scannet-views")

SCANNETPP = (
    Table(
        protocol="scannetpp",
        measures=("miou", "fwiou"),
        source="End-to-End Pipeline for Open-Vocabulary Semantic Novel View Synthesis, Table 1",
        verified=True,
    ).row(
        "open-vocabulary voxel pipeline",
        39.1,
        49.4,
        scene="office",
        note="13 queries against 48 annotated classes in one scene, which the pipeline was "
        "developed on.",
    ),
)
