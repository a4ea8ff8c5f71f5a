"""The protocols that are known, each with every choice that its authors state or their code shows.

What is stated where: `docs/benchmarks.md`.
"""

import difflib

from splatseg.errors import InputError
from splatseg_bench.protocols._protocol import Protocol
from splatseg_bench.protocols._rooms import ROOMS
from splatseg_bench.protocols._scene_lists import SCENE_LISTS
from splatseg_bench.protocols._streets import STREETS
from splatseg_bench.protocols._switches import (
    MapSwitches,
    PointSwitches,
    SpokenSwitches,
    TargetSwitches,
)

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
