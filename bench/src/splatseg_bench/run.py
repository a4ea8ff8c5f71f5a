"""A protocol run over methods and scenes, each result kept when it is there, and its tables."""

import importlib.metadata
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, is_dataclass, replace
from pathlib import Path
from typing import Any

from splatseg.core import LOCAL, Executor, Model
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.json_values import plain_object
from splatseg.core.models import GroundedMasks
from splatseg.errors import InputError
from splatseg.io.atomic import named_write_failures, path_inside
from splatseg.methods import find_method
from splatseg.render import BackendName
from splatseg.tasks.work import SILENT, Observer, check_parent_writable
from splatseg_bench.evidence import (
    bench_model,
    chosen_model,
    evidence_wanted,
    kinds_wanted,
)
from splatseg_bench.job import Job
from splatseg_bench.maps import map_scores
from splatseg_bench.options import BenchOptions
from splatseg_bench.points import point_scores
from splatseg_bench.protocols import (
    PointSwitches,
    Protocol,
    RoomSwitches,
    StreetSwitches,
    TargetSwitches,
    find_protocol,
    mask_scores,
    switch_value,
)
from splatseg_bench.results import (
    MethodResult,
    SceneResult,
    check_comparable,
    check_same_scenes,
    kept_result,
    key_of,
    oracle_of,
    over_scenes,
    result_path,
    results_of,
    save_result,
    switches_of,
)
from splatseg_bench.rooms import check_room, room_scores
from splatseg_bench.scene import BenchmarkScene
from splatseg_bench.scenes import asked_scenes, fitted_scene, gaussians_digest, scene_notes
from splatseg_bench.streets import Drive, point_rules
from splatseg_bench.targets import TargetRun

