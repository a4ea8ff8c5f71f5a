"""A new scene with things taken out, moved, copied, coloured or joined."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from splatseg.core.boundary import boundary
from splatseg.edit import (
    Document,
    Operation,
    apply,
    load_document,
    prepare,
    save_document,
    undo,
)
from splatseg.edit.document import BASE, HISTORY
from splatseg.errors import InputError, MissingFileError
from splatseg.io.scene_folder import is_scene
from splatseg.lift import CutOptions
from splatseg.render import BackendName
from splatseg.tasks._edit_cut import Cut, measured_change
from splatseg.tasks._edit_operations import operations_of, where_of
from splatseg.tasks._edit_pictures import draw_edit, write_edit_report
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks.edit_options import EditOptions
from splatseg.tasks.new_scene import check_new_folder
from splatseg.tasks.outputs import REPORTS_FOLDER


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
        backend: Who renders.
        observer: Is told of the progress and of what was done.

    Raises:
        InputError: If nothing is selected, names are unknown, or something is in the way.
        MissingFileError: If another scene that is needed is not there.
    """
    check_new_folder(folder)
    root = _root(document)
    if options.undo:
        after, done = _undone(root, document, data, backend, observer)
    else:
        work = _Work(
            options=options,
            cut=Cut(by=options.cut, evidence=options.evidence, options=cut_options or CutOptions()),
            backend=backend,
            observer=observer,
        )
        after, done = _edited(work, document)
    with observer.stage("pictures"):
        pictures = draw_edit(document.scene, after.scene, views=options.pictures, backend=backend)
    saved = save_document(_with_base(root, folder, document, after), folder)
    report = None
    if pictures is not None:
        counts = (len(document.scene.gaussians), len(after.scene.gaussians))
        reports = folder / REPORTS_FOLDER
        write_edit_report(pictures, reports, counts=counts, operations=done)
        report = reports / "edit.html"
    return EditedScene(folder=folder, document=saved, operations=tuple(done), report=report)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Work:
    """What is done, and how."""

    options: EditOptions
    cut: Cut
    backend: BackendName
    observer: Observer


def _root(document: Document) -> Path:
    if document.scene.root is None:
        raise InputError("document: expected a scene read from its folder, got one without.")
    return document.scene.root


def _edited(work: _Work, document: Document) -> tuple[Document, list[Mapping[str, Any]]]:
    options = work.options
    where = where_of(options, document)
    done: list[Mapping[str, Any]] = []
    operations = operations_of(options, document, where, cut=work.cut, observer=work.observer)
    for operation in operations:
        with work.observer.stage(operation.kind) as step:
            ready = prepare(document, operation, backend=work.backend, progress=step)
        measured: dict[str, float] = {}
        added = len(ready.document.scene.gaussians) - len(document.scene.gaussians)
        if ready.split:
            measured = measured_change(
                document, ready.document, views=options.measure, backend=work.backend
            )
            work.observer.info(_split_sentence(operation, ready.split, measured))
            work.observer.info(_growth_sentence(added, len(document.scene.gaussians)))
        after = apply(document, operation, prepared=ready, backend=work.backend)
        count = None if ready.selection is None else ready.selection.count
        if count is not None:
            specks = f", {ready.specks} of them specks" if ready.specks else ""
            work.observer.info(f"{operation.kind}: {count} Gaussians selected{specks}")
        done.append(
            {
                "kind": operation.kind,
                "selected": count,
                "specks": ready.specks,
                "split": ready.split,
                "added": added,
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


def _with_base(root: Path, folder: Path, before: Document, after: Document) -> Document:
    """The document with where the scene was before its first edit."""
    provenance = dict(after.scene.provenance)
    found = before.scene.provenance.get(BASE)
    place = root.resolve()
    if isinstance(found, Mapping):
        place = _base_of(root, before)
    start = folder.resolve()
    provenance[BASE] = {
        "relative": Path(os.path.relpath(place, start)).as_posix(),
        "absolute": place.as_posix(),
    }
    return replace(after, scene=replace(after.scene, provenance=provenance))


def _base_of(root: Path, document: Document) -> Path:
    """Folder of the scene that was edited first, seen from `root` before its absolute place."""
    entry = document.scene.provenance.get(BASE)
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
    base = _base_of(root, document)
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
