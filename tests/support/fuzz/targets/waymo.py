"""Drives as Waymo publishes them: components in Parquet, and frames of version 1."""

from pathlib import Path

from splatseg.errors import FileFormatError, InputError
from splatseg.io.captures import read_capture
from splatseg.io.moving import read_moving
from splatseg.io.scans import read_scans
from splatseg_bench.layouts.waymo import read_waymo_scenes
from support.fuzz.targets.base import Target, target
from support.waymo_files import CONTEXT, SCHEMAS, tiny_rows, write_segment
from support.waymo_tfrecord import framed, frames_of, write_tfrecord


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


@target("waymo.tfrecord")
def tfrecord(folder: Path) -> Target:
    """Frames of version 1."""
    file = write_tfrecord(folder, tiny_rows())

    def read() -> None:
        read_capture(file)
        scans = read_scans(file)
        for name in scans.scan_names:
            scans.scan(name)
        read_moving(file)

    return Target(file=file, read=read)


@target("waymo-frame.tfrecord")
def frame(folder: Path) -> Target:
    """A frame whose checksums are those of its damaged bytes."""
    file, framed_file = folder / "frame", folder / "a.tfrecord"
    file.write_bytes(frames_of(tiny_rows())[0])

    def read() -> None:
        framed_file.write_bytes(framed(file.read_bytes()))
        try:
            read_scans(framed_file)
            read_moving(framed_file)
        except InputError as error:  # of another file than the one that is damaged
            raise FileFormatError(f"{file}: {error}") from error

    return Target(file=file, read=read)
