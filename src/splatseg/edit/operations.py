"""Edits of Gaussians: pure functions from Gaussians and a selection to `Edited`.

Nothing is changed in place. Rows that stay keep their order; what is added comes behind them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_finite
from splatseg.core import (
    UNLABELLED,
    Edited,
    Features,
    Gaussians,
    InstanceTree,
    Labels,
    Layer,
    LayerInfo,
    Selection,
    Similarity,
    apply_rows,
)
from splatseg.core.boundary import boundary
from splatseg.core.edited import NEW
from splatseg.core.sh import SH_C0, degree_of
from splatseg.errors import InputError, RangeError, ShapeError


@boundary
def extract(gaussians: Gaussians, selection: Selection) -> Edited:
    """Keep what is selected, and nothing else.

    Raises:
        ShapeError: If the selection is of other Gaussians.
        InputError: If nothing is selected.
    """
    rows = _selected(gaussians, selection)
    return Edited(gaussians=gaussians[rows], rows=rows)


@boundary
def remove(gaussians: Gaussians, selection: Selection) -> Edited:
    """Leave out what is selected.

    Raises:
        ShapeError: If the selection is of other Gaussians.
        InputError: If nothing is selected, or everything: an empty scene is no edit of one.
    """
    if len(_selected(gaussians, selection)) == len(gaussians):
        raise InputError(f"selection: expected to leave Gaussians, got all {len(gaussians)}.")
    rows = (~selection).ids
    return Edited(gaussians=gaussians[rows], rows=rows)


@boundary
def duplicate(
    gaussians: Gaussians,
    selection: Selection,
    target_from_source: Similarity,
) -> Edited:
    """Add a copy of what is selected, moved by a similarity; copies keep their labels.

    Raises:
        ShapeError: If the selection is of other Gaussians.
        InputError: If nothing is selected.
    """
    rows = _selected(gaussians, selection)
    copy = gaussians[rows].transformed(target_from_source)
    return Edited(
        gaussians=Gaussians.concatenate([gaussians, copy]),
        rows=torch.cat((torch.arange(len(gaussians)), rows)),
    )


@boundary
def transform(
    gaussians: Gaussians,
    target_from_source: Similarity,
    *,
    selection: Selection | None = None,
) -> Edited:
    """Move, turn and scale what is selected, in place; None is everything.

    Centres, axes, sizes and harmonics follow (`Gaussians.transformed`); opacities stay.

    Raises:
        ShapeError: If the selection is of other Gaussians.
        InputError: If nothing is selected.
    """
    if selection is None:
        moved = gaussians.transformed(target_from_source)
        return Edited(gaussians=moved, rows=torch.arange(len(gaussians)))
    rows = _selected(gaussians, selection)
    moved = gaussians[rows].transformed(target_from_source)
    return Edited(
        gaussians=gaussians.replace(
            means=gaussians.means.index_copy(0, rows, moved.means),
            rotations=gaussians.rotations.index_copy(0, rows, moved.rotations),
            scales=gaussians.scales.index_copy(0, rows, moved.scales),
            sh=gaussians.sh.index_copy(0, rows, moved.sh),
        ),
        rows=torch.arange(len(gaussians)),
    )


@boundary
def recolour(
    gaussians: Gaussians,
    selection: Selection | None = None,
    *,
    colour: Sequence[float] | None = None,
    scale: Sequence[float] = (1.0, 1.0, 1.0),
    shift: Sequence[float] = (0.0, 0.0, 0.0),
    view_dependent: bool = True,
) -> Edited:
    r"""Change colours: set them, or scale and shift them.

    A colour is :math:`c(d) = 0.5 + Y_0 f_0 + \sum_{k > 0} Y_k(d) f_k`. With scale a and shift b
    it becomes :math:`a \, c(d) + b` for every direction d:

    .. math:: f_0' = \frac{a (0.5 + Y_0 f_0) + b - 0.5}{Y_0}, \qquad f_k' = a f_k

    A colour that is set replaces :math:`0.5 + Y_0 f_0`, the mean over directions, first.

    Args:
        gaussians: The Gaussians.
        selection: Which; None is all of them.
        colour: Red, green and blue in [0, 1] that the mean colour becomes; None keeps it.
        scale: Factor of each channel, not negative.
        shift: Added to each channel after that, in [-1, 1].
        view_dependent: Whether what changes with the direction stays, scaled. Without, the
            Gaussians look the same from everywhere.

    Raises:
        ShapeError: If the selection is of other Gaussians, or a colour has not three channels.
        RangeError: If a value is out of range.
        InputError: If nothing is selected.
    """
    rows = torch.arange(len(gaussians)) if selection is None else _selected(gaussians, selection)
    factor = _channels("scale", scale, 0.0, math.inf)
    added = _channels("shift", shift, -1.0, 1.0)
    sh = gaussians.sh[rows]
    mean = 0.5 + SH_C0 * sh[:, 0]
    if colour is not None:
        mean = _channels("colour", colour, 0.0, 1.0).to(sh).expand_as(mean)
    first = (factor.to(sh) * mean + added.to(sh) - 0.5) / SH_C0
    rest = sh[:, 1:] * factor.to(sh) if view_dependent else torch.zeros_like(sh[:, 1:])
    changed = torch.cat((first.unsqueeze(1), rest), dim=1)
    return Edited(
        gaussians=gaussians.replace(sh=gaussians.sh.index_copy(0, rows, changed)),
        rows=torch.arange(len(gaussians)),
    )


@boundary
def merge(
    gaussians: Gaussians,
    other: Gaussians,
    *,
    target_from_other: Similarity | None = None,
) -> Edited:
    """Add the Gaussians of another scene behind these; their rows are -1.

    Harmonics of the lower degree are filled up with zeros, which changes no colour. Extra
    columns that only one of the two has are 0 for the other.

    Args:
        gaussians: The scene that keeps its frame.
        other: What is added.
        target_from_other: From the frame of `other` to that of `gaussians`; None where they
            share one.

    Raises:
        InputError: If the two are meant for different rendering, or a column of theirs differs
            in width.
    """
    if target_from_other is not None:
        other = other.transformed(target_from_other)
    other = other.to(device=gaussians.device, dtype=gaussians.dtype)
    coefficients = max(gaussians.sh.shape[1], other.sh.shape[1])
    names = {**dict(gaussians.extra), **dict(other.extra)}
    parts = [_filled_up(part, coefficients, names) for part in (gaussians, other)]
    rows = torch.cat((torch.arange(len(gaussians)), torch.full((len(other),), NEW)))
    return Edited(gaussians=Gaussians.concatenate(parts), rows=rows)


def _filled_up(part: Gaussians, coefficients: int, columns: dict[str, Tensor]) -> Gaussians:
    missing = coefficients - part.sh.shape[1]
    degree_of(coefficients)
    extra: dict[str, Tensor] = {}
    for name, example in columns.items():
        own = part.extra.get(name)
        if own is not None and own.shape[1:] != example.shape[1:]:
            raise InputError(
                f"extra[{name!r}]: expected the same width in both scenes, got "
                f"{tuple(own.shape[1:])} and {tuple(example.shape[1:])}."
            )
        extra[name] = example.new_zeros(len(part), *example.shape[1:]) if own is None else own
    return part.replace(
        sh=torch.cat((part.sh, part.sh.new_zeros(len(part), missing, 3)), dim=1), extra=extra
    )


def _selected(gaussians: Gaussians, selection: Selection) -> Tensor:
    """Rows of a selection, after a check that it belongs to these Gaussians and has any."""
    if len(selection) != len(gaussians):
        raise ShapeError(
            f"selection: expected one over {len(gaussians)} Gaussians, "
            f"got one over {len(selection)}."
        )
    rows = selection.ids
    if not len(rows):
        raise InputError("selection: expected at least one Gaussian, got none.")
    return rows.to(gaussians.device)


def _channels(name: str, values: Sequence[float], low: float, high: float) -> Float[Tensor, "3"]:
    tensor = torch.tensor([float(value) for value in values], dtype=torch.float64)
    if tensor.shape != (3,):
        raise ShapeError(f"{name}: expected red, green and blue, got {len(tensor)} numbers.")
    check_finite(name, tensor)
    if bool(((tensor < low) | (tensor > high)).any()):
        raise RangeError(f"{name}: expected values in [{low:g}, {high:g}], got {tensor.tolist()}.")
    return tensor


# Layers of two scenes that become one.


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
            **_rows_of_both(first, second, new),
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
        **_rows_of_both(first, second, new, *_CANDIDATES),
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


_COLUMNS = ("ids", "confidence", "evidence", "effective_views", "inferred")
_CANDIDATES = ("candidates", "shares")


def _rows_of_both(first: Labels, second: Labels, new: Tensor, *columns: str) -> dict[str, Any]:
    """Columns of labels with the rows of the second where new."""
    names = (*_COLUMNS, *columns)
    return {name: _either(getattr(first, name), getattr(second, name), new) for name in names}


def _either(first: Tensor | None, second: Tensor | None, new: Tensor) -> Tensor | None:
    """Rows of the second where new; a column that one of them lacks is left out."""
    if first is None or second is None:
        return None
    mask = new.reshape(-1, *([1] * (first.ndim - 1)))
    return torch.where(mask, second.to(first), first)
