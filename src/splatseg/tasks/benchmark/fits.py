"""Scenes of a benchmark with Gaussians: fitted with its own split, or fitted before."""

import hashlib
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from splatseg.core import Capture, PointCloud, Scene
from splatseg.core.benchmark import BenchmarkScene
from splatseg.core.json_values import plain_object
from splatseg.errors import InputError
from splatseg.evaluate.protocols import (
    MapSwitches,
    PointSwitches,
    Protocol,
    RoomSwitches,
    StreetSwitches,
    TargetSwitches,
)
from splatseg.io.benchmarks.replica import LAYOUT as REPLICA
from splatseg.io.benchmarks.replica import SEQUENCES
from splatseg.io.captures.pose_tables import TRAIN_EVERY
from splatseg.io.paths import path_inside
from splatseg.io.scans import scan_formats
from splatseg.io.scene import load_scene
from splatseg.io.scene_folder import CHECKPOINT_FILE, is_scene
from splatseg.render import BackendName
from splatseg.tasks._observer import Observer
from splatseg.tasks.benchmark.options import BenchOptions
from splatseg.tasks.benchmark.walks import walk_splits
from splatseg.tasks.make_scene import MakeSceneOptions, fit_capture

SCENES_FOLDER = "scenes"


def fitted_scene(
    bench: BenchmarkScene,
    protocol: Protocol,
    root: Path,
    *,
    options: BenchOptions,
    backend: BackendName,
    command: str,
    observer: Observer,
) -> Scene:
    """The scene with Gaussians; fitted, gone on with, or taken as it is.

    Raises:
        KeyboardInterrupt: If the fit was stopped; the next call goes on with it.
        InputError: If the folder holds a fit with other options, or a scene that was fitted before
            learned from views that the protocol holds out.
    """
    fixed = isinstance(protocol.switches, PointSwitches) and protocol.switches.fixed_points
    if options.fitted is not None:
        scene = load_scene(Path(options.fitted.replace("{scene}", bench.name)))
        _check_views(scene, bench, protocol)
        return scene
    fit_options = options.fit_options(fixed=fixed)
    scans = scans_of(bench, protocol)
    if scans is not None:
        fit_options = replace(fit_options, depth="metric")
    folder = path_inside(root, SCENES_FOLDER, _kind(bench, protocol, fixed=fixed), bench.name)
    capture = _capture(bench, protocol, fixed=fixed)
    if not is_scene(folder) or (folder / CHECKPOINT_FILE).is_file():
        made = fit_capture(
            capture,
            folder,
            options=MakeSceneOptions(
                preset=options.preset,
                resume=(folder / CHECKPOINT_FILE).is_file(),
                scans=scans,
            ),
            fit_options=fit_options,
            backend=backend,
            command=command,
            observer=observer,
        )
        if made.interrupted:  # it wrote what there is, which is no fit to measure
            raise KeyboardInterrupt(f"{folder}: the fit goes on when the same is asked for again")
    scene = load_scene(folder)
    _check_options(scene, plain_object("options", asdict(fit_options)))
    _check_split(scene, capture)
    return scene


def held_out_views(bench: BenchmarkScene, protocol: Protocol) -> frozenset[str]:
    """Names of the views that a fit must not learn from.

    Of things that are asked for they are the scored ones, else those of the data set's split, or
    every so many where it has none. Of rooms they are the frames between those that are fitted, of
    streets those of the layout's split.

    Raises:
        InputError: If a drive holds none out.
    """
    if protocol.switches.scored_in_training:
        return frozenset()
    if isinstance(protocol.switches, RoomSwitches):
        splits = walk_splits(bench.capture, protocol.switches.train_every)
        return frozenset(name for name, split in splits.items() if split == "test")
    if isinstance(protocol.switches, StreetSwitches):
        tests = frozenset(view.name for view in bench.capture.test_views)
        if not tests:
            raise InputError(f"scene {bench.name}: expected held-out views, got none.")
        return tests
    if isinstance(protocol.switches, MapSwitches):
        own = frozenset(view.name for view in bench.capture.test_views)
        names = sorted(view.name for view in bench.capture.views)
        return own or frozenset(names[:: protocol.switches.hold_out_every])
    prompts = {
        one.view
        for task in bench.tasks
        for one in (task.reference, task.scribble)
        if one is not None
    }
    return frozenset(true.view for task in bench.tasks for true in task.truth) - prompts


