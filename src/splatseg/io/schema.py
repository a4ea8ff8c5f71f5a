"""What a file must hold, declared once: JSON as dataclasses, arrays by shape and kind of number.

    @dataclass(frozen=True, slots=True)
    class Frame:
        file_path: str
        transform_matrix: tuple[Row, Row, Row, Row]
        w: Annotated[int, Meta(ge=1)] | None = None

    frame = structured(value, Frame, where=f"{path}: frames[3]")

Types, ranges, lengths and choices stand in the annotations (`msgspec.Meta`); fields without a
default must be there, others in the file are left alone. Numbers are finite and at most
`MAX_NUMBER`, unless their range has the extra `MAY_BE_INFINITE`; whole ones may be written 3.0.
"""

import functools
import re
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from itertools import count, repeat
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union, cast

import msgspec
from msgspec import Meta
from numpy.typing import NDArray

from splatseg.core.json_values import MAX_NUMBER
from splatseg.errors import FileFormatError, quoted
from splatseg.io.foreign import malformed
from splatseg.io.json_files import read_json_value

T = TypeVar("T")
MAX_SIDE = 1 << 24
"""Pixels a side of a picture that a file may speak of."""

Side = Annotated[int, Meta(ge=1, le=MAX_SIDE)]
Whole = Annotated[int, Meta(ge=0, le=2**63 - 1)]
"""A whole number of at least 0 that 64 bits hold, such as an id."""

Name = Annotated[str, Meta(min_length=1)]

_MAX_WHOLE = 2**53
_PLACE = re.compile(r"^(?P<what>.*?)(?: - at `(?:key in )?\$(?P<at>.*)`)?$", re.DOTALL)
_STEP = re.compile(r"\.([^.\[]+)|\[(\d+|\.\.\.)\]")
_MISSING = re.compile(r"^Object missing required field `(.*)`$")
_WORDS = (
    (r"Invalid enum value .*", "expected one of the words that are known"),
    (r"Number out of range", "expected a number that can be held"),
    (r" (of length )?>= (-?[\d.]+?)(\.0)?$", r" \1of at least \2"),
    (r" (of length )?<= (-?[\d.]+?)(\.0)?$", r" \1of at most \2"),
    (r" > (-?[\d.]+?)(\.0)?$", r" above \1"),
    (r" < (-?[\d.]+?)(\.0)?$", r" below \1"),
    ("of length of", "of length"),
    ("`int`", "a whole number"),
    (r"`(int \| )?float`", "a number"),
    ("`str`", "text"),
    ("`bool`", "true or false"),
    ("`object`", "an object"),
    ("`array`", "a list"),
    (r"`([a-z]+) \| null`", r"`\1` or null"),
)  # fmt: skip
_TYPES = {
    "int": "a whole number", "float": "a number", "str": "text", "bool": "true or false",
    "object": "an object", "array": "a list", "null": "null",
}  # fmt: skip
_KINDS = {
    "iuf": "numbers",
    "iu": "whole numbers",
    "f": "real numbers",
    "bui": "booleans or whole numbers",
    "U": "text",
}


