"""``splatseg edit``: a new scene with things taken out, moved, copied, coloured or joined."""

import math
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import torch
import tyro

from splatseg.cli._progress import progress
from splatseg.cli._work import check_new_scene
from splatseg.core import Gaussians, Labels, Similarity, View
from splatseg.edit import (
    CutBy,
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
from splatseg.evaluate import psnr, render_and_photograph
from splatseg.io.evidence import find_evidence, open_evidence
from splatseg.io.scene import is_scene
from splatseg.lift import CutOptions
from splatseg.methods import keeps_ids
from splatseg.render import BackendName, render
from splatseg.tasks.scene_parts import views_that_made

Triple = tuple[float, float, float]
_DRAWN_VIEWS = 40
"""Most views in which a layer draws its own boundary."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Edit a scene: what is selected is removed, kept alone, copied, moved or coloured.

    The result is a new scene with the layers in step and the edit written down; SCENE stays as
    it is. What is selected: --layer with --ids or --names, a layer that is a selection, a --box,
    or a layer within a box. One of --extract, --remove, --duplicate or --merge may be given;
    --move, --rotate, --scale and the colours go with --extract and alone, moves also with
    --duplicate (the copy moves) and --merge (OTHER moves). Without a selection moves and colours
    are of the whole scene, and its cameras move along.

    Gaussians that reach over the boundary of what is selected are split first (--split), so that
    no half of them goes along or stays behind; how much that alone changes pictures is printed.

    For example:

    splatseg edit room -o room-without-chair --remove --layer objects --names chair

    splatseg edit room -o two-chairs --duplicate --layer objects --ids 3 --move 1 0 0

    splatseg edit room -o corner --extract --box -1 -1 0 1 1 2

    splatseg edit room -o room-before --undo
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """The scene folder."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="NEW")]
    """The scene folder to write. It must not be there yet."""

    extract: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Keep what is selected, and nothing else."""

    remove: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Leave out what is selected."""

    duplicate: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Add a copy of what is selected, moved by --move, --rotate and --scale."""

    merge: Annotated[Path | None, tyro.conf.arg(metavar="OTHER")] = None
    """Add the Gaussians and layers of another scene folder. Its ids that clash get new numbers,
    except where both scenes have the same name for an id."""

    undo: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write SCENE as it was before its last edit: all others are done again on the scene that
    was edited first, which must still be where it was."""

    layer: str | None = None
    """Layer that names what is selected: labels, with --ids or --names, or a selection."""

    ids: tuple[int, ...] = ()
    """Ids of the layer."""

    names: tuple[str, ...] = ()
    """Names of ids, in the layer or the scene's classes. All ids of a name are meant."""

    box: tuple[float, float, float, float, float, float] | None = None
    """Least x, y, z and largest x, y, z of a box in the world, scene units."""

    invert: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Select all others instead."""

    move: Triple | None = None
    """Shift along x, y, z, scene units."""

    rotate: tuple[float, float, float, float] | None = None
    """Axis x, y, z and angle in degrees, right-handed."""

    scale: float = 1.0
    """Factor of the size."""

    about: Triple | None = None
    """The point that --rotate and --scale leave where it is, world. None is the middle (median)
    of what is selected, and the origin of OTHER for --merge."""

    colour: Triple | None = None
    """Red, green, blue in [0, 1] that the mean colour of every Gaussian becomes."""

    colour_scale: Triple | None = None
    """Factors of red, green, blue."""

    colour_shift: Triple | None = None
    """Added to red, green, blue after that, in [-1, 1]."""

    flat_colour: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Drop what of the colour changes with the direction it is seen from."""

    split: Literal["auto", "masks", "layer", "box", "off"] = "auto"
    """Where Gaussians are split. masks: at the label maps that the layer was made from; layer:
    at the boundary that the layer itself draws in training views; box: at the box only; off:
    nowhere. auto: masks where the layer knows them and nothing was edited yet, else layer, and
    always the box."""

    evidence: str | None = None
    """Name of the label maps for --split masks. None takes those the layer was made from."""

    measure: int = 4
    """Training views in which the change by the split alone is measured. 0 skips it."""

    backend: BackendName = "auto"
    """Who renders. auto: cuda for scenes on a GPU, cpu otherwise."""

    data: Path | None = None
    """Folder of the capture, where it was moved."""

    cut: CutOptions = field(default_factory=CutOptions)
    """How Gaussians are split."""


def run(command: Command) -> None:
    """Edit a scene."""
    _check(command)
    document = load_document(command.scene, data=command.data)
    after = _undone(command, document) if command.undo else _edited(command, document)
    saved = save_document(_with_base(command, document, after), command.output)
    layers = ", ".join(saved.layers) or "no layers"
    sys.stdout.write(f"{command.output}: {len(saved.scene.gaussians)} Gaussians; {layers}\n")


def _check(command: Command) -> None:
    """Refuse before the work what makes no sense or could not be written after it."""
    check_new_scene(command.output)
    actions = {
        "--extract": command.extract,
        "--remove": command.remove,
        "--duplicate": command.duplicate,
        "--merge": command.merge is not None,
        "--undo": command.undo,
    }
    given = [name for name, on in actions.items() if on]
    if len(given) > 1:
        raise InputError(f"{given[0]}, {given[1]}: expected one of the two, got both.")
    action = given[0] if given else None
    selecting = command.layer is not None or command.box is not None
    if action in ("--extract", "--remove", "--duplicate") and not selecting:
        raise InputError(f"{action}: expected --layer or --box, got neither.")
    if action in ("--merge", "--undo") and selecting:
        raise InputError(f"{action}: takes no selection.")
    if action in ("--remove", "--undo") and _moves(command):
        raise InputError(f"{action}: takes no --move, --rotate or --scale.")
    if action in ("--remove", "--duplicate", "--merge", "--undo") and _colours(command):
        raise InputError(f"{action}: takes no colours; colour in an edit of its own.")
    if (command.ids or command.names) and command.layer is None:
        raise InputError("--ids, --names: expected --layer that they are of, got none.")
    if action is None and not _moves(command) and not _colours(command):
        raise InputError("edit: expected something to do, such as --remove or --move, got nothing.")
    if command.invert and not selecting:
        raise InputError("--invert: expected --layer or --box, got neither.")
    if command.measure < 0:
        raise InputError(f"--measure: expected 0 or more, got {command.measure}.")


def _moves(command: Command) -> bool:
    return command.move is not None or command.rotate is not None or command.scale != 1


def _colours(command: Command) -> bool:
    colours = (command.colour, command.colour_scale, command.colour_shift)
    return command.flat_colour or any(value is not None for value in colours)


def _edited(command: Command, document: Document) -> Document:
    where = _where(command, document)
    operations = _operations(command, document, where)
    for operation in operations:
        with progress(operation.kind) as step:
            ready = prepare(document, operation, backend=command.backend, progress=step)
        measured: dict[str, float] = {}
        if ready.split:
            measured = _measured(command, document, ready.document)
            sys.stdout.write(_told(operation, ready.split, measured))
        after = apply(document, operation, prepared=ready, backend=command.backend)
        if ready.selection is not None:
            count = ready.selection.count
            sys.stdout.write(f"{operation.kind}: {count} Gaussians selected\n")
        document = _with_result(after, measured)
    return document


def _where(command: Command, document: Document) -> Where | None:
    if command.layer is None and command.box is None:
        return None
    ids = command.ids
    if command.names and command.layer is not None:
        layer = layer_called(document.layers, command.layer)
        if isinstance(layer, Labels):
            named = ids_named(layer, command.names, classes=document.scene.classes)
            ids = tuple(sorted({*ids, *named}))
        else:
            raise InputError(f"--names: layer {command.layer!r} has no names.")
    return Where(layer=command.layer, ids=ids, box=command.box, invert=command.invert)


def _operations(command: Command, document: Document, where: Where | None) -> tuple[Operation, ...]:
    """What the flags ask for, in the order in which it is done."""
    if command.merge is not None:
        moved = _similarity(command, torch.zeros(3)) if _moves(command) else None
        other = Path(os.path.relpath(command.merge.resolve()))
        if not is_scene(other):
            raise MissingFileError(f"{command.merge}: expected a scene folder, got none.")
        absolute = command.merge.resolve().as_posix()
        return (Operation(kind="merge", other=absolute, transform=moved),)
    cut = None if where is None else _cut(command, document, where)
    found: list[Operation] = []
    if command.extract or command.remove:
        kind: Literal["extract", "remove"] = "extract" if command.extract else "remove"
        found.append(Operation(kind=kind, where=where, cut=cut))
    if command.duplicate:
        moved = _similarity(command, _middle(document, where))
        return (Operation(kind="duplicate", where=where, transform=moved, cut=cut),)
    # Colours before moves: a box still means the same Gaussians then. One split is enough.
    if _colours(command):
        how = _recolour(command)
        split = None if found else cut
        found.append(Operation(kind="recolour", where=where, recolour=how, cut=split))
    if _moves(command):
        moved = _similarity(command, _middle(document, where))
        split = None if found else cut
        found.append(Operation(kind="transform", where=where, transform=moved, cut=split))
    return tuple(found)


def _middle(document: Document, where: Where | None) -> torch.Tensor:
    gaussians = document.scene.gaussians
    if where is not None:
        chosen = select(gaussians, document.layers, where)
        gaussians = gaussians[chosen.mask] if chosen.count else gaussians
    return gaussians.means.double().median(dim=0).values


def _similarity(command: Command, middle: torch.Tensor) -> Similarity:
    """Scale and turn about a point, then move: x -> scale R (x - about) + about + move."""
    about = middle.double()
    if command.about is not None:
        about = torch.tensor(command.about, dtype=torch.float64)
    rotation = torch.eye(3, dtype=torch.float64)
    if command.rotate is not None:
        rotation = _rotation(command.rotate)
    move = torch.tensor(command.move or (0.0, 0.0, 0.0), dtype=torch.float64)
    return Similarity(
        rotation=rotation,
        translation=about - command.scale * (rotation @ about) + move,
        scale=command.scale,
    )


def _rotation(rotate: tuple[float, float, float, float]) -> torch.Tensor:
    """Rodrigues' formula."""
    *axis, degrees = rotate
    vector = torch.tensor(axis, dtype=torch.float64)
    length = float(torch.linalg.vector_norm(vector))
    if not 0 < length < math.inf or not math.isfinite(degrees):
        raise InputError(f"--rotate: expected an axis that is not zero and degrees, got {rotate}.")
    x, y, z = (vector / length).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    angle = math.radians(degrees)
    eye = torch.eye(3, dtype=torch.float64)
    return eye + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)


