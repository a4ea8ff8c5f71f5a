"""JSON in files: read with clear errors, written whole."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from splatseg.core.json_values import plain_json
from splatseg.errors import FileFormatError, MissingFileError
from splatseg.io.atomic import atomic_file


def parse_object(text: str | bytes, *, where: str) -> dict[str, Any]:
    """A JSON object from text; `where` starts the message of an error.

    Raises:
        FileFormatError: If it is not JSON, or holds something other than an object.
    """
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(
            f"{where}: expected JSON, but it cannot be parsed ({error})."
        ) from error
    if not isinstance(value, dict):
        raise FileFormatError(f"{where}: expected a JSON object, got {type(value).__name__}.")
    return cast(dict[str, Any], value)


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is not JSON, or holds something other than an object.
    """
    try:
        text = path.read_bytes()
    except FileNotFoundError as error:
        raise MissingFileError(f"{path}: there is no such file.") from error
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror}).") from error
    return parse_object(text, where=str(path))


def json_text(name: str, value: Mapping[str, Any], *, indent: int | None = None) -> str:
    """Text of a JSON object that reads back as the same values (tuples as lists).

    Numbers are written with the fewest digits that give the same float64.

    Raises:
        InputError: If it holds a key that is no string, NaN, infinity, or an object that JSON
            has no word for; `name` starts the message.
    """
    return json.dumps(plain_json(name, value), indent=indent, ensure_ascii=False, allow_nan=False)


def write_json(value: Mapping[str, Any], path: Path) -> None:
    """Write a JSON object for people to read; atomic.

    Raises:
        InputError: If a value has no place in JSON.
    """
    text = json_text(path.name, value, indent=1)
    with atomic_file(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8", newline="\n")
