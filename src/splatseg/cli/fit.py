"""``splatseg fit`` and ``splatseg import``: scenes of photographs, and of splat files."""

import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from splatseg.cli._shared import (
    Backend,
    NewSceneFolder,
    Printing,
    Seed,
    print_result,
    typed,
)
from splatseg.errors import InputError
from splatseg.fit import FitOptions, Preset, Strategy
from splatseg.report.fit_report import scored_of
from splatseg.tasks import (
    ExecutorOptions,
    ImportOptions,
    MadeScene,
    MakeSceneOptions,
    fit_capture,
    import_scene,
    open_executor,
)

_DEFAULT = FitOptions()


@dataclass(frozen=True, kw_only=True)
class Command(Printing):
    """Fit Gaussians to the training photographs of a capture, and write a scene folder.

    Ctrl-C ends the fit early and writes the scene as it is; --resume continues from there, and
    from the last checkpoint of a fit that was killed. --overwrite begins again instead.

    For example:

    splatseg fit photographs -o room

    splatseg fit capture -o room --preset quick --steps 3000 --seed 1

    splatseg fit walk.mp4 -o room --frames 200 --json

    splatseg fit more-photographs --add room -o room2
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """The capture: a folder of COLMAP, nerfstudio, Blender, LLFF or IDR data, a folder of bare
    photographs, or a video."""

    output: NewSceneFolder

    minutes: float | None = None
    """Length of the optimisation, minutes. Finding poses comes before it and is not counted; scores
    and the report take up to a minute after it. The total time is printed at the end. None takes
    the preset's."""

    steps: int | None = None
    """Length in steps instead of minutes: same seed, same result."""

    max_gaussians: int | None = None
    """Largest number of Gaussians of the scene. None takes the preset's, times the square root of
    how much longer than the preset the fit is."""

    longest: Annotated[int, tyro.conf.arg(metavar="PIXELS")] = _DEFAULT.longest
    """Photographs whose longest side has more pixels are reduced to it. Half of it makes steps
    nearly four times as fast, and what is smaller than a pixel is lost."""

    preset: Preset = "default"
    """quick: 3 minutes, 274 000 Gaussians. default: 10 minutes, 500 000. full: the published
    settings, 30 000 steps, up to a million Gaussians, spherical harmonics of degree 3."""

    strategy: Strategy = "mcmc"
    """Densification. mcmc: faint Gaussians are relocated to others, up to the largest number.
    classic: Gaussians are cloned and split where gradients are large. fixed: one stays at each of
    the capture's points, in their order; none is added or removed."""

    start: Literal["auto", "points", "random"] = _DEFAULT.start
    """Initial positions. points: the capture's points. random: on rays of the photographs, where
    several of them agree. auto: the points if there are any."""

    background: str = "random"
    """Colour behind the Gaussians: random, black, white or #rrggbb. Photographs with an alpha
    channel are blended over it; with random, which prevents holes in dark surfaces, over white."""

    prune_floaters: bool = _DEFAULT.prune_floaters
    """Remove from the finished scene the Gaussians that no training view needs."""

    antialiased: bool | None = None
    """Reduce opacities of Gaussians that are thinner than a pixel, so that they look right from
    nearer and further away too. Recorded in the scene; programs that cannot draw so show thin
    structures somewhat thicker. None takes the preset's: yes, but for full."""

    exposure: bool = _DEFAULT.exposure
    """Fit a brightness and a tint for each photograph, which the scene does not keep."""

    masks: Literal["ignore", "alpha", "off"] = _DEFAULT.masks
    """Meaning of the capture's masks. ignore: nothing is learned where they are 0. alpha: masks, or
    the alpha channel of photographs, cut out the object; the rest is empty. off: not used."""

    depth: Literal["off", "metric", "relative"] = _DEFAULT.depth
    """What is learned from the capture's depth maps, or from --depth-evidence. metric: z-depth.
    relative: inverse depth of unknown scale and shift, as networks predict it from one
    photograph."""

    refine_poses: bool = _DEFAULT.refine_poses
    """Correct the poses of training views during the fit."""

    seed: Seed = 0
    backend: Backend = "auto"

    capture: Annotated[MakeSceneOptions, tyro.conf.arg(name="")] = field(
        default_factory=MakeSceneOptions
    )
    """How photographs are read, where cameras come from, and how a stopped fit goes on."""

    executing: tyro.conf.OmitArgPrefixes[ExecutorOptions] = field(default_factory=ExecutorOptions)
    """Where blocks are fitted (--blocks)."""


def run(command: Command) -> None:
    """Fit a scene and write it."""
    fit_options = _options(command)
    with open_executor(command.executing, observer=command.observer) as executor:
        made = fit_capture(
            command.data,
            command.output,
            options=command.capture,
            fit_options=fit_options,
            backend=command.backend,
            executor=executor,
            command=typed(sys.argv),
            observer=command.observer,
        )
    print_result(_facts(made), _lines(made), json=command.json)
    if made.interrupted:
        raise KeyboardInterrupt


