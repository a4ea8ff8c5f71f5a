"""What the doctor says of a capture."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from splatseg.core import Capture


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One thing that is wrong."""

    name: str
    """A short name for programs: ``camera-axes``, ``inverted-poses``, ``scaled-intrinsics``,
    ``focal-length``, ``swapped-intrinsics``, ``principal-point``, ``half-pixel``,
    ``point-frame``, ``pose-frame``, ``up-axis``, ``image-size``, ``unexplained-poses`` or
    ``unexplained-points``."""

    sentence: str
    """What is wrong and how it shows, for people."""

    remedy: str
    """What corrects it; what `Diagnosis.corrected` has done."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Diagnosis:
    """The result of `diagnose`."""

    capture: Capture
    """As it was given."""

    faults: tuple[Fault, ...]
    """What is wrong, the cameras first. Empty for a healthy capture."""

    doubts: tuple[str, ...]
    """Sentences about what looks odd but is not certain, or not wrong enough to be a fault."""

    unchecked: tuple[str, ...]
    """Sentences about what could not be checked, and why."""

    figures: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """What was measured, in values that JSON holds; see ``docs/doctor.md``."""

    corrected: Capture | None = None
    """The capture with all faults corrected; None where it is healthy or no correction helps."""

    @property
    def healthy(self) -> bool:
        """Whether nothing is wrong as far as it could be checked."""
        return not self.faults
