"""``splatseg sharpen``: a new scene whose Gaussians take sides at the boundaries of a layer."""

import sys
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro

from splatseg.cli._progress import progress
from splatseg.cli._work import check_new_scene
from splatseg.core import (
    UNLABELLED,
    Gaussians,
    InstanceTree,
    Labels,
    LabelSource,
    Layer,
    Scene,
    View,
    layer_address,
)
from splatseg.edit import Document, layer_called, load_document, save_document
from splatseg.edit.document import BASE, HISTORY
from splatseg.errors import InputError
from splatseg.evaluate import psnr, render_and_photograph
from splatseg.fit import (
    EXPOSURES,
    FitOptions,
    exposures_record,
    recorded_exposures,
    refinement_options,
)
from splatseg.io.evidence import Evidence, copy_evidence, find_evidence, open_evidence
from splatseg.lift import (
    ConfusionOptions,
    EvidenceSegments,
    MatchedMaps,
    Sharpened,
    SharpenOptions,
    sharpen,
)
from splatseg.methods import keeps_ids
from splatseg.render import BackendName
from splatseg.tasks.scene_parts import mask_use, views_that_made


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Sharpen a scene at the boundaries of a layer: each Gaussian becomes one thing's.

    The Gaussians go on learning from the photographs and, beside them, from the evidence that
    the layer was made from: of the light of a pixel, as much as possible shall come from
    Gaussians of the pixel's label. Things then come out cleaner when they are removed or
    exported, and label maps are sharper. It costs a little of the picture, which is printed.

    The result is a new scene with as many Gaussians in the same order. LAYER is decided anew;
    all other layers, and the evidence if it is SCENE's own, come along. SCENE stays as it is.

    For example:

    splatseg sharpen room -o room-sharp --layer objects
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """The scene folder. Its photographs must be where they were."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="NEW")]
    """The scene folder to write. It must not be there yet."""

    layer: str
    """The layer whose boundaries count: labels."""

    evidence: str | None = None
    """Name of the evidence that tells where boundaries are. None takes what the layer was made
    from. Segments with ids of each view's own take those of LAYER that they fit best."""

    correct_confusion: bool = True
    """Relabel under how often the evidence takes one id for another, as segment does."""

    measure: int = 8
    """Held-out views in which the picture is compared with photographs before and after; 0 for
    none."""

    seed: int = 0
    """Seed of the order of views and of random codes."""

    backend: BackendName = "auto"
    """Who renders. auto: cuda for scenes on a GPU, cpu otherwise."""

    data: Path | None = None
    """Folder of the capture, where it was moved."""

    sharpen: SharpenOptions = field(default_factory=SharpenOptions)
    """How long, and how much labels count."""

    confusion: ConfusionOptions = field(default_factory=ConfusionOptions)
    """How the evidence errs, for --correct-confusion."""


def run(command: Command) -> None:
    """Sharpen a scene."""
    out = command.output
    check_new_scene(out)
    if command.measure < 0:
        raise InputError(f"--measure: expected 0 or more, got {command.measure}.")
    started = time.monotonic()
    document = load_document(command.scene, data=command.data)
    scene = document.scene
    layer = _layer(document, command.layer)
    evidence, source, views = _source(command, scene, layer)
    spaced = _spaced(scene, command.measure)
    before = _psnr(scene, scene.gaussians, spaced, command.backend)
    exposures = recorded_exposures(scene.provenance)
    with progress("sharpen") as step:
        found = sharpen(
            scene.gaussians,
            views,
            source,
            options=command.sharpen,
            confusion=command.confusion if command.correct_confusion else None,
            fit_options=_fit_options(scene, views),
            exposures=exposures,
            seed=command.seed,
            backend=command.backend,
            progress=step,
        )
    after = _psnr(scene, found.gaussians, spaced, command.backend)
    provenance = {
        key: value for key, value in scene.provenance.items() if key not in (HISTORY, BASE)
    }
    provenance["sharpened"] = {
        "scene": command.scene.resolve().as_posix(),
        "layer": command.layer,
        "options": asdict(command.sharpen),
        "seed": command.seed,
        "agreement": list(found.agreement),
        "psnr": [before, after],
    }
    if found.exposures:
        provenance[EXPOSURES] = exposures_record({**exposures, **found.exposures})
    layers = {**document.layers, **_sharpened(document, command.layer, merged(layer, found))}
    scene = replace(scene, gaussians=found.gaussians, provenance=provenance)
    save_document(Document(scene=scene, layers=layers), out)
    # What lies in the scene's own folder would be out of reach from the new one.
    if evidence.folder.resolve().parent == (command.scene / "evidence").resolve():
        copy_evidence(evidence.folder, out)
    sys.stdout.write(_told(command, found, before, after, len(spaced)))
    seconds = time.monotonic() - started
    sys.stdout.write(f"{out}: {len(found.gaussians)} Gaussians, in {seconds:.0f} s\n")


