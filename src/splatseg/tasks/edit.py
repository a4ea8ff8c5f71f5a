"""A new scene with things taken out, moved, copied, coloured or joined, and pictures of it."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from splatseg.core import Scene, View
from splatseg.core.boundary import boundary
from splatseg.edit import Document, Operation, apply, load_document, prepare, save_document, undo
from splatseg.edit.document import BASE, HISTORY
from splatseg.errors import InputError, MissingFileError
from splatseg.io.images import image_camera
from splatseg.io.scene_folder import is_scene
from splatseg.lift import CutOptions
from splatseg.render import BackendName, render
from splatseg.report.html import Figure, Report
from splatseg.report.images import Gallery, GalleryImage
from splatseg.tasks.edit_operations import EditOptions, measured_change, operations_of, where_of
from splatseg.tasks.work import REPORTS_FOLDER, SILENT, Observer, Work, check_new_folder, write_page

_ASKED_VIEWS = 24
"""Views that are looked at, small, to find those that change most."""


_SMALL, _LARGE = 160, 960
"""Longest side in pixels of these and of those that are shown."""


def draw_edit(before: Scene, after: Scene, *, views: int, backend: BackendName) -> Gallery | None:
    """Draw the views that an edit changes most, before and after it.

    Views are compared by name, each with the camera that it has in its scene: a scene that was
    moved as a whole shows the same.

    Returns:
        None where no view is wanted, or the scenes share none.
    """
    names = {view.name for view in after.views}
    shared = [view for view in before.train_views or before.views if view.name in names]
    if not views or not shared:
        return None
    asked = shared[:: math.ceil(len(shared) / _ASKED_VIEWS)]
    changes: list[float] = []
    for view in asked:
        first, second = (_small_image(s, view.name, _SMALL, backend) for s in (before, after))
        changes.append(float(((first - second) ** 2).mean()))
    order = sorted(range(len(asked)), key=lambda i: (-changes[i], i))[:views]
    return Gallery(
        title="Before and after",
        columns=("before", "after"),
        rows=tuple(_row(before, after, asked[i], backend) for i in order),
        note="The views that change most, the first most of all.",
    )


def _row(
    before: Scene, after: Scene, view: View, backend: BackendName
) -> tuple[str, tuple[GalleryImage, ...]]:
    pictures = (
        GalleryImage(
            image=(_small_image(scene, view.name, _LARGE, backend) * 255 + 0.5).to(torch.uint8),
            caption=f"{view.name}, {when}",
        )
        for scene, when in ((before, "before"), (after, "after"))
    )
    return view.name, tuple(pictures)


def _small_image(scene: Scene, name: str, longest: int, backend: BackendName) -> Tensor:
    camera = image_camera(scene.view(name), longest)
    return render(scene.gaussians, camera, backend=backend).image.clamp(0, 1).cpu()


def write_edit_report(
    pictures: Gallery,
    folder: Path,
    *,
    counts: tuple[int, int],
    operations: Sequence[Mapping[str, Any]],
) -> None:
    """Write edit.html and edit.json in a folder of reports.

    Args:
        folder: The reports of the new scene; made where it is not there.
        pictures: What is shown.
        counts: Gaussians before and after.
        operations: What was done, one entry a step.
    """
    folder.mkdir(exist_ok=True)
    before, after = counts
    figures = (
        Figure(value=f"{before}", label="Gaussians before"),
        Figure(value=f"{after}", label="Gaussians after", note=f"{after - before:+}"),
    )
    summary = " ".join(map(edit_sentence, operations))
    page = Report(title="Edit", summary=summary, figures=figures, blocks=(pictures,))
    record = {
        "before": before,
        "after": after,
        "operations": [dict(operation) for operation in operations],
        "views": [name for name, _ in pictures.rows],
    }
    write_page(page, folder / "edit.html", record=record)


def edit_sentence(operation: Mapping[str, Any]) -> str:
    """What one step did, in words."""
    kind, selected = operation["kind"], operation.get("selected")
    if kind == "undo":
        return f"The last edit ({operation['undone']}) was undone."
    text = f"{kind}: " + ("everything" if selected is None else f"{selected} Gaussians selected")
    if operation.get("specks"):
        text += f", {operation['specks']} of them specks that it would have left behind"
    if operation.get("split"):
        text += (
            f"; {operation['split']} split at the boundary first, which adds {operation['added']}"
        )
    return text + "."


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EditedScene:
    """A new scene folder with its layers, and what was done."""

    folder: Path
    document: Document
    operations: tuple[Mapping[str, Any], ...]
    """One a step: its kind, how many Gaussians were selected, were specks, were split and were
    added by that, what was measured."""

    report: Path | None = None
    """The page of pictures before and after; None where none were wanted or there are no views."""


@boundary
def edit_scene(
    document: Document,
    folder: Path,
    *,
    options: EditOptions,
    cut_options: CutOptions | None = None,
    data: Path | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> EditedScene:
    """Write a new scene with the layers in step and the edit written down.

    It is written whole or not at all; the scene that is edited stays as it is.

    Args:
        document: The scene with its layers, read from its folder.
        folder: The scene folder to write.
        options: What is done.
        cut_options: How Gaussians are split at the boundary of what is selected.
        data: Folder of the capture where it was moved, for the scene that undo begins with.
        backend: Rendering backend.
        observer: Is told of the progress and of what was done.

    Raises:
        InputError: If nothing is selected, names are unknown, or something is in the way.
        MissingFileError: If another scene that is needed is not there.
    """
    check_new_folder(folder)
    root = Work(scene=document.scene).root
    if options.undo:
        after, done = _undone(root, document, data, backend, observer)
    else:
        cut = cut_options or CutOptions()
        after, done = _edited(document, options, cut, backend, observer)
    with observer.stage("pictures"):
        pictures = draw_edit(document.scene, after.scene, views=options.pictures, backend=backend)
    based = with_base(root, folder, document.scene, after.scene)
    saved = save_document(replace(after, scene=based), folder)
    report = None
    if pictures is not None:
        counts = (len(document.scene.gaussians), len(after.scene.gaussians))
        reports = folder / REPORTS_FOLDER
        write_edit_report(pictures, reports, counts=counts, operations=done)
        report = reports / "edit.html"
    return EditedScene(folder=folder, document=saved, operations=tuple(done), report=report)


def _edited(
    document: Document,
    options: EditOptions,
    cut: CutOptions,
    backend: BackendName,
    observer: Observer,
) -> tuple[Document, list[Mapping[str, Any]]]:
    done: list[Mapping[str, Any]] = []
    where = where_of(options, document)
    for operation in operations_of(options, document, where, cut=cut, observer=observer):
        with observer.stage(operation.kind) as step:
            ready = prepare(document, operation, backend=backend, progress=step)
        measured: dict[str, float] = {}
        added = len(ready.document.scene.gaussians) - len(document.scene.gaussians)
        if ready.split:
            if options.pictures:
                measured = measured_change(document, ready.document, backend=backend)
            observer.info(_split_sentence(operation, ready.split, measured))
            observer.info(_growth_sentence(added, len(document.scene.gaussians)))
        after = apply(document, operation, prepared=ready, backend=backend)
        result = after.history[-1]["result"]
        filled = {name: result[name] for name in ("exposed", "filled") if name in result}
        if filled:
            observer.info(
                f"filled with {filled['filled']} Gaussians what was hidden; "
                f"{filled['exposed']} that views hardly saw were removed as well"
            )
        count = None if ready.selection is None else ready.selection.count
        if count is not None:
            specks = f", {ready.specks} of them specks" if ready.specks else ""
            observer.info(f"{operation.kind}: {count} Gaussians selected{specks}")
        done.append(
            {
                "kind": operation.kind,
                "selected": count,
                "specks": ready.specks,
                "split": ready.split,
                "added": added,
                **filled,
                **measured,
            }
        )
        document = _with_result(after, measured)
    return document, done


def _split_sentence(operation: Operation, split: int, measured: Mapping[str, float]) -> str:
    by = "" if operation.cut is None else f" at the boundary ({operation.cut.by})"
    text = f"{split} Gaussians split{by}"
    if measured:
        text += (
            f": renders before and after are {measured['split_psnr']:.1f} dB apart in "
            f"{measured['views']} views"
        )
    if "photographs_after" in measured:
        text += (
            f", PSNR against photographs {measured['photographs_before']:.2f} -> "
            f"{measured['photographs_after']:.2f} dB"
        )
    return text


def _growth_sentence(added: int, before: int) -> str:
    return (
        f"splitting added {added} Gaussians, {added / before:.0%} of the scene; --cut off splits "
        "none, a larger --min-pixels fewer"
    )


def _with_result(document: Document, measured: Mapping[str, float]) -> Document:
    """The document with what was measured beside its last edit."""
    *earlier, last = document.history
    entry = {**last, "result": {**last["result"], **measured}}
    provenance = dict(document.scene.provenance) | {HISTORY: [*earlier, entry]}
    return replace(document, scene=replace(document.scene, provenance=provenance))


def with_base(root: Path, folder: Path, before: Scene, after: Scene) -> Scene:
    """The scene after an edit, with where it was before its first edit.

    Args:
        root: Folder of the scene that was edited.
        folder: Where the new one is to be.
        before: The one that was edited.
        after: The new one.
    """
    edited = isinstance(before.provenance.get(BASE), Mapping)
    place = _base_of(root, before) if edited else root.resolve()
    relative = Path(os.path.relpath(place, folder.resolve())).as_posix()
    base = {"relative": relative, "absolute": place.as_posix()}
    return replace(after, provenance=dict(after.provenance) | {BASE: base})


def _base_of(root: Path, scene: Scene) -> Path:
    """Folder of the scene that was edited first, seen from `root` before its absolute place."""
    entry = scene.provenance.get(BASE)
    if not isinstance(entry, Mapping):
        raise InputError(f"{root}: expected a scene with an edit to undo, got one without.")
    table = cast("Mapping[str, Any]", entry)
    places = [
        Path(os.path.normpath(root.resolve() / str(table.get("relative")))),
        Path(str(table.get("absolute"))),
    ]
    return next((place for place in places if is_scene(place)), places[1])


def _undone(
    root: Path, document: Document, data: Path | None, backend: BackendName, observer: Observer
) -> tuple[Document, list[Mapping[str, Any]]]:
    base = _base_of(root, document.scene)
    if not is_scene(base):
        raise MissingFileError(
            f"{base}: the scene that was edited first is not there; undo does its edits again."
        )
    first = load_document(base, data=data)
    dropped = document.history[-1].get("kind") if document.history else "nothing"
    with observer.stage("undo") as step:
        before = undo(first, document, backend=backend, progress=step)
    observer.info(f"undone: {dropped}; {len(before.history)} edits are left")
    return before, [{"kind": "undo", "undone": dropped, "edits_left": len(before.history)}]