def scans_of(bench: BenchmarkScene, protocol: Protocol) -> Path | None:
    """Where the scans of a drive are that its fit takes; None where it has none, or takes none."""
    path = bench.capture.path
    if not (isinstance(protocol.switches, StreetSwitches) and protocol.switches.scans):
        return None
    return path if scan_formats(path) else None


def gaussians_digest(scene: Scene) -> str:
    """SHA-256 of the Gaussians' values."""
    digest = hashlib.sha256()
    for name in ("means", "rotations", "scales", "opacities", "sh"):
        values = getattr(scene.gaussians, name).detach().cpu().contiguous()
        digest.update(values.numpy().tobytes())
    return digest.hexdigest()


def _capture(bench: BenchmarkScene, protocol: Protocol, *, fixed: bool) -> Capture:
    capture = bench.capture
    if isinstance(protocol.switches, PointSwitches) and protocol.switches.frame_step > 1:
        views = capture.views[:: protocol.switches.frame_step]
        capture = replace(capture, views=views)
    if isinstance(protocol.switches, RoomSwitches):
        splits = walk_splits(capture, protocol.switches.train_every)
        if protocol.switches.scored_in_training:
            splits = {name: "train" if split == "test" else split for name, split in splits.items()}
        views = tuple(replace(view, split=splits[view.name]) for view in capture.views)
        return replace(capture, views=views)
    out = held_out_views(bench, protocol)
    # Views that are neither, as Replica's between two that count, stay so.
    own = not (
        protocol.switches.scored_in_training or isinstance(protocol.switches, TargetSwitches)
    )
    views = tuple(
        replace(view, split="test")
        if view.name in out
        else replace(view, split="train" if view.split == "test" or not own else view.split)
        for view in capture.views
    )
    capture = replace(capture, views=views)
    if not fixed:
        return capture
    if bench.points is None:
        raise InputError(
            f"scene {bench.name}: expected labelled points that Gaussians stay at, got none."
        )
    colours = None if capture.points is None else capture.points.colours
    same = capture.points is not None and len(capture.points) == len(bench.points.points)
    return replace(
        capture, points=PointCloud(points=bench.points.points, colours=colours if same else None)
    )


def _kind(bench: BenchmarkScene, protocol: Protocol, *, fixed: bool) -> str:
    """The folder of fits of a layout; other walks and other splits of them have their own."""
    kind = f"{bench.layout}-fixed" if fixed else bench.layout
    switches = protocol.switches
    if not isinstance(switches, RoomSwitches):
        return kind
    if switches.sequence not in (None, SEQUENCES[0]):
        kind = f"{kind}-{switches.sequence}"
    # The data set's own split, which other protocols fit to as well, needs no name.
    own = bench.layout == REPLICA and switches.train_every == TRAIN_EVERY
    return kind if own else f"{kind}-every-{switches.train_every}"


def _check_views(scene: Scene, bench: BenchmarkScene, protocol: Protocol) -> None:
    """Refuse a scene that lacks views of the benchmark, or learned from those it holds out."""
    known = {view.name: view for view in scene.views}
    lacking = [view.name for view in bench.capture.views if view.name not in known]
    if lacking:
        raise InputError(
            f"{scene.root}: expected a fit of the {len(bench.capture.views)} views of "
            f"{bench.name}, {len(lacking)} are not in it, the first is {lacking[0]}."
        )
    held_out = held_out_views(bench, protocol)
    learned = sorted(name for name in held_out if known[name].split == "train")
    if learned:
        raise InputError(
            f"{scene.root}: expected a fit that did not learn from the {len(held_out)} views that "
            f"{protocol.name} holds out, got one that learned from {len(learned)} of them "
            f"({learned[0]})."
        )


def _check_split(scene: Scene, capture: Capture) -> None:
    """Refuse a fit of another split: it learned from more views, or from fewer."""
    there = {view.name for view in scene.train_views}
    wanted = {view.name for view in capture.train_views}
    if there != wanted:
        raise InputError(
            f"{scene.root}: expected a fit that learned from {len(wanted)} views, got one of "
            f"another split, which learned from {len(there)}; choose another output."
        )


def _check_options(scene: Scene, wanted: Any) -> None:
    """Refuse a fit with other options: results of the two do not go into one table."""
    there = scene.provenance.get("options", {})
    other = [
        f"{name} {there.get(name)} there, {value} now"
        for name, value in wanted.items()
        if there.get(name) != value
    ]
    if other:
        raise InputError(
            f"{scene.root}: expected a fit with these options, got another ({'; '.join(other[:4])})"
            "; choose another output, or take the fit as it is with `fitted`."
        )
