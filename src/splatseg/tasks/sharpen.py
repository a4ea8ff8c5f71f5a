"""A new scene whose Gaussians belong to one side each of a layer's boundaries."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from splatseg.core import (
    UNLABELLED,
    InstanceTree,
    Labels,
    LabelSource,
    Layer,
    Renderable,
    Scene,
    View,
    layer_address,
)
from splatseg.core.boundary import boundary
from splatseg.core.options import Natural
from splatseg.core.options import options as options_class
from splatseg.edit import Document, save_document
from splatseg.errors import InputError
from splatseg.evaluate import psnr, render_and_photograph
from splatseg.evaluate.photographs import MaskUse
from splatseg.fit import (
    EXPOSURES,
    FitOptions,
    exposures_record,
    recorded_exposures,
    refinement_options,
)
from splatseg.io.evidence import Evidence, check_map_sizes, find_evidence, open_evidence
from splatseg.lift import (
    ConfusionOptions,
    EvidenceSegments,
    GaussianField,
    MatchedMaps,
    Sharpened,
    SharpenOptions,
    sharpen,
)
from splatseg.methods import keeps_boundaries
from splatseg.render import BackendName
from splatseg.selection import layer_called
from splatseg.tasks.segment import derived_scene, train_evidence
from splatseg.tasks.work import (
    SILENT,
    Observer,
    Work,
    check_new_folder,
    mask_use,
    photographed,
    source_views,
)


@options_class
class SharpenSceneOptions:
    """What is sharpened by what, and how it is measured."""

    layer: str
    """The layer of labels whose boundaries count."""

    evidence: str | None = None
    """Name of the evidence that says where boundaries are. None takes what the layer was made from.
    Segments with ids of each view take those of the layer that they overlap most."""

    measure: Natural = 8
    """Number of held-out views in which renders are compared with photographs before and after; 0
    for none."""

    seed: int = 0
    """Seed of all random choices."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SharpenedScene:
    """A new scene folder, and what sharpening changed."""

    folder: Path
    document: Document
    agreement: tuple[float, float]
    """Share of the light of labelled pixels, in [0, 1], that comes from Gaussians of their
    label, before and after."""

    psnr: tuple[float, float] | None
    """PSNR of renders against photographs before and after, dB; None where not measured."""

    measured_views: int
    """Views of the PSNR."""


