"""Evidence becomes a layer of a scene, by any method."""

import importlib.metadata
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from splatseg.core import (
    UNLABELLED,
    ClassTable,
    Features,
    InstanceTree,
    Labels,
    Layer,
    Scene,
    View,
    with_info,
)
from splatseg.core.boundary import boundary
from splatseg.core.instance_tree import layer_kind
from splatseg.errors import InputError
from splatseg.io.evidence import (
    Evidence,
    TrackedEvidence,
    check_map_sizes,
    find_evidence,
    open_evidence,
    without_masked,
)
from splatseg.io.npz_writing import discard_checkpoint_file
from splatseg.io.scene import check_name, save_scene_layer
from splatseg.lift.completion import CompletionOptions, complete
from splatseg.lift.panoptic import merge_panoptic
from splatseg.methods import Method, MethodInputs, Refined, find_method
from splatseg.render import BackendName
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks._refined_scene import refined_folder, save_refined
from splatseg.tasks._segment_inputs import (
    named_companions,
    named_models,
    trained_features,
    with_companions,
)
from splatseg.tasks.checkpoint_options import CheckpointOptions
from splatseg.tasks.fit_quality import fit_quality
from splatseg.tasks.scene_parts import layer_of, mask_use, views_asked, views_recorded
from splatseg.tasks.segment_options import SegmentOptions
from splatseg.tasks.stopped_training import told_how_to_resume, training_checkpoints


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Segmentation:
    """A layer, and what it was made from."""

    layer: Layer
    name: str
    """What the layer is to be called."""

    evidence: Evidence
    views: tuple[View, ...]
    timings: Mapping[str, float]
    """Seconds by stage."""

    refined: Scene | None = None
    """The scene with Gaussians that learnt along, which the layer belongs to; None where they stay
    as they are."""

    folder: Path | None = None
    """Where that scene is to be written."""

    warnings: tuple[str, ...] = ()
    """What should be known of it, in sentences: that the scene is too poor to carry labels."""

    checkpoint: Path | None = None
    """What a method that trains keeps until the layer is written, see `save_segmentation`."""

    @property
    def labels(self) -> Labels:
        """The layer, where it is one of labels; of a tree its objects.

        Raises:
            InputError: If the method gives something else.
        """
        if isinstance(self.layer, InstanceTree):
            return self.layer.cut()
        if not isinstance(self.layer, Labels):
            raise InputError(f"layer {self.name!r}: expected labels, got {layer_kind(self.layer)}.")
        return self.layer


