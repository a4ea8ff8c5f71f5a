"""CoSSegGaussians' two tables: Replica and ScanNet, in classes and in panoptic segments."""

from dataclasses import replace
from typing import Literal

from splatseg_bench.protocols._protocol import PublishedFigure
from splatseg_bench.protocols.published._rows import Table

DataSet = Literal["replica", "scannet"]
Task = Literal["semantic", "panoptic"]

_COSTS = ("fps", "scene_mb")
_LABELS = "Seven scenes; every method is fitted to labels of MaskDINO, which was trained on ADE20K."
_TRAINED = {
    "semantic": f"Trained on classes. {_LABELS}",
    "panoptic": f"Trained on panoptic labels. {_LABELS}",
}
_COST_NOTE = (
    "Frames per second are about so many, on an A800; megabytes are of all learnable parameters, "
    "which must include those of the scene itself."
)
_SEMANTIC = {
    "replica": (
        ("Semantic-NeRF", 69.81, 5, 9.7),
        ("Gaussian Grouping", 66.84, 140, 838.0),
        ("CoSSegGaussians", 79.34, 90, 680.3),
    ),
    "scannet": (
        ("Semantic-NeRF", 69.67, 5, 10.4),
        ("Gaussian Grouping", 67.99, 150, 838.6),
        ("CoSSegGaussians", 75.40, 100, 684.5),
    ),
}
_PANOPTIC = {
    "replica": (
        ("Panoptic Lifting", 66.22, 72.25, 64.34, 10, 100.1),
        ("Gaussian Grouping", 71.15, 69.98, 66.52, 140, 840.2),
        ("CoSSegGaussians", 79.49, 80.97, 75.60, 90, 681.1),
    ),
    "scannet": (
        ("Panoptic Lifting", 67.01, 66.95, 60.74, 10, 102.5),
        ("Gaussian Grouping", 68.70, 67.03, 61.83, 150, 841.6),
        ("CoSSegGaussians", 74.37, 76.14, 68.68, 90, 685.4),
    ),
}


def figures(data: DataSet, task: Task) -> tuple[PublishedFigure, ...]:
    """A half of one of the tables, under the protocol of its own."""
    shares = ("miou",) if task == "semantic" else ("miou", "ap50", "pq_scene")
    table = Table(
        protocol=f"cosseg-{data}-{task}",
        measures=(*shares, *_COSTS),
        source=f"CoSSegGaussians, Table {1 if task == 'semantic' else 2}",
        verified=True,
    )
    rows = _SEMANTIC[data] if task == "semantic" else _PANOPTIC[data]
    note = f"{_TRAINED[task]} {_COST_NOTE}"
    return tuple(table.row(method, *cells, note=note) for method, *cells in rows)


def qualities(data: DataSet, protocol: str) -> tuple[PublishedFigure, ...]:
    """The shares of both tables under a protocol that measures no costs."""
    return tuple(
        replace(
            one,
            protocol=protocol,
            scores={name: value for name, value in one.scores.items() if name not in _COSTS},
            note=_TRAINED[task],
        )
        for task in ("semantic", "panoptic")
        for one in figures(data, task)
    )


REPLICA_SEMANTIC = figures("replica", "semantic")
REPLICA_PANOPTIC = figures("replica", "panoptic")
SCANNET_SEMANTIC = figures("scannet", "semantic")
SCANNET_PANOPTIC = figures("scannet", "panoptic")
