"""The nodes of a tree of instances as a table: CSV for spreadsheets, JSON for programs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from splatseg.core import InstanceTree, node_row
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.atomic import atomic_file
from splatseg.io.csv_files import csv_text
from splatseg.io.json_files import write_json

_COLUMNS = (
    "id",
    "parent",
    "level",
    "granularity",
    "name",
    "class",
    "gaussians",
    "support",
    "segments",
    "views",
)


@boundary
def write_node_table(
    tree: InstanceTree, path: Path, *, about: Mapping[str, Any] | None = None
) -> None:
    """Write the nodes of a tree; atomic. The ending, .csv or .json, gives the format.

    A row has the id of the parent (0 for none), the level, the granularity in [0, 1], and how
    many Gaussians are in the node, those of the nodes below it included.

    Args:
        tree: The tree.
        path: The file.
        about: Further members of the JSON. CSV has no place for them.

    Raises:
        InputError: If the name ends otherwise.
        MissingFileError: If the folder of `path` does not exist.
    """
    rows = node_rows(tree)
    match path.suffix.lower():
        case ".json":
            write_json(dict(about or {}) | {"nodes": rows}, path)
        case ".csv":
            text = csv_text(_COLUMNS, ([row[column] for column in _COLUMNS] for row in rows))
            # The byte order mark is what makes spreadsheets read names as UTF-8.
            with atomic_file(path) as temporary:
                temporary.write_text(text, encoding="utf-8-sig", newline="")
        case _:
            raise InputError(f"{path}: expected a table's name to end in .csv or .json.")


@boundary
def node_rows(tree: InstanceTree) -> list[dict[str, Any]]:
    """One row a node: what the file of the layer says of it, its granularity, its Gaussians."""
    ids, counts = torch.unique(tree.labels.ids, return_counts=True)
    total: dict[int, int] = {}
    for id, count in zip(ids.tolist(), counts.tolist(), strict=True):
        if id > 0:
            for above in tree.path(id):
                total[above] = total.get(above, 0) + count
    fine = tree.granularity()
    return [
        node_row(node)
        | {"granularity": round(fine[node.id], 4), "gaussians": total.get(node.id, 0)}
        for node in tree.nodes
    ]
