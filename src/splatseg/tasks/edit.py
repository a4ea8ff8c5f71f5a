"""A new scene with things taken out, moved, copied, coloured or joined."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

import torch

from splatseg.core import Labels, Similarity
from splatseg.edit import (
    Document,
    Operation,
    Recolour,
    Where,
    apply,
    ids_named,
    layer_called,
    load_document,
    prepare,
    save_document,
    select,
    undo,
)
from splatseg.edit.document import BASE, HISTORY
from splatseg.errors import InputError, MissingFileError
from splatseg.io.scene import is_scene
from splatseg.lift import CutOptions
from splatseg.render import BackendName
from splatseg.tasks._edit_cut import Cut, cut_of, measured_change
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks.new_scene import check_new_folder

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class EditOptions:
    """What is selected, and what is done with it."""

    extract: bool = False
    """Keep what is selected, and nothing else."""

    remove: bool = False
    """Leave out what is selected."""

    duplicate: bool = False
    """Add a copy of what is selected, moved by `move`, `rotate` and `scale`."""

    merge: Path | None = None
    """Add the Gaussians and layers of another scene folder. Its ids that clash get new numbers,
    except where both scenes have the same name for an id."""

    undo: bool = False
    """Write SCENE as it was before its last edit: all others are done again on the scene that
    was edited first, which must still be where it was."""

    layer: str | None = None
    """Layer that names what is selected: labels, with `ids` or `names`, or a selection."""

    ids: tuple[int, ...] = ()
    """Ids of the layer."""

    names: tuple[str, ...] = ()
    """Names of ids, in the layer or the scene's classes. All ids of a name are meant."""

    box: tuple[float, float, float, float, float, float] | None = None
    """Least x, y, z and largest x, y, z of a box in the world, scene units."""

    invert: bool = False
    """Select all others instead."""

    move: Triple | None = None
    """Shift along x, y, z, scene units."""

    rotate: tuple[float, float, float, float] | None = None
    """Axis x, y, z and angle in degrees, right-handed."""

    scale: float = 1.0
    """Factor of the size."""

    about: Triple | None = None
    """The point that `rotate` and `scale` leave where it is, world. None is the median
    of what is selected, and the origin of OTHER for `merge`."""

    colour: Triple | None = None
    """Red, green, blue in [0, 1] that the mean colour of every Gaussian becomes."""

    colour_scale: Triple | None = None
    """Factors of red, green, blue."""

    colour_shift: Triple | None = None
    """Added to red, green, blue after that, in [-1, 1]."""

    flat_colour: bool = False
    """Drop what of the colour changes with the direction it is seen from."""

    cut: Literal["auto", "masks", "layer", "box", "off"] = "auto"
    """Where Gaussians that reach over the boundary are cut in two. masks: at the label maps that
    the layer was made from; layer: at the boundary that the layer itself draws in training views;
    box: at the box only; off: nowhere. auto: masks where the layer knows them and nothing was
    edited yet, else layer, and always the box."""

    evidence: str | None = None
    """Name of the label maps for `cut` masks. None takes those the layer was made from."""

    measure: int = 4
    """Training views in which the change by the cut alone is measured. 0 skips it."""

    def __post_init__(self) -> None:
        action = self._action()
        selecting = self.layer is not None or self.box is not None
        if action in ("extract", "remove", "duplicate") and not selecting:
            raise InputError(f"{action}: expected `layer` or `box`, got neither.")
        if action in ("merge", "undo") and selecting:
            raise InputError(f"{action}: takes no selection.")
        if action in ("remove", "undo") and self.moves:
            raise InputError(f"{action}: takes no `move`, `rotate` or `scale`.")
        if action in ("remove", "duplicate", "merge", "undo") and self.recolours:
            raise InputError(f"{action}: takes no colours; colour in an edit of its own.")
        if (self.ids or self.names) and self.layer is None:
            raise InputError("ids, names: expected `layer` that they are of, got none.")
        if action is None and not self.moves and not self.recolours:
            raise InputError(
                "edit: expected something to do, such as `remove` or `move`, got nothing."
            )
        if self.invert and not selecting:
            raise InputError("invert: expected `layer` or `box`, got neither.")
        if self.measure < 0:
            raise InputError(f"measure: expected 0 or more, got {self.measure}.")

    def _action(self) -> str | None:
        actions = {
            "extract": self.extract,
            "remove": self.remove,
            "duplicate": self.duplicate,
            "merge": self.merge is not None,
            "undo": self.undo,
        }
        given = [name for name, on in actions.items() if on]
        if len(given) > 1:
            raise InputError(f"{given[0]}, {given[1]}: expected one of the two, got both.")
        return given[0] if given else None

    @property
    def moves(self) -> bool:
        """Whether something changes its pose or size."""
        return self.move is not None or self.rotate is not None or self.scale != 1

    @property
    def recolours(self) -> bool:
        """Whether something changes its colour."""
        colours = (self.colour, self.colour_scale, self.colour_shift)
        return self.flat_colour or any(value is not None for value in colours)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EditedScene:
    """A new scene folder with its layers, and what was done."""

    folder: Path
    document: Document
    operations: tuple[Mapping[str, Any], ...]
    """One a step: its kind, how many Gaussians were selected and split, what was measured."""


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
    saved = save_document(_with_base(root, folder, document, after), folder)
    return EditedScene(folder=folder, document=saved, operations=tuple(done))


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
    where = _where(work.options, document)
    done: list[Mapping[str, Any]] = []
    for operation in _operations(work, document, where):
        with work.observer.stage(operation.kind) as step:
            ready = prepare(document, operation, backend=work.backend, progress=step)
        measured: dict[str, float] = {}
        if ready.split:
            measured = measured_change(
                document, ready.document, views=work.options.measure, backend=work.backend
            )
            work.observer.info(_split_sentence(operation, ready.split, measured))
        after = apply(document, operation, prepared=ready, backend=work.backend)
        count = None if ready.selection is None else ready.selection.count
        if count is not None:
            work.observer.info(f"{operation.kind}: {count} Gaussians selected")
        done.append({"kind": operation.kind, "selected": count, "split": ready.split, **measured})
        document = _with_result(after, measured)
    return document, done


