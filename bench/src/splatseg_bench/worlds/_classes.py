"""The class tables of the varied rooms and of the street."""

from splatseg.core import ClassInfo, ClassTable

_Row = tuple[str, bool, tuple[int, int, int]]


def _table(rows: tuple[_Row, ...]) -> ClassTable:
    return ClassTable(
        rows=tuple(
            ClassInfo(id=i + 1, name=name, isthing=thing, colour=colour)
            for i, (name, thing, colour) in enumerate(rows)
        )
    )


INTERIOR_CLASSES = _table(
    (
        ("wall", False, (174, 181, 196)),
        ("floor", False, (140, 96, 58)),
        ("ceiling", False, (232, 228, 214)),
        ("beam", False, (190, 160, 120)),
        ("column", False, (150, 140, 170)),
        ("window", True, (92, 190, 240)),
        ("door", True, (120, 70, 30)),
        ("table", True, (226, 190, 60)),
        ("chair", True, (64, 150, 76)),
        ("sofa", True, (46, 84, 190)),
        ("bed", True, (240, 160, 200)),
        ("shelf", True, (110, 66, 150)),
        ("cabinet", True, (170, 120, 60)),
        ("board", True, (250, 250, 250)),
        ("picture", True, (246, 132, 28)),
        ("curtain", True, (150, 210, 190)),
        ("rug", True, (198, 60, 74)),
        ("lamp", True, (255, 238, 110)),
        ("plant", True, (140, 220, 70)),
        ("monitor", True, (20, 24, 40)),
        ("keyboard", True, (90, 100, 110)),
        ("books", True, (30, 170, 160)),
        ("cushion", True, (206, 110, 220)),
        ("vase", True, (250, 130, 160)),
        ("bottle", True, (20, 110, 60)),
        ("mug", True, (130, 20, 40)),
        ("box", True, (196, 150, 100)),
        ("bin", True, (70, 70, 90)),
    )
)
"""The 28 classes of `varied_room`, ids 1 to 28: those of S3DIS, and small things."""

INTERIOR_RELATED = (
    ("wall", "ceiling", "column", "board", "door"),
    ("beam", "ceiling"),
    ("floor", "rug"),
    ("window", "curtain", "picture"),
    ("table", "cabinet", "shelf"),
    ("chair", "sofa", "bed"),
    ("books", "box", "shelf"),
    ("monitor", "picture", "board"),
    ("mug", "bottle", "vase"),
    ("lamp", "plant", "vase"),
    ("bin", "box"),
)

STREET_CLASSES = _table(
    (
        ("road", False, (128, 64, 128)),
        ("sidewalk", False, (244, 35, 232)),
        ("building", True, (70, 70, 70)),
        ("wall", False, (102, 102, 156)),
        ("fence", False, (190, 153, 153)),
        ("pole", True, (153, 153, 153)),
        ("lamp", True, (0, 64, 64)),
        ("traffic light", True, (250, 170, 30)),
        ("traffic sign", True, (220, 220, 0)),
        ("vegetation", False, (107, 142, 35)),
        ("terrain", False, (152, 251, 152)),
        ("person", True, (220, 20, 60)),
        ("rider", True, (255, 0, 0)),
        ("car", True, (0, 0, 142)),
        ("truck", True, (0, 0, 70)),
        ("bicycle", True, (119, 11, 32)),
        ("trash bin", True, (130, 130, 0)),
    )
)
"""The 17 classes of `street`, ids 1 to 17, named and coloured as KITTI-360's."""

STREET_RELATED = (
    ("road", "sidewalk", "terrain"),
    ("building", "wall", "fence"),
    ("pole", "lamp", "traffic sign", "traffic light"),
    ("vegetation", "terrain"),
    ("person", "rider", "bicycle"),
    ("car", "truck"),
    ("trash bin", "wall"),
)
