"""A protocol run over methods and scenes, each result kept when it is there, and its tables."""

import importlib.metadata
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass, replace
from pathlib import Path
from typing import Any

from splatseg.core import Model
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.json_values import plain_object
from splatseg.core.models import GroundedMasks
from splatseg.errors import InputError
from splatseg.io.atomic import atomic_file, named_write_failures, path_inside
from splatseg.io.json_files import write_json
from splatseg.methods import find_method
from splatseg.render import BackendName
from splatseg.report.html import Commands, Notice, Report, Table, report_html
from splatseg.tasks.figures import Cell, write_table
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
    TABLE_1,
    PointSwitches,
    Protocol,
    PublishedFigure,
    RoomSwitches,
    StreetSwitches,
    TargetSwitches,
    find_protocol,
    mask_scores,
    published_figures,
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
    prompter, grounder = _models(chosen, options, observer)
    found: dict[str, list[SceneResult]] = {}
    kept = 0
    for one in scenes:
        for note in one.notes if one.notes != one.capture.notes else ():
            observer.note(f"{one.name}: {note.rstrip('.')}")
        scene = fitted_scene(
            one, chosen, folder, options=options, backend=backend, command=command,
            observer=observer,
        )  # fmt: skip
        digest = gaussians_digest(scene)
        for method in methods:
            job = Job(
                protocol=chosen, bench=one, scene=scene, method=method, root=folder,
                prompter=prompter, grounder=grounder, options=options, backend=backend,
                observer=observer,
            )  # fmt: skip
            for row, scored in _rows(job):
                result, was_kept = _result(row, scored, digest, command)
                found.setdefault(row.row, []).append(result)
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
        job.observer.info(f"{job.bench.name}, {job.row}: as it was measured before")
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
    figure = scores.get(job.protocol.measure)
    shown = "not measured" if figure is None else f"{figure:.4f}"
    job.observer.info(f"{job.bench.name}, {job.row}: {job.protocol.measure} {shown}")
    for note in notes:
        job.observer.note(f"{job.bench.name}, {job.row}: {note.rstrip('.')}")
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


# Results of a protocol as tables, with the published figures beside them.


MEASURED = "measured here"
_UNVERIFIED = " (not verified)"
_KINDS = (".md", ".csv", ".tex")


def bench_table(
    run: BenchRun, *, notes: bool = True, classes: bool = True
) -> tuple[tuple[str, ...], list[tuple[Cell, ...]]]:
    """Names of columns, and a row a method: measured ones first, then published ones.

    Published are means over the protocol's scenes; where none is known, figures of single scenes.

    Scores are shares in [0, 1], PSNR in decibels; an empty cell was not measured, or not published.

    Args:
        run: What was measured.
        notes: Whether sources of published figures come with what is known of their settings.
        classes: Whether figures of single classes of streets have columns.
    """
    published = published_figures(run.protocol.name)
    means = [one for one in published if one.scene is None] or list(published)
    measures = list(dict.fromkeys(name for one in (*run.methods, *means) for name in one.scores))
    if not classes:
        measures = [name for name in measures if name not in TABLE_1]
    scenes = list(dict.fromkeys(one.scene for method in run.methods for one in method.scenes))
    if len(scenes) < 2:
        scenes = []
    columns = ("method", *measures, *scenes, "source")
    rows = [_measured(method, measures, scenes, run) for method in run.methods]
    rows += [_published(one, measures, scenes, published, run, notes=notes) for one in means]
    return columns, rows


