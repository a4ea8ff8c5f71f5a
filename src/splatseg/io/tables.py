"""CSV that spreadsheets read as it is meant: text is text, whatever it begins with."""

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any, cast

from splatseg.core import ClassInfo, ClassTable
from splatseg.errors import FileFormatError, quoted
from splatseg.io.foreign import made_from

_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "\uff1d", "\uff0b", "\uff0d", "\uff20", "'")
"""What programs take for the begin of a formula, the wide forms included, and the mark itself."""


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table as CSV, with lines that end in a line feed; None is an empty cell.

    Text that a spreadsheet would take for a formula has an apostrophe before it, and so has text
    that begins with one: without the first apostrophe each cell is the name again.
    """
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerows([_cell(cell) for cell in row] for row in (columns, *rows))
    return file.getvalue()


def _cell(value: object) -> object:
    """Text that no spreadsheet takes for a formula: names may come from files of others."""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value


# Class tables as JSON rows: id, name, isthing and, where there is one, colour [r, g, b].


_MAX_ID = 2**31 - 1
"""Ids are int32."""


def class_table(rows: object, *, where: str, keep_zero: bool = False) -> ClassTable:
    """A class table from its JSON rows; ``isthing`` (true) and ``colour`` may lack.

    A row of id 0 is left out, as 0 is void in files, unless it is to be kept.

    Raises:
        FileFormatError: If a row has no integer id or no name; the message starts with `where`.
    """
    if not isinstance(rows, list):
        raise FileFormatError(f"{where}: expected a list of classes, got {type(rows).__name__}.")
    table = [
        _class_info(row, where=f"{where}: classes[{i}]")
        for i, row in enumerate(cast(list[object], rows))
    ]
    ids = [row.id for row in table]
    if len(set(ids)) != len(ids):
        raise FileFormatError(f"{where}: expected classes of distinct ids, got one twice.")
    return ClassTable(rows=tuple(row for row in table if keep_zero or row.id != 0))


def class_rows(table: ClassTable) -> list[dict[str, Any]]:
    """JSON rows of a class table. Inverse of `class_table`."""
    return [
        {
            "id": row.id,
            "name": row.name,
            "isthing": row.isthing,
            **({} if row.colour is None else {"colour": list(row.colour)}),
        }
        for row in table.rows
    ]


def _class_info(row: object, *, where: str) -> ClassInfo:
    if not isinstance(row, dict):
        raise FileFormatError(f"{where}: expected an object, got {type(row).__name__}.")
    entry = cast(dict[str, Any], row)
    id, name, colour = entry.get("id"), entry.get("name"), entry.get("colour")
    if isinstance(id, bool) or not isinstance(id, int) or id < 0 or not isinstance(name, str):
        raise FileFormatError(f"{where}: expected an integer id and a name, got {quoted(entry)}.")
    if id > _MAX_ID:
        raise FileFormatError(f"{where}: expected an id up to {_MAX_ID}, got {quoted(id)}.")
    if colour is not None:
        values = cast(list[object], colour) if isinstance(colour, list) else []
        if len(values) != 3 or not all(type(v) is int and 0 <= v <= 255 for v in values):
            raise FileFormatError(
                f"{where}: expected a colour of three bytes, got {quoted(colour)}."
            )
        colour = cast(tuple[int, int, int], tuple(values))
    with made_from(where):
        return ClassInfo(id=id, name=name, isthing=bool(entry.get("isthing", True)), colour=colour)
