"""Class tables of well-known data sets by name, and tables from JSON files.

Names, ids and colours are facts that the data sets publish; each table's file says where they
are from. ``NAME`` has the ids of the annotations, where 0 is void, ``NAME-train`` the ids from 0
in which networks learn them, where 255 is void.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatseg.core import ClassInfo, ClassTable
from splatseg.errors import InputError
from splatseg.io.class_tables import class_table
from splatseg.io.json_files import read_json

TABLES = ("ade20k", "coco", "cityscapes", "scannet")
"""Data sets whose tables are known by name."""

_TRAIN = "-train"
_TRAIN_VOID = 255


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelTable:
    """Names of the ids of label maps, and what 0 and other ids mean in their files."""

    name: str
    classes: ClassTable
    """By the ids of the files."""

    zero_is_class: bool = False
    void: int | None = None


def label_table(name: str) -> LabelTable:
    """A table by name, or from a JSON file: a list of classes, or an object with ``classes``.

    Raises:
        InputError: If there is no such table and no such file.
        FileFormatError: If the file is no table.

    Example:
        >>> table = label_table("scannet")
        >>> table.classes.name_of(6), label_table("scannet-train").classes.name_of(5)
        ('sofa', 'sofa')
    """
    base = name.removesuffix(_TRAIN)
    if base in TABLES:
        return _training(base) if name.endswith(_TRAIN) else _annotated(base)
    path = Path(name)
    if not path.is_file():
        known = ", ".join(f"{table}, {table}{_TRAIN}" for table in TABLES)
        raise InputError(f"classes: expected one of {known} or a JSON file, got {name!r:.80}.")
    content: Any = read_json(path)
    return LabelTable(name=name, classes=class_table(content.get("classes"), where=str(path)))


def training_table(name: str) -> LabelTable | None:
    """The table of training ids of a data set that is known by name, in either of its names."""
    base = name.removesuffix(_TRAIN)
    return _training(base) if base in TABLES else None


def _annotated(base: str) -> LabelTable:
    return LabelTable(name=base, classes=ClassTable(rows=tuple(info for _, info in _rows(base))))


def _training(base: str) -> LabelTable:
    rows = sorted(
        (
            ClassInfo(id=train, name=info.name, isthing=info.isthing, colour=info.colour)
            for train, info in _rows(base)
            if train is not None
        ),
        key=lambda info: info.id,
    )
    return LabelTable(
        name=base + _TRAIN,
        classes=ClassTable(rows=tuple(rows)),
        zero_is_class=True,
        void=_TRAIN_VOID,
    )


def _rows(base: str) -> list[tuple[int | None, ClassInfo]]:
    """Training id, None where there is none, and row of each class."""
    found: list[tuple[int | None, ClassInfo]] = []
    text = (Path(__file__).parent / f"{base}.txt").read_text(encoding="utf-8")
    for line in text.splitlines():
        if line.startswith("#"):
            continue
        id, train, kind, red, green, blue, name = line.split(" ", 6)
        colour = (int(red), int(green), int(blue))
        info = ClassInfo(id=int(id), name=name, isthing=kind == "thing", colour=colour)
        found.append((None if train == "-" else int(train), info))
    return found
