"""Edits of a whole document, one after the other, written down so that they can be repeated.

Each edit leaves its `Operation` in the scene's provenance under ``edits``. `replay` of them over
the scene that was before the first gives the same scene again; `undo` is replay without the
last. Nothing is changed in place, so that whoever keeps an earlier document has it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, cast

import torch

from splatseg.core import Edited, Gaussians, Scene, Selection, Similarity, View
from splatseg.core.boundary import boundary
from splatseg.edit.document import HISTORY, Document, FillBy, Operation, Recolour, load_document
from splatseg.edit.holes import exposed, fill, filled_layer
from splatseg.edit.inpainting import find_inpainter
from splatseg.edit.operations import (
    duplicate,
    extract,
    merge,
    merged_layers,
    recolour,
    remove,
    transform,
)
from splatseg.edit.prepare import Prepared, Progress, prepare
from splatseg.errors import InputError


@boundary
def apply(
    document: Document,
    operation: Operation,
    *,
    prepared: Prepared | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
) -> Document:
    """Do one edit and write it down.

    Args:
        document: The scene with its layers.
        operation: The edit.
        prepared: What `prepare` made of the two, where the caller has it already.
        backend: Who renders, for cuts by pixels.
        progress: Called with the views done and all there are to do.

    Returns:
        A new document; the last of its `history` is this edit with, under ``result``, the
        numbers of Gaussians before and after, of those that were split and by how many the scene
        grew by that, and of specks that went along.

    Raises:
        InputError: If the edit cannot be done; one sentence says why.
    """
    ready = prepared or prepare(document, operation, backend=backend, progress=progress)
    now, chosen = ready.document, ready.selection
    scene = now.scene
    counts: dict[str, int] = {}
    match operation.kind:
        case "split":
            after = now
        case "merge":
            after = _merged(now, load_document(operation.other or ""), operation.transform)
        case "transform" if chosen is None:
            after = replace(now, scene=moved_scene(scene, cast("Similarity", operation.transform)))
        case "remove" if operation.fill is not None and chosen is not None:
            after, counts = _removed_and_filled(now, chosen, operation.fill, (backend, progress))
        case _:
            after = now.edited(_edited(scene.gaussians, chosen, operation))
    result = {
        "before": len(document.scene.gaussians),
        "after": len(after.scene.gaussians),
        "split": ready.split,
        "added": len(now.scene.gaussians) - len(document.scene.gaussians),
        **counts,
    }
    if operation.specks is not None:
        result["specks"] = ready.specks
    edits = [*document.history, operation.to_json() | {"result": result}]
    provenance = dict(after.scene.provenance) | {HISTORY: edits}
    return replace(after, scene=replace(after.scene, provenance=provenance))


def _edited(gaussians: Gaussians, chosen: Selection | None, operation: Operation) -> Edited:
    everything = Selection(mask=torch.ones(len(gaussians), dtype=torch.bool))
    moved = cast("Similarity", operation.transform)  # an operation has what its kind must have
    match operation.kind:
        case "extract":
            return extract(gaussians, chosen or everything)
        case "remove":
            return remove(gaussians, chosen or everything)
        case "duplicate":
            return duplicate(gaussians, chosen or everything, moved)
        case "transform":
            return transform(gaussians, moved, selection=chosen)
        case _:
            how = cast("Recolour", operation.recolour)
            return recolour(gaussians, chosen, **asdict(how))


def _removed_and_filled(
    document: Document, removed: Selection, by: FillBy, how: tuple[str, Progress | None]
) -> tuple[Document, dict[str, int]]:
    """Take something out, and continue behind it what it hid; what was counted by its name."""
    backend, progress = how
    gaussians = document.scene.gaussians
    views = [document.scene.view(name) for name in by.views]
    uncertain = exposed(gaussians, removed, views, backend=backend)
    removed = removed | uncertain
    found = fill(
        gaussians,
        removed,
        views,
        inpainter=find_inpainter(by.inpainter),
        backend=backend,
        progress=progress,
    )
    after = document.edited(remove(gaussians, removed | found.replaced))
    joined = Gaussians.concatenate([after.scene.gaussians, found.gaussians])
    filled = Document(
        scene=replace(after.scene, gaussians=joined),
        layers={name: filled_layer(layer, found, joined) for name, layer in after.layers.items()},
    )
    return filled, {
        "exposed": uncertain.count + found.replaced.count,
        "filled": len(found.gaussians),
    }


def _merged(document: Document, other: Document, moved: Similarity | None) -> Document:
    edited = merge(document.scene.gaussians, other.scene.gaussians, target_from_other=moved)
    return Document(
        scene=replace(document.scene, gaussians=edited.gaussians),
        layers=merged_layers(document.layers, other.layers, edited),
    )


def moved_view(view: View, new_from_old: Similarity) -> View:
    """A view in another frame; its depth maps keep their steps, whose unit changes."""
    unit = None if view.depth_unit is None else view.depth_unit * new_from_old.scale
    return replace(view, camera=view.camera.moved(new_from_old), depth_unit=unit)


def moved_scene(scene: Scene, new_from_old: Similarity) -> Scene:
    """A scene in another frame: cameras, up and units move with the Gaussians."""
    up = scene.up
    if up is not None:
        x, y, z = (new_from_old.rotation.double() @ torch.tensor(up).double()).tolist()
        up = (x, y, z)
    metres = scene.metres_per_unit
    return replace(
        scene,
        gaussians=scene.gaussians.transformed(new_from_old),
        views=tuple(moved_view(view, new_from_old) for view in scene.views),
        up=up,
        metres_per_unit=None if metres is None else metres / new_from_old.scale,
    )


@boundary
def replay(
    document: Document,
    history: Sequence[Mapping[str, Any]],
    *,
    backend: str = "auto",
    progress: Progress | None = None,
) -> Document:
    """Do the edits of a history again, over the document that was before the first.

    Args:
        document: The scene with its layers before the edits.
        history: `Document.history` of the edited one, or a part of it.
        backend: Who renders, for cuts by pixels.
        progress: Called with the views done and all there are to do, anew for each edit.

    Raises:
        InputError: If an entry is no edit, or cannot be done on what it finds.
    """
    for entry in history:
        operation = Operation.from_json(entry)
        document = apply(document, operation, backend=backend, progress=progress)
    return document


@boundary
def undo(
    base: Document,
    edited: Document,
    *,
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
    return replay(base, history[:-1], backend=backend, progress=progress)
