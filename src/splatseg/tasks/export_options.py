"""What is exported, and how."""

from dataclasses import dataclass
from typing import Literal

from splatseg.core.boundary import convert_fields
from splatseg.io.export import (
    BoxMethod,
)
from splatseg.io.splats import WritableFormat

What = Literal["splat", "objects", "points", "coco", "table"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """What is exported, and how."""

    layer: str | None = None
    """Layer of labels for class_id and confidence; a selection becomes the columns selected and,
    where it has a confidence, selected_confidence."""

    instances: str | None = None
    """Layer of labels for instance_id and instance_confidence. With it, its ids are the objects
    and the ids of `layer` their classes; without, the ids of `layer` are the objects."""

    splat_format: WritableFormat | None = None
    """Format of splats: ply, compressed.ply, splat, spz, spz3 (SPZ version 3), sog. Default:
    what the file is named, ply for objects."""

    only: tuple[str, ...] = ()
    """Only these objects, by id or name. Other Gaussians are left out."""

    min_confidence: float = 0.0
    """Labels less sure than this, in [0, 1], count as none."""

    min_opacity: float = 0.0
    """Gaussians less opaque than this, in [0, 1], are left out of point clouds."""

    unlabelled: bool = False
    """With objects: also write what has no label, as unlabelled.ply."""

    box: BoxMethod = "auto"
    """How boxes are turned. upright: about the scene's up axis, with the least ground area.
    pca: along the principal axes. auto: upright where the scene has an up axis."""

    split: str = "test"
    """With coco: which views: test, train, another split, all, or path: a smooth path near the
    training cameras."""

    frames: int = 360
    """Views of split path."""

    def __post_init__(self) -> None:
        convert_fields(self)
