"""Recorded evidence as segments of views."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from splatseg.core import LabelMap, MaskSet
from splatseg.core.boundary import convert_fields
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence, PanopticEvidence, TrackedEvidence


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
