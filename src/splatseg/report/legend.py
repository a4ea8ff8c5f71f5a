"""What the ids of a drawn layer mean, in words and colours: legend.json."""

import colorsys
from collections.abc import Mapping
from typing import Any, cast

import torch
from jaxtyping import Int, UInt8
from torch import Tensor

from splatseg.core import UNLABELLED, ClassTable, Labels

Colour = tuple[int, int, int]

_GOLDEN = 0.6180339887498949


def colour_of(id: int, classes: ClassTable | None) -> Colour:
    """The class table's colour of an id, or one that differs from its neighbours'.

    Hues go round by the golden ratio, which keeps any run of consecutive ids apart.
    """
    for row in () if classes is None else classes.rows:
        if row.id == id and row.colour is not None:
            return row.colour
    lightness = (0.55, 0.42, 0.68)[id % 3]
    red, green, blue = colorsys.hls_to_rgb((id * _GOLDEN) % 1.0, lightness, 0.65)
    return round(255 * red), round(255 * green), round(255 * blue)


def legend_of(labels: Labels, classes: ClassTable | None) -> dict[str, Any]:
    """The content of legend.json for a layer."""
    names = names_of(labels, classes)
    sources = cast(Mapping[str, int], labels.metadata.get("source_ids") or {})
    rows: dict[str, dict[str, Any]] = {}
    for id in labels.present.tolist():
        rows[str(id)] = {"name": names.get(id, ""), "colour": list(colour_of(id, classes))}
        if str(id) in sources:
            rows[str(id)]["source_id"] = sources[str(id)]
    background = 0 if labels.background == UNLABELLED else labels.background
    return {"none": 0, "background": background, "ids": rows}


def names_of(labels: Labels, classes: ClassTable | None) -> dict[int, str]:
    """Names of the ids in use: the layer's own, or the scene's where it has none."""
    own = labels.metadata.get("names")
    if isinstance(own, dict) and own:
        return {int(key): str(name) for key, name in own.items()}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    rows = () if classes is None else classes.rows
    present = set(labels.present.tolist())
    return {row.id: row.name for row in rows if row.id in present}


def coloured(
    ids: Int[Tensor, "height width"], classes: ClassTable | None
) -> UInt8[Tensor, "height width 3"]:
    """A picture of an id map: the legend's colours, black where there is none."""
    present, place = torch.unique(ids, return_inverse=True)
    table = torch.tensor(
        [(0, 0, 0) if i == UNLABELLED else colour_of(int(i), classes) for i in present.tolist()],
        dtype=torch.uint8,
    )
    return table[place]
