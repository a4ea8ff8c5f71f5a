"""Blocks of a drive as fields are made of them: their own views, scans and points."""

from functools import partial
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from splatseg.core import ScanSource, View
from splatseg.street.block_field import DriveScans, block_views
from splatseg.street.blocks import DriveBlock, DriveBlocks
from splatseg.street.field import MeshField
from splatseg.street.files import block_file, load_mesh_field
from splatseg.tasks._observer import Observer
from splatseg.tasks.street._build import FieldBuilder
from splatseg.tasks.street._identity import DigestedScans
from splatseg.tasks.street._inputs import DriveInputs, check_labelled
from splatseg.tasks.street._sources import capture_points
from splatseg.tasks.street.options import StreetOptions


class BlockParts:
    """What of a drive is a block's, and the fields that are made of it.

    Args:
        drive: How it was cut.
        inputs: What is learned from.
        views: All that are learned from, as training views.
        builder: Builds fields.
        options: Where depth comes from.
        observer: Is told which block is made.

    Raises:
        InputError: If a block has no view or no label map, or a scan is broken.
    """

    def __init__(
        self,
        drive: DriveBlocks,
        inputs: DriveInputs,
        *,
        views: tuple[View, ...],
        builder: FieldBuilder,
        options: StreetOptions,
        observer: Observer,
    ) -> None:
        self._drive, self._builder = drive, builder
        self._options, self._observer = options, observer
        self._views = [block_views(views, drive, block) for block in drive.blocks]
        for block, own in zip(drive.blocks, self._views, strict=True):
            check_labelled(own, inputs.evidence, f" of block {block.index + 1} of {len(drive)}")
        #: Of the capture.
        self.points = capture_points(inputs.capture)
        self.digested = None if inputs.scans is None else DigestedScans(inputs.scans)
        self._scans = None if self.digested is None else DriveScans(self.digested, drive)
        self.primitives: dict[int, int] = {}
        self._ready: dict[int, MeshField] = {}

    def prepare(self, block: DriveBlock) -> None:
        """Make the field of a block before anything is written."""
        self._ready[block.index] = self._made(block)

    def make(self, block: DriveBlock) -> MeshField:
        """The field of a block."""
        field = self._ready.pop(block.index, None)
        return self._made(block) if field is None else field

    def count(self, folder: Path, block: DriveBlock) -> int:
        """Primitives of a block that is made."""
        if block.index in self.primitives:
            return self.primitives[block.index]
        return len(load_mesh_field(block_file(folder, block.index)).mesh)

    def _made(self, block: DriveBlock) -> MeshField:
        drive, views = self._drive, self._views[block.index]
        self._observer.info(f"block {block.index + 1} of {len(drive)}: {len(views)} views")
        built = self._builder.build(
            views,
            scans=self._scans_of(block),
            points=self._near(block),
            near=partial(drive.near, block),
            details={"block": block.index, "blocks": len(drive)},
        )
        self.primitives[block.index] = len(built.field.mesh)
        return built.field

    def _scans_of(self, block: DriveBlock) -> ScanSource | None:
        """Scans of a block; where no laser was on, depth comes from what else is there."""
        own = None if self._scans is None else self._scans.of(block)
        unseen = own is not None and not own.scan_names and self._options.depth == "auto"
        return None if unseen else own

    def _near(self, block: DriveBlock) -> Float[Tensor, "n 3"] | None:
        if self.points is None:
            return None
        return self.points[self._drive.near(block, self.points)]
