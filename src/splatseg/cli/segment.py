"""``splatseg segment``: evidence becomes a layer of labels on the Gaussians of a scene."""

import importlib.metadata
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from splatseg.cli._segment_outputs import check_exports, write_exports, write_report
from splatseg.cli._work import layer_of, open_scene, progress
from splatseg.core import UNLABELLED, ClassTable, Labels, Scene, View
from splatseg.errors import InputError
from splatseg.io.evidence import (
    Evidence,
    EvidenceKind,
    TrackedEvidence,
    evidence_names,
    find_evidence,
    open_evidence,
)
from splatseg.io.scene import check_name, save_scene_layer
from splatseg.lift import (
    CompletionOptions,
    ConfusionOptions,
    EvidenceSegments,
    UpliftOptions,
    complete,
    merge_panoptic,
    reconsider,
    uplift,
)
from splatseg.methods.associate import AssociateOptions, associate
from splatseg.methods.identity import IdentityOptions, identity
from splatseg.methods.vote import VoteOptions, vote
from splatseg.render import BackendName


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Lift what was seen in photographs onto the Gaussians: evidence becomes a layer.

    The layer is written to SCENE/layers. An older layer of the same name is replaced.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """The scene folder."""

    method: Literal["uplift", "vote", "associate", "identity"]
    """How. uplift: every pixel votes for its label on the Gaussians it shows. vote: views vote
    for Gaussians by the pixels of their centres. identity: features of 16 channels and a
    classifier are trained (Gaussian Grouping; slower, for comparison). These need labels that
    mean the same in all views. associate: segments of views, each with ids of its own (masks,
    panoptic maps, tracks), become instances."""

    evidence: str | None = None
    """Name of the evidence: a folder of SCENE/evidence or of the capture, such as
    labels_semantic. None takes the only one there is."""

    layer: str | None = None
    """Name of the layer to write. None names it like the evidence."""

    zero_is_class: bool = False
    """The id 0 of the evidence's files is a class and not void: ids grow by 1, and the layer
    records what they were."""

    void: int | None = None
    """A further id of the evidence's files that means none, such as 255."""

    views: str = "train"
    """Which views may be used: train, all, or names with commas between them. What is asked for
    is recorded in the layer."""

    complete: bool = True
    """Label Gaussians that no view explains by their neighbours; they are marked as inferred."""

    reconsider: bool = True
    """With uplift and associate: decide anew under how often the evidence takes one id for
    another, which finds small things that most views miss. Not with FlashSplat's rules."""

    classes: str | None = None
    """With instances: name of a layer of classes to merge them with. Instances take their class
    from it, and what is no thing becomes one segment a class: the layer is panoptic."""

    export: bool = False
    """Also write SCENE/exports/LAYER: one splat file an object, a table of objects, all
    Gaussians with their labels as columns, and label maps of the held-out views."""

    report: bool = False
    """Also write SCENE/reports/LAYER.html: pictures, confidence, coverage and conflicts."""

    truth: Path | None = None
    """Folder of true maps, shown and scored in the report."""

    seed: int = 0
    """Seed of random choices, recorded in the layer. uplift, vote and associate make none."""

    backend: BackendName = "auto"
    """Who renders. auto: cuda for scenes on a GPU, cpu otherwise."""

    data: Path | None = None
    """Folder of the capture, where it was moved."""

    uplift: UpliftOptions = field(default_factory=UpliftOptions)
    """Settings of the method uplift."""

    vote: VoteOptions = field(default_factory=VoteOptions)
    """Settings of the method vote."""

    associate: AssociateOptions = field(default_factory=AssociateOptions)
    """Settings of the method associate."""

    identity: IdentityOptions = field(default_factory=IdentityOptions)
    """Settings of the method identity."""

    completion: CompletionOptions = field(default_factory=CompletionOptions)
    """How neighbours' labels spread."""

    confusion: ConfusionOptions = field(default_factory=ConfusionOptions)
    """How the evidence errs, for --reconsider."""


