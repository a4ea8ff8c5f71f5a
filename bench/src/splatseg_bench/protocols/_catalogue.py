"""The protocols that are known, with every choice that their authors state or their code shows."""

import difflib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

from splatseg.errors import InputError
from splatseg_bench.protocols._protocol import (
    MapSwitches,
    PointSwitches,
    Protocol,
    RoomSwitches,
    SceneList,
    SpokenSwitches,
    StreetSwitches,
    TargetSwitches,
)

_GAGA_SCANNET = (
    "scene0010_00", "scene0012_00", "scene0033_00", "scene0038_00", "scene0088_00",
    "scene0113_00", "scene0192_00",
)  # fmt: skip

SCENE_LISTS: Mapping[str, Mapping[str, SceneList]] = MappingProxyType(
    {
        "replica": MappingProxyType(
            {
                "dm-nerf": SceneList(
                    scenes=(
                        "office_0", "office_2", "office_3", "office_4", "room_0", "room_1",
                        "room_2",
                    ),
                    source="the README and configs/replica of vLAR-group/DM-NeRF",
                )
            }
        ),
        "scannet": MappingProxyType(
            {
                "dm-nerf": SceneList(
                    scenes=tuple(sorted((*_GAGA_SCANNET, "scene0024_00"))),
                    source="the README and configs/scannet of vLAR-group/DM-NeRF",
                ),
                "gaga": SceneList(scenes=_GAGA_SCANNET, source="Gaga (Lyu et al. 2024)"),
            }
        ),
    }
)  # fmt: skip
"""By layout of the data set, then by the name that a protocol's ``scene_list`` has."""


# CoSSegGaussians' experiments: two data sets, each in classes and in panoptic segments.
#
# What the paper says (Dou et al. 2024, section 4.1): seven scenes of each data set, "similar to"
# DM-NeRF; Replica as Semantic-NeRF rendered it; all test poses; mIoU, mAP at an IoU of 0.5, PQ over
# the scene, frames per second, learnable parameters. What it leaves open is a switch, or stands in
# the notes.


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


# Drives along streets as the paper of the mesh field has them: KITTI-360 and Waymo.
#
# What the paper says (Unifying Street Scene Point Cloud Semantic Segmentation with Deformable
# Mesh-based Neural Representation, section 4): mIoU of the points of lasers over 13 classes (Table
# 1), and PSNR, SSIM and mIoU of held-out views (Table 2); every second image of KITTI-360 is for
# testing, of Waymo every fifth. What it leaves open is a switch, or stands in the notes.


TABLE_1 = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign",
    "vegetation", "terrain", "car", "truck", "others",
)  # fmt: skip
"""Columns of the paper's Table 1."""

OTHERS = "others"
SKY = "sky"

MERGED: Mapping[str, str] = MappingProxyType(
    {
        **{name: name for name in (*TABLE_1, SKY)},
        # KITTI-360, as its authors train: kitti360scripts, trainId.
        "garage": "building", "gate": "fence", "smallpole": "pole",
        # Waymo.
        "lane marker": "road", "road marker": "road", "curb": "sidewalk",
        "construction cone pole": "pole", "sign": "traffic sign", "tree trunk": "vegetation",
    }
)  # fmt: skip
"""Column by name of a class, lower case; classes of other names are others."""

_NOT_SEEN = frozenset({"ego vehicle", "rectification border", "out of roi"})
"""Names of what no method is asked for."""

_NOT_SAID = (
    "the paper does not say which classes others are, how points without a label count, how large "
    "the ball of region voting is, or which two segments of each data set it has"
)


def _drive(name: str, tables: str, note: str) -> Protocol:
    return Protocol(
        name=name,
        summary="classes of the points of lasers and of held-out views of drives along streets",
        layouts=(name,),
        reference=f"Semantic DNMP (papers/002), {tables}",
        switches=StreetSwitches(),
        measure="miou",
        note=f"{note}; {_NOT_SAID}",
    )


STREETS = (
    _drive(
        "kitti360",
        "Tables 1 and 2",
        "every second frame is held out; Table 1 is taken to be of KITTI-360, for Waymo has no "
        "terrain, fence and wall",
    ),
    _drive("waymo", "Table 2", "every fifth frame is held out"),
)
"""Both of them."""


def merged_name(name: str) -> str | None:
    """The column of Table 1, or sky, that a class of some name counts as; None is void.

    Example:
        >>> merged_name("Lane marker"), merged_name("bus"), merged_name("ego vehicle")
        ('road', 'others', None)
    """
    name = name.strip().lower()
    return None if name in _NOT_SEEN else MERGED.get(name, OTHERS)


