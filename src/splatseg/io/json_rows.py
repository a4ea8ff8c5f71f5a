"""Lists of objects in JSON, read row by row: a table may be larger than memory."""

import codecs
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from splatseg.errors import FileFormatError, quoted, reason
from splatseg.io.foreign import reading

_CHUNK = 1 << 20
_MAX_ROW = 1 << 24
"""Characters of one row; those of real tables have a thousand."""

_SPACE = re.compile(r"[ \t\r\n]*")
_LONE = re.compile("[\ud800-\udfff]")


def read_json_rows(path: Path) -> Iterator[dict[str, Any]]:
    """The objects of a file that is one JSON list of objects, in its order.

    Their numbers are unchecked: `core.json_numbers` takes them out.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is not JSON, no list, ends early, or holds something else than
            objects, or one of more than 16 million characters.
    """
    with reading(path, "a JSON file"):
        stream = path.open("rb")
    with stream:
        yield from _rows(path, stream)


def _rows(path: Path, stream: BinaryIO) -> Iterator[dict[str, Any]]:
    text = _Text(path, stream)
    if text.next() != "[":
        raise FileFormatError(f"{path}: expected a JSON list of objects, got something else.")
    text.drop(1)
    if text.next() == "]":
        text.drop(1)
    else:
        while True:
            yield text.value()
            sign = text.next()
            if sign not in (",", "]"):
                raise FileFormatError(f"{path}: expected a JSON list, but it ends or breaks early.")
            text.drop(1)
            if sign == "]":
                break
    if text.next():
        raise FileFormatError(f"{path}: expected one JSON list, got more behind it.")


class _Text:
    """Text of a file of which a piece is in memory."""

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self._path, self._stream = path, stream
        self._decode = codecs.getincrementaldecoder("utf-8-sig")()
        self._scan = json.JSONDecoder().raw_decode
        self._piece, self._at, self._ended = "", 0, False

    def next(self) -> str:
        """The next sign that is no space, empty at the end."""
        while True:
            found = _SPACE.match(self._piece, self._at)
            self._at = len(self._piece) if found is None else found.end()
            if self._at < len(self._piece):
                return self._piece[self._at]
            if self._ended:
                return ""
            self._more()

    def drop(self, count: int) -> None:
        """Pass over signs."""
        self._at += count

    def value(self) -> dict[str, Any]:
        """The object that begins at the next sign."""
        self.next()
        while True:
            try:
                value, end = self._scan(self._piece, self._at)
            except (ValueError, RecursionError) as error:
                if self._ended or len(self._piece) - self._at > _MAX_ROW:
                    raise FileFormatError(
                        f"{self._path}: expected JSON, but a row cannot be parsed "
                        f"({reason(error)})."
                    ) from error
                self._more()
                continue
            if not isinstance(value, dict):
                raise FileFormatError(
                    f"{self._path}: expected a list of JSON objects, got {quoted(value)} in it."
                )
            escaped = "\\u" in self._piece[self._at : end]
            if escaped and _LONE.search(json.dumps(value, ensure_ascii=False)) is not None:
                raise FileFormatError(f"{self._path}: expected Unicode text, got {quoted(value)}.")
            self._at = end
            return value

    def _more(self) -> None:
        with reading(self._path, "a JSON file"):
            content = self._stream.read(_CHUNK)
            text = self._decode.decode(content, final=not content)
        self._ended = not content
        self._piece = self._piece[self._at :] + text
        self._at = 0
