"""Classes of streets by the names of other data sets."""

import pytest

from splatseg.evaluate import street_class
from splatseg.io.captures.waymo import CAMERA_CLASSES, LIDAR_CLASSES
from splatseg.io.label_tables import label_table
from splatseg_bench.layouts.kitti360 import EVALUATED
from splatseg_bench.protocols import TABLE_1

KITTI = [row.name for row in EVALUATED.rows]
CAMERA = [row.name for row in CAMERA_CLASSES.rows]
LIDAR = [row.name for row in LIDAR_CLASSES.rows]
CITYSCAPES = [row.name for row in label_table("cityscapes-train").classes.rows]
SEMANTIC_KITTI = [row.name for row in label_table("semantic-kitti-train").classes.rows]


def matched(own, true) -> dict[str, str | None]:
    """What classes of one table are in another, those of the same name left out."""
    pairs = {name: street_class(name, true, own) for name in own}
    return {name: other for name, other in pairs.items() if other != name}


def test_the_tables_of_streets_match_as_their_authors_define_them() -> None:
    assert len(KITTI) == 19
    assert matched(CITYSCAPES, KITTI) == {}
    assert matched(CITYSCAPES, CAMERA) == {
        "wall": "building", "fence": "building", "traffic sign": "sign", "terrain": "ground",
        "person": "pedestrian", "rider": "cyclist", "train": "other large vehicle",
    }  # fmt: skip
    assert matched(CITYSCAPES, LIDAR) == {
        "wall": "building", "fence": "building", "traffic sign": "sign", "terrain": "walkable",
        "sky": None, "person": "pedestrian", "rider": "bicyclist", "train": "other vehicle",
    }  # fmt: skip
    assert matched(LIDAR, KITTI) == {
        "other vehicle": None, "motorcyclist": "rider", "bicyclist": "rider",
        "pedestrian": "person", "sign": "traffic sign", "construction cone": None,
        "tree trunk": "vegetation", "curb": "sidewalk", "lane marker": "road",
        "other ground": None, "walkable": "terrain",
    }  # fmt: skip
    assert matched(LIDAR, CAMERA) == {
        "other vehicle": "other large vehicle", "bicyclist": "cyclist",
        "construction cone": "construction cone pole", "tree trunk": "vegetation",
        "curb": "sidewalk", "other ground": None, "walkable": "ground",
    }  # fmt: skip
    assert matched(SEMANTIC_KITTI, KITTI) == {
        "other-vehicle": "bus", "bicyclist": "rider", "motorcyclist": "rider", "parking": None,
        "other-ground": None, "trunk": "vegetation", "traffic-sign": "traffic sign",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "true", "own", "found"),
    [
        (" Traffic_Sign ", ["sign"], [], "sign"),
        ("moving-car", ["car"], [], "car"),
        ("moving-person", ["Pedestrian"], [], "Pedestrian"),
        ("bus", ["other vehicle", "bus"], [], "bus"),
        ("bus", ["other vehicle"], [], "other vehicle"),
        ("other vehicle", ["bus"], ["other vehicle"], "bus"),
        ("other vehicle", ["bus"], ["other vehicle", "bus"], None),
        ("gate", ["building", "fence"], [], "fence"),
        ("gate", ["building"], [], "building"),
        ("ground", ["terrain"], ["ground"], "terrain"),
        ("ground", ["terrain"], ["ground", "terrain"], None),
        ("lane marking", ["road", "lane marker"], [], "lane marker"),
        ("lane marking", ["road"], ["lane marking", "road"], "road"),
        ("other ground", ["terrain", "road"], [], None),
        ("static", ["building"], [], None),
        ("", ["road"], [], None),
    ],
)
def test_names_and_parts(name, true, own, found) -> None:
    assert street_class(name, true, own) == found


def test_columns_of_the_paper_are_their_own() -> None:
    assert all(street_class(name, TABLE_1) == name for name in TABLE_1)
