"""What is made of a document: labels, and files of a scene as it was edited.

Labels follow edits row by row.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import (
    UNLABELLED,
    Edited,
    InstanceFacts,
    Labels,
    LayerInfo,
    Scene,
)
from splatseg.errors import InputError, quoted
from splatseg.io.atomic import named_write_failures, path_inside
from splatseg.io.export.splats import holds_columns
from splatseg.io.scene import check_name, load_scene_layer, save_scene_layer, scene_layer_names
from splatseg.io.splats import WritableFormat
from splatseg.render import BackendName
from splatseg.tasks import ExportOptions, export_scene
from splatseg.tasks.work import EXPORTS_FOLDER, Observer, layer_versions
from splatseg.viewer._journal import command_to_json
from splatseg.viewer._state import (
    Command,
    Confidence,
    Document,
    Edit,
)

METHOD = "view"
"""Method of layers that are saved here."""

ExportWhat = Literal["splat", "objects", "points", "coco", "table"]

_LAYER = "objects"
_SUFFIXES: Mapping[str, str] = {"splat": ".ply", "points": ".ply", "table": ".csv"}


def labels_of(
    document: Document,
    owned: tuple[NDArray[np.int32], Confidence],
    scene: Scene,
    commands: Sequence[Command],
    *,
    ids: Sequence[int] | None = None,
) -> Labels:
    """The objects as labels of Gaussians, with their names, classes and colours.

    Args:
        document: Whose objects.
        owned: The id of the object of each Gaussian, -1 for none, and how sure it is of it.
        scene: The scene; its class table gives classes their ids.
        commands: What made the document, for the record.
        ids: Only these objects; None takes all.

    Raises:
        InputError: If there is no object, or none of an id.
    """
    chosen = document.objects if ids is None else [document.object(id) for id in ids]
    if not chosen:
        raise InputError("objects: expected at least one, got none; keep a selection first.")
    found, sure = owned
    rows = np.isin(found, [one.id for one in chosen])
    classes = _class_ids(document, scene)
    made = [command_to_json(command) for command in commands]
    return Labels(
        ids=torch.from_numpy(np.where(rows, found, UNLABELLED)),
        confidence=torch.from_numpy(np.where(rows, sure, 0)).float() / 255,
        info=LayerInfo(
            method=METHOD,
            names={one.id: one.name for one in chosen},
            class_of={one.id: classes[one.class_name] for one in chosen if one.class_name},
            instances={one.id: InstanceFacts(details={"source": one.source}) for one in chosen},
            versions=layer_versions(),
            details={
                "classes": {str(id): name for name, id in classes.items()},
                "colours": {str(one.id): list(one.colour) for one in chosen},
                "commands": [{"do": name, "arguments": arguments} for name, arguments in made],
            },
        ),
    )


def save(labels: Labels, root: Path, name: str) -> None:
    """Save labels as a layer of a scene folder.

    Raises:
        InputError: If a layer of this name is there that was not saved here.
    """
    if name in scene_layer_names(root) and load_scene_layer(root, name).info.method != METHOD:
        raise InputError(
            f"layer: {quoted(name)} is there already and was not saved here; choose another name."
        )
    save_scene_layer(labels, root, name)


def digest_of(scene: Scene) -> str:
    """Tells the Gaussians of a scene from those of others: a digest of their centres."""
    means = scene.gaussians.means.detach().cpu().float().contiguous().numpy()
    return hashlib.blake2b(means.astype("<f4").tobytes(), digest_size=16).hexdigest()


def _class_ids(document: Document, scene: Scene) -> dict[str, int]:
    """Ids of the classes in use: the scene's, and behind them those that it has not."""
    rows = () if scene.classes is None else scene.classes.rows
    known = {row.name: row.id for row in rows if row.id > 0}
    following = max((row.id for row in rows), default=0)
    found: dict[str, int] = {}
    for name in dict.fromkeys(one.class_name for one in document.objects if one.class_name):
        if name not in known:
            following = max(following, 0) + 1
            known[name] = following
        found[name] = known[name]
    return found


def exports_folder(scene: Scene, folder: Path | None) -> Path:
    """Where exports go: into the scene, else beside the journal.

    Raises:
        InputError: If there is neither.
    """
    root = scene.root if scene.root is not None else folder
    if root is None:
        raise InputError("export: expected a scene with a folder to write to; save it first.")
    with named_write_failures(root / EXPORTS_FOLDER):
        return path_inside(root, EXPORTS_FOLDER, "file").parent


def export(
    scene: Scene,
    labels: Labels | None,
    folder: Path,
    *,
    what: ExportWhat,
    name: str,
    format: WritableFormat | None,
    only: Sequence[int] | None,
    backend: BackendName,
    observer: Observer,
) -> Path:
    """Write a scene, or objects of it, as files of other programs; gives the file or folder.

    Args:
        scene: The scene, edited.
        labels: Its objects; None where there are none.
        folder: Where to write to.
        what: See `splatseg.export_scene`.
        name: Of the file; its ending says the format.
        format: Of splats, where the name does not say it.
        only: Ids of objects that are written alone; None writes everything.
        backend: Rendering backend.
        observer: Is told of the progress.

    Raises:
        InputError: If the name is none, or there is nothing to write: no object is left.
    """
    if only is not None and labels is not None and not bool((labels.ids != UNLABELLED).any()):
        raise InputError("export: nothing of these objects is left in the scene.")
    check_name("export", name)
    ending = f".{format.rstrip('3')}" if format is not None and what == "splat" else None
    path = folder / (name if "." in name else name + (ending or _SUFFIXES.get(what, "")))
    if labels is not None and only is not None and what in ("splat", "points"):
        rows = torch.isin(labels.ids, torch.tensor(only, dtype=labels.ids.dtype))
        scene, labels = replace(scene, gaussians=scene.gaussians[rows]), labels[rows]
    if what == "splat" and not holds_columns(path, format):
        labels = None
    made = export_scene(
        scene,
        path,
        what,
        options=ExportOptions(
            layer=None if labels is None else _LAYER, splat_format=format, split="all"
        ),
        layers={} if labels is None else {_LAYER: labels},
        backend=backend,
        observer=observer,
    )
    return made.output


def edit_records(edits: Sequence[Edit]) -> list[dict[str, Any]]:
    """Edits as the provenance of an edited scene has them."""
    return [
        {
            "kind": edit.kind,
            "gaussians": edit.mask.count,
            "mask": edit.mask.id,
            "rotation": list(edit.rotation),
            "translation": list(edit.translation),
            "scale": edit.scale,
            "about": list(edit.about),
            "colour": None if edit.colour is None else list(edit.colour),
        }
        for edit in edits
    ]


def edited_scene(scene: Scene, made: Edited, edits: Sequence[Edit]) -> Scene:
    """A scene with Gaussians after edits; without a folder, as its files are not of these."""
    if not edits:
        return scene
    provenance = dict(scene.provenance) | {"view_edits": edit_records(edits)}
    return replace(scene, gaussians=made.gaussians, provenance=provenance, root=None)
