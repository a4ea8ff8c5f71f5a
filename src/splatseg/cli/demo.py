"""``splatseg demo``: a generated room goes through the commands of the main job."""

import shutil
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from splatseg.cli import fit, see
from splatseg.cli._progress import progress
from splatseg.cli._work import ConsoleObserver
from splatseg.core import Scene
from splatseg.errors import InputError, RangeError
from splatseg.io.json_files import read_json, write_json
from splatseg.io.scene import load_scene, save_scene_layer
from splatseg.render import BackendName
from splatseg.report.demo_report import DemoFigures, machine_score, write_report
from splatseg.synthetic import cameras, room, write_capture
from splatseg.tasks import (
    EvaluationOptions,
    ExportOptions,
    RenderingOptions,
    Segmentation,
    SegmentOptions,
    evaluate,
    export,
    export_layer,
    render_views,
    report_layer,
    segment,
)
from splatseg.tasks.evaluate import Metric

_CONSOLE = ConsoleObserver()
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

    job = _MainJob(command=command, console=console, steps=steps)
    job.run()

    begin = time.monotonic()
    figures = DemoFigures(
        came=machine_score(capture, _EVIDENCE),
        train=job.figures[_LAYER, "train"],
        test=job.figures[_LAYER, "test"],
        objects=job.figures[_OBJECTS, "test"],
        steps=tuple(steps),
        commands=tuple(job.lines),
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


@dataclass(frozen=True, slots=True, kw_only=True)
class _MainJob:
    """The steps of the main job; each prints the command that does the same from the shell."""

    command: Command
    console: Console
    steps: list[tuple[str, float]]
    """Names and seconds."""

    lines: list[str] = field(default_factory=list[str])
    """The commands."""

    figures: dict[tuple[str, str], dict[str, Any]] = field(
        default_factory=dict[tuple[str, str], dict[str, Any]]
    )
    """Scores by layer and split."""

    def run(self) -> None:
        """Do all steps."""
        folder, backend = self.command.output, self.command.backend
        capture, root = folder / "capture", folder / "scene"
        with self._step("fit", capture, "-o", root, *self._fit_words()):
            fit.run(self._fit_command(capture, root))
        scene = load_scene(root)
        with self._step(
            "segment", root, "--method", "uplift", "--evidence", _EVIDENCE, "--layer", _LAYER
        ):
            self._segment(scene, "uplift", SegmentOptions(evidence=_EVIDENCE, layer=_LAYER))
        with self._step("see", root, "--model", "classical", "--evidence", _MASKS):
            see.run(see.Command(scene=root, model="classical", evidence=_MASKS))
        with self._step(
            *("segment", root, "--method", "associate", "--evidence", _MASKS),
            *("--layer", _OBJECTS, "--export", "--report"),
        ):
            made = self._segment(
                scene, "associate", SegmentOptions(evidence=_MASKS, layer=_OBJECTS)
            )
            export_layer(scene, root, _OBJECTS, made.layer, backend=backend, observer=_CONSOLE)
            report_layer(scene, root, made, command=self.lines[-1], backend=backend)
        what = ("rgb", "depth", _LAYER, _OBJECTS)
        with self._step("render", root, "--what", ",".join(what), "-o", folder / "render"):
            render_views(
                scene,
                folder / "render",
                options=RenderingOptions(what=what),
                backend=backend,
                observer=_CONSOLE,
            )
        for split in ("train", "test"):
            self._evaluate(scene, _LAYER, split, capture / "semantic", "semantic")
        self._evaluate(scene, _OBJECTS, "test", capture / "instance", "instances")
        labelled = folder / "labelled.ply"
        with self._step("export", root, "--layer", _LAYER, "--instances", _OBJECTS, "-o", labelled):
            export(scene, labelled, options=ExportOptions(layer=_LAYER, instances=_OBJECTS))

    def _segment(self, scene: Scene, method: str, options: SegmentOptions) -> Segmentation:
        made = segment(
            scene, method, options=options, backend=self.command.backend, observer=_CONSOLE
        )
        save_scene_layer(self.command.output / "scene", made.name, made.layer)
        return made

    def _evaluate(self, scene: Scene, layer: str, split: str, truth: Path, metric: Metric) -> None:
        root = self.command.output / "scene"
        with self._step(
            *("evaluate", root, "--layer", layer, "--truth", truth),
            *("--split", split, "--metric", metric),
        ):
            found = evaluate(
                scene,
                options=EvaluationOptions(layer=layer, truth=truth, split=split, metric=metric),
                backend=self.command.backend,
                observer=_CONSOLE,
            )
        self.figures[layer, split] = found
        shown = {key: value for key, value in found.items() if isinstance(value, float)}
        self.console.print("  ".join(f"{key} {value:.3f}" for key, value in shown.items()))

    @contextmanager
    def _step(self, name: str, *words: object) -> Generator[None]:
        """Print a command, and time what does the same."""
        backend = self.command.backend
        chosen = [] if backend == "auto" or name == "see" else ["--backend", backend]
        line = " ".join(["splatseg", name, *map(str, words), *chosen])
        self.lines.append(line)
        self.console.print(f"\n[bold]$[/bold] {line}", soft_wrap=True)
        begin = time.monotonic()
        yield
        seconds = time.monotonic() - begin
        if self.steps[-1][0] == name:
            self.steps[-1] = (name, self.steps[-1][1] + seconds)
        else:
            self.steps.append((name, seconds))

    def _minutes(self) -> float | None:
        command = self.command
        return 1.5 if command.minutes is None and command.steps is None else command.minutes

    def _fit_words(self) -> list[object]:
        command, minutes = self.command, self._minutes()
        words: list[object] = [] if minutes is None else ["--minutes", minutes]
        if command.steps is not None:
            words += ["--steps", command.steps]
        return [*words, "--max-gaussians", command.max_gaussians, "--seed", command.seed]

    def _fit_command(self, capture: Path, root: Path) -> fit.Command:
        return fit.Command(
            data=capture,
            output=root,
            minutes=self._minutes(),
            steps=self.command.steps,
            max_gaussians=self.command.max_gaussians,
            seed=self.command.seed,
            backend=self.command.backend,
        )


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
