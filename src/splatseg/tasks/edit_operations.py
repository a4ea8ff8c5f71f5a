"""Where Gaussians are cut at the boundary of what is selected, and what that changes."""

import math
import os
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import torch

from splatseg.core import Labels, LayerInfo, Similarity
from splatseg.core.options import Natural
from splatseg.core.options import options as options_class
from splatseg.edit import CutBy, Document, FillBy, Operation, Recolour, find_inpainter
from splatseg.errors import InputError, MissingFileError
from splatseg.evaluate import psnr, render_and_photograph
from splatseg.io.evidence import find_evidence, open_evidence
from splatseg.io.scene_folder import is_scene
from splatseg.lift import CutOptions, GaussianField
from splatseg.methods import keeps_boundaries
from splatseg.render import BackendName, render
from splatseg.selection import Where, ids_named, layer_called, select_where
from splatseg.tasks.work import Observer, photographed, source_views

Triple = tuple[float, float, float]


_CONDITIONS = ("layer", "box", "sphere", "opacity", "size", "colour_near", "component_at")


_NOTHING_SELECTED = "expected `layer`, `box` or another condition of what is meant, got none."


@options_class(
    removed={
        "colour_shift": "scale or set the colour, or call splatseg.edit.recolour",
        "measure": "pictures=0 leaves out what is measured, too",
    }
)
class EditOptions:
    """What is selected, and what is done with it."""

    extract: bool = False
    """Keep only what is selected."""

    remove: bool = False
    """Remove what is selected."""

    duplicate: bool = False
    """Add a copy of what is selected, moved by `move`, `rotate` and `scale`."""

    merge: Path | None = None
    """Add the Gaussians and layers of another scene folder. Ids that clash get new numbers, except
    where both scenes have the same name for an id."""

    undo: bool = False
    """Write SCENE as it was before its last edit: all earlier edits are repeated on the scene that
    was edited first, which must still be at its place."""

    layer: str | None = None
    """Layer to select from: labels, with `ids` or `names`, or a selection."""

    ids: tuple[int, ...] = ()
    """Ids of the layer."""

    names: tuple[str, ...] = ()
    """Names of ids, of the layer or of the scene's classes. Selects all ids of a name."""

    box: tuple[float, float, float, float, float, float] | None = None
    """Box in the world: smallest x, y, z, then largest x, y, z, scene units."""

    sphere: tuple[float, float, float, float] | None = None
    """Ball in the world: centre x, y, z and radius, scene units."""

    opacity: tuple[float, float] | None = None
    """Smallest and largest opacity, in [0, 1]."""

    size: tuple[float, float] | None = None
    """Smallest and largest standard deviation along the longest axis, scene units. The largest may
    be inf."""

    colour_near: tuple[float, float, float, float] | None = None
    """Red, green, blue in [0, 1], and the largest distance of a mean colour from them."""

    largest_component: bool = False
    """Of what meets the other conditions, only the connected component with most Gaussians."""

    component_at: Triple | None = None
    """Of what meets the other conditions, only the connected component nearest to this point,
    world."""

    match: Literal["all", "any"] = "all"
    """Whether all conditions must hold, or any. A selection by any is not cut."""

    invert: bool = False
    """Select all other Gaussians instead."""

    move: Triple | None = None
    """Translation along x, y, z, scene units."""

    rotate: tuple[float, float, float, float] | None = None
    """Axis x, y, z and angle in degrees, right-handed."""

    scale: float = 1.0
    """Scale factor."""

    about: Triple | None = None
    """Fixed point of `rotate` and `scale`, world. None takes the median of what is selected, and
    the origin of the other scene for `merge`."""

    colour: Triple | None = None
    """New mean colour: red, green, blue in [0, 1]."""

    colour_scale: Triple | None = None
    """Factors of red, green, blue."""

    flat_colour: bool = False
    """Remove the part of the colour that depends on the direction of view."""

    cut: Literal["auto", "masks", "layer", "box", "off"] = "auto"
    """Boundary at which Gaussians that cross it are split. masks: the label maps that the
    layer was made from; layer: the boundary that the layer draws in training views; box: the box
    only; off: no splitting. auto: masks where the layer has them and the scene was not edited yet,
    else layer; always the box."""

    evidence: str | None = None
    """Name of the label maps for `cut` masks. None takes those the layer was made from."""

    specks: Natural = 30
    """With `remove` of a layer's ids: also remove connected components of up to this many Gaussians
    that touch only what is removed, unless they are most of another object of the layer. 0 keeps
    them."""

    refit: Natural = 0
    """With `remove`: steps of a fit on the photographs that makes what is removed opaque and
    separate from what stays, before it is removed; 150 are a good number. 0 leaves it out."""

    fill: str | None = None
    """With `remove`: continue floors, walls and other planes to where only what is removed stood
    before them, painted by this inpainter: exemplar, copies of what is around, so that patterns
    go on; opencv, smooth; or a model of another package. None leaves holes."""

    pictures: Natural = 3
    """Number of views drawn before and after, those that change most, for reports/edit.html of the
    new scene. 0 draws none, and does not measure the change by the cut."""

    def __post_init__(self) -> None:
        action = self._action()
        selecting = bool(self.conditions)
        if action in ("extract", "remove", "duplicate") and not selecting:
            raise InputError(f"{action}: {_NOTHING_SELECTED}")
        if action in ("merge", "undo") and selecting:
            raise InputError(f"{action}: takes no selection.")
        if action != "remove" and (self.refit or self.fill is not None):
            raise InputError("refit, fill: go with `remove` only.")
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
            raise InputError(f"invert: {_NOTHING_SELECTED}")
        if self.match == "any" and len(self.conditions) < 2:
            raise InputError("match: any needs two conditions or more to choose among.")

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the conditions of the selection that are given."""
        given = (name for name in _CONDITIONS if getattr(self, name) is not None)
        pieces = ("largest_component",) if self.largest_component else ()
        return (*given, *pieces)

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
        return self.flat_colour or self.colour is not None or self.colour_scale is not None


_MEASURED_VIEWS = 4
"""Training views in which the change by a cut alone is measured."""

_DRAWN_VIEWS = 40
"""Most views in which a layer draws its own boundary."""


def cut_of(
    document: Document, where: Where, options: EditOptions, cut: CutOptions, observer: Observer
) -> CutBy | None:
    """How the boundary of what is selected is found, or None where nothing is split."""
    by = options.cut
    if by == "off":
        return None
    if by == "box" or where.layer is None:
        if where.box is None and by == "auto":
            return None
        if where.box is None:
            needed = "`box`" if by == "box" else "`layer`"
            raise InputError(f"cut: {by} goes with {needed}, which was not given.")
        return CutBy(by="box", options=cut)
    if by == "masks":
        return _mask_cut(document, where, options.evidence, cut)
    layer = document.layers.get(where.layer)
    if by == "auto" and not document.history and layer is not None:
        with suppress(InputError):
            if keeps_boundaries(layer.info.method):
                return _mask_cut(document, where, options.evidence, cut)
    views = document.scene.train_views or document.scene.views
    if not views:
        observer.note("not cut: the scene has no views to see a boundary in")
        return None
    every = math.ceil(len(views) / _DRAWN_VIEWS)
    return CutBy(by="layer", views=tuple(view.name for view in views[::every]), options=cut)


def _mask_cut(document: Document, where: Where, named: str | None, cut: CutOptions) -> CutBy:
    """At the label maps that a layer was made from."""
    layer = document.layers.get(where.layer or "")
    info = LayerInfo() if layer is None else layer.info
    name = named or info.evidence
    if not where.ids or name is None:
        raise InputError("cut: masks needs a layer made from label maps, got none.")
    zero_is_class = info.source_ids is not None
    folder = find_evidence(document.scene.evidence_folders, name)
    evidence = open_evidence(folder, zero_is_class=zero_is_class)
    if evidence.kind not in ("labels", "tracked"):
        raise InputError(f"cut: masks needs label maps, {name} is {evidence.kind}.")
    views = tuple(view.name for view in source_views(document.scene, info, evidence))
    if not views:
        raise InputError(f"cut: masks: {name} has no label map of a view that may be used.")
    return CutBy(by="masks", evidence=name, zero_is_class=zero_is_class, views=views, options=cut)


def measured_change(before: Document, split: Document, *, backend: BackendName) -> dict[str, float]:
    """PSNR between renders before and after the split, and of each against photographs."""
    pool = before.scene.train_views or before.scene.views
    if not pool:
        return {}
    spaced = pool[:: math.ceil(len(pool) / _MEASURED_VIEWS)]
    pairs = (before.scene.gaussians, split.scene.gaussians)
    squares = 0.0
    for view in spaced:
        first, second = (
            render(gaussians, view.camera, backend=backend).image.clamp(0, 1) for gaussians in pairs
        )
        squares += float(((first - second) ** 2).mean()) / len(spaced)
    found = {"split_psnr": -10 * math.log10(max(squares, 1e-12))}
    if len(photographed(spaced)) == len(spaced):
        for name, gaussians in zip(("photographs_before", "photographs_after"), pairs, strict=True):
            scores = [
                psnr(*render_and_photograph(GaussianField(gaussians, backend=backend), view))
                for view in spaced
            ]
            found[name] = math.fsum(scores) / len(scores)
    return {name: round(value, 3) for name, value in found.items()} | {"views": len(spaced)}


def where_of(options: EditOptions, document: Document) -> Where | None:
    """What the options select; None is everything.

    Raises:
        InputError: If names are unknown, or the layer has none.
    """
    if not options.conditions:
        return None
    ids = options.ids
    if options.names and options.layer is not None:
        layer = layer_called(document.layers, options.layer)
        if isinstance(layer, Labels):
            called = ids_named(layer, options.names, classes=document.scene.classes)
            ids = tuple(sorted({*ids, *called}))
        else:
            raise InputError(f"names: layer {options.layer!r} has no names.")
    named: dict[str, Any] = {} if options.layer is None else {"layer": options.layer, "ids": ids}
    plain = ("box", "sphere", "opacity", "size", "colour_near")
    values: dict[str, Any] = {name: getattr(options, name) for name in plain}
    pieces: dict[str, Any] = {
        "largest_component": options.largest_component,
        "component_at": options.component_at,
        "invert": options.invert,
    }
    if options.match == "all":
        return Where(**named, **values, **pieces)
    given = [{name: value} for name, value in values.items() if value is not None]
    parts = [Where(**part) for part in ([named] if named else []) + given]
    return Where(any_of=tuple(parts), **pieces)


def operations_of(
    options: EditOptions,
    document: Document,
    where: Where | None,
    *,
    cut: CutOptions,
    observer: Observer,
) -> tuple[Operation, ...]:
    """What the options ask for, in the order in which it is done.

    Args:
        options: What is done.
        document: The scene with its layers.
        where: What is selected; None is everything.
        cut: How Gaussians that reach over the boundary of the selection are split.
        observer: Is told what of that cannot be.

    Raises:
        MissingFileError: If there is no scene to merge with.
        InputError: If the options do not make a similarity.
    """
    if options.merge is not None:
        moved = _similarity(options, torch.zeros(3)) if options.moves else None
        other = Path(os.path.relpath(options.merge.resolve()))
        if not is_scene(other):
            raise MissingFileError(f"{options.merge}: expected a scene folder, got none.")
        absolute = options.merge.resolve().as_posix()
        return (Operation(kind="merge", other=absolute, transform=moved),)
    split_by = None if where is None else cut_of(document, where, options, cut, observer)
    found: list[Operation] = []
    if options.extract or options.remove:
        kind: Literal["extract", "remove"] = "extract" if options.extract else "remove"
        of_things = options.layer is not None and not options.invert
        specks = (options.specks or None) if options.remove and of_things else None
        found.append(
            Operation(
                kind=kind,
                where=where,
                cut=split_by,
                specks=specks,
                refit=options.refit or None,
                fill=_fill(options, document),
            )
        )
    if options.duplicate:
        moved = _similarity(options, _median(document, where))
        return (Operation(kind="duplicate", where=where, transform=moved, cut=split_by),)
    # Colours before moves: a box still means the same Gaussians then. One split is enough.
    if options.recolours:
        how = _recolour(options)
        split = None if found else split_by
        found.append(Operation(kind="recolour", where=where, recolour=how, cut=split))
    if options.moves:
        moved = _similarity(options, _median(document, where))
        split = None if found else split_by
        found.append(Operation(kind="transform", where=where, transform=moved, cut=split))
    return tuple(found)


def _fill(options: EditOptions, document: Document) -> FillBy | None:
    """How what was hidden is continued."""
    if options.fill is None:
        return None
    find_inpainter(options.fill)  # a wrong name is said before anything is computed
    views = document.scene.train_views or document.scene.views
    if not views:
        raise InputError("fill: expected views that saw the scene, got none.")
    return FillBy(views=tuple(view.name for view in views), inpainter=options.fill)


def _median(document: Document, where: Where | None) -> torch.Tensor:
    gaussians = document.scene.gaussians
    if where is not None:
        chosen = select_where(gaussians, document.layers, where)
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
        view_dependent=not options.flat_colour,
    )


# What an edit changed, in pictures: the views that change most, before and after.
