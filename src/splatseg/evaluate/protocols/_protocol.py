"""A protocol: which layout, what is asked of a method, and every choice of how it is scored."""

from dataclasses import dataclass, fields, replace
from typing import Any

from splatseg.core.boundary import convert_fields
from splatseg.core.typed_text import typed_field
from splatseg.errors import InputError
from splatseg.evaluate.protocols._switches import Switches


@dataclass(frozen=True, slots=True, kw_only=True)
class Protocol:
    """An experiment of the field as data."""

    name: str
    """As ``splatseg bench NAME`` asks for it."""

    summary: str
    """What is asked and measured, one line, lower case, without a full stop."""

    layouts: tuple[str, ...]
    """Layouts of the data set that it reads, of `splatseg.io.benchmarks.LAYOUTS`."""

    reference: str
    """Who states it."""

    switches: Switches
    """Every choice; its class says what is asked: targets, maps, or points."""

    measure: str
    """The measure that it is known for, such as ``iou``."""

    scenes: tuple[str, ...] = ()
    """Its scenes; none where all of the data set are meant."""

    note: str = ""
    """What else should be known, such as what of the original is not settled."""

    def __post_init__(self) -> None:
        convert_fields(self)

    def with_switches(self, changes: dict[str, Any]) -> "Protocol":
        """The same protocol with other choices; results record them.

        Raises:
            InputError: If it has no such switch.
        """
        known = {field.name for field in fields(self.switches)}
        for name in changes:
            if name not in known:
                raise InputError(
                    f"switch: protocol {self.name} has {', '.join(sorted(known))}; got {name!r}."
                )
        return replace(self, switches=replace(self.switches, **changes))


def switch_value(protocol: Protocol, text: str) -> tuple[str, Any]:
    """Name and value of ``NAME=VALUE`` as a person types it.

    Raises:
        InputError: If it is not of this form, there is no such switch, or the value does not fit.

    Example:
        >>> from splatseg.evaluate.protocols import find_protocol
        >>> switch_value(find_protocol("spin-nerf"), "reference_scored=no")
        ('reference_scored', False)
    """
    return typed_field(type(protocol.switches), text, what="switch")
