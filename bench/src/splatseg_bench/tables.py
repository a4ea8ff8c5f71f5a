"""Results of a protocol as tables, with the published figures beside them."""

from collections.abc import Sequence
from pathlib import Path

from splatseg.io.atomic import atomic_file, path_inside
from splatseg.io.json_files import write_json
from splatseg.report.html import Commands, Notice, Report, Table, report_html
from splatseg.tasks.figures import Cell, write_table
from splatseg_bench.protocols import TABLE_1, PublishedFigure, published_figures
from splatseg_bench.results import MethodResult, switches_of
from splatseg_bench.run import BenchRun

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