_KINDS: dict[str, tuple[EvidenceKind, ...]] = {
    "uplift": ("labels", "tracked"),
    "vote": ("labels", "tracked"),
    "associate": ("masks", "panoptic", "tracked"),
    "identity": ("labels", "tracked"),
}
_SAME = "label maps whose ids mean the same in all views"
_NEEDS = {
    "uplift": _SAME,
    "vote": _SAME,
    "associate": "segments of objects",
    "identity": _SAME,
}
_CANDIDATES = 8
"""Ids that `reconsider` chooses from."""


def run(command: Command) -> None:
    """Segment a scene."""
    started = time.monotonic()
    timings: dict[str, float] = {}
    scene = open_scene(command.scene, command.data)
    evidence_name, evidence = _evidence(command, scene)
    kinds = _KINDS[command.method]
    if evidence.kind not in kinds:
        raise InputError(
            f"{evidence.folder}: --method {command.method} needs {_NEEDS[command.method]} "
            f"({', '.join(kinds)}), got {evidence.kind}."
        )
    merged = _classes_to_merge(command, scene, evidence)
    layer_name = command.layer or evidence_name
    check_name("--layer", layer_name)
    truth = None if command.truth is None else open_evidence(command.truth)
    if command.export:
        check_exports(command.scene, layer_name)
    views = _voters(scene, evidence, command.views)
    timings["open"] = time.monotonic() - started
    labels = _labels(command, scene, evidence, views, timings)
    if merged is not None:
        labels = merge_panoptic(scene.gaussians, labels, *merged)
    metadata = dict(labels.metadata) | {
        "evidence": evidence_name,
        "views_asked": command.views,
        "seed": command.seed,
        "versions": {
            "splatseg": importlib.metadata.version("splatseg"),
            "torch": str(torch.__version__),
        },
    }
    if evidence.source_ids is not None:
        present = labels.present.tolist()
        metadata["source_ids"] = {str(id): evidence.source_ids[id] for id in present}
    labels = replace(labels, metadata=metadata)
    path = save_scene_layer(command.scene, layer_name, labels)
    sys.stdout.write(_summary(labels, len(views), time.monotonic() - started) + f"{path}\n")
    if command.export:
        begun = time.monotonic()
        write_exports(scene, command.scene, layer_name, backend=command.backend)
        timings["export"] = time.monotonic() - begun
    if command.report:
        where = write_report(
            scene,
            command.scene,
            labels,
            layer=layer_name,
            evidence=evidence,
            views=views,
            truth=truth,
            timings=timings,
            backend=command.backend,
        )
        sys.stdout.write(f"report: {where}\n")


def _classes_to_merge(
    command: Command, scene: Scene, evidence: Evidence
) -> tuple[Labels, ClassTable] | None:
    """The layer of --classes and what its ids mean."""
    if command.classes is None:
        return None
    if evidence.kind == "labels":
        raise InputError(f"--classes: goes with evidence of instances, not of {evidence.kind}.")
    layer = layer_of(scene, command.classes)
    if not isinstance(layer, Labels):
        raise InputError("--classes: expected labels, got the features or selection of a layer.")
    table = _categories(evidence, scene)
    if table is None:
        raise InputError(
            "--classes: expected a table that says which classes are things, and neither the "
            "capture nor the evidence has one."
        )
    return layer, table


