"""Class tables of well-known data sets by name, and tables from JSON files.

Names, ids and colours are facts that the data sets publish; each table's file says where they
are from. ``NAME`` has the ids of the annotations, where 0 is void, ``NAME-train`` the ids from 0
in which networks learn them, where 255 is void (of SemanticKITTI and VOC: from 1, and 0 is void).
Where several classes have one id in training, it is called as the first of them.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from splatseg.core import ClassInfo, ClassTable
from splatseg.errors import FileFormatError as FileFormatError
from splatseg.errors import InputError
from splatseg.errors import quoted as quoted
from splatseg.io.foreign import malformed, read_lines
from splatseg.io.json_files import read_json
from splatseg.io.tables import class_table

TABLES = ("ade20k", "coco", "cityscapes", "scannet", "kitti360", "semantic-kitti", "voc")
"""Data sets whose tables are known by name."""

_VOID_NAMES = ("background", "ignore", "none", "unannotated", "unknown", "unlabel", "void")
"""How names of what is no class begin in the usual tables."""

_LABELMAP_LINE = re.compile(r"(?P<name>[^:]+):(?P<colour>\d{1,3}, ?\d{1,3}, ?\d{1,3})(?::.*)?")
_CAMVID_LINE = re.compile(r"(?P<colour>\d{1,3}\s+\d{1,3}\s+\d{1,3})\s+(?P<name>.+)")

_TRAIN = "-train"
_TRAIN_VOID = 255
_LEARNED_FROM_ONE = frozenset({"semantic-kitti", "voc"})
_ANNOTATED_VOID = {"voc": _TRAIN_VOID}
"""Further ids of annotations that mean none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelTable:
    """Names of the ids of label maps, and what 0 and other ids mean in their files."""

    name: str
    classes: ClassTable
    """By the ids of the files."""

    zero_is_class: bool = False
    void: int | None = None

    @property
    def void_channel(self) -> int | None:
        """The channel of soft maps that is of no class: 0, where the table calls it so."""
        named = any(row.id == 0 and is_void_name(row.name) for row in self.classes.rows)
        return 0 if named else None


def label_table(name: str) -> LabelTable:
    """A table by name, or from a file: a JSON object with ``classes``, a list of rows, or text.

    Text has a class a line: ``car:128,0,0::`` (labelmap.txt of CVAT and datumaro) or
    ``128 0 0 car`` (label_colors.txt of CamVid). They are numbered from 0 where the first is of no
    class, else from 1.

    A file that gives 0 the name of a class says that 0 is one; names such as void, background or
    unlabelled are of none.

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
    if path.suffix == ".txt":
        return _colour_lines(path)
    content: Any = read_json(path)
    table = class_table(content.get("classes"), where=str(path), keep_zero=True)
    zero = next((row.name for row in table.rows if row.id == 0), None)
    return LabelTable(
        name=name, classes=table, zero_is_class=zero is not None and not is_void_name(zero)
    )


def _colour_lines(path: Path) -> LabelTable:
    """A table of colours as text."""
    rows: list[dict[str, object]] = []
    for line in read_lines(path, "a table of colours"):
        if line.startswith("#"):
            continue
        found = _LABELMAP_LINE.fullmatch(line) or _CAMVID_LINE.fullmatch(line)
        if found is None:
            what = "a class and its colour a line (car:128,0,0:: or 128 0 0 car)"
            raise malformed(path, what, line)
        colour = [int(word) for word in re.split(r"[\s,]+", found["colour"])]
        rows.append({"id": len(rows), "name": found["name"].strip(), "colour": colour})
    if rows and not is_void_name(str(rows[0]["name"])):
        rows = [row | {"id": i} for i, row in enumerate(rows, start=1)]
    return LabelTable(name=str(path), classes=class_table(rows, where=str(path), keep_zero=True))


def training_table(name: str) -> LabelTable | None:
    """The table of training ids of a data set that is known by name, in either of its names."""
    base = name.removesuffix(_TRAIN)
    return _training(base) if base in TABLES else None


def learned_as(name: str) -> dict[int, int]:
    """Which class each id of the annotations counts as, by id; others have no class in training.

    Classes that networks learn as one count as the first of them: a garage of KITTI-360 is a
    building.

    Raises:
        InputError: If the data set is not known by name.

    Example:
        >>> learned_as("kitti360")[34], 9 in learned_as("kitti360")
        (11, False)
    """
    if name not in TABLES:
        raise InputError(f"classes: expected one of {', '.join(TABLES)}, got {name!r:.80}.")
    first: dict[int, int] = {}
    found: dict[int, int] = {}
    for train, info in _rows(name):
        if train is not None:
            found[info.id] = first.setdefault(train, info.id)
    return found


def is_void_name(name: str) -> bool:
    """Whether a table means nothing by a class of this name, such as background or void."""
    return name.lower().startswith(_VOID_NAMES)


def _annotated(base: str) -> LabelTable:
    rows = tuple(info for _, info in _rows(base))
    return LabelTable(name=base, classes=ClassTable(rows=rows), void=_ANNOTATED_VOID.get(base))


def _training(base: str) -> LabelTable:
    rows: dict[int, ClassInfo] = {}
    for train, info in _rows(base):
        if train is not None:
            rows.setdefault(train, replace(info, id=train))
    from_zero = base not in _LEARNED_FROM_ONE
    return LabelTable(
        name=base + _TRAIN,
        classes=ClassTable(rows=tuple(rows[id] for id in sorted(rows))),
        zero_is_class=from_zero,
        void=_TRAIN_VOID if from_zero else None,
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
