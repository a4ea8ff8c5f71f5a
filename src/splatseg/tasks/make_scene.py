"""Photographs become a scene: poses where they lack them, a fit, scores, a report."""

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from splatseg.core import LOCAL, Capture, Executor
from splatseg.core.boundary import boundary
from splatseg.core.checkpoints import Checkpoints, deferred_interrupts
from splatseg.errors import InputError
from splatseg.evaluate import PhotographReport
from splatseg.fit import (
    EXPOSURES,
    CaptureBlocks,
    FitOptions,
    FitResult,
    exposures_record,
    random_point_count,
    reduction_note,
)
from splatseg.io.captures import read_start_points
from splatseg.io.scans import read_scans
from splatseg.io.scene import save_scene
from splatseg.io.scene_folder import (
    BLOCKS_FOLDER,
    CHECKPOINT_FILE,
)
from splatseg.pose import PoseReport
from splatseg.pose.pointmaps import PointmapReport
from splatseg.render import BackendName
from splatseg.report.fit_report import FitVerdict, verdict_of
from splatseg.tasks.add_photographs import add_photographs
from splatseg.tasks.checkpoints import (
    check_block_count,
    check_fit_output,
    discard_fit_files,
    fit_folder,
)
from splatseg.tasks.fit_blocks import FitSteps, ObjectsOf, fitted, in_cells
from splatseg.tasks.fit_objects import object_labels
from splatseg.tasks.fit_scores import score_and_report
from splatseg.tasks.moving import (
    LeftOut,
    capture_without_moving,
    moving_things,
    without_moving_points,
)
from splatseg.tasks.photographs import MakeSceneOptions, capture_of, with_depth_evidence, with_scans
from splatseg.tasks.work import (
    SILENT,
    Observer,
    scene_of_capture,
    versions,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MadeScene:
    """A scene folder, and how it was made."""

    folder: Path
    capture: Capture
    """What it was made of; poses that were found included."""

    result: FitResult
    interrupted: bool
    """Whether it was asked to stop; the folder holds what there was, and a checkpoint."""

    scores: PhotographReport | None
    """Renders of held-out views against photographs; None where none were scored."""

    held_out: int
    """Held-out views with photographs."""

    report: Path
    """The page on the fit."""

    poses: PoseReport | PointmapReport | None
    """How poses were found; None where they came with the capture."""

    moving: LeftOut | None
    """What was left out with moving things; None where nothing was to be."""

    verdict: FitVerdict
    """What the fit is good for."""

    blocks: CaptureBlocks | None
    """How the capture was cut; None where it was fitted as a whole."""

    timings: Mapping[str, float]
    """Seconds by part: photographs and poses, optimisation, what follows it."""


@boundary
def fit_capture(
    data: Path | Capture,
    folder: Path,
    *,
    options: MakeSceneOptions | None = None,
    fit_options: FitOptions | None = None,
    backend: BackendName = "auto",
    executor: Executor = LOCAL,
    command: str = "",
    observer: Observer = SILENT,
) -> MadeScene:
    """Fit Gaussians to the training photographs of a capture, and write a scene folder.

    A `KeyboardInterrupt` out of the observer, Ctrl-C or SIGTERM ends the fit early: the scene
    holds what there is, and a call with `MakeSceneOptions.resume` goes on. Another exception
    out of the observer goes through; the last checkpoint is what a call with resume goes on
    from.

    Args:
        data: Folder of a capture or of bare photographs, or a video; or a capture that was read,
            whose views and split are taken as they are.
        folder: The scene folder to write. A scene that is there is replaced unless it has
            layers.
        options: What is around the fit.
        fit_options: The fit itself; its seed is that of everything that is drawn at random.
        backend: Rendering backend.
        executor: Where blocks are fitted.
        command: The words that started it, for the report; may be empty.
        observer: Is told of the progress.

    Raises:
        InputError: If the folder holds what would be lost, the capture cannot be used, or
            another process works on the folder.
        FileFormatError: If a file of the capture or a checkpoint is damaged.
    """
    options = options or MakeSceneOptions()
    fit_options = fit_options or FitOptions()
    if options.add is not None:
        return _with_more(
            data,
            options.add,
            folder,
            options=options,
            fit_options=fit_options,
            backend=backend,
            command=command,
            observer=observer,
        )
    in_blocks = options.blocks != "off"
    onwards = check_fit_output(folder, options, in_blocks=in_blocks)
    with fit_folder(folder):
        began = time.monotonic()
        capture, poses, moving = _capture(data, folder, options, fit_options, observer)
        objects: ObjectsOf | None = None
        if options.evidence is not None:
            objects = partial(
                object_labels,
                asked=options.evidence,
                scene=folder,
                options=fit_options,
                backend=backend,
            )
            whole = objects(capture)
            objects = objects if in_blocks else lambda _: whole
        if not options.resume:  # what is there of an earlier fit in blocks was to be replaced
            discard_fit_files(folder, keep_checkpoint=True)
        cut = None
        if options.blocks != "off":
            cut = in_cells(
                capture, options.blocks, options=fit_options, backend=backend, observer=observer
            )
            check_block_count(folder, len(cut))
        timings = {"photographs and poses": time.monotonic() - began}
        checkpoints = options.checkpoints(
            folder / (CHECKPOINT_FILE if cut is None else BLOCKS_FOLDER),
            at_end=options.keep_checkpoint,
            observer=observer,
            onwards=onwards,
        )
        if options.resume and onwards is None:
            observer.info(f"{folder}: nothing to go on from, beginning")
        began = time.monotonic()
        result, stopped = _fitted(
            capture if cut is None else cut,
            folder,
            fit_options,
            checkpoints,
            record=_record(options, moving) | ({} if cut is None else {"blocks": cut.record()}),
            objects=objects,
            backend=backend,
            executor=executor,
            observer=observer,
        )
        # What was done before a fit was resumed counts as optimisation.
        timings["optimisation"] = result.seconds
        timings["scene written"] = max(0.0, time.monotonic() - began - result.seconds)
        told, report = score_and_report(
            folder,
            capture,
            result,
            options=fit_options,
            backend=backend,
            scoring=not stopped,
            command=command,
            timings=timings,
            poses=None if poses is None else asdict(poses),
        )
        # Not before the report: who is stopped there can resume, and gets it.
        if not (stopped or options.keep_checkpoint):
            discard_fit_files(folder)
    verdict = verdict_of(told)
    if verdict.warns:
        observer.note(f"{verdict.words.lower()}: {verdict.sentence.rstrip('.')}")
    return MadeScene(
        folder=folder,
        capture=capture,
        result=result,
        interrupted=stopped,
        scores=told.scores,
        held_out=told.held_out,
        report=report,
        poses=poses,
        moving=moving,
        verdict=verdict,
        blocks=cut,
        timings=told.timings,
    )


_WITH_ADD = ("add", "format", "strict")
"""Options that say something of photographs that are added to a scene."""


def _with_more(
    data: Path | Capture,
    base: Path,
    folder: Path,
    *,
    options: MakeSceneOptions,
    fit_options: FitOptions,
    backend: BackendName,
    command: str,
    observer: Observer,
) -> MadeScene:
    """`fit_capture` of photographs that are added to a scene."""
    fresh = MakeSceneOptions()
    for field in fields(options):
        name = field.name
        if name not in _WITH_ADD and getattr(options, name) != getattr(fresh, name):
            raise InputError(f"{name}: expected none with `add`, got {getattr(options, name)!r}.")
    if isinstance(data, Capture):
        raise InputError("data: expected a folder with `add`, got a capture that was read.")
    added = add_photographs(
        data,
        base,
        folder,
        options=fit_options,
        format=options.format,
        strict=options.strict,
        backend=backend,
        observer=observer,
    )
    scene = added.scene
    capture = Capture(
        path=scene.source or folder, format="scene", views=scene.views, up=scene.up,
        classes=scene.classes, metres_per_unit=scene.metres_per_unit,
    )  # fmt: skip
    told, report = score_and_report(
        folder,
        capture,
        added.result,
        options=fit_options,
        backend=backend,
        scoring=True,
        command=command,
        timings={"photographs added": added.result.seconds},
    )
    return MadeScene(
        folder=folder,
        capture=capture,
        result=added.result,
        interrupted=False,
        scores=told.scores,
        held_out=told.held_out,
        report=report,
        poses=None,
        moving=None,
        blocks=None,
        verdict=verdict_of(told),
        timings=told.timings,
    )


def _capture(
    data: Path | Capture,
    folder: Path,
    options: MakeSceneOptions,
    fit_options: FitOptions,
    observer: Observer,
) -> tuple[Capture, PoseReport | PointmapReport | None, LeftOut | None]:
    """The capture with its poses, without moving things; the observer is told what it is."""
    things = moving_things(options.moving, options.moving_classes, options.moving_clock)
    if isinstance(data, Capture):
        capture, poses = data, None
    else:
        capture, poses = capture_of(
            data,
            options,
            scene=folder,
            # A fixed fit keeps every point; other strategies thin the cloud themselves.
            max_points=fit_options.max_gaussians if fit_options.strategy == "fixed" else None,
            seed=fit_options.seed,
            observer=observer,
        )
    if options.points is not None:
        if poses is not None:
            raise InputError("points: expected none where poses are found, whose world is new.")
        if options.scans is not None:
            raise InputError("points: expected none with scans, whose points the fit starts at.")
        points, notes = read_start_points(options.points, strict=options.strict)
        capture = replace(capture, points=points, notes=(*capture.notes, *notes))
    if options.depth_evidence is not None:
        if fit_options.depth == "off":
            raise InputError("depth: expected metric or relative with evidence of depth, got off.")
        capture = with_depth_evidence(
            capture, options.depth_evidence, scene=folder, depth=fit_options.depth,
            report=observer.note,
        )  # fmt: skip
    if options.scans is not None:
        if fit_options.depth != "metric":
            raise InputError(f"depth: expected metric with scans, got {fit_options.depth}.")
        if options.depth_evidence is not None:
            raise InputError("depth_evidence: expected none with scans, which tell depths too.")
        observer.info("scans become depth maps")
        scans = without_moving_points(
            read_scans(options.scans), things, metres_per_unit=capture.metres_per_unit or 1.0
        )
        capture = with_scans(capture, scans, scene=folder, report=observer.note)
    left_out: LeftOut | None = None
    if things is not None:
        capture, left_out = capture_without_moving(
            capture, things, scene=folder, evidence=options.moving_evidence,
            masks=fit_options.masks,
        )  # fmt: skip
        observer.note(left_out.sentence)
    elif options.moving_evidence is not None:
        raise InputError("moving_evidence: expected classes with it (`moving_classes`), got none.")
    for note in (*capture.notes, reduction_note(capture.train_views, longest=fit_options.longest)):
        if note is not None:
            observer.note(note)
    observer.info(_beginning(capture, fit_options))
    return capture, poses, left_out


def _fitted(
    data: Capture | CaptureBlocks,
    folder: Path,
    fit_options: FitOptions,
    checkpoints: Checkpoints,
    *,
    record: Mapping[str, Any],
    objects: ObjectsOf | None,
    backend: BackendName,
    executor: Executor,
    observer: Observer,
) -> tuple[FitResult, bool]:
    """Fit and write the scene. Tells whether it was asked to stop, while it wrote too."""
    with deferred_interrupts() as interrupts:
        with observer.stage("fit") as step:
            result = fitted(
                data,
                options=fit_options,
                backend=backend,
                progress=FitSteps(step),
                checkpoints=checkpoints,
                objects=objects,
                executor=executor,
            )
        capture = data if isinstance(data, Capture) else data.capture
        provenance = _provenance(record, fit_options, backend, result)
        scene = scene_of_capture(
            capture, result.gaussians, views=result.views, provenance=provenance
        )
        save_scene(scene, folder)
    return result, interrupts.requested or result.interrupted


def _beginning(capture: Capture, options: FitOptions) -> str:
    train, test = len(capture.train_views), len(capture.test_views)
    points = 0 if capture.points is None else len(capture.points)
    drawn = ""
    if (number := random_point_count(capture, options)) > 0:
        where = "at" if points == 0 or options.start == "random" else "at these and up to"
        drawn = f"; starting {where} {number} places where photographs agree"
    return (
        f"{capture.path} ({capture.format}): {train} training views, {test} held out, "
        f"{points} start points{drawn}"
    )


def _record(options: MakeSceneOptions, moving: LeftOut | None) -> dict[str, Any]:
    """What the scene remembers of what is around the fit."""
    return {
        **({} if options.depth_evidence is None else {"depth_evidence": options.depth_evidence}),
        **({} if options.evidence is None else {"evidence": options.evidence}),
        **({} if options.scans is None else {"scans": str(options.scans)}),
        **({} if options.points is None else {"points": str(options.points)}),
        **({} if moving is None else {"moving": moving.record}),
    }


def _provenance(
    record: Mapping[str, Any], fit_options: FitOptions, backend: str, result: FitResult
) -> dict[str, Any]:
    return {
        "command": "fit",
        "steps": result.steps,
        "seconds": round(result.seconds, 3),
        "interrupted": result.interrupted,
        "seed": fit_options.seed,
        **record,
        "backend": backend,
        "options": asdict(fit_options),
        **({EXPOSURES: exposures_record(result.exposures)} if result.exposures else {}),
        "versions": versions("splatseg", "torch"),
    }
