"""Tells which tool wrote a file or folder of annotations, and opens it; or says what to export."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from splatseg.core import View
from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError, InputError, MissingFileError, quoted
from splatseg.io.annotations._base import Annotations, evidence_of, pictures_of_views
from splatseg.io.annotations._coco import (
    coco_dataset,
    coco_results,
    is_dataset,
    is_results,
    named_by,
)
from splatseg.io.annotations._drawn import (
    cvat_annotations,
    is_label_studio,
    is_labelme,
    label_studio_annotations,
    labelme_annotations,
)
from splatseg.io.evidence import Evidence, LabelEvidence, view_files
from splatseg.io.evidence._base import HEADER_FILE
from splatseg.io.evidence._labels import IdRule, Palette
from splatseg.io.foreign import expect
from splatseg.io.json_files import read_json_value
from splatseg.io.label_tables import label_table

_CLASSES = "SegmentationClass"
_CAMVID = "annot"
_TABLE_FILES = ("labelmap.txt", "label_colors.txt")

_OPENED = frozenset({".json", ".npy", ".npz", ".png", ".tif", ".tiff", ".xml"})
"""Suffixes of files that hold evidence of some kind."""

_FOREIGN = frozenset(
    {".zip", ".pkl", ".pickle", ".pth", ".pt", ".csv", ".tsv", ".txt", ".h5", ".mat"}
)
"""Suffixes in which annotations come that are not read."""

_NOT_READ = (
    "files are not read; export COCO, CVAT for images, labelme, Label Studio's JSON or PNG label "
    "maps (docs/models.md has a table)"
)
_OF_ONE_VIEW = frozenset({".npy", ".npz", ".png", ".tif", ".tiff"})
_TABLES = frozenset({HEADER_FILE, "segments.json", "tracks.json", "legend.json", "metadata.json"})
_WHOLE = "annotations"
"""Folder of the files of a whole data set."""


@boundary
def open_annotations(
    path: Path | str, *, views: Sequence[View] = (), classes: str | None = None
) -> Evidence | None:
    """Annotations of another tool as evidence; None where a folder holds none.

    COCO (instances, panoptic, results of Detectron2), CVAT for images, labelme, Label Studio, and
    pictures of classes in the colours of a table beside them (CVAT's segmentation masks, CamVid).
    Pictures are matched with views by name, then by stem.

    Args:
        path: The file, or the folder that was exported.
        views: The views of the scene; without them every picture is a view by its own name.
        classes: Names of the ids where the file has none, see `label_table`.

    Raises:
        MissingFileError: If there is neither.
        InputError: If it cannot be told which file is meant, or no picture is of a view.
        FileFormatError: If it is broken, or holds no masks; the message says what to export.
    """
    path = Path(path)
    if not path.exists():
        raise MissingFileError(f"{path}: there is no such file or folder.")
    if path.is_dir():
        if (path / HEADER_FILE).is_file():
            return None
        if picture_tables(path):
            return _class_pictures(path, views, classes=classes)
    annotations = _of_folder(path) if path.is_dir() else _of_file(path)
    if annotations is None:
        return None
    if classes is not None:
        if annotations.classes is not None:
            raise InputError(f"classes: {path} names its classes itself.")
        annotations = named_by(annotations, label_table(classes).classes)
    return evidence_of(annotations, views)


def _of_file(path: Path) -> Annotations:
    suffix = path.suffix.lower()
    if suffix == ".xml":
        return cvat_annotations(path)
    if suffix == ".json":
        found = _of_json(path, read_json_value(path))
        if found is None:
            raise FileFormatError(
                f"{path}: expected annotations (COCO, Label Studio, labelme), got another JSON; "
                "masks of one view are read with the folder of all views, VIEW.json each, and "
                "docs/models.md says what other tools export."
            )
        return found
    what = "a folder with a file a view, or annotations of all views in one JSON or XML, got one "
    what += f"{suffix} file; give the folder"
    expect(suffix not in _OF_ONE_VIEW, path, what, error=InputError)
    raise InputError(f"{path}: annotations in {suffix or 'such'} {_NOT_READ}.")


def _of_folder(folder: Path) -> Annotations | None:
    documents = sorted(folder.glob("*.xml"))
    whole = sorted((folder / _WHOLE).glob("*.json"))
    objects = whole or sorted(p for p in folder.glob("*.json") if p.name not in _TABLES)
    if documents and not objects:
        return cvat_annotations(_only(documents))
    if not objects:
        deeper = sorted(p for p in folder.rglob("*.json") if p.name not in _TABLES)
        if deeper and is_labelme(read_json_value(deeper[0])):
            return labelme_annotations(folder, deeper)
        # A folder of nothing but files that are known and not read.
        suffixes = set() if deeper else {p.suffix.lower() for p in folder.rglob("*") if p.is_file()}
        foreign = sorted(suffixes & _FOREIGN) if suffixes.isdisjoint(_OPENED) else []
        what = f"{folder}: annotations in {', '.join(foreign)} {_NOT_READ}."
        if foreign:
            raise InputError(what)
        return None
    # Label maps lie beside tables of their own; only a file of segments means them.
    if not whole and any(folder.glob("*.png")):
        objects = [p for p in objects if p.stem in ("panoptic", "predictions")]
        if not objects:
            return None
    first = read_json_value(objects[0])
    if is_labelme(first):
        return labelme_annotations(folder, sorted(folder.rglob("*.json")))
    if _is_of_one_view(first):
        return None
    contents = {path: read_json_value(path) for path in objects[1:]} | {objects[0]: first}
    results = [path for path, content in contents.items() if is_results(content)]
    if results:
        return _results(_only(results), contents)
    known = [p for p, content in contents.items() if any(tells(content) for tells, _ in _TOOLS)]
    if not known:
        return None
    path = _only(sorted(known))
    return _of_json(path, contents[path])


def _labelme_file(path: Path, _: Any) -> Annotations:
    return labelme_annotations(path, [path])


_TOOLS: tuple[tuple[Callable[[object], bool], Callable[[Path, Any], Annotations]], ...] = (
    (is_label_studio, label_studio_annotations),
    (is_dataset, coco_dataset),
    (is_labelme, _labelme_file),
)
"""How the JSON of a tool is told and read, in the order in which they are looked for."""


def _of_json(path: Path, content: Any) -> Annotations | None:
    if is_results(content):
        beside = {p: read_json_value(p) for p in sorted(path.parent.glob("*.json")) if p != path}
        return _results(path, beside | {path: content})
    return next((read(path, content) for tells, read in _TOOLS if tells(content)), None)


def _results(path: Path, contents: dict[Path, Any]) -> Annotations:
    datasets = [p for p, content in contents.items() if is_dataset(content)]
    dataset = contents[_only(sorted(datasets))] if datasets else None
    return coco_results(path, contents[path], dataset)


def _is_of_one_view(content: Any) -> bool:
    """Whether a JSON value is the masks of one picture, as SAM and we write them."""
    if isinstance(content, list):
        first: object = content[0] if content else {}
        return isinstance(first, dict) and not is_results(content) and "segmentation" in first
    return isinstance(content, dict) and ("masks" in content or "image" in content)


def _only(files: Sequence[Path]) -> Path:
    if len(files) != 1:
        names = ", ".join(quoted(path.name) for path in files[:3])
        more = ", ..." if len(files) > 3 else ""
        raise InputError(
            f"{files[0].parent}: expected one file of annotations, got {len(files)} "
            f"({names}{more}): give the one that is meant."
        )
    return files[0]


def picture_tables(folder: Path) -> tuple[Path, ...]:
    """The table of colours of a folder of pictures of classes, or beside it where it is one.

    labelmap.txt, SegmentationClass/NAME.png       CVAT's segmentation mask 1.1, Pascal VOC
    label_colors.txt, SPLITannot/NAME.png          CamVid
    """
    places = (folder, folder.parent) if _holds_pictures(folder) else (folder,)
    return tuple(p / name for p in places for name in _TABLE_FILES if (p / name).is_file())[:1]


def _class_pictures(folder: Path, views: Sequence[View], *, classes: str | None) -> LabelEvidence:
    """Label maps of the pictures of a folder, by the colours of its table."""
    (path,) = picture_tables(folder)
    if classes is not None:
        raise InputError(f"classes: {path} names the classes of its pictures itself.")
    table = label_table(str(path))
    below = sorted(p for p in (folder, *folder.iterdir()) if p.is_dir() and _holds_pictures(p))
    found = [item for one in below for item in view_files(one, ".png").items()]
    expect(found, path, f"{_CLASSES} beside it with PNGs, got none")
    names = [f"{name}.png" for name, _ in found]
    indices, notes = pictures_of_views(names, views, where=str(folder))
    return LabelEvidence(
        folder=folder,
        files={view: found[i][1] for view, i in indices.items()},
        table=table.classes,
        rule=IdRule(zero_is_class=table.zero_is_class),
        palette=Palette(table.classes),
        remarks=notes,
    )


def _holds_pictures(folder: Path) -> bool:
    return folder.name == _CLASSES or folder.name.endswith(_CAMVID)