def _recolour(command: Command) -> Recolour:
    return Recolour(
        colour=command.colour,
        scale=command.colour_scale or (1.0, 1.0, 1.0),
        shift=command.colour_shift or (0.0, 0.0, 0.0),
        view_dependent=not command.flat_colour,
    )


def _cut(command: Command, document: Document, where: Where) -> CutBy | None:
    """How the boundary of what is selected is found, or None where nothing is split."""
    if command.split == "off" or command.cut.rounds == 0:
        return None
    if command.split == "box" or where.layer is None:
        if where.box is None:
            raise InputError("--split box: expected --box, got none.")
        return CutBy(by="box", options=command.cut)
    masks = _masks(command, document, where)
    if masks is not None:
        return masks
    views = document.scene.train_views or document.scene.views
    if not views:
        sys.stdout.write("not split: the scene has no views to see a boundary in\n")
        return None
    every = math.ceil(len(views) / _DRAWN_VIEWS)
    return CutBy(by="layer", views=tuple(view.name for view in views[::every]), options=command.cut)


def _masks(command: Command, document: Document, where: Where) -> CutBy | None:
    """The label maps that a layer was made from; None where auto has to do without."""
    asked = command.split == "masks"
    layer = document.layers.get(where.layer or "")
    metadata: Mapping[str, Any] = {} if layer is None else layer.metadata
    name = command.evidence or metadata.get("evidence")
    scene = document.scene
    if command.split == "layer" or not where.ids or not isinstance(name, str):
        if asked:
            raise InputError("--split masks: expected a layer made from label maps, got none.")
        return None
    if not asked and (document.history or not keeps_ids(metadata.get("method"))):
        return None
    places = [place for place in (scene.root, scene.source) if place is not None]
    zero_is_class = "source_ids" in metadata
    try:
        evidence = open_evidence(find_evidence(places, name), zero_is_class=zero_is_class)
    except InputError:
        if asked:
            raise
        return None
    if evidence.kind not in ("labels", "tracked"):
        if asked:
            raise InputError(f"--split masks: expected label maps, {name} is {evidence.kind}.")
        return None
    views = tuple(view.name for view in views_that_made(scene, metadata, evidence))
    if not views:
        if asked:
            raise InputError(f"--split masks: {name} has no label map of a view that may be used.")
        return None
    return CutBy(
        by="masks",
        evidence=name,
        zero_is_class=zero_is_class,
        views=views,
        options=command.cut,
    )


