"""The report of a fit: what went in, what came out, how it went, and what it is good for."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any, cast

from splatseg.core import Capture, View
from splatseg.evaluate.photographs import PhotographReport
from splatseg.fit import FitOptions, FitRecord, FitResult, reduction_note, sensible_steps
from splatseg.report.chart import Chart, Line
from splatseg.report.html import Bars, Block, Curves, Figure, Notice, Report, Table
from splatseg.report.images import Gallery
from splatseg.report.words import count_text, counted, environment

MIN_PSNR = 20.0
"""Renders less like the photographs than this, in dB, carry labels badly: in scenes of known truth
a fifth to two thirds of the mIoU of a longer fit was lost (``benchmarks/fit_length.py``, decision
0025)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitVerdict:
    """What a fit is good for."""

    words: str
    """A word or two: ``Too short``."""

    sentence: str
    warns: bool
    """Whether something is to be done before labels are put on it."""

    too_short: bool
    """Whether it has fewer steps than make sense."""

    sensible_steps: int
    """How many make sense for so many training views."""


def fit_verdict(
    *,
    steps: int,
    train_views: int,
    interrupted: bool,
    scores: PhotographReport | None,
    held_out: int,
) -> FitVerdict:
    """Judge a fit by its length, and by its held-out views where there are scores.

    Args:
        steps: Steps done.
        train_views: Training views with photographs.
        interrupted: Whether it was stopped early.
        scores: Of held-out views.
        held_out: Held-out views there are, scored or not.
    """
    needed = sensible_steps(train_views)
    short = steps < needed
    of = "" if scores is None else _of(scores, held_out)
    if short:
        words = "Too short"
        onwards = "--resume goes on" if interrupted else f"--steps {needed} or more is"
        rest = " from here" if interrupted else " worth the time"
        sentence = (
            f"{counted(steps, 'step')} done, where {needed} or more make sense for "
            f"{counted(train_views, 'training view')}; {onwards}{rest}.{of}"
        )
    elif scores is not None and scores.psnr < MIN_PSNR:
        words = "Poor"
        sentence = (
            f"Renders are less like the photographs than the {MIN_PSNR:g} dB from which labels "
            f"hold: too few photographs, wrong poses or moving things, see the worst views.{of}"
        )
    elif scores is None:
        words = "Not judged"
        sentence = "Long enough, but no held-out view was scored."
    else:
        words = "Good enough to carry labels"
        sentence = of.strip()
    poor = scores is not None and scores.psnr < MIN_PSNR
    return FitVerdict(
        words=words,
        sentence=sentence,
        warns=short or poor,
        too_short=short,
        sensible_steps=needed,
    )


def _of(scores: PhotographReport, held_out: int) -> str:
    worst = min(scores.per_view, key=lambda score: score.psnr)
    mean = f" PSNR {scores.psnr:.2f} dB, SSIM {scores.ssim:.3f} on {scored_of(scores, held_out)}"
    return f"{mean}; the worst, {worst.name}, has {worst.psnr:.2f} dB."


def scored_of(scores: PhotographReport, held_out: int) -> str:
    """Of how many views scores are: ``12 held-out views``, ``5 of 12 held-out views``."""
    if len(scores.views) == held_out:
        return counted(held_out, "held-out view")
    return f"{len(scores.views)} of {counted(held_out, 'held-out view')}"


