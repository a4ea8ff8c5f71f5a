"""``splatseg see``: a 2D model, or evidence recorded elsewhere -> evidence of a scene."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from splatseg.cli._types import Backend, Data, Json, Overwrite, Quiet, SceneFolder
from splatseg.cli._words import listed, option_value
from splatseg.cli._work import ConsoleObserver, open_scene, print_result
from splatseg.models import (
    LoadOptions,
    ModelFamily,
    SeenEvidence,
    TrackingOptions,
    find_family,
    model_names,
    model_summary,
)
from splatseg.tasks import SeeOptions, see

CONFIG = (tyro.conf.HelptextFromCommentsOff,)
"""Options of the model and of its weights are flags without a prefix."""


@dataclass(frozen=True, kw_only=True)
class Command:
    """Look at a scene's photographs with a 2D model, and write down what it sees.

    The evidence goes to SCENE/evidence/NAME, a file a view. Work that was stopped goes on where
    it was when the same command is given again; --overwrite begins anew.

    For example:

    splatseg see room --model classical --evidence masks

    splatseg see room --model dinov2 --weights facebook/dinov2-base --download --evidence dino

    splatseg see room --model sam2-video --seeds masks --evidence tracks

    splatseg see room --model sam-masks --evidence masks_sam --views all --allow-missing

    splatseg see room --model label-maps --evidence labels --zero-is-class --void 255

    splatseg see room --model predictions --evidence ade --suffix _pred --classes ade20k-train

    splatseg see room --model instances_default.json --evidence drawn --what labels
    """

    scene: SceneFolder

    model: Annotated[str, tyro.conf.arg(metavar="NAME_OR_PATH")]
    """The model: one of those above, or a file or folder that was recorded elsewhere: masks, label
    maps, features or depth, a file a view, or annotations as COCO, CVAT, labelme, Label Studio and
    Detectron2 write them (docs/models.md). `splatseg see --model NAME --help` shows the options of
    one."""

    evidence: Annotated[str, tyro.conf.arg(metavar="NAME")]
    """Name of the evidence to write."""

    what: Annotated[tuple[str, ...], tyro.conf.arg(metavar="WHAT ..")] = ()
    """What to ask the model for: masks, labels, panoptic, features, text, depth, tracked. Without
    it what the model has, masks before the others. Of several, by comma or by space, each further
    one is written to NAME.WHAT, and each image passes the network once."""

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
    """Names of the ids of recorded label maps: ade20k, coco, cityscapes, scannet, kitti360,
    semantic-kitti or voc, for the ids of their annotations, with -train behind it for the ids that
    networks learn; or a JSON file with "classes" (id, name, isthing, colour), where 0 is a class
    if it is called so; or CVAT's labelmap.txt. Pictures in a table's colours are read by it."""

    depth_unit: float | None = None
    """Metres of one step of recorded depth maps that are pictures or .npy files, such as 0.001.
    Without it those are relative: inverse depth up to a scale and a shift."""

    cache: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder where the model's answers are kept by the content of the photographs, for other
    scenes of them."""

    precision: Literal["float16", "int8"] = "float16"
    """How features are kept in the cache."""

    seeds: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Name of the evidence that says what a tracker is to follow: masks, panoptic segments,
    labels or tracks of some views, of the scene or its capture."""

    overwrite: Overwrite = False
    backend: Backend = "auto"
    data: Data = None
    json: Json = False
    quiet: Quiet = False

    loading: tyro.conf.OmitArgPrefixes[LoadOptions] = field(default_factory=LoadOptions)
    """Weights, and where and how the network runs."""

    tracking: tyro.conf.OmitArgPrefixes[TrackingOptions] = field(default_factory=TrackingOptions)
    """Which of the seeds count, and the order of the views."""

    options: Any = None
    """Options of the model."""


_HIDDEN_LOADING = (
    "loading",
    Annotated[LoadOptions, tyro.conf.OmitArgPrefixes, tyro.conf.Suppress],
    field(default_factory=LoadOptions),
)
"""For a model that has no weights: their flags are unknown to it, and so refused."""

_NO_TRACKING = (
    ("seeds", Annotated[str | None, tyro.conf.Suppress], None),
    (
        "tracking",
        Annotated[TrackingOptions, tyro.conf.OmitArgPrefixes, tyro.conf.Suppress],
        field(default_factory=TrackingOptions),
    ),
)
"""For a model that follows nothing."""

_NO_OPTIONS = ("options", Annotated[Any, tyro.conf.Suppress], field(default=None))


def command_for(words: Sequence[str]) -> type[Any]:
    """The command with the flags of the model that the words name.

    Flags of other models are unknown to it, and so refused.
    """
    name = option_value(words, "--model")
    if name is None:
        return _with_summaries()
    if name not in model_names():
        return _made([_NO_OPTIONS, _HIDDEN_LOADING, *_NO_TRACKING], Command.__doc__)
    family = find_family(name)
    if family is None:
        return _made([_NO_OPTIONS, _HIDDEN_LOADING], Command.__doc__)
    options = Annotated[
        family.options,
        tyro.conf.OmitArgPrefixes,
        tyro.conf.arg(help=f"Options of model {name}: {family.summary} ({family.reference})."),
    ]
    fields: list[Any] = [("options", options, field(default_factory=family.options))]
    if "tracked" not in family.gives:
        fields += _NO_TRACKING
    if not family.needs_weights:
        fields.append(_HIDDEN_LOADING)
    return _made(fields, f"{Command.__doc__}{_weights(family)}")


def _made(fields: list[Any], text: str | None) -> type[Any]:
    made = make_dataclass("Command", fields, bases=(Command,), frozen=True, kw_only=True)
    made.__doc__ = text
    return made


def _weights(family: ModelFamily) -> str:
    """Published weights of a family, a line each."""
    if not family.checkpoints:
        return ""
    rows = "\n".join(
        f"- {one.id} ({one.megabytes} MB, {one.licence}{f'; {one.note}' if one.note else ''})"
        for one in family.checkpoints
    )
    if not family.checkpoints[0].on_hub:
        return f"\n\nPublished weights, of which --weights takes a copy:\n\n{rows}"
    return f"\n\nWeights on the Hugging Face hub, the default first:\n\n{rows}"


def _with_summaries() -> type[Any]:
    """The command without a model, whose help lists the models."""
    text = "\n".join(
        f"- {name}: {model_summary(name) or 'of another package'}" for name in model_names()
    )
    return _made(
        [_NO_OPTIONS, _HIDDEN_LOADING, *_NO_TRACKING], f"{Command.__doc__}\n\nModels:\n\n{text}"
    )


def run(command: Command) -> None:
    """See a scene."""
    asked = {field.name: getattr(command, field.name) for field in fields(SeeOptions)}
    asked["views"] = listed("--views", command.views)
    asked["what"] = command.what
    seen = see(
        open_scene(command.scene, command.data),
        command.model,
        command.evidence,
        options=SeeOptions(**asked),
        model_options=command.options,
        loading=None if command.loading == LoadOptions() else command.loading,
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
    lines = [summary(seen), str(seen.folder)]
    for one in seen.further:
        lines += [summary(one), str(one.folder)]
    facts["further"] = [str(one.folder) for one in seen.further]
    print_result(facts, lines, json=command.json)


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
