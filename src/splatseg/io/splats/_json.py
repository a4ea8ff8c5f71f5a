"""Reading JSON that others wrote: every access says what was expected and what came."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from splatseg.core.json_values import json_integer, json_number
from splatseg.errors import FileFormatError, quoted
from splatseg.io.json_files import parse_object


class Json:
    """A JSON value that knows its file and its place, for one-sentence errors."""

    def __init__(self, path: Path, value: Any, location: str = "") -> None:
        self.path = path
        self.value = value
        self.location = location

    @staticmethod
    def parse(path: Path, text: bytes) -> "Json":
        """Parse a document whose outermost value is an object.

        Raises:
            FileFormatError: If it is no JSON or no object.
        """
        return Json(path, parse_object(text, where=str(path)))

    def error(self, expected: str) -> FileFormatError:
        """The error to raise where this value is not what was expected."""
        return FileFormatError(
            f"{self.path}: expected {expected} at {self.location or 'the root'}, got "
            f"{quoted(self.value)}."
        )

    def __contains__(self, name: str) -> bool:
        return isinstance(self.value, dict) and name in self.value

    def __getitem__(self, name: str) -> "Json":
        """A member that must be there."""
        if not isinstance(self.value, dict):
            raise self.error("an object")
        if name not in self.value:
            location = self.location or "the root"
            raise FileFormatError(
                f"{self.path}: expected a member {name!r} at {location}, got none."
            )
        return Json(self.path, self.value[name], f"{self.location}.{name}".lstrip("."))

    def names(self) -> list[str]:
        """The members of an object."""
        if not isinstance(self.value, dict):
            raise self.error("an object")
        return list(self.value)

    def items(self) -> Iterator["Json"]:
        """The elements of a list."""
        if not isinstance(self.value, list):
            raise self.error("a list")
        for i, value in enumerate(self.value):
            yield Json(self.path, value, f"{self.location}[{i}]")

    def optional_items(self, name: str) -> list["Json"]:
        """The elements of a member that is a list; nothing if it is absent."""
        return list(self[name].items()) if name in self else []

    def element(self, index: int) -> "Json":
        """One element of a list, by an index that some file gave."""
        if not isinstance(self.value, list) or not 0 <= index < len(self.value):
            raise self.error(f"a list with an element {index}")
        return Json(self.path, self.value[index], f"{self.location}[{index}]")

    def text(self) -> str:
        """A string."""
        if not isinstance(self.value, str):
            raise self.error("a string")
        return self.value

    def flag(self) -> bool:
        """True or false."""
        if not isinstance(self.value, bool):
            raise self.error("true or false")
        return self.value

    def integer(self, low: int = 0) -> int:
        """A whole number that is at least `low`."""
        try:
            return json_integer(self.value, where="", low=low)
        except FileFormatError:
            raise self.error(f"a whole number of at least {low}") from None

    def number(self) -> float:
        """A finite number."""
        try:
            return json_number(self.value, where="")
        except FileFormatError:
            raise self.error("a finite number") from None

    def numbers(self, *, min_count: int, max_count: int | None = None) -> list[float]:
        """A list of finite numbers, `min_count` to `max_count` of them (`min_count` by default)."""
        max_count = min_count if max_count is None else max_count
        result = [item.number() for item in self.items()]
        if not min_count <= len(result) <= max_count:
            raise self.error(
                f"{min_count if min_count == max_count else f'{min_count} to {max_count}'} numbers"
            )
        return result
