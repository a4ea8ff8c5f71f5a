"""``splatseg see``: a 2D model, or evidence recorded elsewhere -> evidence of a scene."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from splatseg.cli._types import Backend, Data, Json, Overwrite, Quiet, SceneFolder
from splatseg.cli._words import listed
from splatseg.cli._work import ConsoleObserver, open_scene, print_result
from splatseg.models import SeenEvidence
from splatseg.models.classical import RegionOptions
from splatseg.tasks import SeeOptions, see


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Look at a scene's photographs with a 2D model, and write down what it sees.

    The evidence goes to SCENE/evidence/NAME, a file a view. Work that was stopped goes on where
    it was when the same command is given again; --overwrite begins anew.

    For example:

    splatseg see room --model classical --evidence masks

    splatseg see room --model sam-masks --evidence masks_sam --views all --allow-missing

    splatseg see room --model label-maps --evidence labels --zero-is-class --void 255

    splatseg see room --model predictions --evidence ade --suffix _pred --classes ade20k-train
    """

    scene: SceneFolder

    model: Annotated[str, tyro.conf.arg(metavar="NAME_OR_FOLDER")]
    """The model: classical (a stand-in that needs no weights), one that an installed package
    brings, or a folder of evidence that was recorded elsewhere (docs/models.md)."""

    evidence: Annotated[str, tyro.conf.arg(metavar="NAME")]
    """Name of the evidence to write."""

    what: Literal["masks", "labels", "panoptic", "features", "text"] | None = None
    """What to ask the model for. None takes what it has, masks before the others."""

    views: tuple[str, ...] = ("train",)
    """Which views: train, all, or names of views, by comma or by space. It is recorded with the
    evidence."""

    allow_missing: bool = False
    """Take the views that recorded evidence has, where some that are asked for are missing."""

    zero_is_class: bool = False
    """The id 0 of recorded label maps is a class and not void: ids grow by 1."""

    void: int | None = None
    """A further id of recorded label maps that means none, such as 255."""

    suffix: str = ""
    """What stands in the names of recorded files between the view and the ending, such as _pred
    for 000_pred.png; files without it are left aside."""

    classes: Annotated[str | None, tyro.conf.arg(metavar="NAME_OR_FILE")] = None
    """Names of the ids of recorded label maps: ade20k, coco, cityscapes or scannet, for the ids
    of their annotations, with -train behind it for the ids from 0 that networks learn; or a
    JSON file with "classes" (id, name, isthing, colour), where 0 is a class if it is called so.
    Pictures in a table's colours are read by it."""

    cache: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder where the model's answers are kept by the content of the photographs, for other
    scenes of them."""

    precision: Literal["float16", "int8"] = "float16"
    """How features are kept in the cache."""

    overwrite: Overwrite = False
    backend: Backend = "auto"
    data: Data = None
    json: Json = False
    quiet: Quiet = False

    regions: RegionOptions = field(default_factory=RegionOptions)
    """Settings of the masks of model classical."""


def run(command: Command) -> None:
    """See a scene."""
    asked = {field.name: getattr(command, field.name) for field in fields(SeeOptions)}
    asked["views"] = listed("--views", command.views)
    seen = see(
        open_scene(command.scene, command.data),
        command.model,
        command.evidence,
        options=SeeOptions(**asked),
        regions=command.regions,
        backend=command.backend,
        observer=ConsoleObserver(quiet=command.quiet, json=command.json),
    )
    facts = {
        "evidence": seen.folder,
        "kind": seen.kind,
        "model": seen.model,
        "views": seen.views,
        "views_kept": seen.kept,
        "masks": seen.masks,
        "seconds": round(seen.seconds, 3),
        "bytes": seen.bytes,
        "notes": list(seen.notes),
    }
    print_result(facts, [summary(seen), str(seen.folder)], json=command.json)


def summary(seen: SeenEvidence) -> str:
    """One line on what was written."""
    new = seen.views - seen.kept
    parts = [f"{seen.kind} of {seen.views} views by {seen.model}"]
    if seen.kept:
        parts.append(f"{seen.kept} of them were there")
    if new and seen.masks is not None:
        parts.append(f"{seen.masks / new:.1f} masks a view")
    if new:
        parts.append(f"{seen.seconds / new:.2f} s an image")
    parts.append(f"{seen.bytes / 1e6:.1f} MB")
    return ", ".join(parts)