_Scorer = Callable[[Job], tuple[dict[str, float], Sequence[Mapping[str, Any]], list[str]]]
"""Scores, rows and notes of a job."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BenchRun:
    """What was measured under a protocol."""

    protocol: Protocol
    """With the choices that were made."""

    methods: tuple[MethodResult, ...]
    folder: Path
    kept: int
    """Results that an earlier run had made."""

    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        convert_fields(self)


@boundary
def bench(
    protocol: str,
    data: Path,
    folder: Path,
    *,
    options: BenchOptions | None = None,
    backend: BackendName = "auto",
    command: str = "",
    executor: Executor = LOCAL,
    observer: Observer = SILENT,
) -> BenchRun:
    """Run methods under a published protocol: fit, see, segment, score.

    Each scene is fitted once for all methods, each result is written when it is there, and a run
    that was stopped goes on with the next one.

    Args:
        protocol: Its name, see `splatseg_bench.protocols.PROTOCOLS`.
        data: The data set in the layout that the protocol reads: a scene, or all of them.
        folder: Where fits, predictions and results are kept; it may be there from an earlier run.
        options: Methods, models, fits, and choices other than the protocol's.
        backend: Who renders.
        command: The words that started it, for the record; may be empty.
        executor: Where scenes are fitted and measured.
        observer: Is told of the progress.

    Raises:
        InputError: If there is no such protocol, method, model or scene, they do not fit
            together, or the folder holds fits with other options.
        MissingFileError: If the data set is not there, or lacks files of its layout.
    """
    options = options or BenchOptions()
    chosen = find_protocol(protocol)
    chosen = chosen.with_switches(dict(switch_value(chosen, one) for one in options.switches))
    methods = [find_method(name) for name in options.methods]
    options.check_methods(methods)
    if options.companions and not any(method.companions for method in methods):
        raise InputError(
            "companions: expected a method that takes more than its evidence, got "
            f"{', '.join(options.methods)}."
        )
    check_parent_writable(folder)
    scenes = asked_scenes(chosen, data, options)
    with named_write_failures(folder):
        folder.mkdir(parents=True, exist_ok=True)
    notes = scene_notes(chosen, scenes)
    for note in notes:
        observer.note(note.rstrip("."))
    for one in scenes:
        if isinstance(chosen.switches, RoomSwitches):
            check_room(chosen, one)
        for method in methods:
            wanted = evidence_wanted(chosen, method, options)
            if wanted != "prompts":
                kinds = kinds_wanted(chosen, method)
                chosen_model(method, one, words=wanted == "words", kinds=kinds, options=options)
        for note in one.notes if one.notes != one.capture.notes else ():
            observer.note(f"{one.name}: {note.rstrip('.')}")
    found: dict[str, list[SceneResult]] = {}
    kept = 0
    running = _Running.of(chosen, folder, options, backend, command, observer=observer)
    with closing(executor.map(_measured_scene, scenes, shared=running)) as results:
        for result, was_kept in results:
            _tell(result, chosen, kept=was_kept, observer=observer)
            found.setdefault(result.method, []).append(result)
            kept += was_kept
    measured = [over_scenes(chosen, name, results) for name, results in found.items()]
    others = [one for root in options.beside for one in results_of(root, chosen)]
    for one in others:
        check_comparable([*measured[0].scenes, *one.scenes])
        check_same_scenes(measured[0], one)
    return BenchRun(
        protocol=chosen,
        methods=(*measured, *others),
        folder=folder,
        kept=kept,
        notes=tuple(notes),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Running:
    """What the scenes of a run have in common."""

    protocol: Protocol
    folder: Path
    options: BenchOptions
    backend: BackendName
    command: str
    observer: Observer
    prompter: Model | None
    grounder: GroundedMasks | None

    @classmethod
    def of(
        cls,
        protocol: Protocol,
        folder: Path,
        options: BenchOptions,
        backend: BackendName,
        command: str,
        *,
        observer: Observer = SILENT,
    ) -> "_Running":
        """Opens the models that answer prompts."""
        prompter, grounder = _models(protocol, options, observer)
        return cls(
            protocol=protocol, folder=folder, options=options, backend=backend, command=command,
            observer=observer, prompter=prompter, grounder=grounder,
        )  # fmt: skip

    def __reduce__(self) -> tuple[Callable[..., "_Running"], tuple[Any, ...]]:
        """What another process gets: models of its own, and nobody to tell."""
        given = (self.protocol, self.folder, self.options, self.backend, self.command)
        return _Running.of, given


def _measured_scene(running: _Running, one: BenchmarkScene) -> Iterator[tuple[SceneResult, bool]]:
    """Fit a scene and measure all methods in it: each result, and whether it was there."""
    scene = fitted_scene(
        one,
        running.protocol,
        running.folder,
        options=running.options,
        backend=running.backend,
        command=running.command,
        observer=running.observer,
    )
    digest = gaussians_digest(scene)
    for name in running.options.methods:
        job = Job(
            protocol=running.protocol, bench=one, scene=scene, method=find_method(name),
            root=running.folder, prompter=running.prompter, grounder=running.grounder,
            options=running.options, backend=running.backend, observer=running.observer,
        )  # fmt: skip
        for row, scored in _rows(job):
            yield _result(row, scored, digest, running.command)


def _tell(result: SceneResult, protocol: Protocol, *, kept: bool, observer: Observer) -> None:
    """Tell what was measured, or that it was."""
    where = f"{result.scene}, {result.method}"
    if kept:
        observer.info(f"{where}: as it was measured before")
        return
    figure = result.scores.get(protocol.measure)
    shown = "not measured" if figure is None else f"{figure:.4f}"
    observer.info(f"{where}: {protocol.measure} {shown}")
    for note in result.notes:
        observer.note(f"{where}: {note.rstrip('.')}")


def _rows(job: Job) -> list[tuple[Job, "_Scorer"]]:
    """Rows of the table that a method has, each with who scores it."""
    if not isinstance(job.protocol.switches, StreetSwitches):
        return [(job, _scored)]
    drive = Drive(job)
    rules = point_rules(job.protocol, job.method, job.bench)
    return [(replace(job, rule=rule), drive.scores) for rule in rules]


def _result(job: Job, scored: "_Scorer", digest: str, command: str) -> tuple[SceneResult, bool]:
    """The result of a method in a scene, and whether it was there."""
    made = _made_from(job, digest)
    key = key_of(made)
    path = result_path(job.root, job.protocol.name, job.row, job.bench.name)
    before = None if job.options.again else kept_result(path, key)
    if before is not None:
        return before, True
    began = time.monotonic()
    scores, rows, notes = scored(job)
    result = SceneResult(
        protocol=job.protocol.name,
        scene=job.bench.name,
        method=job.row,
        scores=scores,
        rows=tuple(rows),
        switches=switches_of(job.protocol),
        oracle=oracle_of(job.protocol.switches),
        notes=tuple(notes),
        made={**made, "command": command, "seconds": round(time.monotonic() - began, 3)},
        key=key,
    )
    save_result(result, path)
    return result, False


def _scored(job: Job) -> tuple[dict[str, float], list[Mapping[str, Any]], list[str]]:
    """Scores, rows and notes of a method in a scene."""
    switches = job.protocol.switches
    if isinstance(switches, TargetSwitches):
        if not job.bench.tasks:
            raise InputError(f"scene {job.bench.name}: expected things to ask for, got none.")
        run = TargetRun(job)
        folder = path_inside(
            job.root, "predictions", job.protocol.name, job.method.name, job.bench.name
        )
        with job.observer.stage("score") as step:
            count = sum(len(run.scored(task)) for task in job.bench.tasks)
            rows = []
            for row in run.rows(folder):
                rows.append(row)
                step(len(rows), count)
        return mask_scores(rows, switches), [row.to_json() for row in rows], run.notes
    if isinstance(switches, PointSwitches):
        scores, classes, notes = point_scores(job)
        return scores, [*classes], notes
    scores, maps, notes = (
        room_scores(job) if isinstance(switches, RoomSwitches) else map_scores(job)
    )
    return scores, [*maps], notes


def _made_from(job: Job, digest: str) -> dict[str, Any]:
    """All that a result depends on, in values that JSON holds."""
    method = job.method
    chosen = job.options.options_of(method)
    # Left out where there is none: results of versions that did not know it stay what they are.
    given = bool(method.companions) and bool(job.options.companions)
    companions = {"companions": list(job.options.companions)} if given else {}
    rule = {} if job.rule is None else {"rule": job.rule}
    return plain_object(
        "made",
        {
            "protocol": job.protocol.name,
            "switches": switches_of(job.protocol),
            "scene": job.bench.name,
            "method": method.name,
            "options": asdict(chosen) if is_dataclass(chosen) else {},  # pyright: ignore[reportArgumentType]
            "published": job.options.published,
            "seed": job.options.seed,
            "models": list(job.options.models),
            **companions,
            **rule,
            "prompter": _recorded_model(job.prompter),
            "grounder": _recorded_model(job.grounder),
            "gaussians": digest,
            "backend": job.backend,
            "versions": {name: importlib.metadata.version(name) for name in ("splatseg", "torch")},
        },
    )


def _recorded_model(model: Model | None) -> dict[str, Any] | None:
    return None if model is None else {"name": model.name, "settings": dict(model.settings)}


def _models(
    protocol: Protocol, options: BenchOptions, observer: Observer
) -> tuple[Model | None, GroundedMasks | None]:
    """Who answers strokes, and who finds words in pictures."""
    switches = protocol.switches
    if not isinstance(switches, TargetSwitches):
        return None, None
    if switches.prompt == "scribble":
        return bench_model(options.prompter, options, observer), None
    if switches.prompt != "words" or options.grounder is None:
        return None, None
    grounder = bench_model(options.grounder, options, observer)
    if not isinstance(grounder, GroundedMasks):
        raise InputError(f"grounder: expected a model that finds words, got {grounder.name}.")
    return None, grounder