def _labels(
    command: Command,
    scene: Scene,
    evidence: Evidence,
    views: tuple[View, ...],
    timings: dict[str, float],
) -> Labels:
    """The layer of the method, reconsidered and completed as asked."""
    begun = time.monotonic()
    gaussians, backend, again = scene.gaussians, command.backend, False
    named = (evidence.classes or scene.classes) if evidence.kind == "labels" else None
    with progress("segment") as step:
        match command.method:
            case "uplift":
                options = command.uplift
                again = command.reconsider and options.label_rule == "share"
                if again and options.candidates < 2:
                    options = replace(
                        options, candidates=_CANDIDATES, slots=max(options.slots, _CANDIDATES)
                    )
                labels = uplift(
                    gaussians,
                    views,
                    evidence,
                    options=options,
                    classes=named,
                    backend=backend,
                    progress=step,
                )
            case "vote":
                labels = vote(
                    gaussians,
                    views,
                    evidence,
                    options=command.vote,
                    classes=named,
                    backend=backend,
                    progress=step,
                )
            case "identity":
                labels = identity(
                    gaussians,
                    views,
                    evidence,
                    options=command.identity,
                    classes=named,
                    backend=backend,
                    progress=step,
                    seed=command.seed,
                )
            case "associate":
                labels = associate(
                    gaussians,
                    views,
                    EvidenceSegments(evidence=evidence),
                    options=command.associate,
                    confusion=command.confusion if command.reconsider else None,
                    classes=_categories(evidence, scene),
                    backend=backend,
                    progress=step,
                )
    timings[command.method] = time.monotonic() - begun
    if again:
        begun = time.monotonic()
        labels = reconsider(labels, options=command.confusion)
        if command.uplift.candidates < 2:
            labels = replace(labels, candidates=None, shares=None)
        timings["reconsider"] = time.monotonic() - begun
    if command.complete and bool((labels.ids != UNLABELLED).any()):
        begun = time.monotonic()
        labels = complete(gaussians, labels, options=command.completion)
        timings["complete"] = time.monotonic() - begun
    return labels


def _categories(evidence: Evidence, scene: Scene) -> ClassTable | None:
    """Names of the categories of segments; a tracker's own table is of its tracks."""
    if isinstance(evidence, TrackedEvidence):
        return evidence.maps.table or scene.classes
    return evidence.classes or scene.classes


def _summary(labels: Labels, views: int, seconds: float) -> str:
    labelled = int((labels.ids != UNLABELLED).sum())
    ids = len(torch.unique(labels.ids[labels.ids != UNLABELLED]))
    share = 100 * labelled / max(len(labels), 1)
    background = labels.background
    names = labels.metadata["names"]
    behind = "none" if background == UNLABELLED else names.get(str(background), f"id {background}")
    inferred = 0 if labels.inferred is None else int(labels.inferred.sum())
    guessed = f", {inferred} of them inferred from neighbours" if inferred else ""
    return (
        f"{labelled} of {len(labels)} Gaussians labelled ({share:.1f} %){guessed}, {ids} ids, "
        f"from {views} views in {seconds:.1f} s; behind all of them: {behind}\n"
    )


def _evidence(command: Command, scene: Scene) -> tuple[str, Evidence]:
    places = [place for place in (scene.root, scene.source) if place is not None]
    name = command.evidence
    if name is None:
        names = evidence_names(places)
        if len(names) != 1:
            known = ", ".join(names) or "there is none"
            raise InputError(f"--evidence: expected a name ({known}), got none.")
        name = names[0]
    folder = find_evidence(places, name)
    return name, open_evidence(folder, zero_is_class=command.zero_is_class, void=command.void)


def _voters(scene: Scene, evidence: Evidence, asked: str) -> tuple[View, ...]:
    """The views asked for that have evidence; named ones must have it."""
    if asked not in ("train", "all"):
        return tuple(scene.view(name.strip()) for name in asked.split(","))
    allowed = scene.views if asked == "all" else scene.train_views
    known = set(evidence.view_names)
    views = tuple(view for view in allowed if view.name in known)
    if not views:
        raise InputError(
            f"--evidence: expected evidence of at least one of the {len(allowed)} views that "
            f"--views {asked} allows, got none."
        )
    lacking = [view.name for view in allowed if view.name not in known]
    # Evidence of the train views alone is as it should be, whatever is allowed.
    if lacking and any(view.split == "train" for view in allowed if view.name in set(lacking)):
        sys.stdout.write(
            f"note: {len(lacking)} of {len(allowed)} views have no such evidence, the first is "
            f"{lacking[0]}\n"
        )
    return views
