"""CSV that spreadsheets read as it is meant: text is text, whatever it begins with."""

import csv
import io
from collections.abc import Iterable, Sequence

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
