"""What an edit is of, and the splitting of what straddles its boundary."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

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
    Selection,
    View,
    layer_address,
)
from splatseg.core.boundary import boundary
from splatseg.edit.document import CutBy, Document, Operation
from splatseg.edit.refit import refit
from splatseg.errors import InputError
from splatseg.io.evidence import find_evidence, open_evidence
from splatseg.lift import label_map
from splatseg.lift.boundaries.cut import cut_box, cut_masks
from splatseg.selection import Where, layer_called, leftovers, select_where

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

    specks: int = 0
    """How many Gaussians go along because they would stay behind as specks."""


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


@boundary
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
        InputError: If the selection is empty or names what is not there, or a scene that was
            edited before is to be refitted.
    """
    where = operation.where
    if where is None:
        return Prepared(document=document, selection=None, split=0)
    if operation.refit is not None and document.history:
        raise InputError("refit: the photographs show the scene before it was edited.")
    gaussians = document.scene.gaussians
    chosen = select_where(gaussians, document.layers, where)
    if operation.cut is None:
        _check_some(chosen, where)
        ready = Prepared(document=document, selection=chosen, split=0)
    else:
        ready = _split_at(_Task(document, where, operation.cut, backend, progress))
    if operation.specks:
        ready = _with_specks(ready, where, operation.specks)
    if operation.refit is not None:
        ready = _refitted(ready, operation, operation.refit, (backend, progress))
    return ready


def _refitted(
    ready: Prepared, operation: Operation, steps: int, how: tuple[str, Progress | None]
) -> Prepared:
    """With what is removed, and what is in its pixels, fitted further."""
    backend, progress = how
    document, chosen, where = ready.document, ready.selection, operation.where
    if chosen is None or where is None:
        return ready
    scene, cut = document.scene, operation.cut
    if cut is not None and cut.by == "masks":
        views = [scene.view(name) for name in cut.views]
        masks, ids = _boundary(_Task(document, where, cut, backend, progress), chosen, views)
    else:
        views = list(scene.train_views or scene.views)
        masks, ids = _drawn(scene.gaussians, chosen, views, backend)
    gaussians = refit(
        scene.gaussians,
        chosen,
        views,
        masks,
        ids,
        steps=steps,
        provenance=scene.provenance,
        backend=backend,
        progress=progress,
    )
    scene = replace(scene, gaussians=gaussians)
    return replace(ready, document=replace(document, scene=scene))


def _drawn(
    gaussians: Gaussians, selection: Selection, views: Sequence[View], backend: str
) -> tuple[LabelSource, tuple[int, ...]]:
    """Label maps that a selection draws, and its id in them."""
    maps = {view.name: view for view in views}
    return _Drawn(gaussians=gaussians, selection=selection, views=maps, backend=backend), (1,)


def _with_specks(ready: Prepared, where: Where, most: int) -> Prepared:
    """With the specks that the selection would leave behind added to it."""
    chosen = ready.selection
    if chosen is None:
        return ready
    named = None
    if where.layer is not None:
        layer = layer_called(ready.document.layers, where.layer)
        named = layer if isinstance(layer, Labels) else None
    gaussians = ready.document.scene.gaussians
    specks = leftovers(gaussians, chosen, most=most, labels=_without(named, where.ids))
    return replace(ready, selection=chosen | specks, specks=specks.count)


def _without(labels: Labels | None, ids: Sequence[int]) -> Labels | None:
    """Labels of other things only: what has one of `ids` is no thing of its own."""
    if labels is None:
        return None
    wanted = torch.tensor(ids, dtype=labels.ids.dtype)
    return replace(labels, ids=torch.where(torch.isin(labels.ids, wanted), UNLABELLED, labels.ids))


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
        named = select_where(
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
    if set(where.conditions) - {"layer", "box"}:
        # What the cut has decided is not asked again.
        rest = replace(where, layer=None, ids=(), box=None)
        now = document.scene.gaussians
        selection = select_where(now, document.layers, rest, among=inside)
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
    if cut.by == "box":
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
    judged = found.evidence > 0
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
        return _drawn(scene.gaussians, named, views, task.backend)
    if cut.evidence is None or not ids:
        raise InputError("cut: masks need the name of evidence, and ids of a layer of labels.")
    if any(edit.get("kind") in MOVES for edit in task.document.history):
        raise InputError(
            "cut: the masks show the scene before it was edited; cut by the layer instead."
        )
    folder = find_evidence(scene.evidence_folders, cut.evidence)
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
            changed: Layer = _selected_by_side(layer, inside)
        case Labels():
            changed = _labels_by_side(layer, where.ids, inside)
            if isinstance(whole, InstanceTree):
                changed = whole.with_cut(changed, level or "object")
        case _:
            return document
    return replace(document, layers={**document.layers, name: changed})


def _selected_by_side(selection: Selection, inside: Selection) -> Selection:
    """The selection with what lies on the other side of the cut moved there, surely."""
    if selection.confidence is None:
        return replace(selection, mask=inside.mask)
    stays = selection.mask == inside.mask
    confidence = torch.where(stays, selection.confidence, inside.mask.to(selection.confidence))
    return replace(selection, mask=inside.mask, confidence=confidence)


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
        index = fits.int().argmax(dim=1, keepdim=True)
        found = fits.any(dim=1)
        first = labels.candidates.gather(1, index).squeeze(1)
        new = torch.where(found, first, torch.where(inside.mask, wanted[0], UNLABELLED)).int()
        share = labels.shares.gather(1, index).squeeze(1)
        confidence = torch.where(right, labels.confidence, torch.where(found, share, 0.0))
        keep = right.unsqueeze(1) | fits
        shares = torch.where(keep, labels.shares, 0.0)
        candidates = torch.where(keep, labels.candidates, UNLABELLED)
        order = torch.argsort(shares, dim=1, descending=True, stable=True)
        labels = replace(
            labels, candidates=candidates.gather(1, order), shares=shares.gather(1, order)
        )
    return replace(labels, ids=torch.where(right, labels.ids, new), confidence=confidence)
