"""What classes of streets are called in data sets, to match those of label maps with a truth's.

Facts are those that the data sets publish: the labels of Cityscapes and KITTI-360, the comments of
Waymo's camera_segmentation.proto and segmentation.proto ("permanent building and walls, including
solid fences", "paved walkable surface for pedestrians, including curbs"), SemanticKITTI's labels.
Names that data sets give to different things (other ground, static, dynamic, object) have no row.
"""

from collections.abc import Collection, Mapping
from types import MappingProxyType

from splatseg.core.boundary import boundary

_SAME: tuple[tuple[str, ...], ...] = (
    ("traffic sign", "sign"),
    ("terrain", "ground", "walkable"),
    ("person", "pedestrian"),
    ("rider", "cyclist", "bicyclist"),
    ("bicycle", "bike"),
    ("motorcycle", "motorbike"),
    ("other vehicle", "other large vehicle"),
    ("train", "on rails"),
    ("lane marker", "lane marking"),
    ("tree trunk", "trunk"),
    ("construction cone", "construction cone pole"),
)
"""Names of one class, or of classes that are mostly the same things."""

_PARTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "lane marker": ("road",),
        "lane marking": ("road",),
        "road marker": ("road",),
        "curb": ("sidewalk",),
        "tree trunk": ("vegetation",),
        "trunk": ("vegetation",),
        "wall": ("building",),
        "fence": ("building",),
        "gate": ("fence", "building"),
        "garage": ("building",),
        "smallpole": ("pole",),
        "polegroup": ("pole",),
        "motorcyclist": ("rider",),
        "bus": ("other vehicle", "other large vehicle"),
        "train": ("other vehicle", "other large vehicle"),
        "on rails": ("other vehicle", "other large vehicle"),
        "caravan": ("other vehicle", "other large vehicle"),
        "trailer": ("other vehicle", "other large vehicle"),
    }
)
"""What a class is a part of where a truth has no such class by itself."""

_MOSTLY: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"other vehicle": ("bus",), "other large vehicle": ("bus",)}
)
"""What a class is most often where neither it nor a name of its own is in a truth."""

_MOVING = "moving "
"""SemanticKITTI's classes of what moves begin so."""


@boundary
def street_class(name: str, true: Collection[str], own: Collection[str] = ()) -> str | None:
    """The class of a truth that a class of a label map is, by its name.

    A name that both have is one class; capitals, hyphens and underscores do not matter. Else it is
    another name of the same class, unless the label map tells that class apart itself; else the
    class that it is a part of.

    Args:
        name: Of the label map's class.
        true: Names of the truth's classes.
        own: Names of the label map's classes.

    Returns:
        A name of the truth, or None where it has no such class.

    Example:
        >>> street_class("sign", ["road", "traffic sign"]), street_class("lane-marking", ["road"])
        ('traffic sign', 'road')
        >>> street_class("ground", ["terrain"], own=["ground", "terrain"]) is None
        True
    """
    known = {_plain(other): other for other in true}
    plain = _plain(name)
    if plain in known:
        return known[plain]
    if plain.startswith(_MOVING):
        return street_class(plain.removeprefix(_MOVING), true, own)
    apart = {_plain(other) for other in own}
    same = [other for group in _SAME if plain in group for other in group if other != plain]
    chain = (
        *(other for other in same if other not in apart),
        *_PARTS.get(plain, ()),
        *(other for other in _MOSTLY.get(plain, ()) if other not in apart),
    )
    return next((known[other] for other in chain if other in known), None)


def _plain(name: str) -> str:
    return " ".join(name.lower().replace("-", " ").replace("_", " ").split())
