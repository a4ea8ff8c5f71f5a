"""A scene with its layers, and one edit of it in words that a file can hold."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, cast

import torch

from splatseg.core import Edited, Layer, Scene, Similarity, apply_rows
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.json_values import plain_object
from splatseg.core.options import Count, Natural
from splatseg.errors import InputError, ShapeError
from splatseg.io.atomic import is_vacant
from splatseg.io.scene import load_scene, load_scene_layer, save_scene, scene_layer_names
from splatseg.io.schema import structured
from splatseg.lift.boundaries.cut import CutOptions
from splatseg.selection import Where

_Three = tuple[float, float, float]
Kind = Literal["extract", "remove", "duplicate", "transform", "recolour", "merge", "split"]

_TAKES: dict[str, tuple[set[str], set[str]]] = {
    "extract": ({"where"}, {"cut"}),
    "remove": ({"where"}, {"cut", "specks", "refit", "fill"}),
    "split": ({"where", "cut"}, set()),
    "duplicate": ({"where", "transform"}, {"cut"}),
    "transform": ({"transform"}, {"where", "cut"}),
    "recolour": ({"recolour"}, {"where", "cut"}),
    "merge": ({"other"}, {"transform"}),
}
"""What each kind must have and may have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CutBy:
    """How Gaussians at the boundary of what is selected are split before the edit."""

    by: Literal["masks", "layer", "box"]
    """The boundary: that of recorded label maps, of label maps that the layer itself draws in
    the views, or of the box."""

    evidence: str | None = None
    """Name of the label maps, for masks."""

    zero_is_class: bool = False
    """How the label maps are opened, for masks: see `open_evidence`."""

    views: tuple[str, ...] = ()
    """Names of the views whose pixels count."""

    options: CutOptions = field(default_factory=CutOptions)
    """Which Gaussians are split, and how."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FillBy:
    """How surfaces that a removed thing hid are continued."""

    views: tuple[str, ...]
    """Names of the views that saw the scene."""

    inpainter: str = "exemplar"
    """Name of the model that paints them, see `find_inpainter`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recolour:
    """Arguments of `recolour`."""

    colour: _Three | None = None
    """Red, green, blue in [0, 1] that the mean colour becomes."""

    scale: _Three = (1.0, 1.0, 1.0)
    """Factor of each channel."""

    shift: _Three = (0.0, 0.0, 0.0)
    """Added to each channel."""

    view_dependent: bool = True
    """Whether what changes with the direction stays."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Operation:
    """One edit of a scene with its layers."""

    kind: Kind
    where: Where | None = None
    """What it is of; None is everything, for kinds that allow it."""

    transform: Similarity | None = None
    """``target_from_source``; of the other scene, for a merge."""

    recolour: Recolour | None = None
    other: str | None = None
    """Folder of the scene to merge."""

    cut: CutBy | None = None
    """How what straddles the boundary is split first; None splits nothing."""

    specks: Natural | None = None
    """Most Gaussians of a piece that goes along because it touches nothing but what is removed;
    None leaves all pieces."""

    refit: Count | None = None
    """Steps of a fit that makes what is removed opaque and separate first; None leaves it out."""

    fill: FillBy | None = None
    """How what it hid is completed; None leaves holes."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.kind not in _TAKES:
            raise InputError(f"operation: expected one of {', '.join(_TAKES)}, got {self.kind!r}.")
        must, may = _TAKES[self.kind]
        given = {
            name for name in [f.name for f in fields(self)][1:] if getattr(self, name) is not None
        }
        for name in sorted(must - given):
            raise InputError(f"{self.kind}: expected {name}, got none.")
        for name in sorted(given - must - may):
            raise InputError(f"{self.kind}: takes no {name}.")
        if self.cut is not None and self.where is None:
            raise InputError(f"{self.kind}: expected where to cut, got none.")

    def to_json(self) -> dict[str, Any]:
        """As values that JSON holds. Inverse of `from_json`."""
        moved = None
        if self.transform is not None:
            moved = {
                "rotation": self.transform.rotation.double().tolist(),
                "translation": self.transform.translation.double().tolist(),
                "scale": float(self.transform.scale),
            }
        content = {
            "kind": self.kind,
            "where": None if self.where is None else self.where.to_json(),
            "transform": moved,
            "recolour": None
            if self.recolour is None
            else plain_object("recolour", asdict(self.recolour)),
            "other": self.other,
            "cut": self.cut and plain_object("cut", asdict(self.cut)),
            "specks": self.specks,
            "refit": self.refit,
            "fill": self.fill and plain_object("fill", asdict(self.fill)),
        }
        return {name: value for name, value in content.items() if value is not None}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "Operation":
        """Read what `to_json` wrote; keys under ``result`` are left aside.

        Raises:
            InputError: If it is no operation.
        """
        unknown = sorted(set(content) - {f.name for f in fields(cls)} - {"result"})
        if unknown:
            raise InputError(f"operation: expected the keys of an edit, got {unknown[0]!r}.")
        record = structured(content, _Record, where="operation")
        moved = record.transform
        return cls(
            kind=cast("Kind", record.kind),
            where=None if record.where is None else where_from_json(record.where),
            transform=None if moved is None else moved.similarity(),
            recolour=record.recolour,
            other=record.other,
            cut=record.cut,
            specks=record.specks,
            refit=record.refit,
            fill=record.fill,
        )