@boundary
def sharpen_scene(
    document: Document,
    folder: Path,
    *,
    options: SharpenSceneOptions,
    sharpen_options: SharpenOptions | None = None,
    confusion: ConfusionOptions | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> SharpenedScene:
    """Go on learning from photographs and evidence until Gaussians have one label each.

    The new scene has as many Gaussians in the same order. The layer is decided anew; other layers
    and the scene's own evidence come along. It is written whole or not at all.

    Args:
        document: The scene with its layers, read from its folder.
        folder: The scene folder to write.
        options: The layer, the evidence, and what is measured.
        sharpen_options: How long, and how much labels count.
        confusion: How the evidence errs; None decides labels by plain majority.
        backend: Rendering backend.
        observer: Is told of the progress.

    Raises:
        InputError: If there is no such layer or evidence, or something is in the way.
    """
    check_new_folder(folder)
    how = sharpen_options or SharpenOptions()
    scene = document.scene
    work = Work(scene=scene, backend=backend, observer=observer)
    layer = layer_called(document.layers, options.layer)
    if not isinstance(layer, Labels):
        raise InputError(f"layer: expected labels, {options.layer} is a selection or features.")
    evidence, source, views = _source(work, layer, options)
    spaced = _spaced(scene, options.measure)
    before = mean_psnr(work.field(), spaced, masks=mask_use(scene))
    with observer.stage("sharpen") as step:
        found = sharpen(
            scene.gaussians,
            views,
            source,
            options=how,
            confusion=confusion,
            fit_options=fit_options_of(scene, views),
            exposures=recorded_exposures(scene.provenance),
            seed=options.seed,
            backend=backend,
            progress=step,
        )
    sharpened = GaussianField(found.gaussians, backend=backend)
    after = mean_psnr(sharpened, spaced, masks=mask_use(scene))
    layers = {**document.layers, **_sharpened(document, options.layer, merged(layer, found))}
    new = _sharpened_scene(scene, options, how, found, psnr=[before, after])
    document = Document(scene=new, layers=layers)
    saved = save_document(document, folder, evidence=train_evidence(evidence, scene))
    return SharpenedScene(
        folder=folder,
        document=saved,
        agreement=found.agreement,
        psnr=None if before is None or after is None else (before, after),
        measured_views=len(spaced),
    )


def merged(layer: Labels, found: Sharpened) -> Labels:
    """The layer with what was decided anew; what no pixel shows keeps what it had."""
    new = found.labels
    decided = new.ids != UNLABELLED
    inferred = torch.zeros(len(layer), dtype=torch.bool)
    if layer.inferred is not None:
        inferred = layer.inferred & ~decided
    evidence = new.evidence
    if evidence is not None and layer.evidence is not None:
        evidence = torch.where(decided, evidence, layer.evidence)
    views = new.effective_views
    if views is not None and layer.effective_views is not None:
        views = torch.where(decided, views, layer.effective_views)
    return replace(
        layer,
        ids=torch.where(decided, new.ids, layer.ids),
        confidence=torch.where(decided, new.confidence, layer.confidence),
        candidates=None,
        shares=None,
        evidence=evidence,
        effective_views=views,
        inferred=inferred if bool(inferred.any()) else None,
        info=layer.info.with_edit("sharpen", new.info.edit("sharpen") or {}),
    )


def views_to_learn_from(scene: Scene, layer: Labels, evidence: Evidence) -> tuple[View, ...]:
    """The views that made the layer and have a photograph.

    Raises:
        InputError: If there is none.
    """
    views = source_views(scene, layer.info, evidence)
    views = tuple(view for view in views if view.image is not None)
    if not views:
        raise InputError(
            f"{evidence.folder}: expected evidence of a view with a photograph that may be used, "
            "got none."
        )
    return views


def fit_options_of(scene: Scene, views: tuple[View, ...]) -> FitOptions:
    """How the scene's photographs are compared; without depth where no view has a depth map."""
    options = refinement_options(scene.provenance)
    if all(view.depth is None for view in views):
        options = replace(options, depth="off")
    return options


def _sharpened_scene(
    scene: Scene,
    options: SharpenSceneOptions,
    how: SharpenOptions,
    found: Sharpened,
    *,
    psnr: list[float | None],
) -> Scene:
    """The scene with new Gaussians, and how they were made."""
    record = {
        "layer": options.layer,
        "options": asdict(how),
        "seed": options.seed,
        "agreement": list(found.agreement),
        "psnr": psnr,
    }
    new = derived_scene(scene, "sharpened", record)
    provenance = dict(new.provenance)
    if found.exposures:
        exposures = recorded_exposures(scene.provenance) | dict(found.exposures)
        provenance[EXPOSURES] = exposures_record(exposures)
    return replace(new, gaussians=found.gaussians, provenance=provenance)


def _sharpened(document: Document, address: str, labels: Labels) -> dict[str, Layer]:
    """The layer after sharpening, under its name; a tree keeps the levels above and below."""
    name, level = layer_address(address)
    whole = document.layers[name]
    if isinstance(whole, InstanceTree):
        return {name: whole.with_cut(labels, level or "object")}
    return {name: labels}


def _source(
    work: Work, layer: Labels, options: SharpenSceneOptions
) -> tuple[Evidence, LabelSource, tuple[View, ...]]:
    """The evidence, label maps of it with the layer's ids, and the views to learn from."""
    scene = work.scene
    name = options.evidence or layer.info.evidence
    if name is None:
        raise InputError(
            f"evidence: expected a name, as layer {options.layer} does not say what it was "
            "made from; got none."
        )
    own = name == layer.info.evidence
    zero = own and layer.info.source_ids is not None
    evidence = open_evidence(find_evidence(scene.evidence_folders, name), zero_is_class=zero)
    views = views_to_learn_from(scene, layer, evidence)
    check_map_sizes(evidence, views)
    same = own and keeps_boundaries(layer.info.method)
    if same and evidence.kind in ("labels", "tracked"):
        return evidence, evidence, views
    if evidence.kind not in ("masks", "panoptic", "tracked"):
        raise InputError(
            f"evidence: expected the label maps that layer {options.layer} was made from, or "
            f"segments of objects; {name} is {evidence.kind}."
        )
    matched = MatchedMaps(
        gaussians=scene.gaussians,
        views=views,
        source=EvidenceSegments(evidence=evidence),
        labels=layer,
        backend=work.backend,
    )
    return evidence, matched, views


def _spaced(scene: Scene, most: int) -> tuple[View, ...]:
    """Some held-out views, or training views where there are none."""
    pool = photographed(scene.test_views or scene.train_views)
    if not pool or not most:
        return ()
    return tuple(pool[:: -(-len(pool) // most)])


def mean_psnr(field: Renderable, views: Sequence[View], *, masks: MaskUse = "off") -> float | None:
    """Mean PSNR of renders against photographs, dB; None without views."""
    if not views:
        return None
    scores = [psnr(*render_and_photograph(field, view, masks=masks)) for view in views]
    return sum(scores) / len(scores)
