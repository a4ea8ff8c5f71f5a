"""Segments of views: recorded evidence, on a coarser grid, and with the ids of a layer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg._check import check_rows
from splatseg.core import (
    UNLABELLED,
    Gaussians,
    LabelMap,
    Labels,
    LabelSource,
    MaskSet,
    Rle,
    SegmentSource,
    View,
    camera_of_map,
)
from splatseg.core.boundary import convert_fields
from splatseg.core.options import Share
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence, PanopticEvidence, TrackedEvidence
from splatseg.lift.label_maps import label_map


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EvidenceSegments:
    """Masks, panoptic segments or tracks of a folder as `associate` wants them.

    Raises:
        InputError: If the evidence is of another kind.
    """

    evidence: Evidence

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.evidence.kind not in ("masks", "panoptic", "tracked"):
            raise InputError(
                f"{self.evidence.folder}: expected segments of objects (masks, panoptic, "
                f"tracked), got {self.evidence.kind}."
            )

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have a file."""
        return self.evidence.view_names

    @property
    def overlapping(self) -> bool:
        """Masks may overlap, label maps cannot."""
        return self.evidence.kind == "masks"

    @property
    def persistent(self) -> bool:
        """Ids of tracks are meant to go through all views."""
        return self.evidence.kind == "tracked"

    def segments_of(self, name: str) -> LabelMap | MaskSet:
        """What the file of a view holds."""
        return self.evidence.masks(name) if self.overlapping else self.evidence.label_map(name)

    def categories_of(self, name: str) -> Mapping[int, int]:
        """Categories of panoptic segments, and of tracks by the votes under them."""
        match self.evidence:
            case PanopticEvidence():
                rows = self.evidence.segments(name)
                return {row.id: row.category for row in rows if row.category > 0}
            case TrackedEvidence():
                return self._track_categories(self.evidence)
            case _:
                return {}

    @staticmethod
    def _track_categories(evidence: TrackedEvidence) -> Mapping[int, int]:
        table = evidence.maps.table
        if table is None:
            return {}
        ids = {row.name: row.id for row in table.rows}
        return {track.id: ids[track.category] for track in evidence.tracks if track.category in ids}


def reduced_size(height: int, width: int, longest: int) -> tuple[int, int]:
    """Height and width in proportion, neither longer than that."""
    share = longest / max(height, width)
    if share >= 1:
        return height, width
    return max(1, round(share * height)), max(1, round(share * width))


def reduced_segments(segments: LabelMap | MaskSet, longest: int) -> LabelMap | MaskSet:
    """Segments on a coarser grid: each pixel takes what is at its middle."""
    h, w = reduced_size(segments.height, segments.width, longest)
    if (h, w) == (segments.height, segments.width):
        return segments

    def taken(picture: Tensor) -> Tensor:
        return at_middles(picture, h, w)

    if isinstance(segments, LabelMap):
        return LabelMap(ids=taken(segments.ids.cpu()))
    masks = tuple(Rle.encode(taken(mask.decode())) for mask in segments.masks)
    return replace(segments, height=h, width=w, masks=masks)


