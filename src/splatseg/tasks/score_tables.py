"""Tables of scores as files: CSV, Markdown or LaTeX, by their ending."""

import html
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from splatseg.errors import InputError
from splatseg.io.atomic import atomic_file
from splatseg.io.tables import csv_text

Cell = str | int | float

_LATEX = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_{}"}
    | {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"}
    | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}
)
_MARKUP = re.compile(r"[\\`|\[\]]")
"""What Markdown makes code, cells, links and pictures of."""

_ENDINGS = (".csv", ".md", ".tex")


def check_table_file(name: str, path: Path | None) -> None:
    """Refuse a file that no table can be written to, before anything is scored.

    Raises:
        InputError: If its ending is none of a table's, or its folder is not there.
    """
    if path is None:
        return
    if path.suffix.lower() not in _ENDINGS:
        raise InputError(f"{name}: expected a file that ends in .csv, .md or .tex, got {path}.")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{name}: expected an existing folder to write {path} in.")


def write_class_table(figures: Mapping[str, Any], path: Path) -> None:
    """Write one row a class (id, name, pixels of the truth, IoU), and the mean.

    Args:
        path: The file; its ending says the format.
        figures: What `evaluate` gave for the metric semantic.

    Raises:
        InputError: If the figures are of another metric, or the ending is none of a table's.
    """
    names, pixels = figures.get("names_per_class"), figures.get("pixels_per_class")
    if names is None or pixels is None:
        raise InputError("table: expected scores of classes (metric semantic), got others.")
    rows: list[list[Cell]] = [
        [int(id), names[id], pixels[id], float(iou)] for id, iou in figures["per_class"].items()
    ]
    rows.append(["", "mean", sum(pixels.values()), float(figures["mIoU"])])
    write_table(rows, path, columns=["id", "class", "pixels", "IoU"])


def write_confusion(figures: Mapping[str, Any], path: Path) -> None:
    """Write the confusion matrix: pixels, one row a true class, one column a class of the layer.

    Raises:
        InputError: If the figures are of another metric, or the ending is none of a table's.
    """
    matrix = figures.get("confusion")
    if matrix is None:
        raise InputError("confusion: expected scores of classes (metric semantic), got others.")
    names = [matrix["names"][str(id)] for id in matrix["predicted"]]
    rows: list[list[Cell]] = [
        [matrix["names"][str(id)], *counts]
        for id, counts in zip(matrix["true"], matrix["counts"], strict=True)
    ]
    write_table(rows, path, columns=["true class", *names])


def write_table(rows: Sequence[Sequence[Cell]], path: Path, *, columns: Sequence[str]) -> None:
    """Write rows under the names of columns; numbers stand right.

    Raises:
        InputError: If the ending is none of a table's, or the folder is not there.
    """
    check_table_file("table", path)
    made = {".csv": csv_text, ".md": _markdown, ".tex": _latex}[path.suffix.lower()]
    with atomic_file(path) as temporary:
        temporary.write_text(made(columns, rows), encoding="utf-8", newline="\n")


def _shown(cell: Cell) -> str:
    return f"{cell:.4f}" if isinstance(cell, float) else str(cell)


def _markdown(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    def line(cells: Sequence[Cell]) -> str:
        shown = (
            _MARKUP.sub(r"\\\g<0>", html.escape(" ".join(_shown(cell).split()), quote=False))
            for cell in cells
        )
        return "| " + " | ".join(shown) + " |"

    rule = "| " + " | ".join(_rules(columns, rows, "---", "---:")) + " |"
    return "\n".join([line(columns), rule, *map(line, rows)]) + "\n"


def _latex(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    def line(cells: Sequence[Cell]) -> str:
        shown = (" ".join(_shown(cell).split()).translate(_LATEX) for cell in cells)
        return " & ".join(shown) + r" \\"

    sides = "".join(_rules(columns, rows, "l", "r"))
    head = [rf"\begin{{tabular}}{{{sides}}}", r"\hline", line(columns), r"\hline"]
    return "\n".join([*head, *map(line, rows), r"\hline", r"\end{tabular}"]) + "\n"


def _rules(
    columns: Sequence[str], rows: Sequence[Sequence[Cell]], words: str, numbers: str
) -> list[str]:
    """How each column stands: words left, numbers right."""
    return [
        numbers if any(isinstance(row[i], int | float) for row in rows) else words
        for i in range(len(columns))
    ]
