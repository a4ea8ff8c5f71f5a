"""``splatseg demo``: a generated room goes through the commands of the main job."""

import contextlib
import io
import json
import shutil
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from splatseg.cli import evaluate, export, fit, render, see, segment
from splatseg.cli._work import progress
from splatseg.errors import InputError, RangeError
from splatseg.io.json_files import read_json, write_json
from splatseg.render import BackendName
from splatseg.report.demo_report import DemoFigures, machine_score, write_report
from splatseg.synthetic import cameras, room, write_capture

_RECORD = "demo.json"
_MADE_BY = "splatseg demo"
# Everything that the demo writes besides its record; a second run removes these and no more.
_FOLDERS = ("capture", "scene", "render")
_FILES = ("labelled.ply", "labelled.json", "contact_sheet.png", "report.html")
_POINTS = 15_000
_LAYER = "semantic"
_EVIDENCE = "labels_semantic"
_OBJECTS = "objects"
_MASKS = "masks"


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Show the main job on a generated room, of which the truth is known.

    Photographs of the room and class maps with a network's mistakes are generated; then the
    commands fit, see, segment, render, evaluate and export run as you would run them: classes
    from the maps, objects from masks that need no weights, pictures of held-out views, files and
    reports. Takes about three minutes on two cores. report.html and contact_sheet.png in DIR
    show what came of it.
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")] = Path("splatseg-demo")
    """Folder for everything. One that an earlier demo made is replaced."""

    minutes: float | None = None
    """Length of the fit. None is 1.5, unless --steps says how long."""

    steps: int | None = None
    """Length of the fit in steps instead: same seed, same result."""

    max_gaussians: int = 60_000
    """Most Gaussians of the scene."""

    views: int = 48
    """Photographs to learn from; a quarter as many are held out."""

    width: int = 320
    """Pixels a row of the photographs; they are three quarters as high."""

    seed: int = 0
    """Which room, and every other choice."""

    backend: BackendName = "auto"
    """Who renders. auto: cuda for scenes on a GPU, cpu otherwise."""

    def __post_init__(self) -> None:
        if self.views < 4:
            raise RangeError(f"--views: expected at least 4, got {self.views}.")
        if self.width < 32:
            raise RangeError(f"--width: expected at least 32 pixels, got {self.width}.")