# The report of a fit: what went in, what came out, how it went, and how good it is.


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
    minutes, seconds = divmod(round(result.seconds), 60)
    rate = result.steps / max(result.seconds, 1e-9)
    ended = "It was stopped early, and can go on with --resume. " if result.interrupted else ""
    scored = "No held-out view was scored."
    if scores is not None:
        scored = "Held-out views were not learned from."
    blocks: list[Block | None] = [
        pairs,
        None if scores is None else _score_table(scores),
        cameras,
        _curves(result.history) if result.history else None,
        _stages(result),
        _time(data),
        _input(data),
        _output(data),
        _changed_options(data.options),
    ]
    verdict = verdict_of(data)
    return Report(
        title=f"Fit of {data.capture.path.name}",
        summary=f"{result.steps} steps in {minutes} min {seconds:02d} s, {rate:.1f} steps a "
        f"second. {ended}{scored}",
        command=data.command,
        notices=(Notice(verdict.words, verdict.sentence, warns=verdict.warns),),
        figures=tuple(_figures(data)),
        blocks=tuple(block for block in blocks if block is not None),
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


def _figures(data: FitReportData) -> list[Figure]:
    result, scores = data.result, data.scores
    out: list[Figure] = []
    if scores is not None:
        of = f"mean of {scored_of(scores, data.held_out)}"
        worst = f"PSNR, {of}; worst {scores.psnr_min:.2f} dB"
        out.append(Figure("Held-out views", f"{scores.psnr:.2f} dB", worst))
        out.append(Figure("SSIM", f"{scores.ssim:.3f}", of))
    if result.history:
        note = "PSNR of the last 50 steps, before each was learned from"
        out.append(Figure("Training views", f"{result.history[-1].psnr:.2f} dB", note))
    size = f"{data.file_bytes / 1e6:.1f} MB"
    return [*out, Figure("Gaussians", count_text(len(result.gaussians)), size)]


def _curves(history: Sequence[FitRecord]) -> Curves:
    """Loss, PSNR and count over minutes."""
    minutes = [record.seconds / 60 for record in history]

    def chart(title: str, name: str, values: Sequence[float]) -> Chart:
        return Chart(title, "minutes", (Line(name, tuple(zip(minutes, values, strict=True))),))

    return Curves(
        "How it went",
        (
            chart("Loss", "training views", [record.loss for record in history]),
            chart("PSNR, dB", "training views", [record.psnr for record in history]),
            chart("Gaussians", "count", [float(record.count) for record in history]),
        ),
        "Means of 50 steps, of training views at the resolution of the stage: where it "
        "grows finer, the task gets harder.",
    )


def _stages(result: FitResult) -> Bars:
    total = max(sum(result.stages.values()), 1e-9)
    step = 1e3 / max(1, result.steps)
    rows = sorted(result.stages.items(), key=lambda item: -item[1])
    return Bars(
        "Where the time of a step goes",
        ("share",),
        tuple((f"{name}, {step * spent:.1f} ms", (spent / total,)) for name, spent in rows),
        f"Means over all steps; {step * total:.1f} ms a step together.",
    )


def _time(data: FitReportData) -> Table:
    """What each part of the command took; `--minutes` is the length of one of them."""
    spent = dict(data.timings) or {"optimisation": data.result.seconds}
    if len(spent) > 1:
        spent["together"] = sum(spent.values())
    return Table(
        "Time",
        ("part", "time"),
        tuple((name, _duration(seconds)) for name, seconds in spent.items()),
        "--minutes is the length of the optimisation; finding poses comes before it, scores "
        "and this report after it.",
    )


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"


def _input(data: FitReportData) -> Table:
    notes = [("note", note) for note in (*data.capture.notes, *data.result.notes)]
    poses = [] if data.poses is None else _pose_rows(data.poses)
    return Table("What was in", ("what", "value"), (*_input_rows(data), *notes, *poses))


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
            seconds = cast(Mapping[str, float], value)
            stages = ", ".join(f"{stage} {spent:.1f}" for stage, spent in seconds.items())
            words = f"{sum(seconds.values()):.1f} s" + (f" ({stages})" if stages else "")
        elif isinstance(value, (list, tuple, dict)):
            words = f"{len(cast(Sequence[Any], value))}"
        if len(words) <= _LONG_LIST:
            rows.append((f"poses: {name.replace('_', ' ')}", words))
    return rows


def _output(data: FitReportData) -> Table:
    result, verdict = data.result, verdict_of(data)
    ended = "as asked for, which is too short" if verdict.too_short else "as planned"
    rows = [
        ("Gaussians", f"{len(result.gaussians)}"),
        ("harmonics", f"degree {result.gaussians.sh_degree}"),
        ("file", f"{data.file_bytes / 1e6:.1f} MB"),
        ("steps", str(result.steps)),
        ("steps that make sense", f"{verdict.sensible_steps} or more"),
        ("time", f"{result.seconds:.1f} s"),
        ("ended", "interrupted" if result.interrupted else ended),
    ]
    if data.scores is not None:
        rows.append(("held-out views scored", f"{len(data.scores.views)} of {data.held_out}"))
    return Table("What came out", ("what", "value"), tuple(rows))


def _score_table(scores: PhotographReport) -> Table:
    worst_first = sorted(scores.per_view, key=lambda score: score.psnr)
    return Table(
        "Scores of held-out views, the worst first",
        ("view", "PSNR, dB", "SSIM"),
        tuple((score.name, score.psnr, score.ssim) for score in worst_first),
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
        "Options",
        ("option", "value", "default"),
        tuple(rows),
        note="All others are as they come; fit.json lists every one.",
    )


def _facts(data: FitReportData) -> dict[str, Any]:
    versions = {name.lower(): value for name, value in environment().items()}
    return {"seed": data.options.seed, **data.facts, **versions}