def at_middles(picture: Tensor, h: int, w: int) -> Tensor:
    """What is at the middle of each of h x w cells of a picture, be they larger than its pixels."""
    height, width = picture.shape
    down = ((torch.arange(h) + 0.5) * height / h).long()
    across = ((torch.arange(w) + 0.5) * width / w).long()
    return picture[down.unsqueeze(1), across]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReducedMaps:
    """Label maps with at most so many pixels along their longest side: a `LabelSource`."""

    source: LabelSource

    longest_side: int
    """Pixels. Larger maps take the pixel at the middle of each cell, its confidence included."""

    @property
    def view_names(self) -> Sequence[str]:
        """Views of the source."""
        return self.source.view_names

    def label_map(self, name: str) -> LabelMap:
        """The map of a view."""
        full = self.source.label_map(name)
        share = self.longest_side / max(full.height, full.width)
        if share >= 1:
            return full
        h, w = max(1, round(share * full.height)), max(1, round(share * full.width))
        confidence = full.confidence
        return LabelMap(
            ids=at_middles(full.ids.cpu(), h, w),
            confidence=None if confidence is None else at_middles(confidence.cpu(), h, w),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchedMaps:
    r"""A layer's ids with the boundaries of segments: a `LabelSource`.

    Segments have the boundaries that were seen, but ids of their view's own; a layer has ids that
    mean the same in all views, but boundaries that are as good as its Gaussians. Drawn in a view,
    the layer tells which of its ids each segment shows: the one with which it has the largest

    .. math:: \mathrm{IoU}(s, k) = \frac{|s \cap k|}{|s \cup k|}

    over the view's pixels. A segment that fits none by at least `min_overlap` says nothing, so
    what the model got wrong in this view, or what the layer does not have, is left out.

    Maps are made when they are asked for and not kept.

    Raises:
        ShapeError: If the layer has another number of rows than there are Gaussians.
        RangeError: If the least overlap is outside [0, 1].
    """

    gaussians: Gaussians
    views: Sequence[View]
    source: SegmentSource
    """Segments of the views."""

    labels: Labels
    """The layer whose ids the segments take."""

    min_overlap: Share = 0.2
    """Intersection over union, in [0, 1], that a segment must have with what the layer shows,
    the same that joins segments (`AssociateOptions.agreement`)."""

    min_labelled: Share = 0.0
    """Above 0, pixels at which the layer has no label are left out of a segment's overlap, as where
    the scene has grown, and of a segment at least this share must be labelled."""

    longest_side: int = 1000
    """Segments of larger photographs are read at this many pixels along their longest side;
    bounds time."""

    backend: str = "auto"

    def __post_init__(self) -> None:
        convert_fields(self)
        check_rows("labels", self.labels, len(self.gaussians))

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have segments."""
        known = set(self.source.view_names)
        return [view.name for view in self.views if view.name in known]

    def label_map(self, name: str) -> LabelMap:
        """Ids of a view; -1 where no segment says anything.

        Raises:
            InputError: If there is no such view.
            ShapeError: If the segments have not their photograph's proportions.
        """
        view = next((view for view in self.views if view.name == name), None)
        if view is None:
            raise InputError(f"views: expected a view {name}, got none.")
        segments = reduced_segments(self.source.segments_of(name), self.longest_side)
        camera = camera_of_map(view, segments.height, segments.width)
        hard = Labels(
            ids=self.labels.ids,
            confidence=self.labels.confidence,
            background=self.labels.background,
        )
        drawn = label_map(self.gaussians, camera, hard, backend=self.backend).ids.long()
        least = self.min_overlap, self.min_labelled
        if isinstance(segments, LabelMap):
            return _of_map(segments, drawn, least)
        return _of_masks(segments, drawn, least)


Least = tuple[float, float]
"""Overlap that a segment must have, and share of it that must be labelled (0 counts all of it)."""


def _of_map(segments: LabelMap, drawn: Int64[Tensor, "height width"], least: Least) -> LabelMap:
    """Segments that do not overlap: one table of how often each meets each id."""
    names, place = torch.unique(segments.ids.cpu().long(), return_inverse=True)
    ids, column = torch.unique(drawn, return_inverse=True)
    table = torch.bincount(
        (place * len(ids) + column).reshape(-1), minlength=len(names) * len(ids)
    ).view(len(names), len(ids))
    best, overlap = _best(table.double(), table.sum(0).double(), ids, least[1])
    chosen = torch.where((overlap >= least[0]) & (names != UNLABELLED), best, UNLABELLED)
    return LabelMap(ids=chosen[place].int())


def _of_masks(masks: MaskSet, drawn: Int64[Tensor, "height width"], least: Least) -> LabelMap:
    """Masks that overlap: each pixel takes the id of the best of those over it."""
    # Down one column after another, as the runs of masks go.
    flat = drawn.T.reshape(-1)
    ids, column = torch.unique(flat, return_inverse=True)
    whole = torch.bincount(column, minlength=len(ids)).double()
    column = column.int().numpy()
    found = np.full(len(flat), UNLABELLED, np.int32)
    strength = np.zeros(len(flat))
    for mask in masks.masks:
        inside = np.repeat(np.arange(len(mask.counts)) % 2 == 1, mask.counts)
        meets = torch.from_numpy(np.bincount(column[inside], minlength=len(ids))).double()
        best, overlap = _best(meets[None], whole, ids, least[1])
        if float(overlap) < least[0]:
            continue
        better = inside & (float(overlap) > strength)
        found[better], strength[better] = int(best), float(overlap)
    return LabelMap(ids=torch.from_numpy(found).view(drawn.T.shape).T.contiguous())


def _best(
    meets: Float[Tensor, "segments ids"],
    whole: Float[Tensor, "ids"],
    ids: Int64[Tensor, "ids"],
    min_labelled: float,
) -> tuple[Int64[Tensor, "segments"], Float[Tensor, "segments"]]:
    """For each segment the id that it overlaps most with (the smaller of equals), and how much.

    No label, -1, is no id.
    """
    areas = meets.sum(dim=1)
    labelled = meets[:, ids != UNLABELLED].sum(dim=1)
    union = (labelled if min_labelled > 0 else areas)[:, None] + whole - meets
    overlap = torch.where(union > 0, meets / union.clamp_min(1), 0.0)
    overlap[:, ids == UNLABELLED] = 0.0
    overlap[labelled < min_labelled * areas] = 0.0
    best = overlap.max(dim=1)
    return ids[best.indices], best.values
