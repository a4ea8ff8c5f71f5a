"""A scene in chunks edited: chunk by chunk from the one on the disk into a new one."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from splatseg.core import Edited, Gaussians, Layer, Scene, Selection, Similarity, apply_rows
from splatseg.core.boundary import boundary
from splatseg.core.chunks import Chunks
from splatseg.core.gaussians import no_gaussians
from splatseg.edit import Document, Operation, Recolour, recolour, transform
from splatseg.edit.document import HISTORY
from splatseg.edit.history import moved_scene
from splatseg.errors import InputError
from splatseg.io.chunks import ChunkWriter, open_chunks
from splatseg.io.scene import GaussiansToWrite, load_scene, save_scene_in_chunks
from splatseg.lift import CutOptions
from splatseg.render import BackendName
from splatseg.selection import select_where
from splatseg.tasks.edit import EditedScene, draw_edit, with_base, write_edit_report
from splatseg.tasks.edit_operations import EditOptions, operations_of, where_of
from splatseg.tasks.work import (
    REPORTS_FOLDER,
    SILENT,
    Observer,
    Work,
    check_new_folder,
    check_streams,
)


@boundary
def edit_chunks(
    scene: Scene,
    folder: Path,
    *,
    options: EditOptions,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> EditedScene:
    """Write a new scene in chunks with one edit done, and the layers in step.

    It is written whole or not at all; the scene that is edited stays as it is. Rows stay in their
    order, and copies come behind them, as in memory.

    Args:
        scene: The scene, opened to be streamed.
        folder: The scene folder to write.
        options: What is done: an extract, a removal, a copy, moves or colours.
        backend: Rendering backend, for pictures.
        observer: Is told of the progress and of what was done.

    Raises:
        InputError: If nothing is selected, or the edit needs all Gaussians at once: a merge, an
            undo, a refit, a fill, a cut of Gaussians, specks.
    """
    check_new_folder(folder)
    work = Work(scene=scene, backend=backend, observer=observer)
    chunks = scene.gaussians.chunks
    if chunks is None:
        raise InputError("scene: expected one in chunks, got one in memory.")
    _check(scene, options)
    named = () if options.layer is None else (options.layer.partition("@")[0],)
    document = Document(scene=scene, layers={name: work.layer(name) for name in named})
    where = where_of(options, document)
    operations = operations_of(options, document, where, cut=CutOptions(), observer=observer)
    if len(operations) != 1:
        kinds = " and ".join(one.kind for one in operations)
        raise InputError(
            f"{kinds}: expected one of them on a scene in chunks, got both; give the other to an "
            "edit of the result."
        )
    operation = operations[0]
    chosen = None if where is None else select_where(scene.gaussians, document.layers, where)
    if chosen is not None and where is not None and not chosen.count:
        raise InputError(
            f"selection: expected at least one Gaussian, got none of {where.to_json()}."
        )
    rows = _rows_after(operation, chosen, len(scene.gaussians))
    after = _recorded(document, operation, len(rows))
    del document
    with observer.stage(operation.kind) as step:

        def write(into: Path) -> None:
            like = scene.gaussians[:1]
            half = scene.gaussians.sh.dtype == torch.float16
            with ChunkWriter(into, len(rows), like=like, half=half) as writer:
                for part in _edited_parts(scene.gaussians, chunks, operation, chosen):
                    writer.append(part)
                    step(writer.written, len(rows))

        def layers(written: Path) -> Iterable[tuple[str, Layer]]:
            edited = Edited(gaussians=open_chunks(written, memory=chunks.memory), rows=rows)
            for name in work.layer_names:
                yield name, apply_rows(work.layer(name), edited)

        save_scene_in_chunks(
            with_base(work.root, folder, scene, after),
            GaussiansToWrite(count=len(rows), write=write),
            folder,
            layers=layers,
        )
    saved = load_scene(folder, memory=chunks.memory)
    count = None if chosen is None else chosen.count
    if count is not None:
        observer.info(f"{operation.kind}: {count} Gaussians selected")
    done: Mapping[str, Any] = {
        "kind": operation.kind, "selected": count, "specks": 0, "split": 0, "added": 0,
    }  # fmt: skip
    with observer.stage("pictures"):
        pictures = draw_edit(scene, saved, views=options.pictures, backend=backend)
    report = None
    if pictures is not None:
        counts = (len(scene.gaussians), len(rows))
        write_edit_report(pictures, folder / REPORTS_FOLDER, counts=counts, operations=[done])
        report = folder / REPORTS_FOLDER / "edit.html"
    return EditedScene(
        folder=folder, document=Document(scene=saved), operations=(done,), report=report
    )


def _check(scene: Scene, options: EditOptions) -> None:
    """Refuse what needs all Gaussians at once."""
    for name, asked in (
        ("merge", options.merge is not None),
        ("undo", options.undo),
        ("refit", bool(options.refit)),
        ("fill", options.fill is not None),
    ):
        if asked:
            check_streams(scene, name)
    if options.cut != "off" and {"layer", "box"} & set(options.conditions):
        check_streams(scene, f"cut {options.cut} (off splits none)")
    if options.remove and options.layer is not None and not options.invert and options.specks:
        check_streams(scene, f"specks {options.specks} (0 leaves them)")


def _rows_after(operation: Operation, chosen: Selection | None, count: int) -> Tensor:
    """Which row each one comes from."""
    if operation.kind == "duplicate" and chosen is not None:
        return torch.cat((torch.arange(count), chosen.ids))
    if operation.kind == "extract" and chosen is not None:
        return chosen.ids
    if operation.kind == "remove" and chosen is not None:
        if chosen.count == count:
            raise InputError(f"selection: expected to leave Gaussians, got all {count}.")
        return (~chosen).ids
    return torch.arange(count)


def _recorded(document: Document, operation: Operation, count: int) -> Scene:
    """The scene without its Gaussians after an edit, which is written down as `edit.apply` does."""
    scene = replace(document.scene, gaussians=no_gaussians())
    if operation.kind == "transform" and operation.where is None:
        scene = moved_scene(scene, cast("Similarity", operation.transform))
    result = {"before": len(document.scene.gaussians), "after": count, "split": 0, "added": 0}
    edits = [*document.history, operation.to_json() | {"result": result}]
    return replace(scene, provenance=dict(scene.provenance) | {HISTORY: edits})


def _edited_parts(
    gaussians: Gaussians, chunks: Chunks, operation: Operation, chosen: Selection | None
) -> Iterator[Gaussians]:
    """All chunks after the edit, those of copies last."""
    for first, end, part in _parts(gaussians, chunks):
        own = None if chosen is None else chosen[slice(first, end)]
        yield _edited(part, operation, own)
    if operation.kind == "duplicate" and chosen is not None:
        moved = cast("Similarity", operation.transform)
        for first, end, part in _parts(gaussians, chunks):
            copied = part[chosen.mask[first:end]]
            if len(copied):
                yield copied.transformed(moved)


def _parts(gaussians: Gaussians, chunks: Chunks) -> Iterator[tuple[int, int, Gaussians]]:
    """One chunk after the other: its first row, the one behind its last, and its Gaussians."""
    for first, end in pairwise(chunks.starts.tolist()):
        extra = {name: column[first:end] for name, column in gaussians.extra.items()}
        yield first, end, chunks.read([(first, end)]).replace(extra=extra)


def _edited(part: Gaussians, operation: Operation, own: Selection | None) -> Gaussians:
    """A chunk after the edit."""
    match operation.kind:
        case "extract" if own is not None:
            return part[own.mask]
        case "remove" if own is not None:
            return part[~own.mask]
        case "transform" if own is None or own.count:
            moved = cast("Similarity", operation.transform)
            return transform(part, moved, selection=own).gaussians
        case "recolour" if own is None or own.count:
            how = cast("Recolour", operation.recolour)
            return recolour(part, own, **asdict(how)).gaussians
        case _:
            return part
