"""Scans and label maps as they are read, without moving things."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from splatseg._check import check_choice
from splatseg.core import UNLABELLED, LabelMap, LabelSource, ScanSource, View
from splatseg.core.boundary import boundary
from splatseg.core.moving import MovingBox, boxes_at, inside_boxes
from splatseg.core.scans import Scan
from splatseg.core.scene import camera_of_map
from splatseg.io.images import load_mask
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


class MaskedLabels:
    """Label maps without the pixels that masks of views leave out; a `core.LabelSource`.

    Args:
        labels: Label maps of views.
        views: Views with their masks; maps of others are as they are.
    """

    @boundary
    def __init__(self, labels: LabelSource, views: Sequence[View]) -> None:
        self._labels = labels
        self._views = {view.name: view for view in views if view.mask is not None}

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have a label map."""
        return self._labels.view_names

    def label_map(self, name: str) -> LabelMap:
        """The label map of a view, -1 where its mask is 0.

        Raises:
            ShapeError: If the map is not of its view.
        """
        found = self._labels.label_map(name)
        if name not in self._views:
            return found
        view = self._views[name]
        used = load_mask(view)
        if used is None:
            return found
        camera_of_map(view, found.height, found.width)
        rows = torch.arange(found.height) * view.camera.height // found.height
        columns = torch.arange(found.width) * view.camera.width // found.width
        ignored = used[rows][:, columns] == 0
        return replace(found, ids=found.ids.masked_fill(ignored, UNLABELLED))
