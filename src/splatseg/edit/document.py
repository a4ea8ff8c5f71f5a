"""A scene with its layers, which edits change together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from splatseg.core import Edited, Layer, Scene, apply_rows
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, ShapeError
from splatseg.io.atomic import is_vacant
from splatseg.io.scene import load_scene, load_scene_layer, save_scene, scene_layer_names

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
