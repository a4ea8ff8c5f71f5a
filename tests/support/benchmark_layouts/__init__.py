"""Scenes with exact truth in the layouts of benchmarks, for tests and `scripts/to_layout`."""

from collections.abc import Callable, Mapping
from pathlib import Path

from support.benchmark_layouts.kitti360 import write_kitti360
from support.benchmark_layouts.prompts import write_nvos, write_spin_nerf
from support.benchmark_layouts.rooms import (
    write_grouping_replica,
    write_replica,
    write_scannet,
    write_scannetpp,
)
from support.benchmark_layouts.source import Source, read_source
from support.benchmark_layouts.waymo import write_waymo
from support.benchmark_layouts.words import write_lerf_mask, write_lerf_ovs, write_ovs3d

WRITERS: Mapping[str, Callable[[Source, Path], None]] = {
    "nvos": write_nvos,
    "spin-nerf": write_spin_nerf,
    "lerf-mask": write_lerf_mask,
    "lerf-ovs": write_lerf_ovs,
    "3d-ovs": write_ovs3d,
    "replica": write_replica,
    "replica-gg": write_grouping_replica,
    "scannet": write_scannet,
    "scannetpp": write_scannetpp,
    "kitti360": write_kitti360,
    "waymo": write_waymo,
}

__all__ = ["WRITERS", "Source", "read_source", "write_layout"]


def write_layout(layout: str, scene: Path, folder: Path) -> Path:
    """Write a scene into a new or empty folder in a layout; the folder."""
    if folder.exists() and any(folder.iterdir()):
        raise FileExistsError(f"{folder}: expected a new folder, got one with files")
    folder.mkdir(parents=True, exist_ok=True)
    WRITERS[layout](read_source(scene), folder)
    return folder
