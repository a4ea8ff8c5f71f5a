"""Edits of a whole document, one after the other, written down so that they can be repeated.

Each edit leaves its `Operation` in the scene's provenance under ``edits``. `replay` of them over
the scene that was before the first gives the same scene again; `undo` is replay without the
last. Nothing is changed in place, so that whoever keeps an earlier document has it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from splatseg.core import (
    UNLABELLED,
    Edited,
    Gaussians,
    InstanceTree,
    LabelMap,
    Labels,
    LabelSource,
    Layer,
    Scene,
    Selection,
    Similarity,
    View,
    layer_address,
)
from splatseg.edit._merge import merged_layers
from splatseg.edit._operation import CutBy, Operation
from splatseg.edit._where import Where, layer_called, select
from splatseg.edit.document import HISTORY, Document, load_document
from splatseg.edit.operations import duplicate, extract, merge, recolour, remove, transform
from splatseg.errors import InputError
from splatseg.io.evidence import find_evidence, open_evidence
from splatseg.lift import label_map
from splatseg.lift.boundaries.cut import cut_box, cut_masks

Progress = Callable[[int, int], None]
MOVES = ("duplicate", "transform", "merge", "remove", "extract")
"""Edits after which photographs no longer show the scene as it is."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prepared:
    """A document whose Gaussians are split at the cut, right before the edit itself."""

    document: Document
    """With the Gaussians that were split, layers in step."""

    selection: Selection | None
    """What the edit is of; None is everything."""

    split: int
    """How many Gaussians were split."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Drawn:
    """Label maps of views as a selection draws them: 1 inside, 2 where other Gaussians are."""

    gaussians: Gaussians
    selection: Selection
    views: Mapping[str, View]
    backend: str

    @property
    def view_names(self) -> Sequence[str]:
        return tuple(self.views)

    def label_map(self, name: str) -> LabelMap:
        sides = torch.where(self.selection.mask, 1, 2).int()
        labels = Labels(ids=sides, confidence=torch.ones(len(sides)))
        return label_map(self.gaussians, self.views[name].camera, labels, backend=self.backend)


def prepare(
    document: Document,
    operation: Operation,
    *,
    backend: str = "auto",
    progress: Progress | None = None,
) -> Prepared:
    """Find what an operation is of, and split what straddles its boundary.

    Args:
        document: The scene with its layers.
        operation: The edit that is to come.
        backend: Who renders, for cuts by pixels.
        progress: Called with the views done and all there are to do.

    Raises:
        InputError: If the selection is empty or names what is not there.
    """
    where = operation.where
    if where is None:
        return Prepared(document=document, selection=None, split=0)
    gaussians = document.scene.gaussians
    chosen = select(gaussians, document.layers, where)
    if operation.cut is None:
        _check_some(chosen, where)
        return Prepared(document=document, selection=chosen, split=0)
    return _split_at(_Task(document, where, operation.cut, backend, progress))


@dataclass(frozen=True, slots=True)
class _Task:
    """What is to be split where, and how."""

    document: Document
    where: Where
    cut: CutBy
    backend: str
    progress: Progress | None


def _split_at(task: _Task) -> Prepared:
    document, where = task.document, task.where
    inside, split = Selection(mask=torch.ones(len(document.scene.gaussians)).bool()), 0
    if where.layer is not None:
        # The boundary of what is not selected is that of what is.
        named = select(
            document.scene.gaussians, document.layers, replace(where, box=None, invert=False)
        )
        edited, inside, split = _cut_layer(task, named)
        document = _relabelled(document.edited(edited), where, inside)
    if where.box is not None:
        boxed = cut_box(
            document.scene.gaussians,
            where.box[:3],
            where.box[3:],
            among=inside,
            options=task.cut.options,
            cameras=[view.camera for view in document.scene.views],
        )
        document = document.edited(boxed.edited)
        inside = inside[boxed.edited.rows] & boxed.inside
        split += boxed.split
    selection = ~inside if where.invert else inside
    _check_some(selection, where)
    return Prepared(document=document, selection=selection, split=split)


def _check_some(selection: Selection, where: Where) -> None:
    if not selection.count:
        raise InputError(
            f"selection: expected at least one Gaussian, got none of {where.to_json()}."
        )


def _cut_layer(task: _Task, named: Selection) -> tuple[Edited, Selection, int]:
    """Split at the boundary of what a layer names; which Gaussians are inside afterwards."""
    scene, cut = task.document.scene, task.cut
    if cut.by == "box" or cut.options.rounds == 0:
        return Edited.unchanged(scene.gaussians), named, 0
    views = [scene.view(name) for name in cut.views]
    evidence, ids = _boundary(task, named, views)
    found = cut_masks(
        scene.gaussians,
        views,
        evidence,
        ids,
        options=cut.options,
        backend=task.backend,
        progress=task.progress,
    )
    edited = found.edited
    judged = found.known > 0
    if cut.by == "layer":
        # What the layer draws says nothing new of a Gaussian that is still whole.
        judged &= (
            torch.zeros(len(edited)).bool() if edited.fractions is None else (edited.fractions < 1)
        )
    inside = torch.where(judged, found.inside.mask, named.mask[edited.rows])
    return edited, Selection(mask=inside), found.split


def _boundary(
    task: _Task, named: Selection, views: Sequence[View]
) -> tuple[LabelSource, tuple[int, ...]]:
    """Label maps, and the ids in them that are inside."""
    scene, cut, ids = task.document.scene, task.cut, task.where.ids
    if cut.by == "layer":
        maps = {view.name: view for view in views}
        drawn = _Drawn(gaussians=scene.gaussians, selection=named, views=maps, backend=task.backend)
        return drawn, (1,)
    if cut.evidence is None or not ids:
        raise InputError("cut: masks need the name of evidence, and ids of a layer of labels.")
    if any(edit.get("kind") in MOVES for edit in task.document.history):
        raise InputError(
            "cut: the masks show the scene before it was edited; cut by the layer instead."
        )
    places = [place for place in (scene.root, scene.source) if place is not None]
    folder = find_evidence(places, cut.evidence)
    return open_evidence(folder, zero_is_class=cut.zero_is_class), ids


def _relabelled(document: Document, where: Where, inside: Selection) -> Document:
    """The layer that was cut, with parts named after the side that they are on."""
    if where.layer is None:
        return document
    name, level = layer_address(where.layer)
    layer = layer_called(document.layers, where.layer)
    whole = document.layers[name]
    match layer:
        case Selection():
            changed: Layer = replace(layer, mask=inside.mask)
        case Labels():
            changed = _labels_by_side(layer, where.ids, inside)
            if isinstance(whole, InstanceTree):
                changed = whole.with_cut(changed, level or "object")
        case _:
            return document
    return replace(document, layers={**document.layers, name: changed})


def _labels_by_side(labels: Labels, ids: Sequence[int], inside: Selection) -> Labels:
    """Give what is on the wrong side of the cut its best candidate on the right one.

    Without such a candidate, what is inside gets the first of `ids`, what is outside none.
    """
    wanted = torch.tensor(ids, dtype=labels.ids.dtype)
    right = torch.isin(labels.ids, wanted) == inside.mask
    if labels.candidates is None or labels.shares is None:
        new = torch.where(inside.mask, wanted[0], UNLABELLED).int()
        confidence = torch.where(right, labels.confidence, 0.0)
    else:
        fits = torch.isin(labels.candidates, wanted) == inside.mask.unsqueeze(1)
        fits &= labels.candidates != UNLABELLED
        # Candidates stand strongest first: the first that fits is the best.
        place = fits.int().argmax(dim=1, keepdim=True)
        found = fits.any(dim=1)
        first = labels.candidates.gather(1, place).squeeze(1)
        new = torch.where(found, first, torch.where(inside.mask, wanted[0], UNLABELLED)).int()
        share = labels.shares.gather(1, place).squeeze(1)
        confidence = torch.where(right, labels.confidence, torch.where(found, share, 0.0))
        keep = right.unsqueeze(1) | fits
        shares = torch.where(keep, labels.shares, 0.0)
        candidates = torch.where(keep, labels.candidates, UNLABELLED)
        order = torch.argsort(shares, dim=1, descending=True, stable=True)
        labels = replace(
            labels, candidates=candidates.gather(1, order), shares=shares.gather(1, order)
        )
    return replace(labels, ids=torch.where(right, labels.ids, new), confidence=confidence)


def apply(
    document: Document,
    operation: Operation,
    *,
    prepared: Prepared | None = None,
    open_other: Callable[[str], Document] = load_document,
    backend: str = "auto",
    progress: Progress | None = None,
) -> Document:
    """Do one edit and write it down.

    Args:
        document: The scene with its layers.
        operation: The edit.
        prepared: What `prepare` made of the two, where the caller has it already.
        open_other: Reads the scene that a merge names.
        backend: Who renders, for cuts by pixels.
        progress: Called with the views done and all there are to do.

    Returns:
        A new document; the last of its `history` is this edit with, under ``result``, the
        numbers of Gaussians before and after and of those that were split.

    Raises:
        InputError: If the edit cannot be done; one sentence says why.
    """
    ready = prepared or prepare(document, operation, backend=backend, progress=progress)
    now, chosen = ready.document, ready.selection
    scene = now.scene
    match operation.kind:
        case "split":
            after = now
        case "merge":
            after = _merged(now, open_other(operation.other or ""), operation.transform)
        case "transform" if chosen is None:
            after = replace(now, scene=_moved_scene(scene, _transform(operation)))
        case _:
            after = now.edited(_edited(scene.gaussians, chosen, operation))
    result = {
        "before": len(document.scene.gaussians),
        "after": len(after.scene.gaussians),
        "split": ready.split,
    }
    edits = [*document.history, operation.to_json() | {"result": result}]
    provenance = dict(after.scene.provenance) | {HISTORY: edits}
    return replace(after, scene=replace(after.scene, provenance=provenance))


def _edited(gaussians: Gaussians, chosen: Selection | None, operation: Operation) -> Edited:
    everything = Selection(mask=torch.ones(len(gaussians), dtype=torch.bool))
    match operation.kind:
        case "extract":
            return extract(gaussians, chosen or everything)
        case "remove":
            return remove(gaussians, chosen or everything)
        case "duplicate":
            return duplicate(gaussians, chosen or everything, _transform(operation))
        case "transform":
            return transform(gaussians, _transform(operation), selection=chosen)
        case _:
            how = operation.recolour
            if how is None:
                raise InputError(f"{operation.kind}: expected recolour, got none.")
            return recolour(
                gaussians,
                chosen,
                colour=how.colour,
                scale=how.scale,
                shift=how.shift,
                view_dependent=how.view_dependent,
            )


def _transform(operation: Operation) -> Similarity:
    if operation.transform is None:
        raise InputError(f"{operation.kind}: expected a transform, got none.")
    return operation.transform


def _merged(document: Document, other: Document, moved: Similarity | None) -> Document:
    edited = merge(document.scene.gaussians, other.scene.gaussians, target_from_other=moved)
    return Document(
        scene=replace(document.scene, gaussians=edited.gaussians),
        layers=merged_layers(document.layers, other.layers, edited),
    )


def _moved_scene(scene: Scene, new_from_old: Similarity) -> Scene:
    """A scene in another frame: cameras, up and units move with the Gaussians."""
    views = tuple(
        replace(
            view,
            camera=view.camera.moved(new_from_old),
            depth_unit=None if view.depth_unit is None else view.depth_unit * new_from_old.scale,
        )
        for view in scene.views
    )
    up = scene.up
    if up is not None:
        x, y, z = (new_from_old.rotation.double() @ torch.tensor(up).double()).tolist()
        up = (x, y, z)
    metres = scene.metres_per_unit
    return replace(
        scene,
        gaussians=scene.gaussians.transformed(new_from_old),
        views=views,
        up=up,
        metres_per_unit=None if metres is None else metres / new_from_old.scale,
    )


def replay(
    document: Document,
    history: Sequence[Mapping[str, Any]],
    *,
    open_other: Callable[[str], Document] = load_document,
    backend: str = "auto",
    progress: Progress | None = None,
) -> Document:
    """Do the edits of a history again, over the document that was before the first.

    Args:
        document: The scene with its layers before the edits.
        history: `Document.history` of the edited one, or a part of it.
        open_other: Reads the scenes that merges name.
        backend: Who renders, for cuts by pixels.
        progress: Called with the views done and all there are to do, anew for each edit.

    Raises:
        InputError: If an entry is no edit, or cannot be done on what it finds.
    """
    for entry in history:
        document = apply(
            document,
            Operation.from_json(entry),
            open_other=open_other,
            backend=backend,
            progress=progress,
        )
    return document


def undo(
    base: Document,
    edited: Document,
    *,
    open_other: Callable[[str], Document] = load_document,
    backend: str = "auto",
    progress: Progress | None = None,
) -> Document:
    """The document without its last edit: all but that one, done again over `base`.

    Raises:
        InputError: If there is nothing to undo.
    """
    history = edited.history[len(base.history) :]
    if not history:
        raise InputError("undo: expected a scene with an edit, got one without.")
    return replay(base, history[:-1], open_other=open_other, backend=backend, progress=progress)
