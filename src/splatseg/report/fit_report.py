"""The report of a fit: what went in, what came out, how it went, and how good it is."""

import os
import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from importlib import metadata
from typing import Any, cast

from splatseg.core import Capture, View
from splatseg.evaluate.photographs import PhotographReport
from splatseg.fit import FitOptions, FitRecord, FitResult, reduction_note
from splatseg.report.chart import Chart, Line
from splatseg.report.fit_verdict import FitVerdict, fit_verdict, scored_of
from splatseg.report.html import Bars, Block, Curves, Figure, Notice, Report, Table
from splatseg.report.images import Gallery
from splatseg.report.words import count_text

_LONG_LIST = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitReportData:
    """Everything that the report of a fit tells."""

    capture: Capture
    """What it learned from."""

    options: FitOptions
    result: FitResult

    scores: PhotographReport | None
    """Of held-out views; None where there are none, or no time was left."""

    held_out: int
    """Held-out views there are, scored or not."""

    file_bytes: int
    """Size of the file of Gaussians."""

    command: str = ""
    """The words that started it."""

    poses: Mapping[str, Any] | None = None
    """What was said by what found the poses, where they did not come with the capture."""

    timings: Mapping[str, float] = field(default_factory=dict[str, float])
    """Seconds of the command by part: poses, optimisation, what follows it."""

    facts: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """More of how it was made, such as the backend."""


def verdict_of(data: FitReportData) -> FitVerdict:
    """What the fit is good for."""
    return fit_verdict(
        steps=data.result.steps,
        train_views=sum(view.image is not None for view in data.capture.train_views),
        interrupted=data.result.interrupted,
        scores=data.scores,
        held_out=data.held_out,
    )


def fit_report(
    data: FitReportData, *, pairs: Gallery | None = None, cameras: Gallery | None = None
) -> Report:
    """The page.

    Args:
        data: The fit.
        pairs: Photographs beside renders of held-out views, the worst first.
        cameras: Where cameras stood.
    """
    result, scores = data.result, data.scores
    rate = result.steps / max(result.seconds, 1e-9)
    ended = "It was stopped early, and can go on with --resume. " if result.interrupted else ""
    held_out = (
        "Held-out views were not learned from."
        if scores is not None
        else "No held-out view was scored."
    )
    blocks: list[Block] = [] if pairs is None else [pairs]
    if scores is not None:
        blocks.append(_score_table(scores))
    if cameras is not None:
        blocks.append(cameras)
    curves = _curves(result.history)
    if curves is not None:
        blocks.append(curves)
    blocks += [_stages(result), _time(data), _input(data), _output(data)]
    blocks.append(_changed_options(data.options))
    verdict = verdict_of(data)
    return Report(
        title=f"Fit of {data.capture.path.name}",
        summary=f"{_length(result)}, {rate:.1f} steps a second. {ended}{held_out}",
        command=data.command,
        notices=(Notice(verdict=verdict.words, sentence=verdict.sentence, warns=verdict.warns),),
        figures=_figures(data),
        blocks=tuple(blocks),
        facts=_facts(data),
    )


def fit_record(data: FitReportData) -> dict[str, Any]:
    """The same as values that JSON holds: fit.json."""
    result, scores, verdict = data.result, data.scores, verdict_of(data)
    return {
        "made_by": "splatseg fit",
        "command": data.command,
        "interrupted": result.interrupted,
        "steps": result.steps,
        "sensible_steps": verdict.sensible_steps,
        "too_short": verdict.too_short,
        "verdict": f"{verdict.words}. {verdict.sentence}",
        "seconds": round(result.seconds, 3),
        "seconds_by_part": {name: round(spent, 3) for name, spent in data.timings.items()},
        "gaussians": len(result.gaussians),
        "file_bytes": data.file_bytes,
        "held_out": None
        if scores is None
        else {
            "views": data.held_out,
            "scored": len(scores.views),
            "psnr": scores.psnr,
            "psnr_min": scores.psnr_min,
            "ssim": scores.ssim,
            "per_view": [asdict(score) for score in scores.per_view],
        },
        "input": dict(_input_rows(data)),
        "poses": None if data.poses is None else dict(data.poses),
        "notes": [*data.capture.notes, *result.notes],
        "stages_seconds": {name: round(spent, 4) for name, spent in result.stages.items()},
        "history": [asdict(record) for record in result.history],
        "options": asdict(data.options),
        **_facts(data),
    }


