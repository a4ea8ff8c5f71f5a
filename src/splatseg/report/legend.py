"""What ids mean to the eye: the one colour and the name that each has everywhere."""

import colorsys
from typing import Any

import torch
from jaxtyping import Int, UInt8
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import UNLABELLED, ClassTable, RenderableLayer

Colour = tuple[int, int, int]

NOTHING: Colour = (24, 24, 28)
"""Where there is no id, or nothing at all."""


def colour_of(id: int, classes: ClassTable | None = None) -> Colour:
    """The class table's colour of an id, else a colour of its own; -1 is nearly black.

    Colours that are made up walk round the hues by the golden ratio, and through brightness by
    another irrational step, so that no two of the first forty look alike.
    """
    if id < 0:
        return NOTHING
    if classes is not None:
        for row in classes.rows:
            if row.id == id and row.colour is not None:
                return row.colour
    hue = (id * 0.6180339887) % 1.0
    light = 0.40 + 0.38 * ((id * 0.7548776662) % 1.0)
    red, green, blue = colorsys.hls_to_rgb(hue, light, 0.62)
    return round(255 * red), round(255 * green), round(255 * blue)


def colour_labels(
    ids: Int[Tensor, "height width"], classes: ClassTable | None = None
) -> UInt8[Tensor, "height width 3"]:
    """A label map in colours, see `colour_of`."""
    check_shape("ids", ids, (None, None))
    present, index = torch.unique(ids, return_inverse=True)
    colours = [colour_of(id, classes) for id in present.tolist()]
    return torch.tensor(colours, dtype=torch.uint8)[index]


def names_of(layer: RenderableLayer, classes: ClassTable | None) -> dict[int, str]:
    """Names of the ids in use: the layer's own, or the scene's where it has none."""
    present = set(layer.ids)
    rows = () if classes is None else classes.rows
    return dict(layer.info.names) or {row.id: row.name for row in rows if row.id in present}


def legend_of(
    layer: RenderableLayer, classes: ClassTable | None, *, colours: ClassTable | None = None
) -> dict[str, Any]:
    """The content of legend.json for a layer.

    Args:
        layer: What is known of it.
        classes: Of the scene.
        colours: Of its ids, see `splatseg.report.layer_colours`; None takes those of the classes.
    """
    colours = classes if colours is None else colours
    names = names_of(layer, classes)
    sources = layer.info.source_ids or {}
    rows: dict[str, dict[str, Any]] = {}
    for id in layer.ids:
        rows[str(id)] = {"name": names.get(id, ""), "colour": list(colour_of(id, colours))}
        if id in sources:
            rows[str(id)]["source_id"] = sources[id]
    background = 0 if layer.background == UNLABELLED else layer.background
    return {"none": 0, "background": background, "ids": rows}
