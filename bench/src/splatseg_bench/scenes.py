"""Which scenes a run is of: those of the data set, of the protocol's list, or of a person's."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from splatseg.errors import InputError
from splatseg_bench.layouts import find_layout, read_benchmark
from splatseg_bench.layouts.spin_nerf import WORDS_FILE
from splatseg_bench.options import BenchOptions
from splatseg_bench.protocols import (
    ALL_WINDOWS,
    Protocol,
    RoomSwitches,
    SpokenSwitches,
    StreetSwitches,
)
from splatseg_bench.scene import BenchmarkScene


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
