"""``splatseg segment``: evidence becomes a layer of a scene, by any method."""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, make_dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro

from splatseg.cli._shared import Memory, OnViews, print_result, typed
from splatseg.cli._words import option_value
from splatseg.core import UNLABELLED, Features, Selection, VoxelFeatures
from splatseg.core.instance_tree import layer_kind
from splatseg.errors import InputError
from splatseg.io.evidence import open_evidence
from splatseg.io.scene_folder import work_on_scene
from splatseg.methods import Method, find_method, methods
from splatseg.report.words import counted
from splatseg.tasks import (
    CheckpointOptions,
    Exported,
    Segmentation,
    SegmentOptions,
    check_layer_exports,
    export_layer,
    report_layer,
    save_segmentation,
    segment,
)
from splatseg.tasks.work import check_streams

CONFIG = (tyro.conf.HelptextFromCommentsOff,)
"""Options of the method and the shared ones are flags without a prefix."""


_HIDDEN_CHECKPOINTS = (
    "checkpoint",
    Annotated[CheckpointOptions, tyro.conf.OmitArgPrefixes, tyro.conf.Suppress],
    field(default_factory=CheckpointOptions),
)
"""The flags of trainings for a method that does not train: not in its help, and refused by the
task, which says why."""


_COMPLETION = (
    "neighbours", "spread_steps", "train_evidence", "min_inferred", "colour_width", "feature_width",
    "smoothing", "smoothing_steps", "completed_layer",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Command(OnViews):
    """Lift evidence of the photographs onto the Gaussians: it becomes a layer.

    The layer is written to SCENE/layers and replaces an older layer of the same name. Ctrl-C ends
    a method that trains and keeps its state in SCENE/training; --resume continues from there, and
    from the last checkpoint of a training that was killed.

    For example:

    splatseg segment room --method uplift --evidence labels_semantic --layer semantic

    splatseg segment room --method associate --evidence masks --layer objects --export --report

    splatseg segment room --method vote --evidence labels_tracked --views all --json

    splatseg segment city --method uplift --evidence labels --executor ray --workers 16
    """

    REMOVED: ClassVar[dict[str, str]] = {
        f"completion.{name}": "labels are completed in one way, or not at all (--no-complete)"
        for name in _COMPLETION
    }
    """Flags that went, and what to do instead."""

    method: Annotated[str, tyro.conf.arg(metavar="METHOD")]
    """Method to use. `splatseg segment --method METHOD --help` shows its options."""

    shared: tyro.conf.OmitArgPrefixes[SegmentOptions] = field(default_factory=SegmentOptions)
    """Options that all methods share."""

    export: bool = False
    """Also write SCENE/exports/LAYER: one splat file per object, a table of objects, all Gaussians
    with their labels as columns, and label maps of all views."""

    report: bool = False
    """Also write SCENE/reports/LAYER.html and LAYER.json: a picture of each object, views,
    confidence, coverage and conflicts."""

    truth: Path | None = None
    """Folder of true maps, which are shown and scored in the report."""

    checkpoint: tyro.conf.OmitArgPrefixes[CheckpointOptions] = field(
        default_factory=CheckpointOptions
    )
    """How a stopped training goes on."""

    options: Any = None
    """Options of the method."""


def command_for(words: Sequence[str]) -> type[Any]:
    """The command with the flags of the method that the words name.

    Flags of other methods are unknown to it, and so refused.
    """
    name = option_value(words, "--method")
    if name is None:
        return _with_summaries()
    method = find_method(name)
    published = "--published" in words
    default = method.published_options if published else method.options()
    options = Annotated[
        method.options,
        tyro.conf.OmitArgPrefixes,
        tyro.conf.arg(help=f"Options of method {name}: {method.summary} ({method.reference})."),
    ]
    own: list[tuple[str, Any, Any]] = [("options", options, field(default=default))]
    if method.camera is not None:
        own.append(("memory", Memory, field(default=None)))
    if method.published_differs:
        own.append(_shared_with(method.published_differs))
    made = make_dataclass(
        "Command",
        own if method.resumes else [*own, _HIDDEN_CHECKPOINTS],
        bases=(Command,),
        frozen=True,
        kw_only=True,
    )
    made.__doc__ = Command.__doc__
    return made


def _shared_with(differs: str) -> tuple[str, Any, Any]:
    """What methods share, with a --published that says how the setting differs from the paper's."""
    said = f"Use the method's published setting: the authors' options, no completion. {differs}"
    told = Annotated[bool, tyro.conf.arg(help=said)]
    shared = make_dataclass(
        "Shared", [("published", told, field(default=False))], bases=(SegmentOptions,), frozen=True,
        kw_only=True,
    )  # fmt: skip
    return "shared", tyro.conf.OmitArgPrefixes[shared], field(default_factory=shared)


def _with_summaries() -> type[Any]:
    """The command without a method, whose help lists the methods."""
    rows = "\n".join(f"- {method.name}: {method.summary}" for method in methods())
    made = make_dataclass(
        "Command",
        [("options", Annotated[Any, tyro.conf.Suppress], field(default=None)), _HIDDEN_CHECKPOINTS],
        bases=(Command,),
        frozen=True,
        kw_only=True,
    )
    made.__doc__ = f"{Command.__doc__}\n\nMethods:\n\n{rows}"
    return made


def run(command: Command) -> None:
    """Segment a scene."""
    started = time.monotonic()
    observer = command.observer
    # Of a method that streams; trainings have a memory of another kind among their options.
    scene = command.open_streamed(getattr(command, "memory", None))
    if command.report:
        check_streams(scene, "--report")
    opened = time.monotonic() - started
    truth = None if command.truth is None else open_evidence(command.truth)
    method = find_method(command.method)
    if command.export or command.report:
        _check_outputs(command, method)
    if command.export and command.shared.layer is not None:
        check_layer_exports(scene, command.scene, command.shared.layer)
    # Until all of it is written, no other process may change the scene.
    writes = ["layers", *(["reports"] if command.report else [])]
    with work_on_scene(command.scene, "segment", writes=writes):
        with command.open_executor() as executor:
            result = segment(
                scene,
                method,
                options=command.shared,
                method_options=command.options,
                checkpoints=command.checkpoint,
                backend=command.backend,
                executor=executor,
                observer=observer,
            )
        if command.export:
            check_layer_exports(scene, command.scene, result.name)
        path = save_segmentation(result, command.scene)
        lines = [_summary(result, time.monotonic() - started), str(path)]
        made = _facts(result, path)
        timings = {"load": opened}
        files: tuple[Exported, ...] = ()
        if command.export:
            began = time.monotonic()
            files, maps = export_layer(
                scene, command.scene, result.name, result.layer,
                backend=command.backend, observer=observer,
            )  # fmt: skip
            timings["export"] = time.monotonic() - began
            lines += [f"{file.summary} in {file.output}" for file in files]
            made["exports"] = [file.output for file in files]
            if maps is not None:
                lines.append(f"label maps of {maps.views} views in {maps.folder}")
                made["exports"].append(maps.folder)
        if command.report:
            where = report_layer(
                scene,
                command.scene,
                result,
                truth=truth,
                timings=timings,
                exported=files,
                command=typed(sys.argv),
                backend=command.backend,
            )
            lines.append(f"report: {where}")
            made["report"] = where
    made["seconds"] = round(time.monotonic() - started, 3)
    print_result(made, lines, json=command.json)


def _facts(result: Segmentation, path: Path) -> dict[str, Any]:
    """What was made, for programs."""
    facts: dict[str, Any] = {
        "layer": result.name,
        "file": path,
        "kind": layer_kind(result.layer),
        "views": len(result.views),
        "warnings": list(result.warnings),
        "stage_seconds": {name: round(value, 3) for name, value in result.timings.items()},
    }
    if isinstance(result.layer, Selection):
        mean = result.layer.mean_confidence
        facts["gaussians"] = len(result.layer)
        facts["selected"] = result.layer.count
        facts["confidence"] = None if mean is None else round(mean, 4)
    elif not isinstance(result.layer, Features | VoxelFeatures):
        labels = result.labels
        facts["gaussians"] = len(labels)
        facts["labelled"] = int((labels.ids != UNLABELLED).sum())
        facts["ids"] = len(labels.present)
        facts["inferred"] = 0 if labels.inferred is None else int(labels.inferred.sum())
    return facts


def _check_outputs(command: Command, method: Method) -> None:
    if method.refines is not None and getattr(command.options, method.refines) is not None:
        raise InputError(
            f"export, report: are of this scene, and with {method.refines} the layer is of a new "
            "one; export or report that layer afterwards."
        )
    gives = method.gives(command.options)
    if gives not in ("labels", "tree"):
        raise InputError(
            f"export, report: go with methods that give labels, {method.name} gives {gives}."
        )


def _summary(result: Segmentation, seconds: float) -> str:
    """One line on the layer."""
    end = f"from {counted(len(result.views), 'view')} in {seconds:.1f} s"
    if isinstance(result.layer, VoxelFeatures):
        return f"{result.layer!r}, {end}"
    if isinstance(result.layer, Features):
        count, channels = result.layer.values.shape
        return f"features of {channels} channels on {count} Gaussians, {end}"
    if isinstance(result.layer, Selection):
        mean = result.layer.mean_confidence
        sure = "" if mean is None else f", confidence {mean:.2f}"
        return f"{result.layer.count} of {len(result.layer)} Gaussians{sure}, {end}"
    labels = result.labels
    labelled = int((labels.ids != UNLABELLED).sum())
    background = labels.info.names.get(labels.background, f"id {labels.background}")
    share = 100 * labelled / max(len(labels), 1)
    inferred = 0 if labels.inferred is None else int(labels.inferred.sum())
    guessed = f", {inferred} of them inferred from neighbours" if inferred else ""
    return (
        f"{labelled} of {len(labels)} Gaussians labelled ({share:.1f} %){guessed}, "
        f"{counted(len(labels.present), 'id')}, {end}; "
        f"background: {'none' if labels.background == UNLABELLED else background}"
    )