def _length(result: FitResult) -> str:
    minutes, seconds = divmod(round(result.seconds), 60)
    return f"{result.steps} steps in {minutes} min {seconds:02d} s"


def _figures(data: FitReportData) -> tuple[Figure, ...]:
    result, scores = data.result, data.scores
    out: list[Figure] = []
    if scores is not None:
        out.append(
            Figure(
                label="Held-out views",
                value=f"{scores.psnr:.2f} dB",
                note=f"PSNR, mean of {scored_of(scores, data.held_out)}; worst "
                f"{scores.psnr_min:.2f} dB",
            )
        )
        out.append(
            Figure(
                label="SSIM",
                value=f"{scores.ssim:.3f}",
                note=f"mean of {scored_of(scores, data.held_out)}",
            )
        )
    if result.history:
        out.append(
            Figure(
                label="Training views",
                value=f"{result.history[-1].psnr:.2f} dB",
                note="PSNR of the last 50 steps, before each was learned from",
            )
        )
    out.append(
        Figure(
            label="Gaussians",
            value=count_text(len(result.gaussians)),
            note=f"{data.file_bytes / 1e6:.1f} MB",
        )
    )
    return tuple(out)


def _curves(history: Sequence[FitRecord]) -> Curves | None:
    """Loss, PSNR and count over minutes."""
    if not history:
        return None

    def chart(title: str, name: str, values: Sequence[float]) -> Chart:
        minutes = [record.seconds / 60 for record in history]
        line = Line(name=name, points=tuple(zip(minutes, values, strict=True)))
        return Chart(title=title, across="minutes", lines=(line,))

    return Curves(
        title="How it went",
        charts=(
            chart("Loss", "training views", [record.loss for record in history]),
            chart("PSNR, dB", "training views", [record.psnr for record in history]),
            chart("Gaussians", "count", [float(record.count) for record in history]),
        ),
        note="Means of 50 steps, of training views at the resolution of the stage: where it "
        "grows finer, the task gets harder.",
    )


def _stages(result: FitResult) -> Bars:
    total = max(sum(result.stages.values()), 1e-9)
    steps = max(1, result.steps)
    rows = sorted(result.stages.items(), key=lambda item: -item[1])
    return Bars(
        title="Where the time of a step goes",
        series=("share",),
        rows=tuple(
            (f"{name}, {1e3 * spent / steps:.1f} ms", (spent / total,)) for name, spent in rows
        ),
        note=f"Means over all steps; {1e3 * total / steps:.1f} ms a step together.",
    )


def _time(data: FitReportData) -> Table:
    """What each part of the command took; `--minutes` is the length of one of them."""
    rows = [(name, _duration(spent)) for name, spent in data.timings.items()]
    if len(rows) > 1:
        rows.append(("together", _duration(sum(data.timings.values()))))
    return Table(
        title="Time",
        columns=("part", "time"),
        rows=tuple(rows or [("optimisation", _duration(data.result.seconds))]),
        note="--minutes is the length of the optimisation; finding poses comes before it, scores "
        "and this report after it.",
    )


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"


def _input(data: FitReportData) -> Table:
    notes = (*data.capture.notes, *data.result.notes)
    rows = [*_input_rows(data), *(("note", note) for note in notes)]
    if data.poses is not None:
        rows += _pose_rows(data.poses)
    return Table(title="What was in", columns=("what", "value"), rows=tuple(rows))


