"""What a file's JSON must look like, declared as dataclasses and held to them in one place.

    @dataclass(frozen=True, slots=True)
    class Frame:
        file_path: str
        transform_matrix: tuple[Row, Row, Row, Row]
        w: Annotated[int, Meta(ge=1)] | None = None

    frame = structured(value, Frame, where=f"{path}: frames[3]")

Types, ranges, lengths and choices stand in the annotations (`msgspec.Meta`); fields without a
default must be there, others in the file are left alone. Numbers are finite.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar, cast

import msgspec

from splatseg.errors import FileFormatError, quoted

T = TypeVar("T")
_PLACE = re.compile(r"^(?P<what>.*?)(?: - at `(?:key in )?\$(?P<at>.*)`)?$", re.DOTALL)
_STEP = re.compile(r"\.([^.\[]+)|\[(\d+|\.\.\.)\]")
_MISSING = re.compile(r"^Object missing required field `(.*)`$")


def structured(value: object, kind: type[T], *, where: str) -> T:
    """A value of a file as the declared type.

    Args:
        value: What JSON gave.
        kind: A dataclass, or any type that `msgspec.convert` knows.
        where: File, and place in it, which start the message of an error.

    Raises:
        FileFormatError: If it is not of this form, with the place, what is expected and what came.
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise FileFormatError(_sentence(value, str(error), where)) from error


def _sentence(value: object, message: str, where: str) -> str:
    found = _PLACE.match(message)
    what, at = (found["what"], found["at"] or "") if found else (message, "")
    place = f"{where}: {at.removeprefix('.')}" if at else where
    missing = _MISSING.match(what)
    if missing is not None:
        return f"{place}: expected a field {missing[1]}, got none."
    what = _plain(what)
    here = _found(value, at)
    came = "" if here is None else f", got {here}"
    return f"{place}: {what}{came}."


_WORDS = {
    "`int`": "a whole number",
    "`float`": "a number",
    "`str`": "text",
    "`bool`": "true or false",
    "`object`": "an object",
    "`array`": "a list",
    "`null`": "null",
    "`int | float`": "a number",
}


def _plain(what: str) -> str:
    """What msgspec says in those of this library."""
    what = what.split(", got ")[0]
    for theirs, ours in _WORDS.items():
        what = what.replace(theirs, ours)
    return what[:1].lower() + what[1:].replace("`", "")


def _found(value: object, at: str) -> str | None:
    """The value at a place of msgspec's (``.frames[3].w``), in words."""
    for name, index in _STEP.findall(at):
        if name and isinstance(value, Mapping):
            value = cast("Mapping[str, Any]", value).get(name)
        elif index.isdigit() and isinstance(value, Sequence) and not isinstance(value, str):
            value = cast("Sequence[Any]", value)[int(index)]
        else:
            return None
    if isinstance(value, (bool, int, float, str)) or value is None:
        return quoted(value)
    return f"{'an object' if isinstance(value, Mapping) else 'a list'} of {len(cast('Any', value))}"