# The protocols that are known, each with every choice that its authors state or their code shows.
#
# What is stated where: `docs/benchmarks.md`.


CANONICAL_NEGATIVES = ("object", "things", "stuff", "texture")
"""Words that LERF holds every query against."""

_SPIN_SCENES = (
    "orchids", "leaves", "fern", "room", "horns", "fortress", "fork", "pinecone", "truck", "lego",
)  # fmt: skip
_OPEN_GAUSSIAN_SCENES = (
    "scene0000_00", "scene0062_00", "scene0070_00", "scene0097_00", "scene0140_00",
    "scene0200_00", "scene0347_00", "scene0400_00", "scene0590_00", "scene0645_00",
)  # fmt: skip
_LERF_OVS_SCENES = ("figurines", "ramen", "teatime", "waldo_kitchen")

_NYU40 = {
    19: (*range(1, 13), 14, 16, 24, 28, 33, 34, 36),
    15: (*range(1, 11), 12, 14, 16, 33, 34),
    10: (1, 2, 4, 5, 6, 7, 8, 9, 10, 33),
}
"""Ids of NYU's 40 classes that OpenGaussian scores, by how many they are."""

_NVOS = Protocol(
    name="nvos",
    summary="one object of a forward-facing scene by scribbles in one view, its mask in another",
    layouts=("nvos",),
    reference="Ren et al. 2022 (NVOS); pairs of views by fvdb's eval_nvos.py",
    switches=TargetSwitches(
        averaging="tasks", prompt="scribble", decided="pixels", silhouette_cut=0.5,
        boundary_ratio=0.02,
    ),
    measure="iou",
    scenes=("fern", "flower", "fortress", "horns", "leaves", "orchids", "trex"),
    note="target views are held out, as COB-GS has it; above 127 of 255 a mask is inside",
)  # fmt: skip
_SPIN_NERF = Protocol(
    name="spin-nerf",
    summary="the mask of one view carried to all annotated ones, which include it",
    layouts=("spin-nerf",),
    reference="Mirzaei et al. 2023; SA3D's authors on the reference view",
    switches=TargetSwitches(
        averaging="scenes", prompt="mask", scored_in_training=True, reference_scored=True,
        boundary_ratio=0.02,
    ),
    measure="iou",
    scenes=_SPIN_SCENES,
)  # fmt: skip
_SPIN_NERF_WORDS = Protocol(
    name="spin-nerf-words",
    summary="the object of SPIn-NeRF's masks asked for by words, in all annotated views",
    layouts=("spin-nerf",),
    reference="Prompt SA-GS (2024), Table 3",
    switches=SpokenSwitches(
        averaging="scenes",
        prompt="words",
        scored_in_training=True,
        boundary_ratio=0.02,
        negatives=CANONICAL_NEGATIVES,
        scene_words=(
            "truck:truck",
            "orchids:all of the flowers",
            "fortress:fortress",
            "pinecone:pine cone",
        ),
    ),
    measure="iou",
    scenes=("truck", "orchids", "fortress", "pinecone"),
    note="words of other scenes stand in their words.txt; those that begin with all mean "
    "everything that answers, others one thing",
)
_LERF_MASK = Protocol(
    name="lerf-mask",
    summary="objects by words in held-out views",
    layouts=("lerf-mask",),
    reference="Gaussian Grouping (Ye et al. 2024)",
    switches=TargetSwitches(
        averaging="scenes",
        prompt="words",
        boundary_ratio=0.02,
        answered="segments",
        segment_share=0.7,
        negatives=CANONICAL_NEGATIVES,
    ),
    measure="iou",
    scenes=("figurines", "ramen", "teatime"),
    note="the authors leave out prompts without a prediction; here they count as wrong",
)
_LERF_OVS_2D = Protocol(
    name="lerf-ovs-2d",
    summary="objects by words, decided in rendered pixels",
    layouts=("lerf-ovs",),
    reference="LangSplat (Qin et al. 2024)",
    switches=TargetSwitches(
        averaging="pairs", prompt="words", decided="pixels", scored_in_training=True,
        negatives=CANONICAL_NEGATIVES, temperature=10.0, box_filter=30, stretch=True,
        relevancy_cut=0.4, majority=7, localisation=True,
    ),
    measure="iou",
    scenes=_LERF_OVS_SCENES,
    note="the best of three levels where a method has levels; features of one level are one",
)  # fmt: skip
_LERF_OVS_3D = Protocol(
    name="lerf-ovs-3d",
    summary="objects by words, decided for Gaussians, whose silhouette is scored",
    layouts=("lerf-ovs",),
    reference="OpenGaussian (Wu et al. 2024)",
    switches=TargetSwitches(
        averaging="pairs", prompt="words", decided="gaussians", scored_in_training=True,
        negatives=CANONICAL_NEGATIVES, temperature=10.0, stretch=True, relevancy_cut=0.6,
        silhouette_cut=10 / 255, hits_at=(0.25, 0.5),
    ),
    measure="iou",
    scenes=_LERF_OVS_SCENES,
    note="how Gaussians are chosen is the method's own; the cut of 0.6 is LaGa's",
)  # fmt: skip
_OVS_3D = Protocol(
    name="3d-ovs",
    summary="objects of long-tail classes by words",
    layouts=("3d-ovs",),
    reference="Liu et al. 2023 (3D-OVS), pooled as LaGa has it",
    switches=TargetSwitches(
        averaging="pooled", prompt="words", scored_in_training=True,
        negatives=CANONICAL_NEGATIVES, stretch=True, relevancy_cut=0.4,
    ),
    measure="iou",
    scenes=("bed", "bench", "room", "lawn", "sofa"),
)  # fmt: skip


