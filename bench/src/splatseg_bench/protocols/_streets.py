"""Drives along streets as the paper of the mesh field has them: KITTI-360 and Waymo.

What the paper says (Unifying Street Scene Point Cloud Semantic Segmentation with Deformable
Mesh-based Neural Representation, section 4): mIoU of the points of lasers over 13 classes (Table
1), and PSNR, SSIM and mIoU of held-out views (Table 2); every second image of KITTI-360 is for
testing, of Waymo every fifth. What it leaves open is a switch, or stands in the notes.
"""

from collections.abc import Mapping
from types import MappingProxyType

from splatseg_bench.protocols._protocol import Protocol
from splatseg_bench.protocols._switches import StreetSwitches

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

_OPEN = (
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
        note=f"{note}; {_OPEN}",
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
