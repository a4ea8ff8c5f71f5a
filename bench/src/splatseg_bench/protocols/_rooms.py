"""CoSSegGaussians' experiments: two data sets, each in classes and in panoptic segments.

What the paper says (Dou et al. 2024, section 4.1): seven scenes of each data set, "similar to"
DM-NeRF; Replica as Semantic-NeRF rendered it; all test poses; mIoU, mAP at an IoU of 0.5, PQ over
the scene, frames per second, learnable parameters. What it leaves open is a switch, or stands in
the notes.
"""

from typing import Literal

from splatseg_bench.protocols._protocol import Protocol
from splatseg_bench.protocols._scene_lists import SCENE_LISTS
from splatseg_bench.protocols._switches import RoomSwitches

_REFERENCE = "CoSSegGaussians (Dou et al. 2024), Table {}; PQ of Siddiqui et al. 2023"
_STUFF = ("wall", "floor", "ceiling")
_OPEN = (
    "fps are label maps drawn per second on the machine that measured; the paper does not say how "
    "ADE20K's classes became those of the truth (aliases), which classes are stuff, whether mAP50 "
    "is over classes, or what a megabyte is (here 1 000 000 bytes)"
)
_REPLICA_OPEN = (
    "of public code, not of the paper: the seven scenes are DM-NeRF's, the walk is Sequence_1, and "
    "the test poses are Semantic-NeRF's"
)
_SCANNET_OPEN = (
    "the paper has seven scenes without their names and DM-NeRF names eight, all of which are run; "
    "the split is Semantic-NeRF's, whose code trains on every 100th frame: every fifth of those "
    "that are read of a whole scan"
)
_TABLES: dict[Literal["semantic", "panoptic"], int] = {"semantic": 1, "panoptic": 2}


def _replica(task: Literal["semantic", "panoptic"]) -> Protocol:
    return Protocol(
        name=f"cosseg-replica-{task}",
        summary=f"{_asked(task)} of Replica's rooms, frames per second and learned bytes",
        layouts=("replica",),
        reference=_REFERENCE.format(_TABLES[task]),
        switches=RoomSwitches(task=task, scene_list="dm-nerf", sequence="Sequence_1", stuff=_STUFF),
        measure=_measure(task),
        scene_lists=SCENE_LISTS["replica"],
        note=f"{_REPLICA_OPEN}; {_OPEN}",
    )


def _scannet(task: Literal["semantic", "panoptic"]) -> Protocol:
    return Protocol(
        name=f"cosseg-scannet-{task}",
        summary=f"{_asked(task)} of ScanNet's rooms, frames per second and learned bytes",
        layouts=("scannet",),
        reference=_REFERENCE.format(_TABLES[task]),
        switches=RoomSwitches(task=task, scene_list="dm-nerf", stuff=_STUFF),
        measure=_measure(task),
        scene_lists=SCENE_LISTS["scannet"],
        note=f"{_SCANNET_OPEN}; {_OPEN}",
    )


def _asked(task: Literal["semantic", "panoptic"]) -> str:
    return "classes" if task == "semantic" else "panoptic segments"


def _measure(task: Literal["semantic", "panoptic"]) -> str:
    return "miou" if task == "semantic" else "pq_scene"


ROOMS = (_replica("semantic"), _replica("panoptic"), _scannet("semantic"), _scannet("panoptic"))
"""The four of them."""
