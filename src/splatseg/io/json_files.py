"""JSON in files: read with clear errors, and written whole."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from splatseg.core.json_values import plain_json
from splatseg.errors import FileFormatError, InputError, quoted, reason
from splatseg.io.atomic import atomic_file
from splatseg.io.foreign import expect, malformed, read_bytes

_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]|[\ud800-\udfff]")


def parse_object(text: str | bytes, *, where: str) -> dict[str, Any]:
    """A JSON object from text; `where` starts the message of an error.

    Its numbers are unchecked: `io.schema` and `core.json_values` take them out.

    Raises:
        FileFormatError: If it is not JSON, holds something other than an object, or text in it is
            no Unicode (half of a pair of surrogates).
    """
    value = _parsed(text, where=where)
    if not isinstance(value, dict):
        raise FileFormatError(f"{where}: expected a JSON object, got {type(value).__name__}.")
    return cast(dict[str, Any], value)


def _parsed(text: str | bytes, *, where: str) -> object:
    try:
        decoded = text if isinstance(text, str) else text.decode(json.detect_encoding(text))
        value = json.loads(decoded)
    except (ValueError, RecursionError) as error:
        raise malformed(where, f"JSON, but it cannot be parsed ({reason(error)})") from error
    if _SURROGATE.search(decoded) is not None:
        try:
            json.dumps(value, ensure_ascii=False).encode()
        except (UnicodeEncodeError, RecursionError) as error:
            raise malformed(where, f"Unicode text ({reason(error)})") from error
    return value


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is not JSON, or holds something other than an object.
    """
    return parse_object(read_bytes(path, "a JSON file"), where=str(path))


def read_json_value(path: Path) -> Any:
    """Whatever JSON a file holds: others write lists, where we write objects.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is not JSON.
    """
    return _parsed(read_bytes(path, "a JSON file"), where=str(path))


def json_text(name: str, value: Mapping[str, Any], *, indent: int | None = None) -> str:
    """Text of a JSON object that reads back as the same values (tuples as lists).

    Numbers are written with the fewest digits that give the same float64.

    Raises:
        InputError: If it holds a key that is no string, NaN, infinity, an object that JSON has no
            word for, or bytes of a file name that are no UTF-8; `name` starts the message.
    """
    text = json.dumps(plain_json(name, value), indent=indent, ensure_ascii=False, allow_nan=False)
    try:
        text.encode()
    except UnicodeEncodeError as error:
        around = text[max(error.start - 20, 0) : error.end + 20]
        raise InputError(f"{name}: expected text that UTF-8 can hold, got {around!r}.") from error
    return text


def check_version(
    path: Path, content: Mapping[str, Any], *, format: str, version: int, what: str
) -> None:
    """Refuse a file of ours that is of another format, or of a later version.

    Raises:
        FileFormatError: If it is.
    """
    found = content.get("version")
    if content.get("format") != format or type(found) is not int:
        raise FileFormatError(f"{path}: expected {what}, got {quoted(content.get('format'))}.")
    wanted = f"{what} of version {version} or less, got version {quoted(found)}; a later splatseg "
    wanted += "wrote it"
    expect(1 <= found <= version, path, wanted)


def write_json(value: Mapping[str, Any], path: Path) -> None:
    """Write a JSON object for people to read; atomic.

    Raises:
        InputError: If a value has no place in JSON.
        OutputError: If the disk is full, or there is no permission.
    """
    text = json_text(path.name, value, indent=1)
    with atomic_file(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8", newline="\n")
