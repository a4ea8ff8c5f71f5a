"""Public benchmarks in the folders that people have: what is asked of a scene, and its truth.

One module a layout; ``docs/benchmarks.md`` says which files each of them reads. Nothing of a mask
or a photograph is read before somebody asks for it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from splatseg._check import check_choice
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures.kitti360 import window_of
from splatseg_bench.layouts.kitti360 import LAYOUT as KITTI360
from splatseg_bench.layouts.kitti360 import find_kitti360_scenes, read_kitti360_scenes
from splatseg_bench.layouts.lerf_mask import find_lerf_mask, read_lerf_mask
from splatseg_bench.layouts.lerf_ovs import find_lerf_ovs, read_lerf_ovs
from splatseg_bench.layouts.nvos import find_nvos, read_nvos
from splatseg_bench.layouts.ovs3d import find_ovs3d, read_ovs3d
from splatseg_bench.layouts.replica import LAYOUT as REPLICA
from splatseg_bench.layouts.replica import (
    SEQUENCES,
    find_grouping_replica,
    find_replica_scenes,
    read_grouping_replica,
    read_replica_scenes,
)
from splatseg_bench.layouts.scannet import find_scannet_scenes, read_scannet_scenes
from splatseg_bench.layouts.scannetpp import find_scannetpp_scenes, read_scannetpp_scenes
from splatseg_bench.layouts.spin_nerf import find_spin_nerf, read_spin_nerf
from splatseg_bench.layouts.waymo import find_waymo_scenes, read_waymo_scenes
from splatseg_bench.scene import BenchmarkScene


@dataclass(frozen=True, slots=True)
class _Layout:
    """How a layout is told and read."""

    found: Callable[[Path], object]
    """Something true where a folder has it."""

    read: Callable[[Path], tuple[BenchmarkScene, ...]]


_LAYOUTS: Mapping[str, _Layout] = {
    "nvos": _Layout(find_nvos, read_nvos),
    "lerf-mask": _Layout(find_lerf_mask, read_lerf_mask),
    "lerf-ovs": _Layout(find_lerf_ovs, read_lerf_ovs),
    "3d-ovs": _Layout(find_ovs3d, read_ovs3d),
    "replica": _Layout(find_replica_scenes, read_replica_scenes),
    "replica-gg": _Layout(find_grouping_replica, read_grouping_replica),
    "scannet": _Layout(find_scannet_scenes, read_scannet_scenes),
    "scannetpp": _Layout(find_scannetpp_scenes, read_scannetpp_scenes),
    "kitti360": _Layout(find_kitti360_scenes, read_kitti360_scenes),
    "waymo": _Layout(find_waymo_scenes, read_waymo_scenes),
    # Last: masks beside photographs are all that tells it.
    "spin-nerf": _Layout(find_spin_nerf, read_spin_nerf),
}

LAYOUTS = tuple(_LAYOUTS)
"""Layouts that are read, in the order in which they are looked for."""


@boundary
def read_benchmark(
    layout: str, folder: Path, *, sequence: str | None = None, windows: str | None = None
) -> tuple[BenchmarkScene, ...]:
    """Read scenes of a benchmark: cameras, tasks and truth, sorted by name.

    Masks and maps are read when they are asked for, by the `read` of their values; that is when a
    damaged one is found. Files that are not there, or of views that are not, are found here.

    Args:
        layout: One of `LAYOUTS`.
        folder: A scene, or the data set's folder with several. Of KITTI-360 also a window of a
            drive, ``.../DRIVE/START_END``, which is no folder.
        sequence: Which walk through a scene is read, of a layout with several (``replica``); None
            reads the first.
        windows: Name of the data set's list whose windows are read, of ``kitti360``; None is all.

    Raises:
        MissingFileError: If there is no such folder, or files of the layout are missing.
        InputError: If a file is damaged, or of a view that the scene does not have; one sentence
            that names it. Also if scenes of the layout have one walk, and another is asked for, or
            the layout has no windows.
    """
    check_choice("layout", layout, LAYOUTS)
    if sequence is not None:
        if layout != REPLICA:
            raise InputError(f"sequence: scenes of layout {layout} have one, got {sequence!r}.")
        check_choice("sequence", sequence, SEQUENCES)
    if windows is not None and layout != KITTI360:
        raise InputError(f"windows: scenes of layout {layout} are no windows, got {windows!r}.")
    if not folder.is_dir() and window_of(folder.name) is None:
        raise MissingFileError(f"{folder}: there is no such folder of a benchmark.")
    if sequence is not None:
        return read_replica_scenes(folder, sequence=sequence)
    if windows is not None:
        return read_kitti360_scenes(folder, windows=windows)
    return _LAYOUTS[layout].read(folder)


@boundary
def find_layout(folder: Path) -> str:
    """The layout of a folder: the first of `LAYOUTS` that it has.

    Raises:
        MissingFileError: If there is no such folder.
        InputError: If it has none of them.
    """
    if not folder.is_dir() and window_of(folder.name) is None:
        raise MissingFileError(f"{folder}: there is no such folder of a benchmark.")
    for name, layout in _LAYOUTS.items():
        if layout.found(folder):
            return name
    raise InputError(
        f"{folder}: expected a benchmark in one of the layouts {', '.join(LAYOUTS)}, got none of "
        "them."
    )
