"""``splatseg fit``: photographs with cameras become a scene of Gaussians."""

import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from splatseg.cli._fit_report import score_and_report
from splatseg.cli._output import check_output
from splatseg.cli._photographs import Poses, capture_of
from splatseg.cli._progress import lines_on_stderr
from splatseg.core import Capture, Scene
from splatseg.fit import (
    EXPOSURES,
    Checkpoints,
    FitOptions,
    FitProgress,
    FitResult,
    Preset,
    Strategy,
    deferred_interrupts,
    discard_checkpoint,
    exposures_record,
    fit,
    random_point_count,
    reduction_note,
)
from splatseg.io.scene import CHECKPOINT_FILE, save_scene
from splatseg.render import BackendName

# Weight of the newest view in the figures of the progress line; views differ much.
_SMOOTHING = 0.02
_DEFAULT = FitOptions()


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Fit Gaussians to the training photographs of a capture, and write a scene folder.

    Ctrl-C ends it early and writes what there is; --resume goes on from there, and from the
    last checkpoint of a fit that was killed.
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """The capture: a folder of COLMAP, nerfstudio, Blender, LLFF or IDR data, a folder of bare
    photographs, or a video."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="SCENE")]
    """The scene folder to write. A scene that is there is replaced unless it has layers."""

    minutes: float | None = None
    """Length of the optimisation; the whole command ends within a minute more. None is the
    preset's."""

    steps: int | None = None
    """Length in steps instead of minutes: same seed, same result."""

    max_gaussians: int | None = None
    """Most Gaussians of the scene. None is the preset's, times the square root of how much longer
    than the preset the fit is."""

    preset: Preset = "default"
    """quick: 3 minutes, 274 000 Gaussians. default: 10 minutes, 500 000. full: the published
    settings, 30 000 steps, up to a million Gaussians, colours with harmonics of degree 3."""

    strategy: Strategy = "mcmc"
    """How Gaussians come and go. mcmc: the faint move to where there are others, up to the
    number asked for. classic: cloned and split where the picture pulls at them."""

    start: Literal["auto", "points", "random"] = _DEFAULT.start
    """Where Gaussians start. points: at the capture's points. random: on rays of the photographs,
    where several of them agree. auto: at the points if there are any."""

    background: str = "random"
    """What is behind the Gaussians: random, black, white or #rrggbb. Photographs with an alpha
    channel are blended over it; over random, which forbids holes in dark surfaces, they are over
    white."""

    prune_floaters: bool = _DEFAULT.prune_floaters
    """Leave out of the finished scene what no training view needs."""

    resume: bool = False
    """Go on with the fit that was stopped in SCENE, with the same data and options; minutes or
    steps may be others. The result is that of a fit that was never stopped."""

    overwrite: bool = False
    """Begin again where a fit was stopped in SCENE."""

    checkpoint_every: float = 60.0
    """Seconds between two checkpoints, from which --resume goes on."""

    checkpoint_steps: int | None = None
    """Steps between two checkpoints, instead of seconds."""

    keep_checkpoint: bool = False
    """Keep the checkpoint of the finished fit, so that --resume with more minutes or steps can
    make it longer."""

    antialiased: bool | None = None
    """Opacities shrink with Gaussians that are thinner than a pixel, so that they look right from
    nearer and further away too. The scene remembers it; programs that cannot draw so show thin
    things somewhat thicker. None is the preset's: yes, but for full."""

    exposure: bool = _DEFAULT.exposure
    """Give each photograph a brightness and a tint of its own, which the scene is freed of."""

    masks: Literal["ignore", "alpha", "off"] = _DEFAULT.masks
    """What masks of the capture mean. ignore: nothing is learned where they are 0. alpha: masks,
    or the alpha channel of photographs, cut out what is wanted; the rest is empty. off: nothing."""

    depth: Literal["off", "metric", "relative"] = _DEFAULT.depth
    """What to learn from the capture's depth maps. metric: they hold z-depth. relative: inverse
    depth of unknown scale and shift, as networks guess it from one photograph."""

    refine_poses: bool = _DEFAULT.refine_poses
    """Correct the poses of training views while fitting."""

    seed: int = 0
    """Seed of everything that is drawn at random."""

    backend: BackendName = "auto"
    """Who renders. auto and cpu: the C++ kernels."""

    format: str = "auto"
    """How DATA is read: auto, nerfstudio, colmap, blender, llff or idr."""

    poses: Poses = "auto"
    """Where cameras come from. given: DATA. sfm: they are found from the photographs alone, by
    structure from motion, and kept in SCENE/capture. auto: sfm where DATA has none."""

    frames: int = 120
    """Frames to take from DATA where it is a video."""