def _measured(command: Command, before: Document, split: Document) -> dict[str, float]:
    """PSNR between pictures before and after the split, and of each against photographs."""
    views = before.scene.train_views or before.scene.views
    if not views or not command.measure:
        return {}
    spaced = views[:: math.ceil(len(views) / command.measure)]
    pairs = (before.scene.gaussians, split.scene.gaussians)
    squares = 0.0
    for view in spaced:
        first, second = (_picture(gaussians, view, command.backend) for gaussians in pairs)
        squares += float(((first - second) ** 2).mean()) / len(spaced)
    found = {"split_psnr": -10 * math.log10(max(squares, 1e-12))}
    if all(view.image is not None and view.image.is_file() for view in spaced):
        for name, gaussians in zip(("photographs_before", "photographs_after"), pairs, strict=True):
            scores = [
                psnr(*render_and_photograph(gaussians, view, backend=command.backend))
                for view in spaced
            ]
            found[name] = math.fsum(scores) / len(scores)
    return {name: round(value, 3) for name, value in found.items()} | {"views": len(spaced)}


def _picture(gaussians: Gaussians, view: View, backend: str) -> torch.Tensor:
    return render(gaussians, view.camera, backend=backend).image.clamp(0, 1)


def _told(operation: Operation, split: int, measured: Mapping[str, float]) -> str:
    by = "" if operation.cut is None else f" at the boundary ({operation.cut.by})"
    text = f"{split} Gaussians split{by}"
    if measured:
        text += (
            f": pictures before and after are {measured['split_psnr']:.1f} dB apart in "
            f"{measured['views']} views"
        )
    if "photographs_after" in measured:
        text += (
            f", PSNR against photographs {measured['photographs_before']:.2f} -> "
            f"{measured['photographs_after']:.2f} dB"
        )
    return text + "\n"


def _with_result(document: Document, measured: Mapping[str, float]) -> Document:
    """The document with what was measured beside its last edit."""
    *earlier, last = document.history
    entry = {**last, "result": {**last["result"], **measured}}
    provenance = dict(document.scene.provenance) | {HISTORY: [*earlier, entry]}
    return replace(document, scene=replace(document.scene, provenance=provenance))


def _with_base(command: Command, before: Document, after: Document) -> Document:
    """The document with where the scene was before its first edit."""
    provenance = dict(after.scene.provenance)
    found = before.scene.provenance.get(BASE)
    place = command.scene.resolve()
    if isinstance(found, Mapping):
        place = _base_of(command.scene, before)
    start = command.output.resolve()
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


def _undone(command: Command, document: Document) -> Document:
    base = _base_of(command.scene, document)
    if not is_scene(base):
        raise MissingFileError(
            f"{base}: the scene that was edited first is not there; undo does its edits again."
        )
    first = load_document(base, data=command.data)
    dropped = document.history[-1].get("kind") if document.history else "nothing"
    with progress("undo") as step:
        before = undo(first, document, backend=command.backend, progress=step)
    sys.stdout.write(f"undone: {dropped}; {len(before.history)} edits are left\n")
    return before