def _options(command: Command) -> FitOptions:
    if command.capture.add is not None and command.minutes is not None:
        raise InputError("minutes: photographs are added in steps (`--steps`), got minutes.")
    options = FitOptions.preset(command.preset)
    scans = command.capture.scans
    options = replace(
        options,
        seed=command.seed,
        longest=command.longest,
        start=command.start,
        background=command.background,
        prune_floaters=command.prune_floaters,
        antialiased=options.antialiased if command.antialiased is None else command.antialiased,
        exposure=command.exposure,
        masks=command.masks,
        depth="metric" if scans and command.depth == "off" else command.depth,
        refine_poses=command.refine_poses,
    )
    options = options.with_strategy(command.strategy)
    options = options.with_length(minutes=command.minutes, steps=command.steps)
    if command.max_gaussians is not None:
        options = replace(options, max_gaussians=command.max_gaussians)
    return options


def _facts(made: MadeScene) -> dict[str, Any]:
    scores, result = made.scores, made.result
    return {
        "scene": made.folder,
        "gaussians": len(result.gaussians),
        "steps": result.steps,
        "sensible_steps": made.verdict.sensible_steps,
        "too_short": made.verdict.too_short,
        "verdict": f"{made.verdict.words}. {made.verdict.sentence}",
        "seconds": round(result.seconds, 3),
        "seconds_by_part": {name: round(spent, 3) for name, spent in made.timings.items()},
        "seconds_together": round(sum(made.timings.values()), 3),
        "interrupted": made.interrupted,
        "train_views": len(made.capture.train_views),
        "test_views": len(made.capture.test_views),
        "held_out_views": made.held_out,
        **({} if made.moving is None else {"moving": made.moving.record}),
        **({} if made.blocks is None else {"blocks": len(made.blocks)}),
        "scored_views": 0 if scores is None else len(scores.views),
        "psnr": None if scores is None else scores.psnr,
        "ssim": None if scores is None else scores.ssim,
        "report": made.report,
        "notes": list(result.notes),
    }


def _lines(made: MadeScene) -> list[str]:
    result = made.result
    rate = result.steps / max(result.seconds, 1e-9)
    ended = "stopped after" if result.interrupted else "in"
    onwards = "; the same command with --resume goes on" if result.interrupted else ""
    lines = [
        f"{made.folder}: {len(result.gaussians)} Gaussians {ended} {result.steps} steps, "
        f"{result.seconds:.1f} s ({rate:.1f} steps/s){onwards}",
        *result.notes,
    ]
    if not made.held_out:
        lines.append("no held-out views to score")
    elif made.scores is not None:
        scored = scored_of(made.scores, made.held_out)
        lines.append(f"PSNR {made.scores.psnr:.2f} dB on {scored}, SSIM {made.scores.ssim:.3f}")
    parts = ", ".join(f"{name} {spent:.0f} s" for name, spent in made.timings.items())
    return [
        *lines,
        f"{made.verdict.words}: {made.verdict.sentence}",
        f"the whole took {sum(made.timings.values()):.0f} s: {parts}",
        f"report: {made.report}",
    ]


@dataclass(frozen=True, kw_only=True)
class ImportCommand(Printing):
    """Make a scene of a splat file, with its photographs or with virtual cameras.

    With --data, a few views are drawn and compared with the photographs; a file in another
    frame (axes, nerfstudio's transforms, another scale) is moved, and one that fits in no frame is
    refused. Without, cameras are placed so that they cover what is visible; their views have
    no photographs, and everything that needs none works on them.

    For example:

    splatseg import room.ply -o room --data capture

    splatseg import chair.spz -o chair --kind object --max-views 60

    splatseg import room.glb -o room --up +z --width 640
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """The splat file: PLY, compressed PLY, .splat, .ksplat, SPZ, SOG or glTF."""

    output: NewSceneFolder

    importing: Annotated[ImportOptions, tyro.conf.arg(name="")] = field(
        default_factory=ImportOptions
    )
    """The capture, or virtual cameras."""

    backend: Backend = "auto"


def run_import(command: ImportCommand) -> None:
    """Import a splat file."""
    started = time.monotonic()
    made = import_scene(
        command.file,
        command.output,
        options=command.importing,
        backend=command.backend,
        observer=command.observer,
    )
    scene, found = made.scene, made.alignment
    train, test = len(scene.train_views), len(scene.test_views)
    facts = {
        "scene": command.output,
        "gaussians": len(scene.gaussians),
        "train_views": train,
        "test_views": test,
        "moved": None if found is None else found.moved,
        "correlation": None if found is None else found.correlation,
        "coverage": None if made.placed is None else made.placed.coverage,
        "seconds": round(time.monotonic() - started, 3),
    }
    line = (
        f"{command.output}: {len(scene.gaussians)} Gaussians, {train} training views, "
        f"{test} test views"
    )
    print_result(facts, [line], json=command.json)