def run(command: Command) -> None:
    """Fit a scene and write it."""
    options = _options(command)
    place = check_output(command.output, resume=command.resume, overwrite=command.overwrite)
    checkpoints = _checkpoints(command)
    capture = capture_of(
        command.data,
        scene=command.output,
        format=command.format,
        poses=command.poses,
        frames=command.frames,
        seed=command.seed,
    )
    for note in (*capture.notes, reduction_note(capture.train_views, longest=options.longest)):
        if note is not None:
            sys.stdout.write(f"{note}\n")
    sys.stdout.write(_beginning(capture, options))
    sys.stdout.flush()

    if place is not None:
        sys.stdout.write(f"{place}\n")
        sys.stdout.flush()
    with deferred_interrupts() as interrupts:
        with _shown_progress() as show:
            result = fit(
                capture,
                options=options,
                backend=command.backend,
                progress=show,
                checkpoints=checkpoints,
            )
        _save(command, options, capture, result)
    sys.stdout.write(_summary(result, command.output))
    sys.stdout.writelines(f"{note}\n" for note in result.notes)
    sys.stdout.flush()
    stopped = interrupts.requested or result.interrupted
    sys.stdout.write(
        score_and_report(
            command.output,
            capture,
            result,
            options=options,
            backend=command.backend,
            scoring=not stopped,
        )
    )
    if stopped:
        raise KeyboardInterrupt


def _save(command: Command, options: FitOptions, capture: Capture, result: FitResult) -> None:
    """Write the scene; then a finished fit needs its checkpoint no more."""
    scene = Scene(
        gaussians=result.gaussians,
        views=result.views,
        classes=capture.classes,
        up=capture.up,
        metres_per_unit=capture.metres_per_unit,
        source=capture.path,
        provenance=_provenance(command, options, result),
    )
    save_scene(scene, command.output)
    if not (result.interrupted or command.keep_checkpoint):
        discard_checkpoint(command.output / CHECKPOINT_FILE)


def _checkpoints(command: Command) -> Checkpoints:
    return Checkpoints(
        path=command.output / CHECKPOINT_FILE,
        seconds=command.checkpoint_every,
        steps=command.checkpoint_steps,
        resume=command.resume,
        at_end=command.keep_checkpoint,
    )


def _options(command: Command) -> FitOptions:
    options = replace(FitOptions.preset(command.preset), seed=command.seed)
    options = replace(
        options,
        start=command.start,
        background=command.background,
        prune_floaters=command.prune_floaters,
        antialiased=options.antialiased if command.antialiased is None else command.antialiased,
        exposure=command.exposure,
        masks=command.masks,
        depth=command.depth,
        refine_poses=command.refine_poses,
    )
    options = options.with_strategy(command.strategy)
    options = options.with_length(minutes=command.minutes, steps=command.steps)
    if command.max_gaussians is not None:
        options = replace(options, max_gaussians=command.max_gaussians)
    return options


def _beginning(capture: Capture, options: FitOptions) -> str:
    train, test = len(capture.train_views), len(capture.test_views)
    points = 0 if capture.points is None else len(capture.points)
    drawn = ""
    if (number := random_point_count(capture, options)) > 0:
        where = "at" if points == 0 or options.start == "random" else "at these and up to"
        drawn = f"; starting {where} {number} places where photographs agree"
    return (
        f"{capture.path} ({capture.format}): {train} training views, {test} held out, "
        f"{points} start points{drawn}\n"
    )


class _Smoothed:
    """Loss and PSNR of single views, smoothed over many of them."""

    def __init__(self) -> None:
        self._values: tuple[float, float] | None = None

    def text(self, now: FitProgress) -> str:
        """What a line of progress says of a step."""
        loss, psnr = self._values or (now.loss, now.psnr)
        loss += _SMOOTHING * (now.loss - loss)
        psnr += _SMOOTHING * (now.psnr - psnr)
        self._values = loss, psnr
        speed = now.step / max(now.seconds, 1e-9)
        return (
            f"step {now.step}, loss {loss:.4f}, PSNR {psnr:.2f}, {now.count} Gaussians, "
            f"{speed:.1f} it/s"
        )


@contextmanager
def _shown_progress() -> Generator[Callable[[FitProgress], None]]:
    """On stderr: share done, smoothed loss and PSNR, count, speed, estimate."""
    smoothed = _Smoothed()
    lines = lines_on_stderr("fit")
    if lines is not None:

        def write(now: FitProgress) -> None:
            text = smoothed.text(now)
            lines.show(now.progress, 1.0, text=text, seconds_left=now.seconds_left)

        yield write
        return
    columns = (
        TextColumn("fit"),
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:>3.0f}%"),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0, left="")
        shown = 0.0

        def show(now: FitProgress) -> None:
            nonlocal shown
            text = smoothed.text(now)
            if now.seconds - shown < 0.25:
                return
            shown = now.seconds
            left = f"{now.seconds_left / 60:.1f} min left"
            bar.update(task, completed=now.progress, description=text, left=left)

        yield show


def _provenance(command: Command, options: FitOptions, result: FitResult) -> dict[str, Any]:
    return {
        "command": "fit",
        "steps": result.steps,
        "seconds": round(result.seconds, 3),
        "interrupted": result.interrupted,
        "seed": options.seed,
        "preset": command.preset,
        "backend": command.backend,
        "options": asdict(options),
        **({EXPOSURES: exposures_record(result.exposures)} if result.exposures else {}),
        "versions": {name: metadata.version(name) for name in ("splatseg", "torch")},
    }


def _summary(result: FitResult, root: Path) -> str:
    rate = result.steps / max(result.seconds, 1e-9)
    ended = "stopped after" if result.interrupted else "in"
    onwards = "; the same command with --resume goes on" if result.interrupted else ""
    return (
        f"{root}: {len(result.gaussians)} Gaussians {ended} {result.steps} steps, "
        f"{result.seconds:.1f} s ({rate:.1f} steps/s){onwards}\n"
    )
