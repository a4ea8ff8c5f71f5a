"""Classes of a network out of its configuration, as the ids from 1 that files hold."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

from splatseg.core import ClassInfo, ClassTable
from splatseg.io.label_tables import TABLES, is_void_name, label_table

_MIN_SAME = 0.5
"""Share of names that must be those of a data set, in its order: others are synonyms."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkClasses:
    """What the classes of a closed-set network are called, and which of them are things."""

    table: ClassTable
    """Ids from 1: class c of the network has id c + 1. One that means nothing has no row."""

    count: int
    """Classes of the network."""

    void: int | None
    """The class of the network that means nothing, such as background; None where none does."""

    note: str
    """What was assumed of them."""

    def is_thing(self, category: int) -> bool:
        """Whether an id is of a thing rather than of stuff."""
        return any(row.id == category and row.isthing for row in self.table.rows)


def network_classes(config: Mapping[str, Any], *, count: int, things: bool) -> NetworkClasses:
    """The classes of a network.

    Of a name that lists synonyms, ``sofa, couch, lounge``, the first one is kept, unless two
    classes share it. Which are things no configuration says: if there are as many classes as in
    one of our tables and at least half have its names in its order, the table does, and gives
    their colours.

    Args:
        config: Content of config.json, for ``id2label``.
        count: Classes that the network tells apart.
        things: What classes of a network are that no table knows.
    """
    given = config.get("id2label")
    labels = cast(dict[str, Any], given) if isinstance(given, dict) else {}
    whole = [" ".join(str(labels.get(str(c)) or f"class {c}").split()) for c in range(count)]
    first = [name.split(",")[0].strip() or name for name in whole]
    shared = {name for name, times in Counter(first).items() if times > 1}
    names = [full if name in shared else name for name, full in zip(first, whole, strict=True)]
    found = _known(first)
    void = 0 if count > 1 and is_void_name(names[0]) else None
    rows: list[ClassInfo] = []
    for c, name in enumerate(names):
        if c == void:
            continue
        if found is None:
            rows.append(ClassInfo(id=c + 1, name=name, isthing=things))
        else:
            row = found[1][c]
            rows.append(ClassInfo(id=c + 1, name=name, isthing=row.isthing, colour=row.colour))
    if found is not None:
        note = f"things and stuff as in {found[0]}"
    else:
        note = f"classes of no known table, all taken for {'things' if things else 'stuff'}"
    return NetworkClasses(table=ClassTable(rows=tuple(rows)), count=count, void=void, note=note)


def _known(names: list[str]) -> tuple[str, dict[int, ClassInfo]] | None:
    """The data set whose classes these are, and its rows by class of the network."""
    for base in TABLES:
        rows = {row.id: row for row in label_table(f"{base}-train").classes.rows}
        if rows.keys() != set(range(len(names))):
            continue
        same = sum(rows[c].name.lower() == name.lower() for c, name in enumerate(names))
        if same >= _MIN_SAME * len(names):
            return base, rows
    return None
