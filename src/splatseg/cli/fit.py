"""``splatseg fit``: photographs with cameras become a scene of Gaussians."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from splatseg.cli._types import (
    Backend,
    Format,
    Json,
    MadeSceneFolder,
    Overwrite,
    Quiet,
    Seed,
    Strict,
)
from splatseg.cli._work import ConsoleObserver, print_result, typed
from splatseg.fit import FitOptions, Preset, Strategy
from splatseg.report.fit_report import scored_of
from splatseg.tasks import MadeScene, MakeSceneOptions, fit_capture

_DEFAULT = FitOptions()
_SCENE = MakeSceneOptions()


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Fit Gaussians to the training photographs of a capture, and write a scene folder.

    Ctrl-C ends it early and writes what there is; --resume goes on from there, and from the
    last checkpoint of a fit that was killed. --overwrite begins again instead.

    For example:

    splatseg fit photographs -o room

    splatseg fit capture -o room --preset quick --steps 3000 --seed 1

    splatseg fit walk.mp4 -o room --frames 200 --json
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """The capture: a folder of COLMAP, nerfstudio, Blender, LLFF or IDR data, a folder of bare
    photographs, or a video."""

    output: MadeSceneFolder

    minutes: float | None = None
    """Length of the optimisation. Finding poses is not counted and comes before it; scores and
    the report take up to a minute after it. What the whole took is said at the end. None is the
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
    number asked for. classic: cloned and split where the picture pulls at them. fixed: one stays
    at each of the capture's points, in their order, and none comes or goes."""

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

    overwrite: Overwrite = False

    checkpoint_every: float = _SCENE.checkpoint_every
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
    """What to learn from the capture's depth maps, or from --depth-evidence. metric: they hold
    z-depth. relative: inverse depth of unknown scale and shift, as networks guess it from one
    photograph."""

    depth_evidence: Annotated[str | None, tyro.conf.arg(metavar="FOLDER_OR_NAME")] = None
    """Evidence of depth, as see --what depth writes it, instead of the capture's depth maps: a
    folder, or its name in DATA or in a scene that SCENE replaces."""

    scans: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Laser scans of the drive: the fit starts at their points and learns their depth, as with
    --depth metric. For streets, whose far and thin things photographs alone place badly."""

    points: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A PLY file of points, or of a mesh, in the world of DATA: where the fit starts, instead of
    the points of DATA."""

    moving: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Boxes of moving things, which are left out of training views and of scans: a JSON file, a
    drive of KITTI-360 or a segment of Waymo."""

    moving_classes: tuple[str, ...] = ()
    """Classes of label maps whose things move, such as car pedestrian: they are left out of
    training views."""

    moving_evidence: Annotated[str | None, tyro.conf.arg(metavar="FOLDER_OR_NAME")] = None
    """The label maps of --moving-classes: a folder, or its name in DATA or in a scene that SCENE
    replaces. None takes the only label maps there are."""

    moving_clock: Literal["recorded", "frames"] = _SCENE.moving_clock
    """What the times of boxes are. recorded: what the data set has, such as seconds. frames: the
    last number in the name of a view or scan."""

    refine_poses: bool = _DEFAULT.refine_poses
    """Correct the poses of training views while fitting."""

    seed: Seed = 0
    backend: Backend = "auto"
    format: Format = "auto"
    strict: Strict = False

    poses: Literal["auto", "given", "sfm", "pointmaps"] = _SCENE.poses
    """Where cameras come from. given: DATA. sfm: they are found from the photographs alone, by
    structure from motion, and kept in SCENE/capture. pointmaps: from what a network such as DUSt3R
    says of pairs of photographs, with a dense cloud to start from; for few photographs. auto: sfm
    where DATA has none."""

    pointmaps: Annotated[str | None, tyro.conf.arg(metavar="FOLDER_OR_MODEL")] = None
    """Whose, with --poses pointmaps: a folder of recorded pointmaps, or a model of another package,
    MODEL[=WEIGHTS][,OPTION=VALUE...]. None is DATA/pointmaps."""

    frames: int = _SCENE.frames
    """Frames to take from DATA where it is a video."""

    json: Json = False
    quiet: Quiet = False


def run(command: Command) -> None:
    """Fit a scene and write it."""
    made = fit_capture(
        command.data,
        command.output,
        options=MakeSceneOptions(
            format=command.format,
            strict=command.strict,
            poses=command.poses,
            pointmaps=command.pointmaps,
            frames=command.frames,
            resume=command.resume,
            overwrite=command.overwrite,
            checkpoint_every=command.checkpoint_every,
            checkpoint_steps=command.checkpoint_steps,
            keep_checkpoint=command.keep_checkpoint,
            preset=command.preset,
            depth_evidence=command.depth_evidence,
            scans=command.scans,
            points=command.points,
            moving=command.moving,
            moving_classes=command.moving_classes,
            moving_evidence=command.moving_evidence,
            moving_clock=command.moving_clock,
        ),
        fit_options=_options(command),
        backend=command.backend,
        command=typed(sys.argv),
        observer=ConsoleObserver(quiet=command.quiet, json=command.json),
    )
    print_result(_facts(made), _lines(made), json=command.json)
    if made.interrupted:
        raise KeyboardInterrupt


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
        depth="metric" if command.scans and command.depth == "off" else command.depth,
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
