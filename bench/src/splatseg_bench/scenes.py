"""The scenes of a run: which frames are which, which scenes are taken, and their fits."""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from splatseg.core import Capture, PointCloud, Scene
from splatseg.core.json_values import plain_object
from splatseg.errors import InputError
from splatseg.io.atomic import path_inside
from splatseg.io.captures.pose_tables import TRAIN_EVERY
from splatseg.io.scans import scan_formats
from splatseg.io.scene import load_scene
from splatseg.io.scene_folder import CHECKPOINT_FILE, is_scene
from splatseg.render import BackendName
from splatseg.tasks.make_scene import MakeSceneOptions, fit_capture
from splatseg.tasks.work import Observer
from splatseg_bench.layouts import find_layout, read_benchmark
from splatseg_bench.layouts.replica import LAYOUT as REPLICA
from splatseg_bench.layouts.replica import SEQUENCES
from splatseg_bench.layouts.spin_nerf import WORDS_FILE
from splatseg_bench.options import BenchOptions
from splatseg_bench.protocols import (
    ALL_WINDOWS,
    MapSwitches,
    PointSwitches,
    Protocol,
    RoomSwitches,
    SpokenSwitches,
    StreetSwitches,
    TargetSwitches,
)
from splatseg_bench.scene import BenchmarkScene

_NUMBER = re.compile(r"\d+")


def walk_splits(capture: Capture, every: int) -> dict[str, str]:
    """``train``, ``test`` or ``unused`` by name of the view, as Semantic-NeRF divides its frames.

    Of `every` frames that follow each other the first is a training view, the one in the middle
    between it and the next is a test view, and the others are neither: of frames 0 to 9 with 5 the
    frames 0 and 5 are trained on and 2 and 7 are scored. Frames without a pose are not counted.

    Args:
        capture: Of a walk; its views are in the order of the numbers in their names.
        every: At least 2.

    Raises:
        InputError: If there is no test view, as there are too few frames.
    """
    names = sorted((view.name for view in capture.views), key=_frame)
    split_at = {0: "train", every // 2: "test"}
    splits = {name: split_at.get(i % every, "unused") for i, name in enumerate(names)}
    if "test" not in splits.values():
        raise InputError(
            f"{capture.path}: expected more than {every // 2} frames, got {len(names)}; "
            "train_every must be smaller for so few."
        )
    return splits


def _frame(name: str) -> tuple[int, str]:
    """The number that a name ends with, and the name."""
    numbers = _NUMBER.findall(name)
    return (int(numbers[-1]) if numbers else -1, name)


# Which scenes a run is of: those of the data set, of the protocol's list, or of a person's.


def asked_scenes(protocol: Protocol, data: Path, options: BenchOptions) -> list[BenchmarkScene]:
    """Read the data set, and take the scenes that are to be run.

    Of a protocol with lists of scenes these are all of its list, or those that are asked for by
    name; of others all that are there, or those.

    Raises:
        InputError: If the data set has another layout, a scene is not there or not in the list, or
            nobody says by which words it is asked for.
        MissingFileError: If the data set is not there, or lacks files of its layout.
    """
    there = {one.name: one for one in _read(protocol, data)}
    listed = protocol.scenes if protocol.scene_lists else ()
    for name in options.scenes:
        if listed and name not in listed:
            raise InputError(
                f"scenes: expected some of the list {_list_name(protocol)} of {protocol.name} "
                f"({', '.join(listed)}), got {name!r}; scene_list=all takes any."
            )
        if name not in there:
            raise InputError(f"{data}: expected scenes {', '.join(there)}, got {name!r}.")
    wanted = options.scenes or listed
    lacking = [name for name in wanted if name not in there]
    if lacking:
        raise InputError(
            f"{data}: expected the {len(listed)} scenes of the list {_list_name(protocol)} of "
            f"{protocol.name}, {len(lacking)} are not there ({', '.join(lacking)}); name those to "
            "run with `scenes`, or set scene_list=all."
        )
    return [_in_words(one, protocol) for name, one in there.items() if not wanted or name in wanted]


def _in_words(scene: BenchmarkScene, protocol: Protocol) -> BenchmarkScene:
    """The scene with the words that the protocol asks by, where it says them."""
    switches = protocol.switches
    if not isinstance(switches, SpokenSwitches):
        return scene
    words = switches.words_of_scenes.get(scene.name)
    tasks = tuple(replace(task, words=words or task.words) for task in scene.tasks)
    if any(task.words is None for task in tasks):
        raise InputError(
            f"scene {scene.name}: expected the words that ask for it, got none; write them into "
            f"{scene.capture.path / WORDS_FILE}, or set scene_words={scene.name}:WORDS."
        )
    return replace(scene, tasks=tasks)


def scene_notes(protocol: Protocol, scenes: Sequence[BenchmarkScene]) -> list[str]:
    """How the scenes at hand differ from those of the protocol."""
    notes: list[str] = []
    if protocol.scene_lists:
        name = _list_name(protocol)
        notes.append(
            f"scenes of the list {name}: {protocol.scene_lists[name].source}."
            if name in protocol.scene_lists
            else f"{', '.join(one.name for one in scenes)}: of no published list."
        )
    if not protocol.scenes:
        return notes
    names = {one.name for one in scenes}
    there, others = [n for n in protocol.scenes if n in names], names - set(protocol.scenes)
    if len(there) < len(protocol.scenes):
        notes.append(f"{len(there)} of the {len(protocol.scenes)} scenes of the protocol are run.")
    if others:
        notes.append(f"{', '.join(sorted(others))}: of no published figure.")
    return notes


def _list_name(protocol: Protocol) -> str:
    switches = protocol.switches
    return switches.scene_list if isinstance(switches, RoomSwitches) else ""


def _read(protocol: Protocol, data: Path) -> tuple[BenchmarkScene, ...]:
    """The data set, in the one of the protocol's layouts that it has."""
    switches = protocol.switches
    sequence = switches.sequence if isinstance(switches, RoomSwitches) else None
    windows = switches.windows if isinstance(switches, StreetSwitches) else ALL_WINDOWS
    if len(protocol.layouts) == 1:
        listed = None if windows == ALL_WINDOWS else windows
        return read_benchmark(protocol.layouts[0], data, sequence=sequence, windows=listed)
    found = find_layout(data)
    if found not in protocol.layouts:
        raise InputError(
            f"{data}: expected the layout {' or '.join(protocol.layouts)}, got {found}."
        )
    return read_benchmark(found, data, sequence=sequence)


# Scenes of a benchmark with Gaussians: fitted with its own split, or fitted before.


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
