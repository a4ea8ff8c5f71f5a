"""LAS, and LAZ in both of its compressions: points in chunks, and chunks in layers."""

from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np

from splatseg.io.scans import read_scans
from support.fuzz.targets.base import Target, target

COUNT = 40


def write(file: Path, *, version: str, point_format: int) -> None:
    """A few points with classes, ids of objects and a record of our own."""
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales = np.full(3, 0.001)
    header.vlrs.append(laspy.VLR(user_id="someone", record_id=7, record_data=b"words"))
    header.add_extra_dim(laspy.ExtraBytesParams(name="class_id", type=np.int32))
    las = laspy.LasData(header)
    las.xyz = np.arange(3.0 * COUNT).reshape(COUNT, 3) % 7
    las.classification = np.arange(COUNT, dtype=np.uint8) % 5
    las["class_id"] = np.arange(COUNT, dtype=np.int32) % 3
    las.write(str(file))


def _target(name: str, *, version: str, point_format: int) -> Callable[[Path], Target]:
    @target(name)
    def make(folder: Path) -> Target:
        file = folder / f"a.{name[:3]}"
        write(file, version=version, point_format=point_format)

        def read() -> object:
            scans = read_scans(file)
            return [scans.scan(one) for one in scans.scan_names]

        return Target(file=file, read=read)

    return make


_target("las", version="1.4", point_format=6)
_target("laz", version="1.4", point_format=7)
_target("laz-points", version="1.2", point_format=3)