def check_array(
    where: object, name: str, array: NDArray[Any], shape: Sequence[object], kinds: str = "iuf"
) -> NDArray[Any]:
    """An array of a file, if it has a shape and a kind of number.

    Args:
        where: The file.
        name: What the array is called.
        array: It.
        shape: Lengths of its axes; a word is any length, called so.
        kinds: NumPy's letters of kinds of numbers.

    Raises:
        FileFormatError: If it has others.
    """
    fits = len(shape) == array.ndim and all(
        isinstance(axis, str) or axis == length
        for axis, length in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in kinds:
        axes = ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")
        what = _KINDS.get(kinds, "numbers")
        raise malformed(
            where, f"{name} of shape ({axes}) in {what}, got {array.dtype} of {array.shape}"
        )
    return array


def read_structured(path: Path, kind: type[T]) -> T:
    """A JSON file as the declared type, see `structured`.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no JSON, or not of this form.
    """
    return structured(read_json_value(path), kind, where=path)


def structured(value: object, kind: type[T], *, where: object, strict: bool = True) -> T:
    """A value of a file as the declared type.

    Args:
        value: What JSON gave.
        kind: A dataclass, or any type that `msgspec.convert` knows.
        where: File, and place in it, which start the message of an error.
        strict: Without, numbers may be text, as in XML.

    Raises:
        FileFormatError: If it is not of this form, with the place, what is expected and what came.
    """
    try:
        found = _converted(value, kind, strict=strict)
    except msgspec.ValidationError as error:
        raise FileFormatError(_sentence(value, kind, str(error), where)) from error
    except RecursionError as error:
        raise malformed(where, "values within each other, got too many") from error
    if (bad := _strange(kind, found)) is not None:
        raise malformed(_place(where, bad[0]), f"a finite number up to {MAX_NUMBER:g}", bad[1])
    return found


def _converted(value: object, kind: type[T], *, strict: bool = True) -> T:
    try:
        return msgspec.convert(value, kind, strict=strict)
    except msgspec.ValidationError as error:
        if "got `float`" not in str(error):
            raise
    return msgspec.convert(_with_whole_numbers(value), kind, strict=strict)


def _with_whole_numbers(value: Any) -> Any:
    """The same with 3 for 3.0, which JSON does not tell apart."""
    if isinstance(value, float) and value.is_integer() and abs(value) < _MAX_WHOLE:
        return int(value)
    if isinstance(value, dict):
        return {k: _with_whole_numbers(v) for k, v in cast("dict[Any, Any]", value).items()}
    if isinstance(value, list):
        return [_with_whole_numbers(v) for v in cast("list[Any]", value)]
    return value


@functools.cache
def _numbers_in(kind: Any, within: tuple[Any, ...] = ()) -> Any:
    """Where a type has numbers that must be finite; None where it has none.

    `float`, the types of fields by name, (class, type) of members of a union, or the type of items.
    A class that is among those it is within, as a field of itself, counts as having some.
    """
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if kind is float:
        return float
    if origin is Annotated:
        free = any(m.extra and m.extra.get("infinite") for m in args[1:] if hasattr(m, "extra"))
        return None if free else _numbers_in(args[0], within)
    if isinstance(kind, type) and is_dataclass(kind):
        if kind in within:
            return kind
        hints = typing.get_type_hints(kind, include_extras=True)
        within = (*within, kind)
        return {name: hint for name, hint in hints.items() if _numbers_in(hint, within)} or None
    inner = [arg for arg in args if _numbers_in(arg, within)]
    if origin not in (Union, types.UnionType):
        return tuple(inner[:1]) or None
    plain = ((typing.get_args(m)[0] if typing.get_origin(m) is Annotated else m) for m in inner)
    return [(typing.get_origin(p) or p, one) for p, one in zip(plain, inner, strict=True)] or None


def _strange(kind: Any, value: Any) -> tuple[str, float] | None:
    """Where in a value of a type a number is that is NaN, infinite or too large, and the number."""
    numbers = _numbers_in(kind)
    if numbers is float:
        return None if abs(value) <= MAX_NUMBER else ("", value)
    if isinstance(numbers, list):
        for cls, one in numbers:
            if isinstance(value, cls) and (bad := _strange(one, value)) is not None:
                return bad
        return None
    named = isinstance(numbers, dict)
    if named:
        parts = ((name, one, getattr(value, name)) for name, one in numbers.items())
    elif numbers:
        keys, items = (value, value.values()) if isinstance(value, dict) else (count(), value)
        if _numbers_in(numbers[0]) is float and all(abs(item) <= MAX_NUMBER for item in items):
            return None
        parts = zip(keys, repeat(numbers[0]), items)
    else:
        return None
    for key, one, part in parts:
        if (bad := _strange(one, part)) is not None:
            return (f".{key}" if named else f"[{quoted(key)}]") + bad[0], bad[1]
    return None


def _place(where: object, at: str) -> str:
    """A file and a place in it: ``FILE: frames[3].w``."""
    if not at or at.startswith("["):
        return f"{where}{at}"
    return f"{where}: {at.removeprefix('.')}"


def _sentence(value: object, kind: type[Any], message: str, where: object) -> str:
    found = _PLACE.match(message)
    what, at = (found["what"], found["at"] or "") if found else (message, "")
    steps = [name or index for name, index in _STEP.findall(at)]
    if "..." in steps:
        steps = _with_keys(value, kind, steps)
    place = _place(where, "".join(f"[{s}]" if s.isdigit() else f".{s}" for s in steps))
    missing = _MISSING.match(what)
    if missing is not None:
        return f"{place}: expected a field {missing[1]}, got none."
    return f"{place}: {_in_our_words(what)}, got {_in_words(_at(value, steps))}."


def _in_our_words(what: str) -> str:
    """What msgspec says in the words of this library."""
    what = re.sub(r"`([a-z]+(?: \| [a-z]+)+)`", _alternatives, what.split(", got ")[0])
    for theirs, ours in _WORDS:
        what = re.sub(theirs, ours, what)
    return what[:1].lower() + what[1:]


def _alternatives(found: "re.Match[str]") -> str:
    return " or ".join(dict.fromkeys(_TYPES.get(name, name) for name in found[1].split(" | ")))


def _in_words(value: object) -> str:
    if isinstance(value, Mapping):
        return f"an object of {len(cast('Any', value))}"
    if isinstance(value, list):
        return f"a list of {len(cast('Any', value))}"
    return quoted(value)


def _at(value: Any, steps: Sequence[str]) -> Any:
    """The value at a place."""
    for step in steps:
        value = value[int(step)] if isinstance(value, list) else value[step]
    return value


def _with_keys(value: Any, kind: type[Any], steps: Sequence[str]) -> list[str]:
    """A place of msgspec's, which does not tell keys of mappings, with the first that is wrong."""
    index = steps.index("...")
    before = steps[:index]
    keys = list(_at(value, before))
    while len(keys) > 1:
        half = keys[: len(keys) // 2]
        keys = half if _fails(_with_only(value, before, half), kind) else keys[len(half) :]
    found = [*before, keys[0], *steps[index + 1 :]]
    return _with_keys(value, kind, found) if "..." in found else found


def _fails(value: object, kind: type[Any]) -> bool:
    try:
        _converted(value, kind)
    except msgspec.ValidationError:
        return True
    return False


def _with_only(value: Any, steps: Sequence[str], keys: Sequence[str]) -> Any:
    """The value with some keys alone in the mapping at a place."""
    if not steps:
        return {key: value[key] for key in keys}
    copied: Any = value.copy()
    step: Any = int(steps[0]) if isinstance(value, list) else steps[0]
    copied[step] = _with_only(value[step], steps[1:], keys)
    return copied
