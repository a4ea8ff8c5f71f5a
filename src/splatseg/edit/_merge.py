"""Layers of two scenes that become one."""

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    Edited,
    Features,
    InstanceTree,
    Labels,
    Layer,
    LayerInfo,
    Selection,
    apply_rows,
)
from splatseg.core.boundary import boundary
from splatseg.errors import InputError


@boundary
def merged_layers(
    layers: Mapping[str, Layer], others: Mapping[str, Layer], edited: Edited
) -> dict[str, Layer]:
    """Layers of a scene, and behind them those of another that was merged into it.

    Layers of the same name and kind are joined. An id of the other scene keeps its number
    where the first does not use it, or uses it under the same name; else it gets the next free
    one, and the edit ``merge`` in its info says so. A layer that only one of them has is
    empty in the rows of the other. Features are joined where they have as many channels.

    Args:
        layers: Of the scene that was first.
        others: Of the scene that was added.
        edited: The merge (`merge`): its new rows are the other scene's, in order.

    Raises:
        InputError: If layers of the same name do not fit each other.
    """
    new = edited.rows < 0
    behind = Edited(
        gaussians=edited.gaussians,
        rows=torch.where(new, torch.cumsum(new.long(), dim=0) - 1, -1),
    )
    result: dict[str, Layer] = {}
    for name in dict.fromkeys([*layers, *others]):
        if name not in others:
            result[name] = apply_rows(layers[name], edited)
        elif name not in layers:
            result[name] = apply_rows(others[name], behind)
        else:
            result[name] = _joined(name, layers[name], others[name], edited, behind)
    return result


def _joined(name: str, own: Layer, other: Layer, edited: Edited, behind: Edited) -> Layer:
    new = edited.rows < 0
    match own, other:
        case Labels(), Labels():
            return _joined_labels(own, other, edited, behind)
        case InstanceTree(), InstanceTree():
            return _joined_trees(own, other, edited, behind)
        case Selection(), Selection():
            first, second = apply_rows(own, edited), apply_rows(other, behind)
            return replace(first | second, info=first.info)
        case Features(), Features() if own.values.shape[1] == other.values.shape[1]:
            first, second = apply_rows(own, edited), apply_rows(other, behind)
            return replace(
                first,
                values=torch.where(new[:, None], second.values.to(first.values), first.values),
                weights=_either(first.weights, second.weights, new),
            )
        case _:
            raise InputError(
                f"layer {name!r}: expected the same kind and as many channels in both scenes, "
                "got layers that do not fit; rename one of them."
            )


def _joined_trees(
    own: InstanceTree, other: InstanceTree, edited: Edited, behind: Edited
) -> InstanceTree:
    """Trees side by side: all nodes of `other` get ids behind those of `own`."""
    shift = max((node.id for node in own.nodes), default=0)
    table = {node.id: node.id + shift for node in other.nodes}
    moved = replace(
        other,
        nodes=tuple(
            replace(node, id=table[node.id], parent=table.get(node.parent, UNLABELLED))
            for node in other.nodes
        ),
        labels=replace(
            other.labels,
            ids=_mapped(other.labels.ids, table),
            background=table.get(other.labels.background, UNLABELLED),
        ),
    )
    first, second = apply_rows(own.labels, edited), apply_rows(moved.labels, behind)
    new = edited.rows < 0
    return InstanceTree(
        nodes=own.nodes + moved.nodes,
        labels=replace(
            first,
            ids=torch.where(new, second.ids, first.ids),
            confidence=torch.where(new, second.confidence, first.confidence),
            evidence=_either(first.evidence, second.evidence, new),
            effective_views=_either(first.effective_views, second.effective_views, new),
            inferred=_either(first.inferred, second.inferred, new),
            info=_with_new_ids(own.info, table),
        ),
    )


def _joined_labels(own: Labels, other: Labels, edited: Edited, behind: Edited) -> Labels:
    """Labels of both, with the ids of `other` out of the way of those of `own`."""
    moved, names, table = _renumbered(own, other)
    width = max(_width(own), _width(other))
    first = apply_rows(_widened(own, width), edited)
    second = apply_rows(_widened(moved, width), behind)
    new = edited.rows < 0
    return replace(
        first,
        ids=torch.where(new, second.ids, first.ids),
        confidence=torch.where(new, second.confidence, first.confidence),
        candidates=_either(first.candidates, second.candidates, new),
        shares=_either(first.shares, second.shares, new),
        evidence=_either(first.evidence, second.evidence, new),
        effective_views=_either(first.effective_views, second.effective_views, new),
        inferred=_either(first.inferred, second.inferred, new),
        info=_with_new_ids(replace(own.info, names=names), table),
    )


def _with_new_ids(info: LayerInfo, table: Mapping[int, int]) -> LayerInfo:
    """The record, with what ids of the other layer became where they changed."""
    if not table:
        return info
    return info.with_edit("merge", {"ids": {str(old): now for old, now in table.items()}})


def _renumbered(own: Labels, other: Labels) -> tuple[Labels, dict[int, str], dict[int, int]]:
    """`other` with ids that clash with no id of `own`, the names of both, and what changed."""
    used, wanted = _ids_of(own), sorted(_ids_of(other))
    names, others = own.info.names, other.info.names
    table: dict[int, int] = {}
    following = max([0, *used, *wanted]) + 1
    for id in wanted:
        same = id in names and names[id] == others.get(id)
        if id in used and not same:
            table[id] = following
            following += 1
    joined = dict(names)
    joined |= {table.get(id, id): others[id] for id in wanted if id in others}
    moved = replace(
        other,
        ids=_mapped(other.ids, table),
        candidates=None if other.candidates is None else _mapped(other.candidates, table),
    )
    return moved, joined, table


def _ids_of(labels: Labels) -> set[int]:
    ids = set(torch.unique(labels.ids).tolist())
    if labels.candidates is not None:
        ids |= set(torch.unique(labels.candidates).tolist())
    return ids - {UNLABELLED}


def _mapped(ids: Tensor, table: Mapping[int, int]) -> Tensor:
    result = ids.clone()
    for old, new in table.items():
        result[ids == old] = new
    return result


def _width(labels: Labels) -> int:
    return 0 if labels.candidates is None else labels.candidates.shape[1]


def _widened(labels: Labels, width: int) -> Labels:
    """With candidates of this many columns; a hard label is its own only candidate."""
    if not width or _width(labels) == width:
        return labels
    candidates, shares = labels.candidates, labels.shares
    if candidates is None or shares is None:
        candidates = labels.ids.unsqueeze(1)
        # Of a hard layer the winner is drawn with all its weight.
        shares = (labels.ids != UNLABELLED).to(labels.confidence).unsqueeze(1)
    missing = width - candidates.shape[1]
    return replace(
        labels,
        candidates=torch.nn.functional.pad(candidates, (0, missing), value=UNLABELLED),
        shares=torch.nn.functional.pad(shares, (0, missing)),
    )


def _either(first: Tensor | None, second: Tensor | None, new: Tensor) -> Tensor | None:
    """Rows of the second where new; a column that one of them lacks is left out."""
    if first is None or second is None:
        return None
    mask = new.reshape(-1, *([1] * (first.ndim - 1)))
    return torch.where(mask, second.to(first), first)
