"""``splatseg see``: a 2D model, or evidence recorded elsewhere -> evidence of a scene."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from splatseg.cli._progress import progress
from splatseg.cli._work import open_scene
from splatseg.core import Model, Scene, View
from splatseg.errors import InputError
from splatseg.io.scene import check_name
from splatseg.models import ModelCache, SeenEvidence, find_model, record_evidence
from splatseg.models.classical import Classical, RegionOptions
from splatseg.models.recorded import AnyRecorded, recorded_model


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Look at a scene's photographs with a 2D model, and write down what it sees.

    The evidence goes to SCENE/evidence/NAME, a file a view. Work that was stopped goes on where
    it was when the same command is given again.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """The scene folder."""

    model: Annotated[str, tyro.conf.arg(metavar="NAME_OR_FOLDER")]
    """The model: classical (a stand-in that needs no weights), one that an installed package
    brings, or a folder of evidence that was recorded elsewhere (docs/models.md)."""

    evidence: Annotated[str, tyro.conf.arg(metavar="NAME")]
    """Name of the evidence to write."""

    what: Literal["masks", "labels", "panoptic", "features", "text"] | None = None
    """What to ask the model for. None takes what it has, masks before the others."""

    views: str = "train"
    """Which views: train, all, or names with commas between them. It is recorded with the
    evidence."""

    allow_missing: bool = False
    """Take the views that recorded evidence has, where some that are asked for are missing."""

    zero_is_class: bool = False
    """The id 0 of recorded label maps is a class and not void: ids grow by 1."""

    void: int | None = None
    """A further id of recorded label maps that means none, such as 255."""

    cache: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder where the model's answers are kept by the content of the photographs, for other
    scenes of them."""

    precision: Literal["float16", "int8"] = "float16"
    """How features are kept in the cache."""

    overwrite: bool = False
    """Delete evidence of this name first."""

    data: Path | None = None
    """Folder of the capture, where it was moved."""

    regions: RegionOptions = field(default_factory=RegionOptions)
    """Settings of the masks of model classical."""


def run(command: Command) -> None:
    """See a scene."""
    check_name("--evidence", command.evidence)
    scene = open_scene(command.scene, command.data)
    views = _views(scene, command.views)
    model = _model(command)
    cache = (
        None
        if command.cache is None
        else ModelCache(folder=command.cache, precision=command.precision, report=_say)
    )
    if model.note:
        _say(f"{model.name}: {model.note}")
    folder = command.scene / "evidence" / command.evidence
    folder.parent.mkdir(exist_ok=True)
    with progress("see") as step:
        seen = record_evidence(
            model,
            views,
            folder,
            what=command.what,
            asked=command.views,
            overwrite=command.overwrite,
            missing="skip" if command.allow_missing else "refuse",
            cache=cache,
            progress=step,
        )
    for note in seen.notes:
        _say(f"note: {note}")
    if cache is not None:
        _say(f"{cache.folder}: {cache.size()}")
    sys.stdout.write(f"{summary(seen, model)}\n{folder}\n")


def summary(seen: SeenEvidence, model: Model) -> str:
    """One line on what was written."""
    new = seen.views - seen.kept
    parts = [f"{seen.kind} of {seen.views} views by {model.name}"]
    if seen.kept:
        parts.append(f"{seen.kept} of them were there")
    if new and seen.masks is not None:
        parts.append(f"{seen.masks / new:.1f} masks a view")
    if new:
        parts.append(f"{seen.seconds / new:.2f} s an image")
    parts.append(f"{seen.bytes / 1e6:.1f} MB")
    return ", ".join(parts)


def _views(scene: Scene, asked: str) -> tuple[View, ...]:
    if asked not in ("train", "all"):
        return tuple(scene.view(name.strip()) for name in asked.split(","))
    views = scene.views if asked == "all" else scene.train_views
    if not views:
        raise InputError(f"--views: the scene has no view that {asked} allows.")
    return views


def _model(command: Command) -> Model:
    model = find_model(command.model)
    if not isinstance(model, Classical) and command.regions != RegionOptions():
        raise InputError(
            f"expected settings of regions with --model classical, got --model {command.model}."
        )
    if isinstance(model, AnyRecorded):
        kind = "masks" if command.what == "masks" else None
        return recorded_model(
            command.model, kind=kind, zero_is_class=command.zero_is_class, void=command.void
        )
    if command.zero_is_class or command.void is not None:
        raise InputError(
            f"--zero-is-class, --void: expected with recorded label maps, got --model "
            f"{command.model}."
        )
    return Classical(regions=command.regions) if isinstance(model, Classical) else model


def _say(sentence: str) -> None:
    print(sentence, file=sys.stderr)
