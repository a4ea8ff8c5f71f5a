"""``splatseg export``: Gaussians in a file of other tools, with their labels as columns."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from torch import Tensor

from splatseg.cli._legend import colour_of, names_of
from splatseg.cli._work import layer_of, open_scene
from splatseg.core import UNLABELLED, Labels, Scene, Selection
from splatseg.errors import InputError
from splatseg.io._json import write_json
from splatseg.io.splats import write_splats

_NONE = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Write the Gaussians with their labels: a file that other tools open.

    A PLY gets the columns class_id, instance_id (int32, 0 for none) and confidence (float32),
    and a table of what the ids mean beside it, FILE.json. Other formats hold no such columns.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """The scene folder."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
    """File to write: .ply, or without labels .compressed.ply, .splat, .spz."""

    layer: str | None = None
    """Layer of labels for class_id and confidence; a selection becomes the column selected."""

    instances: str | None = None
    """Layer of labels for instance_id and instance_confidence."""


def run(command: Command) -> None:
    """Export a scene."""
    scene = open_scene(command.scene, None)
    columns: dict[str, Tensor] = {}
    table: dict[str, Any] = {}
    for name, kind in ((command.layer, "class"), (command.instances, "instance")):
        if name is not None:
            _add_layer(scene, name, kind, columns, table)
    if not command.output.parent.is_dir():
        raise InputError(f"{command.output}: expected an existing folder to write in.")
    if columns and not _holds_columns(command.output):
        raise InputError(f"{command.output}: labels need a .ply file, other formats drop them.")
    extra = dict(scene.gaussians.extra) | columns
    write_splats(scene.gaussians.replace(extra=extra), command.output)
    lines = f"{len(scene.gaussians)} Gaussians in {command.output}\n"
    if table:
        beside = command.output.with_suffix(".json")
        write_json(beside, {"gaussians": len(scene.gaussians), "columns": table})
        lines += f"what the ids mean in {beside}\n"
    sys.stdout.write(lines)


def _add_layer(
    scene: Scene, name: str, kind: str, columns: dict[str, Tensor], table: dict[str, Any]
) -> None:
    layer = layer_of(scene, name)
    if isinstance(layer, Selection):
        columns["selected"] = layer.mask.to(torch.int32)
        table["selected"] = {"layer": name, "meaning": "1 for selected Gaussians, 0 for others"}
        return
    if not isinstance(layer, Labels):
        raise InputError(f"--layer: {name} holds features, which have no ids to write.")
    confidence = "confidence" if kind == "class" else "instance_confidence"
    columns[f"{kind}_id"] = torch.where(layer.ids == UNLABELLED, _NONE, layer.ids).int()
    columns[confidence] = layer.confidence.float()
    table[f"{kind}_id"] = {
        "layer": name,
        "none": _NONE,
        "background": _NONE if layer.background == UNLABELLED else layer.background,
        "confidence": confidence,
        "ids": _rows(layer, scene),
        "made": dict(layer.metadata),
    }


def _rows(layer: Labels, scene: Scene) -> dict[str, Any]:
    names = names_of(layer, scene.classes)
    ids, counts = torch.unique(layer.ids, return_counts=True)
    count_of = dict(zip(ids.tolist(), counts.tolist(), strict=True))
    return {
        str(id): {
            "name": names.get(id, ""),
            "colour": list(colour_of(id, scene.classes)),
            "gaussians": count_of.get(id, 0),
        }
        for id in layer.present.tolist()
    }


def _holds_columns(path: Path) -> bool:
    name = path.name.lower()
    return name.endswith(".ply") and not name.endswith(".compressed.ply")
