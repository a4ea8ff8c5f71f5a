"""Tables: CSV for spreadsheets, and classes as JSON rows (id, name, isthing, colour [r, g, b])."""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from msgspec import Meta

from splatseg.core import ClassInfo, ClassTable
from splatseg.io.foreign import derived_from
from splatseg.io.schema import structured

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


_Byte = Annotated[int, Meta(ge=0, le=255)]


@dataclass(frozen=True, slots=True)
class _Row:
    id: Annotated[int, Meta(ge=0, le=2**31 - 1)]
    name: str
    isthing: Any = True
    """COCO has 0 and 1."""

    colour: tuple[_Byte, _Byte, _Byte] | None = None


def class_table(rows: object, *, where: str, keep_zero: bool = False) -> ClassTable:
    """A class table from its JSON rows; ``isthing`` (true) and ``colour`` may lack.

    A row of id 0 is left out, as 0 is void in files, unless it is to be kept.

    Raises:
        FileFormatError: If a row has no integer id or no name; the message starts with `where`.
    """
    classes: list[ClassInfo] = []
    for i, row in enumerate(structured(rows, list[_Row], where=f"{where}: classes")):
        if keep_zero or row.id != 0:
            with derived_from(f"{where}: classes[{i}]"):
                thing = bool(row.isthing)
                classes.append(
                    ClassInfo(id=row.id, name=row.name, isthing=thing, colour=row.colour)
                )
    with derived_from(where):
        return ClassTable(rows=tuple(classes))


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
