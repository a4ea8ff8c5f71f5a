"""What columns of labels mean, for the JSON table beside a file."""

from typing import Any, Literal

import torch

from splatseg.core import (
    UNLABELLED,
    ClassTable,
    Gaussians,
    Labels,
    RenderableLayer,
    Selection,
    layer_info_to_json,
)
from splatseg.report.colours import colour_of, layer_colours, names_of

_NONE = 0


def label_tables(
    layer: Labels | Selection,
    kind: Literal["class", "instance"],
    name: str,
    classes: ClassTable | None,
    *,
    gaussians: Gaussians | None = None,
) -> dict[str, Any]:
    """The entry of the column that a layer becomes: where it is from and what its ids mean."""
    if isinstance(layer, Selection):
        entry = {"layer": name, "meaning": "1 for selected Gaussians, 0 for others"}
        if layer.confidence is not None:
            entry["confidence"] = "selected_confidence"
        return {"selected": entry}
    return {
        f"{kind}_id": {
            "layer": name,
            "none": _NONE,
            "background": _NONE if layer.background == UNLABELLED else layer.background,
            "confidence": "confidence" if kind == "class" else "instance_confidence",
            "ids": _rows(layer, classes, gaussians),
            "made": layer_info_to_json(layer.info),
        }
    }


def _rows(layer: Labels, classes: ClassTable | None, gaussians: Gaussians | None) -> dict[str, Any]:
    summary = RenderableLayer.of(layer)
    colours = layer_colours(summary, classes, gaussians=gaussians, labels=layer)
    names = names_of(summary, classes)
    ids, counts = torch.unique(layer.ids, return_counts=True)
    count_of = dict(zip(ids.tolist(), counts.tolist(), strict=True))
    return {
        str(id): {
            "name": names.get(id, ""),
            "colour": list(colour_of(id, colours)),
            "gaussians": count_of.get(id, 0),
        }
        for id in layer.present.tolist()
    }
