"""Where Gaussians are cut at the boundary of what is selected, and what that changes."""

import math
from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from splatseg.core import (
    Gaussians,
    LayerInfo,
    View,
)
from splatseg.edit import CutBy, Document
from splatseg.errors import InputError
from splatseg.evaluate import psnr, render_and_photograph
from splatseg.io.evidence import find_evidence, open_evidence
from splatseg.lift import CutOptions, GaussianField
from splatseg.methods import keeps_boundaries
from splatseg.render import BackendName, render
from splatseg.selection import Where
from splatseg.tasks._observer import Observer
from splatseg.tasks.scene_parts import views_that_made

_DRAWN_VIEWS = 40
"""Most views in which a layer draws its own boundary."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cut:
    """What was asked for."""

    by: Literal["auto", "masks", "layer", "box", "off"]
    evidence: str | None
    """Name of label maps; None takes those that the layer was made from."""

    options: CutOptions


def cut_of(document: Document, where: Where, cut: Cut, observer: Observer) -> CutBy | None:
    """How the boundary of what is selected is found, or None where nothing is split."""
    if cut.by == "off":
        return None
    if cut.by == "box" or where.layer is None:
        if where.box is None and cut.by == "auto":
            return None
        if where.box is None:
            needed = "`box`" if cut.by == "box" else "`layer`"
            raise InputError(f"cut: {cut.by} goes with {needed}, which was not given.")
        return CutBy(by="box", options=cut.options)
    masks = _masks(document, where, cut)
    if masks is not None:
        return masks
    views = document.scene.train_views or document.scene.views
    if not views:
        observer.note("not cut: the scene has no views to see a boundary in")
        return None
    every = math.ceil(len(views) / _DRAWN_VIEWS)
    return CutBy(by="layer", views=tuple(view.name for view in views[::every]), options=cut.options)


def _masks(document: Document, where: Where, cut: Cut) -> CutBy | None:
    """The label maps that a layer was made from; None where auto has to do without."""
    asked = cut.by == "masks"
    layer = document.layers.get(where.layer or "")
    info = LayerInfo() if layer is None else layer.info
    name = cut.evidence or info.evidence
    scene = document.scene
    if cut.by == "layer" or not where.ids or name is None:
        if asked:
            raise InputError("cut: masks needs a layer made from label maps, got none.")
        return None
    if not asked and (document.history or not keeps_boundaries(info.method)):
        return None
    zero_is_class = info.source_ids is not None
    try:
        evidence = open_evidence(
            find_evidence(scene.evidence_folders, name), zero_is_class=zero_is_class
        )
    except InputError:
        if asked:
            raise
        return None
    if evidence.kind not in ("labels", "tracked"):
        if asked:
            raise InputError(f"cut: masks needs label maps, {name} is {evidence.kind}.")
        return None
    views = tuple(view.name for view in views_that_made(scene, info, evidence))
    if not views:
        if asked:
            raise InputError(f"cut: masks: {name} has no label map of a view that may be used.")
        return None
    return CutBy(
        by="masks",
        evidence=name,
        zero_is_class=zero_is_class,
        views=views,
        options=cut.options,
    )


def measured_change(
    before: Document, split: Document, *, views: int, backend: BackendName
) -> dict[str, float]:
    """PSNR between renders before and after the split, and of each against photographs."""
    pool = before.scene.train_views or before.scene.views
    if not pool or not views:
        return {}
    spaced = pool[:: math.ceil(len(pool) / views)]
    pairs = (before.scene.gaussians, split.scene.gaussians)
    squares = 0.0
    for view in spaced:
        first, second = (_image(gaussians, view, backend) for gaussians in pairs)
        squares += float(((first - second) ** 2).mean()) / len(spaced)
    found = {"split_psnr": -10 * math.log10(max(squares, 1e-12))}
    if all(view.image is not None and view.image.is_file() for view in spaced):
        for name, gaussians in zip(("photographs_before", "photographs_after"), pairs, strict=True):
            scores = [
                psnr(*render_and_photograph(GaussianField(gaussians, backend=backend), view))
                for view in spaced
            ]
            found[name] = math.fsum(scores) / len(scores)
    return {name: round(value, 3) for name, value in found.items()} | {"views": len(spaced)}


def _image(gaussians: Gaussians, view: View, backend: str) -> Tensor:
    return render(gaussians, view.camera, backend=backend).image.clamp(0, 1)