def _where(options: EditOptions, document: Document) -> Where | None:
    if options.layer is None and options.box is None:
        return None
    ids = options.ids
    if options.names and options.layer is not None:
        layer = layer_called(document.layers, options.layer)
        if isinstance(layer, Labels):
            named = ids_named(layer, options.names, classes=document.scene.classes)
            ids = tuple(sorted({*ids, *named}))
        else:
            raise InputError(f"names: layer {options.layer!r} has no names.")
    return Where(layer=options.layer, ids=ids, box=options.box, invert=options.invert)


def _operations(work: _Work, document: Document, where: Where | None) -> tuple[Operation, ...]:
    """What the flags ask for, in the order in which it is done."""
    options = work.options
    if options.merge is not None:
        moved = _similarity(options, torch.zeros(3)) if options.moves else None
        other = Path(os.path.relpath(options.merge.resolve()))
        if not is_scene(other):
            raise MissingFileError(f"{options.merge}: expected a scene folder, got none.")
        absolute = options.merge.resolve().as_posix()
        return (Operation(kind="merge", other=absolute, transform=moved),)
    cut = None if where is None else cut_of(document, where, work.cut, work.observer)
    found: list[Operation] = []
    if options.extract or options.remove:
        kind: Literal["extract", "remove"] = "extract" if options.extract else "remove"
        found.append(Operation(kind=kind, where=where, cut=cut))
    if options.duplicate:
        moved = _similarity(options, _median(document, where))
        return (Operation(kind="duplicate", where=where, transform=moved, cut=cut),)
    # Colours before moves: a box still means the same Gaussians then. One split is enough.
    if options.recolours:
        how = _recolour(options)
        split = None if found else cut
        found.append(Operation(kind="recolour", where=where, recolour=how, cut=split))
    if options.moves:
        moved = _similarity(options, _median(document, where))
        split = None if found else cut
        found.append(Operation(kind="transform", where=where, transform=moved, cut=split))
    return tuple(found)


def _median(document: Document, where: Where | None) -> torch.Tensor:
    gaussians = document.scene.gaussians
    if where is not None:
        chosen = select(gaussians, document.layers, where)
        gaussians = gaussians[chosen.mask] if chosen.count else gaussians
    return gaussians.means.double().median(dim=0).values


def _similarity(options: EditOptions, median: torch.Tensor) -> Similarity:
    """Scale and turn about a point, then move: x -> scale R (x - about) + about + move."""
    about = median.double()
    if options.about is not None:
        about = torch.tensor(options.about, dtype=torch.float64)
    rotation = torch.eye(3, dtype=torch.float64)
    if options.rotate is not None:
        rotation = _rotation(options.rotate)
    move = torch.tensor(options.move or (0.0, 0.0, 0.0), dtype=torch.float64)
    return Similarity(
        rotation=rotation,
        translation=about - options.scale * (rotation @ about) + move,
        scale=options.scale,
    )


def _rotation(rotate: tuple[float, float, float, float]) -> torch.Tensor:
    """Rodrigues' formula."""
    *axis, degrees = rotate
    vector = torch.tensor(axis, dtype=torch.float64)
    length = float(torch.linalg.vector_norm(vector))
    if not 0 < length < math.inf or not math.isfinite(degrees):
        raise InputError(f"rotate: expected an axis that is not zero and degrees, got {rotate}.")
    x, y, z = (vector / length).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    angle = math.radians(degrees)
    eye = torch.eye(3, dtype=torch.float64)
    return eye + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)


def _recolour(options: EditOptions) -> Recolour:
    return Recolour(
        colour=options.colour,
        scale=options.colour_scale or (1.0, 1.0, 1.0),
        shift=options.colour_shift or (0.0, 0.0, 0.0),
        view_dependent=not options.flat_colour,
    )


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