def where_from_json(content: Mapping[str, Any]) -> Where:
    """Inverse of `Where.to_json`.

    Raises:
        InputError: If it is nothing that it writes.
    """
    return structured(_finished(content), Where, where="where")


def _finished(content: Mapping[str, Any]) -> dict[str, Any]:
    """A description with infinity where JSON has null, as it knows no infinity."""
    known = [f.name for f in fields(Where)]
    unknown = sorted(set(content) - set(known))
    if unknown:
        # What is not understood would select something else.
        raise InputError(f"where: expected {', '.join(known)}, got {unknown[0]!r}.")
    found = dict(content)
    for name in ("opacity", "size"):
        match found.get(name):
            case [low, None]:
                found[name] = [low, math.inf]
            case _:
                pass
    parts: Any = found.get("any_of")
    if isinstance(parts, list):
        found["any_of"] = [
            _finished(cast("Mapping[str, Any]", part)) if isinstance(part, Mapping) else part
            for part in cast("list[Any]", parts)
        ]
    return found


@dataclass(frozen=True, slots=True)
class _Transform:
    """A similarity as JSON has it."""

    rotation: tuple[_Three, _Three, _Three]
    translation: _Three
    scale: float = 1.0

    def similarity(self) -> Similarity:
        return Similarity(
            rotation=torch.tensor(self.rotation, dtype=torch.float64),
            translation=torch.tensor(self.translation, dtype=torch.float64),
            scale=self.scale,
        )


@dataclass(frozen=True, slots=True)
class _Record:
    """An operation as JSON has it."""

    kind: str
    where: dict[str, Any] | None = None
    transform: _Transform | None = None
    recolour: Recolour | None = None
    other: str | None = None
    cut: CutBy | None = None
    specks: int | None = None
    refit: int | None = None
    fill: FillBy | None = None


# A scene with its layers, which edits change together.


HISTORY = "edits"
"""Key of the provenance that holds the operations, first to last."""

BASE = "edited_from"
"""Key of the provenance that holds where the scene was before the first of them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Document:
    """A scene and its layers by name, one row a Gaussian in each."""

    scene: Scene
    layers: Mapping[str, Layer] = field(default_factory=dict[str, Layer])

    def __post_init__(self) -> None:
        convert_fields(self)
        count = len(self.scene.gaussians)
        for name, layer in self.layers.items():
            if len(layer) != count:
                raise ShapeError(
                    f"layers[{name!r}]: expected {count} rows, one a Gaussian, got {len(layer)}."
                )

    @property
    def history(self) -> tuple[Mapping[str, Any], ...]:
        """The operations that made it, as in the scene's provenance, first to last."""
        return tuple(self.scene.provenance.get(HISTORY, ()))

    def edited(self, edited: Edited) -> "Document":
        """The document after an edit of its Gaussians; layers follow."""
        return Document(
            scene=replace(self.scene, gaussians=edited.gaussians),
            layers={name: apply_rows(layer, edited) for name, layer in self.layers.items()},
        )


@boundary
def load_document(root: Path | str, *, data: Path | str | None = None) -> Document:
    """Read a scene folder with all its layers.

    Raises:
        MissingFileError: If there is no scene.
        FileFormatError: If a file of it is broken, or a layer is of other Gaussians.
    """
    scene = load_scene(root, data=data)
    names = scene_layer_names(root)
    return Document(scene=scene, layers={name: load_scene_layer(root, name) for name in names})


@boundary
def save_document(
    document: Document, root: Path | str, *, evidence: Sequence[Path] = ()
) -> Document:
    """Write a new scene folder with its layers, whole or not at all.

    Args:
        document: The scene and its layers.
        root: The folder to write.
        evidence: Folders of evidence of the same photographs, copied under their own names.

    Raises:
        InputError: If something is there already: edits write new scenes.
    """
    root = Path(root)
    if root.exists() and not (root.is_dir() and is_vacant(root)):
        raise InputError(
            f"{root}: expected a new folder, got one that is there; an edit never overwrites."
        )
    scene = save_scene(document.scene, root, layers=document.layers, evidence=evidence)
    return replace(document, scene=scene)