def write_tables(run: BenchRun, folder: Path, *, command: str = "") -> tuple[Path, ...]:
    """Write PROTOCOL.md, .csv, .tex, .html and .json into a folder.

    Args:
        run: What was measured.
        folder: Where to write.
        command: The words that started it, for the record.
    """
    columns, rows = bench_table(run)
    paths = [path_inside(folder, f"{run.protocol.name}{kind}") for kind in _KINDS]
    for path in paths:
        write_table(rows, path, columns=columns)
    page = path_inside(folder, f"{run.protocol.name}.html")
    with atomic_file(page) as temporary:
        temporary.write_text(report_html(_report(run, command)), encoding="utf-8")
    record = path_inside(folder, f"{run.protocol.name}.json")
    write_json(
        {
            "protocol": run.protocol.name,
            "switches": switches_of(run.protocol),
            "command": command,
            "notes": list(run.notes),
            "methods": {
                method.method: {
                    "scores": dict(method.scores),
                    "oracle": list(method.oracle),
                    "scenes": {one.scene: dict(one.scores) for one in method.scenes},
                    "keys": {one.scene: one.key for one in method.scenes},
                }
                for method in run.methods
            },
        },
        record,
    )
    return (*paths, page, record)


def _measured(
    method: MethodResult, measures: Sequence[str], scenes: Sequence[str], run: BenchRun
) -> tuple[Cell, ...]:
    own = {one.scene: one.scores.get(run.protocol.measure) for one in method.scenes}
    oracle = f", oracle {' and '.join(method.oracle)}" if method.oracle else ""
    return (
        method.method,
        *(_figure(method.scores.get(name)) for name in measures),
        *(_figure(own.get(scene)) for scene in scenes),
        f"{MEASURED}{oracle}",
    )


def _published(
    mean: PublishedFigure,
    measures: Sequence[str],
    scenes: Sequence[str],
    figures: Sequence[PublishedFigure],
    run: BenchRun,
    *,
    notes: bool,
) -> tuple[Cell, ...]:
    own = {
        one.scene: one.scores.get(run.protocol.measure)
        for one in figures
        if one.method == mean.method
        and one.source == mean.source
        and mean.scene in (None, one.scene)
    }
    source = mean.source if mean.scene is None else f"{mean.source}, {mean.scene}"
    note = f"; {mean.note}" if mean.note and notes else ""
    return (
        mean.method,
        *(_figure(mean.scores.get(name)) for name in measures),
        *(_figure(own.get(scene)) for scene in scenes),
        f"{source}{'' if mean.verified else _UNVERIFIED}{note}",
    )


def _figure(value: float | None) -> Cell:
    return "" if value is None else value


def _report(run: BenchRun, command: str) -> Report:
    columns, rows = bench_table(run)
    ours = [row for row in rows if str(row[-1]).startswith(MEASURED)]
    theirs = [row for row in rows if not str(row[-1]).startswith(MEASURED)]
    protocol = run.protocol
    notices = [Notice(verdict="Note", sentence=note) for note in run.notes]
    if any(method.oracle for method in run.methods):
        notices.append(
            Notice(
                verdict="Oracle",
                sentence="Something was chosen with the help of the truth that is evaluated.",
                warns=True,
            )
        )
    blocks = [_table("Measured here", columns, ours)]
    if theirs:
        blocks.append(
            _table(
                "Published",
                columns,
                theirs,
                note="Other programs, other fits, and choices that were not always stated.",
            )
        )
    switches = [(name, _text(value)) for name, value in switches_of(protocol).items()]
    blocks.append(Table(title="Choices", columns=("switch", "value"), rows=tuple(switches)))
    commands = {str(one.made.get("command")) for m in run.methods for one in m.scenes}
    return Report(
        title=protocol.name,
        summary=f"{protocol.summary[0].upper()}{protocol.summary[1:]}. {protocol.reference}. "
        + (f"{protocol.note[0].upper()}{protocol.note[1:]}." if protocol.note else ""),
        command=command,
        notices=tuple(notices),
        blocks=(
            *blocks,
            Commands(title="Commands of the results", lines=tuple(sorted(commands - {""}))),
        ),
    )


def _table(
    title: str, columns: Sequence[str], rows: Sequence[tuple[Cell, ...]], note: str = ""
) -> Table:
    return Table(
        title=title,
        columns=tuple(columns),
        rows=tuple(tuple(None if cell == "" else cell for cell in row) for row in rows),
        note=note,
    )


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
    return "none" if value is None else str(value)
