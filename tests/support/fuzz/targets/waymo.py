"""Drives as Waymo publishes them: components in Parquet."""

from pathlib import Path

from splatseg.io.moving import read_moving
from splatseg.io.scans import read_scans
from splatseg_bench.layouts.waymo import read_waymo_scenes
from support.fuzz.targets.base import Target, target
from support.waymo_files import CONTEXT, SCHEMAS, write_segment


def _of_waymo(component: str) -> None:
    @target(f"waymo-{component}.parquet")
    def make(folder: Path) -> Target:
        write_segment(folder)

        def read() -> None:
            (scene,) = read_waymo_scenes(folder)
            for name in () if scene.semantic is None else scene.semantic.read:
                scene.semantic.read[name]()
            scans = read_scans(folder)
            for name in scans.scan_names:
                scans.scan(name)
            read_moving(folder)

        return Target(file=folder / component / f"{CONTEXT}.parquet", read=read)


for _component in SCHEMAS:
    _of_waymo(_component)
