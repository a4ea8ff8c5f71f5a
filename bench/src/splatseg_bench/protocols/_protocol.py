"""A protocol: which layout, what is asked of a method, and every choice of how it is scored."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from splatseg.core.boundary import convert_fields
from splatseg.core.typed_text import typed_field
from splatseg.errors import InputError
from splatseg_bench.protocols._scene_lists import SceneList
from splatseg_bench.protocols._switches import RoomSwitches, Switches


@dataclass(frozen=True, slots=True, kw_only=True)
class Protocol:
    """An experiment of the field as data."""

    name: str
    """As ``splatseg bench NAME`` asks for it."""

    summary: str
    """What is asked and measured, one line, lower case, without a full stop."""

    layouts: tuple[str, ...]
    """Layouts of the data set that it reads, of `splatseg_bench.layouts.LAYOUTS`."""

    reference: str
    """Who states it."""

    switches: Switches
    """Every choice; its class says what is asked: targets, maps, or points."""

    measure: str
    """The measure that it is known for, such as ``iou``."""

    scenes: tuple[str, ...] = ()
    """Its scenes; none where all of the data set are meant."""

    scene_lists: Mapping[str, SceneList] = field(default_factory=dict[str, SceneList])
    """Lists of which the switch ``scene_list`` takes one to be the scenes."""

    note: str = ""
    """What else should be known, such as what of the original is not settled."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if isinstance(self.switches, RoomSwitches):
            object.__setattr__(self, "scenes", self._listed(self.switches.scene_list))

    def with_switches(self, changes: dict[str, Any]) -> "Protocol":
        """The same protocol with other choices; results record them.

        Raises:
            InputError: If it has no such switch.
        """
        known = {each.name for each in fields(self.switches)}
        for name in changes:
            if name not in known:
                raise InputError(
                    f"switch: protocol {self.name} has {', '.join(sorted(known))}; got {name!r}."
                )
        return replace(self, switches=replace(self.switches, **changes))

    def _listed(self, name: str) -> tuple[str, ...]:
        """Scenes of a list by its name; none where all are meant."""
        if name == "all":
            return ()
        if name not in self.scene_lists:
            raise InputError(
                f"scene_list: protocol {self.name} has {', '.join((*self.scene_lists, 'all'))}; "
                f"got {name!r}."
            )
        return self.scene_lists[name].scenes


def switch_value(protocol: Protocol, text: str) -> tuple[str, Any]:
    """Name and value of ``NAME=VALUE`` as a person types it.

    Raises:
        InputError: If it is not of this form, there is no such switch, or the value does not fit.

    Example:
        >>> from splatseg_bench.protocols import find_protocol
        >>> switch_value(find_protocol("spin-nerf"), "reference_scored=no")
        ('reference_scored', False)
    """
    return typed_field(type(protocol.switches), text, what="switch")
