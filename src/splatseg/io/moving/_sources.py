"""Scans as they are read, without moving things."""

from collections.abc import Mapping, Sequence

import torch

from splatseg._check import check_choice
from splatseg.core import ScanSource
from splatseg.core.boundary import boundary
from splatseg.core.scans import MovingBox, Scan, boxes_at, inside_boxes
from splatseg.io.moving._times import CLOCKS, Clock, scan_time


class StaticScans:
    """Scans without their points in boxes of moving things; a `core.ScanSource`.

    The boxes of a scan are those that are there at its time: `Scan.time`, unless `clock` says
    frames, else the last number in its name, which counts the frames.

    Args:
        scans: The scans.
        boxes: Boxes of moving things.
        margin: By how much boxes are larger on every side, scene units.
        clock: What the times of boxes are.
        times: When scans were measured, by their names, where that is known better.
    """

    @boundary
    def __init__(
        self,
        scans: ScanSource,
        boxes: Sequence[MovingBox],
        *,
        margin: float = 0.0,
        clock: Clock = "recorded",
        times: Mapping[str, float] | None = None,
    ) -> None:
        self._scans, self._boxes = scans, tuple(boxes)
        self._margin, self._times = margin, dict(times or {})
        check_choice("clock", clock, CLOCKS)
        self._clock: Clock = clock

    @property
    def scan_names(self) -> Sequence[str]:
        """All scans."""
        return self._scans.scan_names

    def scan(self, name: str) -> Scan:
        """One of them without what moves.

        Raises:
            InputError: If there is none of that name, its file is broken, or it has no time.
        """
        scan = self._scans.scan(name)
        known = self._times.get(name)
        time = scan_time(scan, self._clock) if known is None else known
        there = boxes_at(self._boxes, time)
        moving = inside_boxes(scan.points, there, margin=self._margin)
        return scan.take(torch.nonzero(~moving).squeeze(1)) if bool(moving.any()) else scan
