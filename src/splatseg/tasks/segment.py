"""Evidence becomes a layer of a scene, by any method."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from splatseg.core import (
    LOCAL,
    UNLABELLED,
    ClassTable,
    Executor,
    InstanceTree,
    Labels,
    Layer,
    Scene,
    View,
    with_info,
)
from splatseg.core.boundary import boundary
from splatseg.core.instance_tree import layer_kind
from splatseg.core.options import options as options_class
from splatseg.edit import Document, save_document
from splatseg.edit.document import BASE, HISTORY
from splatseg.errors import InputError
from splatseg.io.arrays import discard_checkpoint_file
from splatseg.io.evidence import Evidence
from splatseg.io.scene import check_name, save_scene_layer
from splatseg.lift.completion import complete
from splatseg.lift.panoptic import merge_panoptic
from splatseg.methods import Method, MethodInputs, Refined, find_method
from splatseg.render import BackendName
from splatseg.tasks.checkpoints import CheckpointOptions, training_checkpoints, with_resume_hint
from splatseg.tasks.segment_chunks import check_streamed, run_on_seen
from splatseg.tasks.segment_inputs import (
    check_fit,
    classes_to_merge,
    evidence_to_lift,
    layer_to_update,
    named_companions,
    named_models,
    trained_features,
    unmasked,
    views_to_add,
    views_to_lift,
    with_companions,
)
from splatseg.tasks.work import (
    EVIDENCE_FOLDER,
    SILENT,
    Observer,
    Work,
    check_new_folder,
    layer_versions,
    view_spec,
)


@options_class
class SegmentOptions:
    """Options that all methods share."""

    evidence: str | None = None
    """Name of the evidence: a folder of the scene's or of its capture, such as labels_semantic.
    None takes the only one there is."""

    layer: str | None = None
    """Name of the layer. None names it like the evidence."""

    zero_is_class: bool = False
    """The id 0 of the evidence's files is a class, not void: ids grow by 1, and the layer records
    what they were."""

    void: int | None = None
    """A further id of the evidence's files that means void, such as 255."""

    views: tuple[str, ...] = ("train",)
    """Views to use: train, all, or names, separated by commas or spaces. Recorded in the layer."""

    view_masks: Literal["auto", "ignore", "off"] = "auto"
    """How the views' masks apply to label maps, panoptic segments and tracks. ignore: pixels where
    the mask is 0 have no label, such as those of moving things. off: masks are not used. auto:
    ignore where the fit ignored them too, else off."""

    published: bool = False
    """Use the method's published setting: the authors' options, and no completion."""

    complete: bool = True
    """Label Gaussians that no view explains from their neighbours; they are marked as inferred."""

    classes: str | None = None
    """With instances: name of a layer of classes to merge them with. Instances take their class
    from it, and stuff classes become one segment each: the layer is panoptic."""

    update: bool = False
    """Add the views that the layer of this name does not have yet, and keep what it knows: the cost
    is that of these views alone. For uplift, features and associate, after `fit --add`."""

    seed: int = 0
    """Seed of all random choices."""


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
    checkpoints: CheckpointOptions | None = None,
    layers: Mapping[str, Layer] | None = None,
    backend: BackendName = "auto",
    executor: Executor = LOCAL,
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
        checkpoints: How often a method that trains keeps its state in the scene's folder, and
            whether it goes on from there. What ends it early leaves a checkpoint; None keeps none.
        layers: Layers at hand; others are read from the scene's folder.
        backend: Rendering backend.
        executor: Where views are worked on; the layer does not depend on it.
        observer: Is told of the progress.

    Raises:
        InputError: If there is no such method, evidence or layer, or they do not fit together.
        ShapeError: If evidence does not have its photograph's proportions.
        KeyboardInterrupt: If it was interrupted; the message says how to go on.
    """
    work = Work(scene=scene, layers=layers, backend=backend, observer=observer, executor=executor)
    method = find_method(method) if isinstance(method, str) else method
    return segment_work(
        work,
        method,
        options or SegmentOptions(),
        method_options=method_options,
        checkpoints=checkpoints,
    )


def segment_work(
    work: Work,
    method: Method,
    options: SegmentOptions,
    *,
    method_options: Any = None,
    checkpoints: CheckpointOptions | None = None,
) -> Segmentation:
    """`segment` of a scene that is open."""
    began = time.monotonic()
    scene = work.scene
    chosen = _method_options(method, method_options, options)
    folder = _refined_folder(method, chosen, checkpoints)
    trained = trained_features(work, method, chosen)
    if trained is None:
        chosen = with_companions(work, method, chosen)
    name, evidence = evidence_to_lift(
        work,
        method,
        options.evidence or (None if trained is None else trained.info.evidence),
        zero_is_class=options.zero_is_class,
        void=options.void,
    )
    completes = options.complete and method.complete and not options.published
    check_streamed(work, method, options, completes=completes)
    merged = classes_to_merge(work, evidence, options.classes)
    check_name("layer", layer_name := options.layer or name)
    views = views_to_lift(work, evidence, options.views)
    before = layer_to_update(work, method, layer_name) if options.update else None
    if before is not None:
        views = views_to_add(views, before, layer_name)
    keeps_state = trained is None and folder is None
    inputs = MethodInputs(
        gaussians=scene.gaussians,
        views=views,
        evidence=unmasked(work, evidence, views, options.view_masks),
        prompt_views=scene.views,
        companions=named_companions(work, method, chosen),
        models=named_models(method, chosen, report=work.observer.note),
        trained=trained,
        classes=scene.classes,
        metres_per_unit=scene.metres_per_unit,
        up=scene.up,
        backend=work.backend,
        executor=work.executor,
        seed=options.seed,
        checkpoints=training_checkpoints(work, layer_name, method, checkpoints)
        if keeps_state
        else None,
    )
    timings = {"open": time.monotonic() - began}
    began = time.monotonic()
    warnings = check_fit(work)
    timings["check fit"] = time.monotonic() - began
    refined = None
    with with_resume_hint(inputs.checkpoints, work.observer):
        began = time.monotonic()
        with work.observer.stage("segment") as step:
            inputs = replace(inputs, progress=step)
            if scene.gaussians.chunks is not None:
                layer = run_on_seen(inputs, method, chosen, scene.gaussians.chunks)
            elif before is None or method.update is None:
                layer = method.run(inputs, chosen)
            else:
                layer = method.update(inputs, chosen, before)
        timings[method.name] = time.monotonic() - began
        if isinstance(layer, Refined):
            scene = refined = replace(scene, gaussians=layer.gaussians)
            layer = layer.layer
        if completes:
            began = time.monotonic()
            layer = _completed(scene, layer)
            timings["complete"] = time.monotonic() - began
        if merged is not None:
            layer = _panoptic(scene, layer, merged, method)
    return Segmentation(
        layer=_described(layer, method, name, inputs, options, before=before),
        name=layer_name,
        evidence=inputs.evidence,
        views=views,
        timings=timings,
        refined=refined,
        folder=folder,
        warnings=warnings,
        checkpoint=None if inputs.checkpoints is None else inputs.checkpoints.path,
    )


@boundary
def save_segmentation(made: Segmentation, root: Path) -> Path:
    """Write the layer into the scene's folder; then its training needs its checkpoint no more.

    Where Gaussians learnt along, the layer is written with them into a new scene.

    Returns:
        The file of the layer.
    """
    if made.refined is not None and made.folder is not None:
        record = {"layer": made.name, "method": made.layer.info.method}
        scene = derived_scene(made.refined, "refined", record)
        document = Document(scene=scene, layers={made.name: made.layer})
        evidence = train_evidence(made.evidence, made.refined)
        save_document(document, made.folder, evidence=evidence)
        return made.folder / "layers" / f"{made.name}.npz"
    path = save_scene_layer(made.layer, root, made.name)
    if made.checkpoint is not None:
        discard_checkpoint_file(made.checkpoint)
    return path


def derived_scene(scene: Scene, how: str, record: Mapping[str, Any]) -> Scene:
    """The scene as a new one without the edits of the one it was made of, which it records."""
    provenance = {
        key: value for key, value in scene.provenance.items() if key not in (HISTORY, BASE)
    }
    source = None if scene.root is None else scene.root.resolve().as_posix()
    return replace(scene, provenance=provenance | {how: {"scene": source, **record}})


def train_evidence(evidence: Evidence, scene: Scene) -> tuple[Path, ...]:
    """Evidence that lies in the scene's own folder, which a new scene could not find."""
    if scene.root is None:
        return ()
    inside = evidence.folder.resolve().parent == (scene.root / EVIDENCE_FOLDER).resolve()
    return (evidence.folder,) if inside else ()


