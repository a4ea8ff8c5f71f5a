"""What a layer of associated segments says of itself."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.core import ClassTable, InstanceFacts, LayerInfo
from splatseg.lift.segments.table import SegmentTable
from splatseg.lift.segments.tree_labels import category_of


def with_instances(
    info: LayerInfo, table: SegmentTable, group: NDArray[np.int64], classes: ClassTable | None
) -> LayerInfo:
    """The record with the name, the class where it is known, and the facts of each instance."""
    names: dict[int, str] = {}
    class_of: dict[int, int] = {}
    facts: dict[int, InstanceFacts] = {}
    for index in range(int(group.max(initial=-1)) + 1):
        id, members = index + 1, np.flatnonzero(group == index)
        category = category_of(table, members)
        named = category > 0 and classes is not None
        name = classes.name_of(category) if named and classes is not None else "object"
        names[id] = f"{name} {id}"
        if category > 0:
            class_of[id] = category
        views = np.unique(table.view[members])
        facts[id] = InstanceFacts(segments=len(members), views=len(views))
    return replace(info, names=names, class_of=class_of, instances=facts)


def account(table: SegmentTable, group: NDArray[np.int64], *, tracked: bool) -> dict[str, Any]:
    """What became of the segments; of tracks, which were joined and which were divided."""
    there = group >= 0
    pairs = np.stack((group[there], table.view[there]))
    _, counts = np.unique(pairs, axis=1, return_counts=True)
    said: dict[str, Any] = {
        "segments": len(group),
        "instances": int(group.max(initial=-1)) + 1,
        "left_out": int((~there).sum()),
        "joined_within_views": int((counts - 1).sum()),
    }
    if not tracked:
        return said
    of: dict[int, set[int]] = {}
    names: dict[int, set[int]] = {}
    for instance, name in zip(group[there].tolist(), table.name[there].tolist(), strict=True):
        of.setdefault(name, set()).add(instance + 1)
        names.setdefault(instance + 1, set()).add(name)
    merged = {i: found for i, found in sorted(names.items()) if len(found) > 1}
    split = {name: found for name, found in sorted(of.items()) if len(found) > 1}
    return said | {
        "merged": [{"id": i, "from": sorted(found)} for i, found in merged.items()],
        "split": [{"from": name, "ids": sorted(found)} for name, found in split.items()],
    }