def _views(name: str, summary: str, layouts: tuple[str, ...], reference: str) -> Protocol:
    return Protocol(
        name=name,
        summary=summary,
        layouts=layouts,
        reference=reference,
        switches=MapSwitches(),
        measure="miou",
    )


def _gaga(name: str, layouts: tuple[str, ...], scenes: tuple[str, ...] = ()) -> Protocol:
    return Protocol(
        name=name,
        summary="instances of held-out views, matched over the scene",
        layouts=layouts,
        reference="Gaga (Lyu et al. 2024)",
        scenes=scenes,
        switches=MapSwitches(zero_is_instance=True),
        measure="instance_miou",
    )


def _points(classes: int) -> Protocol:
    return Protocol(
        name=f"scannet-{classes}",
        summary=f"{classes} classes of the vertices that Gaussians stay at",
        layouts=("scannet",),
        reference="OpenGaussian (Wu et al. 2024)",
        switches=PointSwitches(class_ids=_NYU40[classes], scored_in_training=True),
        measure="miou",
        scenes=_OPEN_GAUSSIAN_SCENES,
    )


PROTOCOLS: tuple[Protocol, ...] = (
    _NVOS,
    _SPIN_NERF,
    Protocol(
        name="spin-nerf-ludvig",
        summary="as spin-nerf, without the view of the prompt",
        layouts=("spin-nerf",),
        reference="LUDVIG (Marrie et al. 2024)",
        switches=TargetSwitches(
            averaging="scenes", prompt="mask", scored_in_training=True, threshold="reference",
            boundary_ratio=0.02,
        ),
        measure="iou",
        scenes=_SPIN_SCENES,
        note="LUDVIG leaves out view 14 of orchids as well, which is not done here",
    ),
    _SPIN_NERF_WORDS,
    _LERF_MASK,
    _LERF_OVS_2D,
    _LERF_OVS_3D,
    _OVS_3D,
    _views(
        "replica", "classes and instances of held-out views of Replica's rooms",
        ("replica", "replica-gg"),
        "Zhi et al. 2021 (Semantic-NeRF), CoSSegGaussians; PQ of Siddiqui et al. 2023",
    ),
    _gaga("replica-gaga", ("replica", "replica-gg")),
    _points(19),
    _points(15),
    _points(10),
    _views(
        "scannet-views", "classes and instances of held-out views of ScanNet's rooms", ("scannet",),
        "CoSSegGaussians; PQ of Siddiqui et al. 2023",
    ),
    _gaga("scannet-gaga", ("scannet",), SCENE_LISTS["scannet"]["gaga"].scenes),
    _views(
        "scannetpp", "classes of views, their truth rendered from the labelled mesh",
        ("scannetpp",),
        "the open-vocabulary voxel paper: mIoU and frequency-weighted IoU",
    ),
    *ROOMS,
    *STREETS,
)  # fmt: skip
"""All of them, in the order of the documentation."""


def find_protocol(name: str) -> Protocol:
    """The protocol of a name.

    Raises:
        InputError: If there is none.
    """
    known = {protocol.name: protocol for protocol in PROTOCOLS}
    if name in known:
        return known[name]
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(close)}?" if close else f"known: {', '.join(known)}."
    raise InputError(f"there is no protocol {name!r}; {hint}")