@boundary
def segment(
    scene: Scene,
    method: str | Method = "uplift",
    *,
    options: SegmentOptions | None = None,
    method_options: Any = None,
    completion: CompletionOptions | None = None,
    checkpoints: CheckpointOptions | None = None,
    layers: Mapping[str, Layer] | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> Segmentation:
    """Lift what was seen in photographs onto the Gaussians, as well as the method knows how.

    What the command ``splatseg segment`` does: with the defaults, votes are corrected for how
    the evidence errs, and Gaussians that no view explains are completed from their neighbours.

    Args:
        scene: The scene; it stays as it is. `save_segmentation` writes the layer into it.
        method: The method, or its name (`methods.method_names`).
        options: Which evidence and views, and what follows the method.
        method_options: An instance of the method's options; None is its default, or the
            published setting where `options` ask for it.
        completion: How neighbours' labels spread.
        checkpoints: How often a method that trains keeps its state in the scene's folder, and
            whether it goes on from there. What ends it early leaves a checkpoint; None keeps none.
        layers: Layers at hand; others are read from the scene's folder.
        backend: Who renders.
        observer: Is told of the progress.

    Raises:
        InputError: If there is no such method, evidence or layer, or they do not fit together.
        ShapeError: If evidence does not have its photograph's proportions.
        KeyboardInterrupt: If it was interrupted; the message says how to go on.
    """
    started = time.monotonic()
    options = options or SegmentOptions()
    method = find_method(method) if isinstance(method, str) else method
    chosen = _method_options(method, method_options, options)
    folder = refined_folder(method, chosen, checkpoints)
    trained = trained_features(scene, method, chosen, layers)
    if trained is None:
        chosen = with_companions(scene, method, chosen, observer)
    evidence_name, evidence = _evidence(scene, method, options, trained)
    merged = _classes_to_merge(scene, options, evidence, layers)
    check_name("layer", name := options.layer or evidence_name)
    views = _views(scene, evidence, options.views, observer)
    masks = mask_use(scene) if options.view_masks == "auto" else options.view_masks
    if masks == "ignore":
        evidence, whole = without_masked(evidence, views), evidence
        if evidence is not whole:
            masked = sum(view.mask is not None for view in views)
            observer.note(f"masks of {masked} of {len(views)} views leave pixels out")
    inputs = MethodInputs(
        gaussians=scene.gaussians,
        views=views,
        evidence=evidence,
        prompt_views=scene.views,
        companions=named_companions(scene, method, chosen),
        models=named_models(method, chosen, report=observer.note),
        trained=trained,
        classes=scene.classes,
        metres_per_unit=scene.metres_per_unit,
        up=scene.up,
        backend=backend,
        seed=options.seed,
        checkpoints=(
            training_checkpoints(scene, name, method, checkpoints, observer)
            if trained is None and folder is None
            else None
        ),
    )
    timings = {"open": time.monotonic() - started}
    warnings = _checked_fit(scene, backend, timings, observer)
    with told_how_to_resume(inputs.checkpoints, observer):
        made = _run(method, inputs, chosen, timings, observer)
        refined = None
        if isinstance(made, Refined):
            refined = replace(scene, gaussians=made.gaussians)
            scene, made = refined, made.layer
        layer = made
        if options.complete and method.complete and not options.published:
            layer = _completed(scene, layer, completion, timings)
        layer = _panoptic(scene, layer, merged, method)
    layer = _described(layer, method, evidence_name, inputs, options)
    found = _segmentation(layer, name, inputs, timings)
    return replace(found, warnings=warnings, refined=refined, folder=folder)


def _checked_fit(
    scene: Scene, backend: BackendName, timings: dict[str, float], observer: Observer
) -> tuple[str, ...]:
    """Tell where the scene is too poor to carry labels, or cannot be held against photographs."""
    began = time.monotonic()
    try:
        quality = fit_quality(scene, backend=backend)
    except InputError as error:
        said = f"the scene was not held against its photographs: {str(error).rstrip('.')}"
        observer.note(said)
        return (f"{said}.",)
    timings["check fit"] = time.monotonic() - began
    if quality is None or quality.warning is None:
        return ()
    observer.note(quality.warning)
    return (f"{quality.warning}.",)


@boundary
def save_segmentation(made: Segmentation, root: Path) -> Path:
    """Write the layer into the scene's folder; then its training needs its checkpoint no more.

    Where Gaussians learnt along, the layer is written with them into a new scene.

    Returns:
        The file of the layer.
    """
    if made.refined is not None and made.folder is not None:
        return save_refined(
            made.refined, made.layer, made.folder, made.name, evidence=made.evidence
        )
    path = save_scene_layer(made.layer, root, made.name)
    if made.checkpoint is not None:
        discard_checkpoint_file(made.checkpoint)
    return path


def _run(
    method: Method,
    inputs: MethodInputs,
    options: Any,
    timings: dict[str, float],
    observer: Observer,
) -> Layer | Refined:
    """Run the method as the stage ``segment``."""
    with observer.stage("segment") as step:
        began = time.monotonic()
        found = method.run(replace(inputs, progress=step), options)
        timings[method.name] = time.monotonic() - began
    return found


def _segmentation(
    layer: Layer, name: str, inputs: MethodInputs, timings: Mapping[str, float]
) -> Segmentation:
    return Segmentation(
        layer=layer,
        name=name,
        evidence=inputs.evidence,
        views=inputs.views,
        timings=timings,
        checkpoint=None if inputs.checkpoints is None else inputs.checkpoints.path,
    )


def _method_options(method: Method, given: Any, options: SegmentOptions) -> Any:
    if given is None:
        return method.published_options if options.published else method.options()
    if not isinstance(given, method.options):
        raise InputError(
            f"method_options: expected {method.options.__name__} for method {method.name}, "
            f"got {type(given).__name__}."
        )
    return given


def _completed(
    scene: Scene,
    layer: Layer,
    completion: CompletionOptions | None,
    timings: dict[str, float],
) -> Layer:
    """The layer with labels for Gaussians that have none, where it is one of labels."""
    labels = layer.labels if isinstance(layer, InstanceTree) else layer
    if not isinstance(labels, Labels) or not bool((labels.ids != UNLABELLED).any()):
        return layer
    began = time.monotonic()
    labels = complete(scene.gaussians, labels, options=completion)
    timings["complete"] = time.monotonic() - began
    return replace(layer, labels=labels) if isinstance(layer, InstanceTree) else labels


def _panoptic(
    scene: Scene, layer: Layer, classes: tuple[Labels, ClassTable] | None, method: Method
) -> Layer:
    """Instances merged with classes, where these are given."""
    if classes is None:
        return layer
    instances = layer.cut() if isinstance(layer, InstanceTree) else layer
    if not isinstance(instances, Labels):
        raise InputError(
            f"classes: goes with methods that give labels; {method.name} gives {method.returns}."
        )
    return merge_panoptic(scene.gaussians, instances, *classes)


def _described(
    layer: Layer,
    method: Method,
    evidence_name: str,
    inputs: MethodInputs,
    options: SegmentOptions,
) -> Layer:
    """The layer with a record of what it was made from; a method's own record comes first."""
    own = layer.info.views
    info = replace(
        layer.info,
        method=layer.info.method or method.name,
        evidence=evidence_name,
        views=tuple(view.name for view in inputs.views) if own is None else own,
        views_asked=views_recorded(options.views),
        seed=options.seed,
        versions={
            "splatseg": importlib.metadata.version("splatseg"),
            "torch": str(torch.__version__),
        },
    )
    source_ids = inputs.evidence.source_ids
    if isinstance(layer, Labels) and source_ids is not None:
        info = replace(info, source_ids={id: source_ids[id] for id in layer.present.tolist()})
    return with_info(layer, info)


def _classes_to_merge(
    scene: Scene,
    options: SegmentOptions,
    evidence: Evidence,
    layers: Mapping[str, Layer] | None,
) -> tuple[Labels, ClassTable] | None:
    """The layer of classes and what its ids mean."""
    if options.classes is None:
        return None
    if evidence.kind == "labels":
        raise InputError(f"classes: goes with evidence of instances, not of {evidence.kind}.")
    layer = layer_of(scene, options.classes, layers)
    if not isinstance(layer, Labels):
        raise InputError(f"classes: expected a layer of labels, got {layer_kind(layer)}.")
    table = evidence.classes or scene.classes
    if isinstance(evidence, TrackedEvidence):
        table = evidence.maps.table or scene.classes
    if table is None:
        raise InputError(
            "classes: expected a table that says which classes are things, and neither the "
            "capture nor the evidence has one."
        )
    return layer, table


def _evidence(
    scene: Scene, method: Method, options: SegmentOptions, trained: Features | None
) -> tuple[str, Evidence]:
    """The evidence asked for, or else that of what was trained before, or else the only one."""
    asked = options.evidence or (None if trained is None else trained.info.evidence)
    folder = find_evidence(scene.evidence_folders, asked)
    evidence = open_evidence(folder, zero_is_class=options.zero_is_class, void=options.void)
    method.check_evidence(evidence)
    return folder.name, evidence


def _views(
    scene: Scene, evidence: Evidence, asked: Sequence[str], observer: Observer
) -> tuple[View, ...]:
    """The views asked for that have evidence; named ones must have it."""
    allowed = views_asked(scene, asked)
    check_map_sizes(evidence, allowed)
    if asked[0] not in ("train", "all"):
        return allowed
    known = set(evidence.view_names)
    views = tuple(view for view in allowed if view.name in known)
    if not views:
        raise InputError(
            f"evidence: expected some of at least one of the {len(allowed)} views that "
            f"{asked[0]} allows, got none."
        )
    lacking = [view for view in allowed if view.name not in known]
    # Evidence of the train views alone is as it should be, whatever is allowed.
    if any(view.split == "train" for view in lacking):
        observer.note(
            f"{len(lacking)} of {len(allowed)} views have no such evidence, the first is "
            f"{lacking[0].name}"
        )
    return views
