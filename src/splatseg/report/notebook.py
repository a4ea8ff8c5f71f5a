"""How a notebook shows our values: a few words, a small picture, a short table."""

import base64
import io
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    Capture,
    Gaussians,
    InstanceTree,
    LabelMap,
    Labels,
    MaskSet,
    Scene,
    View,
)
from splatseg.errors import InputError, SplatsegError
from splatseg.io.images import load_image
from splatseg.render import render
from splatseg.report.colours import colour_labels, colour_of
from splatseg.report.words import text

_SIDE = 240
"""Longest side of a picture, pixels."""

_ROWS = 12
"""Rows of a table; the rest is counted."""

_PHOTOGRAPHS = 3
_POINTS = 200_000


def preview_html(value: object) -> str:
    """A value as HTML of a few kilobytes that stands alone.

    Raises:
        InputError: If it is of a kind that has no preview.
    """
    match value:
        case View():
            shown = _photographs([value])
        case Scene():
            shown = _photographs(value.views[:_PHOTOGRAPHS]) + _render(value)
        case Capture():
            shown = _photographs(value.views[:_PHOTOGRAPHS])
        case Gaussians():
            shown = _picture(_from_above(value), "from above")
        case MaskSet():
            shown = _picture(_masks(value), "masks, smaller ones in front")
        case LabelMap():
            shown = _picture(_thinned(colour_labels(value.ids.cpu())), "ids")
        case Labels():
            shown = _ids(value, value.info.names)
        case InstanceTree():
            shown = _tree(value)
        case _:
            raise InputError(f"value: expected one that has a preview, got {type(value).__name__}.")
    return f"<div><code>{text(repr(value))}</code><br>{shown}</div>"


def _picture(pixels: UInt8[Tensor, "height width 3"], title: str) -> str:
    file = io.BytesIO()
    Image.fromarray(pixels.cpu().numpy()).save(file, format="PNG")
    data = base64.b64encode(file.getvalue()).decode("ascii")
    words = text(title)
    return f'<img alt="{words}" title="{words}" src="data:image/png;base64,{data}"> '


def _photographs(views: Sequence[View]) -> str:
    """Photographs of views; a word for those that are not there."""
    shown = ""
    for view in views:
        try:
            shown += _picture(load_image(view, longest=_SIDE), view.name)
        except SplatsegError as error:
            shown += f"<em>{text(str(error))}</em> "
    return shown


def _render(scene: Scene) -> str:
    """The first view as the Gaussians have it."""
    if not scene.views or not len(scene.gaussians):
        return ""
    camera = scene.views[0].camera
    scale = min(1.0, _SIDE / max(camera.width, camera.height))
    small = camera.resized(
        max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    )
    try:
        with torch.no_grad():
            image = render(scene.gaussians, small).image
    except SplatsegError as error:
        return f"<em>{text(str(error))}</em>"
    pixels = (image.clamp(0, 1) * 255).round().to(torch.uint8)
    return _picture(pixels, f"{scene.views[0].name}, rendered")


def _from_above(gaussians: Gaussians) -> UInt8[Tensor, "height width 3"]:
    """Centres along the axis of least extent, in their mean colours, opaque ones last."""
    picture = np.full((_SIDE, _SIDE, 3), 255, np.uint8)
    step = max(1, len(gaussians) // _POINTS)
    means = gaussians.means.detach()[::step].double().cpu().numpy()
    if not len(means):
        return torch.from_numpy(picture)
    colours = gaussians.colours.detach()[::step].clamp(0, 1).cpu().numpy()
    low, high = np.quantile(means, (0.02, 0.98), axis=0)
    # The two axes of largest extent span the picture.
    across, down = sorted(np.argsort(high - low)[1:])
    extent = max(high[across] - low[across], high[down] - low[down], 1e-9)
    middle = (low + high)[[across, down]] / 2
    pixels = (means[:, [across, down]] - middle) / extent * (_SIDE - 1) + _SIDE / 2
    inside = ((pixels >= 0) & (pixels < _SIDE)).all(axis=1)
    order = np.argsort(gaussians.opacities.detach()[::step].cpu().numpy()[inside], kind="stable")
    columns, rows = pixels[inside][order].astype(np.int64).T
    picture[_SIDE - 1 - rows, columns] = (colours[inside][order] * 255).round()
    return torch.from_numpy(picture)


def _masks(masks: MaskSet) -> UInt8[Tensor, "height width 3"]:
    """Masks over each other, the largest at the back."""
    step = max(1, -(-max(masks.height, masks.width) // _SIDE))
    ids = torch.full((-(-masks.height // step), -(-masks.width // step)), UNLABELLED)
    order = sorted(range(len(masks)), key=lambda i: -masks.masks[i].area)
    for number, i in enumerate(order, start=1):
        ids[masks.dense(i)[::step, ::step]] = number
    return colour_labels(ids)


def _thinned(pixels: UInt8[Tensor, "height width 3"]) -> UInt8[Tensor, "height width 3"]:
    step = max(1, -(-max(pixels.shape[0], pixels.shape[1]) // _SIDE))
    return pixels[::step, ::step].contiguous()


def _ids(labels: Labels, names: Mapping[int, str]) -> str:
    """The ids with most Gaussians."""
    ids, counts = torch.unique(labels.ids[labels.ids != UNLABELLED], return_counts=True)
    order = torch.argsort(counts, descending=True, stable=True).tolist()
    rows = "".join(
        f"<tr><td>{_swatch(int(ids[i]))}</td><td>{int(ids[i])}</td>"
        f"<td>{text(names.get(int(ids[i]), ''))}</td><td>{int(counts[i]):,}</td></tr>"
        for i in order[:_ROWS]
    )
    further = f"<p>and {len(order) - _ROWS} further ids</p>" if len(order) > _ROWS else ""
    head = "<tr><th></th><th>id</th><th>name</th><th>Gaussians</th></tr>"
    return f"<table>{head}{rows}</table>{further}"


def _tree(tree: InstanceTree) -> str:
    """The first nodes, each below its parent."""
    nodes = sorted(tree.nodes, key=lambda node: tree.path(node.id))
    rows = "".join(
        f"<li style='margin-left:{len(tree.path(node.id)) - 1}em'>{_swatch(node.id)} "
        f"{node.level} {node.id} {text(node.name)}</li>"
        for node in nodes[:_ROWS]
    )
    further = f"<p>and {len(nodes) - _ROWS} further nodes</p>" if len(nodes) > _ROWS else ""
    return f"<ul style='list-style:none'>{rows}</ul>{further}"


def _swatch(id: int) -> str:
    red, green, blue = colour_of(id)
    return f"<span style='color:rgb({red},{green},{blue})'>&#9632;</span>"