def _input_rows(data: FitReportData) -> list[tuple[str, str]]:
    capture, options = data.capture, data.options
    train = [view for view in capture.train_views if view.image is not None]
    masks = sum(view.mask is not None for view in train)
    depths = sum(view.depth is not None for view in train)
    points = 0 if capture.points is None else len(capture.points)
    reduced = reduction_note(capture.train_views, longest=options.longest)
    return [
        ("capture", f"{capture.path} ({capture.format})"),
        ("training views", str(len(train))),
        ("held-out views", str(len(capture.test_views))),
        ("sizes", _sizes(capture.views)),
        ("reduced", reduced or "no"),
        ("masks", f"{masks} ({options.masks})" if masks else "none"),
        ("depth maps", f"{depths} ({options.depth})" if depths else "none"),
        ("start points", str(points) if points else "none; places were drawn"),
    ]


def _sizes(views: Sequence[View]) -> str:
    counts = Counter((view.camera.width, view.camera.height) for view in views)
    shown = [f"{count} of {w}x{h}" for (w, h), count in counts.most_common(4)]
    more = len(counts) - len(shown)
    return ", ".join(shown) + (f" and {more} more sizes" if more else "") or "none"


def _pose_rows(poses: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What is said of how poses were found, as far as it fits into a cell."""
    rows: list[tuple[str, str]] = []
    for name, value in poses.items():
        words = f"{value:.3f}" if isinstance(value, float) else str(value)
        if name == "seconds" and isinstance(value, Mapping):
            words = _pose_seconds(cast(Mapping[str, float], value))
        elif isinstance(value, (list, tuple, dict)):
            words = f"{len(cast(Sequence[Any], value))}"
        if len(words) <= _LONG_LIST:
            rows.append((f"poses: {name.replace('_', ' ')}", words))
    return rows


def _pose_seconds(seconds: Mapping[str, float]) -> str:
    """The whole, and the stages that it was made of."""
    stages = ", ".join(f"{stage} {spent:.1f}" for stage, spent in seconds.items())
    return f"{sum(seconds.values()):.1f} s" + (f" ({stages})" if stages else "")


def _output(data: FitReportData) -> Table:
    result = data.result
    gaussians = result.gaussians
    rows = [
        ("Gaussians", f"{len(gaussians)}"),
        ("harmonics", f"degree {gaussians.sh_degree}"),
        ("file", f"{data.file_bytes / 1e6:.1f} MB"),
        ("steps", str(result.steps)),
        ("steps that make sense", f"{verdict_of(data).sensible_steps} or more"),
        ("time", f"{result.seconds:.1f} s"),
        ("ended", _ended(data)),
    ]
    if data.scores is not None:
        rows.append(("held-out views scored", f"{len(data.scores.views)} of {data.held_out}"))
    return Table(title="What came out", columns=("what", "value"), rows=tuple(rows))


def _ended(data: FitReportData) -> str:
    if data.result.interrupted:
        return "interrupted"
    return "as asked for, which is too short" if verdict_of(data).too_short else "as planned"


def _score_table(scores: PhotographReport) -> Table:
    worst_first = sorted(scores.per_view, key=lambda score: score.psnr)
    return Table(
        title="Scores of held-out views, the worst first",
        columns=("view", "PSNR, dB", "SSIM"),
        rows=tuple((score.name, score.psnr, score.ssim) for score in worst_first),
    )


def _changed_options(options: FitOptions) -> Table:
    """The length, the size, the seed, and what differs from the default."""
    plain = FitOptions()
    always = ("minutes", "steps", "max_gaussians", "seed", "strategy")
    rows: list[tuple[str, str, str]] = []
    for one in fields(options):
        value, default = getattr(options, one.name), getattr(plain, one.name)
        if one.name in always or value != default:
            rows.append((one.name, str(value), str(default)))
    return Table(
        title="Options",
        columns=("option", "value", "default"),
        rows=tuple(rows),
        note="All others are as they come; fit.json lists every one.",
    )


def _facts(data: FitReportData) -> dict[str, Any]:
    return {
        "seed": data.options.seed,
        **data.facts,
        "splatseg": metadata.version("splatseg"),
        "torch": metadata.version("torch"),
        "python": platform.python_version(),
        "cores": os.cpu_count(),
    }
