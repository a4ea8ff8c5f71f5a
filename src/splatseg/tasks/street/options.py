"""What a mesh field of a drive is made from, and what it is called."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from splatseg._check import check_choice
from splatseg.core.boundary import convert_fields
from splatseg.errors import InputError
from splatseg.io.scene import check_name
from splatseg.street.blocks import DriveBlockOptions

_OVERLAP = 0.25
"""Of the length of a block, where no other overlap is asked for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreetOptions:
    """What a mesh field is made from, and what it is called."""

    field: str = "street"
    """Name of the field: it becomes SCENE/fields/NAME.safetensors, or a folder of this name."""

    evidence: str | None = None
    """Name of the evidence: a folder of the scene's or of its capture, such as labels_semantic.
    None takes the only label maps there are."""

    layer: str | None = None
    """Name of the field's layer. None names it like the evidence."""

    zero_is_class: bool = False
    """The id 0 of the evidence's files is a class and not void: ids grow by 1."""

    void: int | None = None
    """A further id of the evidence's files that means none, such as 255."""

    views: tuple[str, ...] = ("train",)
    """Which views are learned from: train, all, or names by comma or by space."""

    scans: Path | None = None
    """Scans of lasers in the world of the scene: where primitives are, and their depth. None uses
    none."""

    depth: str = "auto"
    """Where depth comes from: scans, scans+gaussians (what Gaussians show where no laser looked),
    maps of the capture, gaussians, points, or the name of evidence of depth. auto takes the most
    that is there, scans before maps before gaussians before points."""

    block_length: float | None = None
    """Cut the drive into overlapping blocks of at most so many metres along it, each made by
    itself. None makes one field of the whole drive."""

    block_overlap: float | None = None
    """What two blocks that follow each other share, metres. None is a quarter of a block."""

    moving: Path | None = None
    """Boxes of moving things, which are left out of views and scans: a JSON file, a drive of
    KITTI-360 or a segment of Waymo."""

    moving_classes: tuple[str, ...] = ()
    """Classes of the evidence whose things move, such as car pedestrian: they are left out of
    views."""

    moving_clock: Literal["recorded", "frames"] = "recorded"
    """What the times of boxes are. recorded: what the data set has, such as seconds. frames: the
    last number in the name of a view or scan."""

    published: bool = False
    """The setting of the papers: networks, rates, 5 000 and 50 000 iterations."""

    seed: int = 0
    """Seed of random choices, recorded in the field."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_name("field", self.field)
        if self.layer is not None:
            check_name("layer", self.layer)
        check_choice("moving_clock", self.moving_clock, ("recorded", "frames"))
        length, overlap = self.block_length, self.block_overlap
        if length is None and overlap is not None:
            raise InputError(
                f"block_overlap: expected a length of blocks with it, got {overlap:g} m alone."
            )
        for name, value in (("block_length", length), ("block_overlap", overlap)):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InputError(f"{name}: expected a positive number of metres, got {value}.")
        if length is not None and overlap is not None and overlap >= length:
            raise InputError(
                f"block_overlap: expected less than a block of {length:g} m, got {overlap:g} m."
            )

    @property
    def blocks(self) -> DriveBlockOptions | None:
        """How the drive is cut; None where it is not."""
        if self.block_length is None:
            return None
        overlap = self.block_overlap
        if overlap is None:
            overlap = _OVERLAP * self.block_length
        return DriveBlockOptions(length=self.block_length, overlap=overlap)
