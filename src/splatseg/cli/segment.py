"""``splatseg segment``: evidence becomes a layer of labels on the Gaussians of a scene."""

import importlib.metadata
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from splatseg.cli._work import open_scene, progress
from splatseg.core import UNLABELLED, Labels, Scene, View
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence, evidence_names, find_evidence, open_evidence
from splatseg.io.scene import check_name, save_scene_layer
from splatseg.lift import UpliftOptions, uplift
from splatseg.render import BackendName


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Lift what was seen in photographs onto the Gaussians: evidence becomes a layer.

    The layer is written to SCENE/layers. An older layer of the same name is replaced.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """The scene folder."""

    method: Literal["uplift"]
    """How. uplift: every pixel votes for its label on the Gaussians it shows."""

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

    seed: int = 0
    """Seed of random choices, recorded in the layer. uplift makes none."""

    backend: BackendName = "auto"
    """Who renders. auto: cuda for scenes on a GPU, cpu otherwise."""

    data: Path | None = None
    """Folder of the capture, where it was moved."""

    uplift: UpliftOptions = field(default_factory=UpliftOptions)
    """Settings of the method uplift."""


def run(command: Command) -> None:
    """Segment a scene."""
    started = time.monotonic()
    scene = open_scene(command.scene, command.data)
    evidence_name, evidence = _evidence(command, scene)
    if evidence.kind not in ("labels", "tracked"):
        raise InputError(
            f"{evidence.folder}: --method uplift needs label maps whose ids mean the same in all "
            f"views (labels, tracked), got {evidence.kind}."
        )
    layer_name = command.layer or evidence_name
    check_name("--layer", layer_name)
    views = _voters(scene, evidence, command.views)
    with progress("segment") as step:
        labels = uplift(
            scene.gaussians,
            views,
            evidence,
            options=command.uplift,
            classes=(evidence.classes or scene.classes) if evidence.kind == "labels" else None,
            backend=command.backend,
            progress=step,
        )
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
    path = save_scene_layer(command.scene, layer_name, replace(labels, metadata=metadata))
    sys.stdout.write(_summary(labels, len(views), time.monotonic() - started) + f"{path}\n")


def _summary(labels: Labels, views: int, seconds: float) -> str:
    labelled = int((labels.ids != UNLABELLED).sum())
    ids = len(torch.unique(labels.ids[labels.ids != UNLABELLED]))
    share = 100 * labelled / max(len(labels), 1)
    background = labels.background
    names = labels.metadata["names"]
    behind = "none" if background == UNLABELLED else names.get(str(background), f"id {background}")
    return (
        f"{labelled} of {len(labels)} Gaussians labelled ({share:.1f} %), {ids} ids, "
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
    return views
