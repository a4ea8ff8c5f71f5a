"""What of a capture and of its scans is a block's: views, start points and scans near it."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from splatseg.core import Capture, PointCloud, ScanSource, View
from splatseg.core.boundary import boundary
from splatseg.core.scans import Scan
from splatseg.errors import InputError
from splatseg.street.blocks.cut import BlockShare, Drive, DriveBlock

_KEPT_SHARES = 64
"""Scans of which it is kept what a block counts there: more than a window of scans with those
around it."""


@boundary
def block_capture(capture: Capture, drive: Drive, block: DriveBlock) -> Capture:
    """The part of a capture that a block is made from.

    Its views are those at whose place the block counts, so that views of an overlap are of both
    blocks; its start points are those in reach. Photographs are not looked at.

    Args:
        capture: The whole drive.
        drive: How it was cut.
        block: One of its blocks.

    Raises:
        InputError: If no training view is of the block.
    """
    views = block_views(capture.views, drive, block)
    return replace(capture, views=views, points=_cloud(capture.points, drive, block))


@boundary
def block_views(views: Sequence[View], drive: Drive, block: DriveBlock) -> tuple[View, ...]:
    """The views at whose place a block counts, in their order.

    Raises:
        InputError: If no training view is among them.
    """
    centres = [view.camera.centre for view in views]
    at = torch.stack(centres) if centres else torch.zeros(0, 3)
    of_block = drive.counts(block, at).tolist()
    found = tuple(view for view, own in zip(views, of_block, strict=True) if own)
    if not any(view.split == "train" for view in found):
        raise InputError(
            f"blocks: expected training views in every block, block {block.index} of {len(drive)} "
            "has none; longer blocks bridge a gap of the drive."
        )
    return found


def _cloud(cloud: PointCloud | None, drive: Drive, block: DriveBlock) -> PointCloud | None:
    if cloud is None:
        return None
    near = drive.near(block, cloud.points)
    colours = None if cloud.colours is None else cloud.colours[near]
    return PointCloud(points=cloud.points[near], colours=colours)


class DriveScans:
    """Scans of a drive by blocks; a `core.ScanSource` itself.

    Every scan is read once to see where it is, and again when it is asked for.

    Args:
        scans: Scans of the whole drive, in its world.
        drive: How it was cut.

    Raises:
        InputError: If a scan is broken.
    """

    @boundary
    def __init__(self, scans: ScanSource, drive: Drive) -> None:
        self._scans, self._drive = scans, drive
        self._facts = {name: _facts(scans.scan(name), drive) for name in scans.scan_names}
        self._built_from: dict[int, list[str]] = {}
        self._to_label: dict[int, list[str]] = {}
        for name, facts in self._facts.items():
            for block in facts.makes:
                self._built_from.setdefault(block, []).append(name)
            for block in facts.labelled_by:
                self._to_label.setdefault(block, []).append(name)

    @property
    def scan_names(self) -> Sequence[str]:
        """All scans in the order of the source."""
        return tuple(self._facts)

    def scan(self, name: str) -> Scan:
        """One of them, whole."""
        return self._scans.scan(name)

    def points(self, name: str) -> int:
        """How many points a scan has."""
        return self._facts[name].points

    def labelled_by(self, name: str) -> tuple[int, ...]:
        """Blocks that count at points of a scan, ascending."""
        return self._facts[name].labelled_by

    def of(self, block: DriveBlock) -> ScanSource:
        """Scans that a block is made from: those measured where it counts.

        Of each come the points in reach of the block. Clouds that were put together have no such
        place; they are of every block that has a point of them.
        """
        return _NearScans(self._scans, self._built_from.get(block.index, []), self._drive, block)

    def to_label(self, block: DriveBlock) -> "ScansToLabel":
        """Scans with points at which a block counts, and nothing but these points of them."""
        return ScansToLabel(self._scans, self._to_label.get(block.index, []), self._drive, block)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Facts:
    """Where a scan is."""

    points: int
    labelled_by: tuple[int, ...]
    makes: tuple[int, ...]


def _facts(scan: Scan, drive: Drive) -> _Facts:
    if scan.origin is not None:
        at = drive.shares(scan.origin.unsqueeze(0))
        makes = tuple(share.block for share in at)
    else:
        near = (block for block in drive.blocks if bool(drive.near(block, scan.points).any()))
        makes = tuple(block.index for block in near)
    labelled_by = tuple(share.block for share in drive.shares(scan.points))
    return _Facts(points=len(scan), labelled_by=labelled_by, makes=makes)


class _NearScans:
    """Some scans of a source, and their points in reach of a block; a `core.ScanSource`."""

    def __init__(
        self, scans: ScanSource, names: Sequence[str], drive: Drive, block: DriveBlock
    ) -> None:
        self._scans, self._names = scans, tuple(names)
        self._drive, self._block = drive, block

    @property
    def scan_names(self) -> Sequence[str]:
        """Scans in the order of the source."""
        return self._names

    def scan(self, name: str) -> Scan:
        """One of them, its far points left out."""
        _check_name(name, self._names)
        scan = self._scans.scan(name)
        near = self._drive.near(self._block, scan.points)
        return scan.take(torch.nonzero(near).squeeze(1))


class ScansToLabel:
    """Some scans of a source, and their points at which a block counts; a `core.ScanSource`."""

    def __init__(
        self, scans: ScanSource, names: Sequence[str], drive: Drive, block: DriveBlock
    ) -> None:
        """Take what `DriveScans.to_label` knows."""
        self._scans, self._names = scans, tuple(names)
        self._drive, self._block = drive, block
        self._read: OrderedDict[str, BlockShare] = OrderedDict()

    @property
    def scan_names(self) -> Sequence[str]:
        """Scans in the order of the source."""
        return self._names

    def scan(self, name: str) -> Scan:
        """One of them, its other points left out."""
        _check_name(name, self._names)
        scan = self._scans.scan(name)
        share = next(s for s in self._drive.shares(scan.points) if s.block == self._block.index)
        self._read[name] = share
        self._read.move_to_end(name)
        if len(self._read) > _KEPT_SHARES:
            self._read.popitem(last=False)
        return scan.take(share.rows)

    def share(self, name: str) -> BlockShare:
        """What the block counts at these points of a scan, known still if it was read lately."""
        if name not in self._read:
            self.scan(name)
        return self._read.pop(name)


def _check_name(name: str, names: Sequence[str]) -> None:
    if name not in names:
        raise InputError(f"scan: there is no {name!r:.80} in this block of the drive.")
