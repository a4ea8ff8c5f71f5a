"""Whether work that was interrupted was begun with the options that are asked for now.

Options are recorded as they stand in a file's JSON. Programs grow: an option that a record does
not have is one that came later, and the work was done as if it had its default. An option that
only the record has was taken away since; at its default of then it changed nothing, at any other
value the work cannot go on as it began.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, cast


class Absent(Enum):
    """Where there is no value at all."""

    ABSENT = "no value"


ABSENT: Final = Absent.ABSENT

DIFFERENCES: Final = 240
"""Characters of a message that lists differences, whose names may be a file's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OptionDifference:
    """An option that is not what it was."""

    name: str

    recorded: Any
    """The value that the work was begun with; `ABSENT` if it is not known."""

    wanted: Any
    """The value that is asked for; `ABSENT` where the program does not know the option."""

    @property
    def text(self) -> str:
        """The difference in words: ``seed 1 instead of 2``."""
        if self.recorded is ABSENT:
            return f"no {self.name} instead of {json.dumps(self.wanted)}"
        recorded = f"{self.name} {json.dumps(self.recorded)}"
        if self.wanted is ABSENT:
            return f"{recorded}, an option that this splatseg does not have"
        return f"{recorded} instead of {json.dumps(self.wanted)}"


def differing_names(recorded: Mapping[str, Any], wanted: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of the entries that are not equal in both, in order."""
    return tuple(
        name for name in sorted({*recorded, *wanted}) if recorded.get(name) != wanted.get(name)
    )


def option_differences(
    recorded: Mapping[str, Any],
    wanted: Mapping[str, Any],
    *,
    defaults: Mapping[str, Any],
    recorded_defaults: Mapping[str, Any],
) -> tuple[OptionDifference, ...]:
    """Options that differ, by name; groups of options are looked into.

    Args:
        recorded: What the work was begun with, from JSON.
        wanted: What is asked for, in values as JSON gives them back.
        defaults: This program's: what an option counts as that is not recorded.
        recorded_defaults: Those of the program that made the record: a recorded option that this
            program does not know is no difference if it had this value.

    Example:
        >>> option_differences({"size": 3, "old": 1}, {"size": 3, "new": 7},
        ...                    defaults={"new": 7}, recorded_defaults={"old": 1})
        ()
        >>> option_differences({"size": 3}, {"size": 4}, defaults={}, recorded_defaults={})
        (OptionDifference(name='size', recorded=3, wanted=4),)
    """
    found: list[OptionDifference] = []
    for name in sorted({*recorded, *wanted}):
        before, now = recorded.get(name, ABSENT), wanted.get(name, ABSENT)
        default, old_default = defaults.get(name, ABSENT), recorded_defaults.get(name, ABSENT)
        if before is ABSENT:
            before = default
        groups = (_group(before), _group(now))
        if groups[0] is not None and groups[1] is not None:
            found += option_differences(
                groups[0],
                groups[1],
                defaults=_group(default) or {},
                recorded_defaults=_group(old_default) or {},
            )
        elif now is ABSENT and before == old_default:
            continue
        elif before != now:
            found.append(OptionDifference(name=name, recorded=before, wanted=now))
    return tuple(found)


def _group(value: object) -> Mapping[str, Any] | None:
    return cast("Mapping[str, Any]", value) if isinstance(value, Mapping) else None