def _sharpened(document: Document, address: str, labels: Labels) -> dict[str, Layer]:
    """The layer after sharpening, under its name; a tree keeps the levels above and below."""
    name, level = layer_address(address)
    whole = document.layers[name]
    if isinstance(whole, InstanceTree):
        return {name: whole.with_cut(labels, level or "object")}
    return {name: labels}


def merged(layer: Labels, found: Sharpened) -> Labels:
    """The layer with what was decided anew; what no pixel shows keeps what it had."""
    new = found.labels
    told = new.ids != UNLABELLED
    inferred = torch.zeros(len(layer), dtype=torch.bool)
    if layer.inferred is not None:
        inferred = layer.inferred & ~told
    evidence = new.evidence
    if evidence is not None and layer.evidence is not None:
        evidence = torch.where(told, evidence, layer.evidence)
    views = new.effective_views
    if views is not None and layer.effective_views is not None:
        views = torch.where(told, views, layer.effective_views)
    return replace(
        layer,
        ids=torch.where(told, new.ids, layer.ids),
        confidence=torch.where(told, new.confidence, layer.confidence),
        candidates=None,
        shares=None,
        evidence=evidence,
        effective_views=views,
        inferred=inferred if bool(inferred.any()) else None,
        metadata=dict(layer.metadata) | {"sharpened": new.metadata["sharpened"]},
    )


def _layer(document: Document, name: str) -> Labels:
    layer = layer_called(document.layers, name)
    if not isinstance(layer, Labels):
        raise InputError(f"--layer: expected labels, {name} is a selection or features.")
    return layer


def _source(
    command: Command, scene: Scene, layer: Labels
) -> tuple[Evidence, LabelSource, tuple[View, ...]]:
    """The evidence, label maps of it with the layer's ids, and the views to learn from."""
    name = command.evidence or layer.metadata.get("evidence")
    if not isinstance(name, str):
        raise InputError(
            f"--evidence: expected a name, as layer {command.layer} does not say what it was "
            "made from; got none."
        )
    places = [place for place in (scene.root, scene.source) if place is not None]
    own = name == layer.metadata.get("evidence")
    zero = own and "source_ids" in layer.metadata
    evidence = open_evidence(find_evidence(places, name), zero_is_class=zero)
    views = _views(scene, layer, evidence)
    same = own and keeps_ids(layer.metadata.get("method"))
    if same and evidence.kind in ("labels", "tracked"):
        return evidence, evidence, views
    if evidence.kind not in ("masks", "panoptic", "tracked"):
        raise InputError(
            f"--evidence: expected the label maps that layer {command.layer} was made from, or "
            f"segments of objects; {name} is {evidence.kind}."
        )
    segments = EvidenceSegments(evidence=evidence)
    matched = MatchedMaps(
        gaussians=scene.gaussians,
        views=views,
        source=segments,
        labels=layer,
        backend=command.backend,
    )
    return evidence, matched, views


def _views(scene: Scene, layer: Labels, evidence: Evidence) -> tuple[View, ...]:
    """Those that made the layer and have a photograph."""
    views = views_that_made(scene, layer.metadata, evidence)
    views = tuple(view for view in views if view.image is not None)
    if not views:
        raise InputError(
            f"{evidence.folder}: expected evidence of a view with a photograph that may be used, "
            "got none."
        )
    return views


def _fit_options(scene: Scene, views: tuple[View, ...]) -> FitOptions:
    """How the scene's photographs are compared; without depth where no view has a depth map."""
    options = refinement_options(scene.provenance)
    if all(view.depth is None for view in views):
        options = replace(options, depth="off")
    return options


def _spaced(scene: Scene, most: int) -> tuple[View, ...]:
    """Some held-out views, or training views where there are none."""
    pool = [view for view in scene.test_views or scene.train_views if view.image is not None]
    pool = [view for view in pool if view.image is not None and view.image.is_file()]
    if not pool or not most:
        return ()
    return tuple(pool[:: -(-len(pool) // most)])


def _psnr(
    scene: Scene, gaussians: Gaussians, views: tuple[View, ...], backend: str
) -> float | None:
    if not views:
        return None
    masks = mask_use(scene)
    scores = [
        psnr(*render_and_photograph(gaussians, view, masks=masks, backend=backend))
        for view in views
    ]
    return sum(scores) / len(scores)


def _told(
    command: Command, found: Sharpened, before: float | None, after: float | None, views: int
) -> str:
    first, last = (100 * share for share in found.agreement)
    text = (
        f"light of labelled pixels that comes from Gaussians of their label: {first:.2f} -> "
        f"{last:.2f} %\n"
    )
    if before is not None and after is not None:
        text += f"PSNR in {views} views: {before:.2f} -> {after:.2f} dB\n"
    return text