def run(command: Command) -> None:
    """Generate the room and run the main job on it."""
    started = time.monotonic()
    console = Console(highlight=False)
    folder = _prepared(command.output, console)
    steps: list[tuple[str, float]] = []

    capture = folder / "capture"
    console.print("[bold]Generating a room[/bold] with photographs, truth and machine labels")
    with progress("photograph") as show:
        write_capture(
            room(seed=command.seed),
            capture,
            views=cameras(
                room(seed=command.seed),
                train=command.views,
                test=max(1, command.views // 4),
                width=command.width,
                height=command.width * 3 // 4,
            ),
            points=_POINTS,
            seed=command.seed,
            progress=show,
        )
    steps.append(("generate", time.monotonic() - started))

    lines: list[str] = []
    printed: dict[tuple[str, str], dict[str, Any]] = {}
    for name, module, job in main_job(command):
        line = words_of(name, job)
        lines.append(" ".join(line))
        console.print(f"\n[bold]$[/bold] {' '.join(line)}", soft_wrap=True)
        begin = time.monotonic()
        if name == "evaluate":
            printed[job.layer, job.split] = _evaluated(job)
        else:
            module.run(job)
        if steps[-1][0] == name:
            steps[-1] = (name, steps[-1][1] + time.monotonic() - begin)
        else:
            steps.append((name, time.monotonic() - begin))

    begin = time.monotonic()
    figures = DemoFigures(
        came=machine_score(capture, _EVIDENCE),
        train=printed[_LAYER, "train"],
        test=printed[_LAYER, "test"],
        objects=printed[_OBJECTS, "test"],
        steps=tuple(steps),
        commands=tuple(lines),
        started=started,
    )
    write_report(
        folder, figures, seed=command.seed, layer=_LAYER, evidence=_EVIDENCE, objects=_OBJECTS
    )
    steps.append(("report", time.monotonic() - begin))
    total = time.monotonic() - started
    write_json(folder / _RECORD, _record(figures, steps, total, finished=True))
    _print_tables(console, figures, steps, total)
    console.print(f"\nOpen {folder / 'report.html'} in a browser.", soft_wrap=True)


def main_job(command: Command) -> list[tuple[str, ModuleType, Any]]:
    """The commands that the demo runs: name, module and parsed form of each."""
    folder, backend = command.output, command.backend
    capture, scene, pictures = folder / "capture", folder / "scene", folder / "render"
    minutes = 1.5 if command.minutes is None and command.steps is None else command.minutes
    truth = capture / "semantic"
    return [
        (
            "fit",
            fit,
            fit.Command(
                data=capture,
                output=scene,
                minutes=minutes,
                steps=command.steps,
                max_gaussians=command.max_gaussians,
                seed=command.seed,
                backend=backend,
            ),
        ),
        (
            "segment",
            segment,
            segment.Command(
                scene=scene,
                method="uplift",
                evidence=_EVIDENCE,
                layer=_LAYER,
                backend=backend,
            ),
        ),
        ("see", see, see.Command(scene=scene, model="classical", evidence=_MASKS)),
        (
            "segment",
            segment,
            segment.Command(
                scene=scene,
                method="associate",
                evidence=_MASKS,
                layer=_OBJECTS,
                export=True,
                report=True,
                backend=backend,
            ),
        ),
        (
            "render",
            render,
            render.Command(
                scene=scene,
                what=f"rgb,depth,{_LAYER},{_OBJECTS}",
                output=pictures,
                backend=backend,
            ),
        ),
        *(
            (
                "evaluate",
                evaluate,
                evaluate.Command(
                    scene=scene,
                    layer=_LAYER,
                    truth=truth,
                    split=split,
                    json=True,
                    backend=backend,
                ),
            )
            for split in ("train", "test")
        ),
        (
            "evaluate",
            evaluate,
            evaluate.Command(
                scene=scene,
                layer=_OBJECTS,
                metric="instances",
                truth=capture / "instance",
                json=True,
                backend=backend,
            ),
        ),
        (
            "export",
            export,
            export.Command(
                scene=scene, layer=_LAYER, instances=_OBJECTS, output=folder / "labelled.ply"
            ),
        ),
    ]


def words_of(name: str, job: Any) -> list[str]:
    """The words that one would type for a parsed command; defaults are left out.

    Positional arguments come first, which in every command is the first field alone.
    """
    first, *rest = fields(job)
    words = ["splatseg", name, str(getattr(job, first.name))]
    for field in rest:
        value = getattr(job, field.name)
        if value == field.default or not isinstance(value, (str, int, float, Path)):
            continue
        flag = "-o" if field.name == "output" else "--" + field.name.replace("_", "-")
        words += [flag] if value is True and field.default is False else [flag, str(value)]
    return words


def _prepared(folder: Path, console: Console) -> Path:
    """An empty folder with the record of an unfinished demo in it.

    The record comes first and goes last, so that whatever an interrupted run leaves is known
    to be a demo's and may be replaced by the next.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder to write to, got a file.")
    if not folder.absolute().parent.is_dir():
        raise InputError(f"{folder}: expected a place in a folder that is there, got none.")
    record = folder / _RECORD
    if folder.is_dir() and any(folder.iterdir()):
        if not record.is_file() or read_json(record).get("made_by") != _MADE_BY:
            raise InputError(
                f"{folder}: expected a new or empty folder or one that an earlier demo made, got "
                "one with other files; choose another with -o."
            )
        console.print(f"Replacing the earlier demo in {folder}", soft_wrap=True)
    folder.mkdir(exist_ok=True)
    write_json(record, {"made_by": _MADE_BY, "finished": False})
    for name in _FOLDERS:
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)
    for name in _FILES:
        (folder / name).unlink(missing_ok=True)
    return folder


def _evaluated(job: evaluate.Command) -> dict[str, Any]:
    """The figures that ``splatseg evaluate --json`` prints."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        evaluate.run(job)
    figures: dict[str, Any] = json.loads(printed.getvalue())
    shown = {key: value for key, value in figures.items() if isinstance(value, float)}
    sys.stdout.write("  ".join(f"{key} {value:.3f}" for key, value in shown.items()) + "\n")
    return figures


def _record(
    figures: DemoFigures, steps: list[tuple[str, float]], total: float, *, finished: bool
) -> dict[str, Any]:
    return {
        "made_by": _MADE_BY,
        "finished": finished,
        "psnr_test": figures.test["PSNR"],
        "miou_labels_as_they_came_train": figures.came.miou,
        "miou_lifted_train": figures.train["mIoU"],
        "miou_lifted_test": figures.test["mIoU"],
        "miou_objects_test": figures.objects["mIoU"],
        "seconds": {name: round(seconds, 2) for name, seconds in steps},
        "seconds_total": round(total, 2),
        "commands": list(figures.commands),
    }


def _print_tables(
    console: Console, figures: DemoFigures, steps: list[tuple[str, float]], total: float
) -> None:
    console.print()
    scores = Table("labels", "views", "mIoU", "accuracy", title="Class maps against the truth")
    for column in scores.columns[2:]:
        column.justify = "right"
    came: Mapping[str, float] = {"mIoU": figures.came.miou, "accuracy": figures.came.accuracy}
    for what, views, row in (
        ("as they came", "train", came),
        ("lifted and rendered", "train", figures.train),
        ("lifted and rendered", "held out", figures.test),
    ):
        scores.add_row(what, views, f"{row['mIoU']:.3f}", f"{row['accuracy']:.3f}")
    console.print(scores)
    console.print(
        f"Pictures of held-out views: PSNR {figures.test['PSNR']:.2f} dB, "
        f"SSIM {figures.test['SSIM']:.3f}"
    )
    console.print(
        f"Objects from masks without weights: {figures.objects['predicted_instances']} for "
        f"{figures.objects['truth_instances']} true ones, mIoU {figures.objects['mIoU']:.3f} "
        "held out"
    )
    times = Table("step", "seconds", title=f"{total:.0f} s in all")
    times.columns[1].justify = "right"
    for name, seconds in steps:
        times.add_row(name, f"{seconds:.1f}")
    console.print(times)