def _refined_folder(
    method: Method, options: Any, checkpoints: CheckpointOptions | None
) -> Path | None:
    """The folder of the new scene that the method's options name, if they name one."""
    folder: Path | None = None if method.refines is None else getattr(options, method.refines)
    if folder is None:
        return None
    if checkpoints is not None and checkpoints.resume:
        raise InputError(
            f"resume: a training with {method.refines} keeps nothing to go on from; leave one out."
        )
    check_new_folder(folder)
    return folder


def _method_options(method: Method, given: Any, options: SegmentOptions) -> Any:
    if given is None:
        return method.published_options if options.published else method.options()
    if not isinstance(given, method.options):
        raise InputError(
            f"method_options: expected {method.options.__name__} for method {method.name}, "
            f"got {type(given).__name__}."
        )
    return given


def _completed(scene: Scene, layer: Layer) -> Layer:
    """The layer with labels for Gaussians that have none, where it is one of labels."""
    labels = layer.labels if isinstance(layer, InstanceTree) else layer
    if not isinstance(labels, Labels) or not bool((labels.ids != UNLABELLED).any()):
        return layer
    labels = complete(scene.gaussians, labels)
    return replace(layer, labels=labels) if isinstance(layer, InstanceTree) else labels


def _panoptic(
    scene: Scene, layer: Layer, classes: tuple[Labels, ClassTable], method: Method
) -> Layer:
    """Instances merged with classes."""
    instances = layer.cut() if isinstance(layer, InstanceTree) else layer
    if not isinstance(instances, Labels):
        raise InputError(
            f"classes: goes with methods that give labels; {method.name} gives {method.returns}."
        )
    return merge_panoptic(scene.gaussians, instances, *classes)


def _with_names(before: Layer | None, inputs: MethodInputs) -> tuple[str, ...]:
    """Names of the views that a layer was made from, those before first."""
    known = () if before is None else before.info.views or ()
    return (*known, *(view.name for view in inputs.views))


def _described(
    layer: Layer,
    method: Method,
    evidence: str,
    inputs: MethodInputs,
    options: SegmentOptions,
    *,
    before: Layer | None,
) -> Layer:
    """The layer with a record of what it was made from; a method's own record comes first."""
    views = layer.info.views
    info = replace(
        layer.info,
        method=layer.info.method or method.name,
        evidence=evidence,
        views=_with_names(before, inputs) if views is None or before is not None else views,
        views_asked=view_spec(options.views),
        seed=options.seed,
        versions=layer_versions(),
    )
    source_ids = inputs.evidence.source_ids
    if isinstance(layer, Labels) and source_ids is not None:
        info = replace(info, source_ids={id: source_ids[id] for id in layer.present.tolist()})
    return with_info(layer, info)
