"""One function a format: it writes a small sound file and says which file is damaged and read."""

from support.fuzz.targets import (
    annotations,
    benchmarks,
    captures,
    evidence,
    kitti,
    lasers,
    networks,
    own,
    pictures,
    pointmaps,
    points,
    splats,
    surfaces,
    waymo,
)
from support.fuzz.targets.base import TARGETS, Target

__all__ = [
    "TARGETS",
    "Target",
    "annotations",
    "benchmarks",
    "captures",
    "evidence",
    "kitti",
    "lasers",
    "networks",
    "own",
    "pictures",
    "pointmaps",
    "points",
    "splats",
    "surfaces",
    "waymo",
]
