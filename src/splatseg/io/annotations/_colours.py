"""Pictures of classes in colours, with the table beside them.

labelmap.txt, SegmentationClass/NAME.png       CVAT's segmentation mask 1.1, Pascal VOC
label_colors.txt, SPLITannot/NAME.png          CamVid
"""

from collections.abc import Sequence
from pathlib import Path

from splatseg.core import View
from splatseg.errors import FileFormatError, InputError
from splatseg.io.annotations._names import check_some, matched, unmatched_note
from splatseg.io.evidence import LabelEvidence, view_files
from splatseg.io.evidence._label_files import Palette
from splatseg.io.evidence._labels import IdRule
from splatseg.io.label_tables import label_table

_CLASSES = "SegmentationClass"
_CAMVID = "annot"
_TABLE_FILES = ("labelmap.txt", "label_colors.txt")


def picture_tables(folder: Path) -> tuple[Path, ...]:
    """The table of colours of a folder, or beside it where it is the folder of pictures itself."""
    places = (folder, folder.parent) if _holds_pictures(folder) else (folder,)
    return tuple(p / name for p in places for name in _TABLE_FILES if (p / name).is_file())[:1]


def class_pictures(folder: Path, views: Sequence[View], *, classes: str | None) -> LabelEvidence:
    """Label maps of the pictures of a folder, by the colours of its table.

    Raises:
        InputError: If a table was asked for besides, or no picture is of a view.
        FileFormatError: If the table is broken, or there are no pictures.
    """
    (path,) = picture_tables(folder)
    if classes is not None:
        raise InputError(f"classes: {path} names the classes of its pictures itself.")
    table = label_table(str(path))
    below = sorted(p for p in (folder, *folder.iterdir()) if p.is_dir() and _holds_pictures(p))
    found = [item for one in below for item in view_files(one, ".png").items()]
    names = [name for name, _ in found]
    if not found:
        raise FileFormatError(f"{path}: expected {_CLASSES} beside it with PNGs, got none.")
    indices = {name: i for i, name in enumerate(names)}
    if views:
        indices = matched([f"{name}.png" for name in names], views, where=str(folder))
        check_some(indices, names, views, where=str(folder))
    return LabelEvidence(
        root=folder,
        files={view: found[i][1] for view, i in indices.items()},
        table=table.classes,
        rule=IdRule(zero_is_class=table.zero_is_class),
        palette=Palette(table.classes),
        remarks=unmatched_note(names, indices),
    )


def _holds_pictures(folder: Path) -> bool:
    return folder.name == _CLASSES or folder.name.endswith(_CAMVID)
