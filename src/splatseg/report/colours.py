"""The colour and the name of each id, the same in every picture, and ids written on pictures."""

import colorsys
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage, sparse
from torch import Tensor

from splatseg.core import UNLABELLED, ClassInfo, ClassTable, Gaussians, Labels, RenderableLayer
from splatseg.report.palette import NOTHING as NOTHING
from splatseg.report.palette import Colour as Colour
from splatseg.report.palette import own_colour


def colour_of(id: int, classes: ClassTable | None = None) -> Colour:
    """The class table's colour of an id, else a colour of its own; -1 is nearly black."""
    if id >= 0 and classes is not None:
        for row in classes.rows:
            if row.id == id and row.colour is not None:
                return row.colour
    return own_colour(id)


def colour_labels(
    ids: Int[Tensor, "height width"], classes: ClassTable | None = None
) -> UInt8[Tensor, "height width 3"]:
    """A label map in colours, see `colour_of`."""
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
        colours: Of its ids, see `splatseg.report.colours`; None takes those of the classes.
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


# Colours of a layer's ids: neighbours in the scene look unlike each other.
#
# The same layer has the same colours in reports, coloured label maps, legends and tables, since
# they follow from its Gaussians alone.


_MAX_CELLS, _MIN_CELLS = 64, 8
"""Cells along the longest side of the scene; things in one cell or in two that share a side are
neighbours."""

_MAX_POINTS = 2_000_000
"""Gaussians that are looked at for what is beside what; of more, every second, every third ..."""

_ENOUGH = 0.22
"""Distance in OKLab from which on two colours are told apart at a glance."""

_CROWDING = 0.004
"""What each use of a colour elsewhere counts against it, in the same unit."""


def layer_colours(
    layer: RenderableLayer,
    classes: ClassTable | None,
    *,
    gaussians: Gaussians | None = None,
    labels: Labels | None = None,
) -> ClassTable:
    """Names and colours of the ids in use.

    A class table's colour is kept where id and name are its own. Others are chosen, the largest
    first, so that each is far from those of its neighbours.

    Args:
        layer: What is known of the layer.
        classes: Of the scene.
        gaussians: Who carries the labels; without them each id has the colour of `colour_of`.
        labels: Their labels.
    """
    names = names_of(layer, classes)
    known = {} if classes is None else {row.id: row for row in classes.rows}
    fixed: dict[int, Colour] = {}
    for id in layer.ids:
        row = known.get(id)
        if row is not None and row.colour is not None and row.name == names.get(id):
            fixed[id] = row.colour
    if gaussians is None or labels is None or len(fixed) == len(layer.ids):
        found = {id: colour_of(id) for id in layer.ids} | fixed
    else:
        found = _spread_out(gaussians.means, labels, layer.ids, fixed)
    return ClassTable(
        rows=tuple(
            ClassInfo(id=id, name=names.get(id) or f"id {id}", colour=found[id]) for id in layer.ids
        )
    )


def _spread_out(
    points: Float[Tensor, "n 3"],
    labels: Labels,
    ids: tuple[int, ...],
    fixed: dict[int, Colour],
) -> dict[int, Colour]:
    """Greedy: from the largest to the smallest, the colour that its neighbours leave."""
    order = np.array(ids, dtype=np.int64)
    every = max(1, -(-len(points) // _MAX_POINTS))
    own = labels.ids[::every].detach().cpu().numpy().astype(np.int64)
    there = own != UNLABELLED
    index = np.searchsorted(order, own[there])
    contacts = _contacts(points[::every].detach().cpu().double().numpy()[there], index, len(ids))
    size = np.bincount(index, minlength=len(ids))
    palette = _palette()
    lab = _oklab(np.array(palette, dtype=np.float64) / 255)
    used = np.zeros(len(palette))
    chosen: dict[int, Colour] = dict(fixed)
    places = {id: _oklab(np.array([colour]) / 255)[0] for id, colour in fixed.items()}
    for i in sorted(range(len(ids)), key=lambda i: (-int(size[i]), i)):
        id = ids[i]
        if id in chosen:
            continue
        beside = contacts.indices[contacts.indptr[i] : contacts.indptr[i + 1]]
        taken = [places[ids[j]] for j in beside.tolist() if j != i and ids[j] in places]
        score = np.full(len(palette), _ENOUGH)
        if taken:
            away = np.linalg.norm(lab[:, None] - np.array(taken)[None], axis=2).min(axis=1)
            score = np.minimum(away, _ENOUGH)
        # Among equals the one after that of the id before, so that few objects differ too.
        score = score - _CROWDING * used - 1e-6 * ((np.arange(len(palette)) - 7 * i) % len(palette))
        best = int(score.argmax())
        used[best] += 1
        chosen[id], places[id] = palette[best], lab[best]
    return chosen


def _contacts(
    points: NDArray[np.float64], index: NDArray[np.int64], count: int
) -> sparse.csr_matrix:
    """Which ids have Gaussians in one cell of a grid, or in cells that share a side."""
    if not len(points):
        return sparse.csr_matrix((count, count))
    # A few Gaussians far outside must not make one cell of all the rest.
    low, high = np.quantile(points[:: max(1, len(points) // 100_000)], (0.01, 0.99), axis=0)
    # On a surface about four points share a cell: where there are few, cells are large.
    most = min(_MAX_CELLS, max(_MIN_CELLS, int((len(points) / 4) ** 0.5)))
    side = max(float((high - low).max()), 1e-9) / most
    cells = np.clip((points - low) / side, -most, 2 * most).astype(np.int64) + most + 1
    strides = np.array([1, 4 * most, 16 * most**2])
    keys, row = np.unique(cells @ strides, return_inverse=True)
    ones = np.ones(len(row), dtype=np.int32)
    inside = sparse.csr_matrix((ones, (row.reshape(-1), index)), shape=(len(keys), count))
    inside.data[:] = 1
    found = inside.T @ inside
    for stride in strides:
        beside = np.searchsorted(keys, keys + stride)
        there = np.nonzero(keys[np.minimum(beside, len(keys) - 1)] == keys + stride)[0]
        joint = inside[there].T @ inside[beside[there]]
        found = found + joint + joint.T
    return sparse.csr_matrix(found)


def _palette() -> list[Colour]:
    """Seventy-two colours: hues all round, three brightnesses, two of them also pale."""
    found: list[Colour] = []
    for light, vivid in ((0.52, 0.75), (0.34, 0.70), (0.72, 0.85), (0.60, 0.35)):
        for hue in range(18):
            rgb = colorsys.hls_to_rgb(hue / 18, light, vivid)
            found.append((round(255 * rgb[0]), round(255 * rgb[1]), round(255 * rgb[2])))
    return found


def _oklab(rgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """SRGB in [0, 1] to OKLab (Ottosson 2020), in which distances are about those of the eye."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    lms = linear @ np.array(
        [
            [0.4122214708, 0.2119034982, 0.0883024619],
            [0.5363325363, 0.6806995451, 0.2817188376],
            [0.0514459929, 0.1073969566, 0.6299787005],
        ]
    )
    return np.cbrt(lms) @ np.array(
        [
            [0.2104542553, 1.9779984951, 0.0259040371],
            [0.7936177850, -2.4285922050, 0.7827717662],
            [-0.0040720468, 0.4505937099, -0.8086757660],
        ]
    )


# Ids written on a picture, each where its thing is widest.


_SMALLEST, _SHARE = 11, 1 / 30
"""Height of the letters, pixels, and as a share of the longest side; the larger counts."""


def draw_ids(
    image: UInt8[Tensor, "height width 3"], ids: Int[Tensor, "height width"]
) -> UInt8[Tensor, "height width 3"]:
    """A picture with the ids of a label map written on it; too small areas go without."""
    size = max(_SMALLEST, round(_SHARE * max(image.shape[:2])))
    picture = Image.fromarray(image.cpu().numpy())
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(size)
    for id, x, y in _places(ids, radius=0.45 * size):
        draw.text(
            (x, y),
            str(id),
            fill=(255, 255, 255),
            font=font,
            anchor="mm",
            stroke_width=max(1, size // 8),
            stroke_fill=(16, 16, 20),
        )
    return torch.from_numpy(np.array(picture))


def _places(ids: Tensor, *, radius: float) -> list[tuple[int, float, float]]:
    """Id and centre of the largest circle that its area holds, where that is wide enough."""
    present, index = torch.unique(ids, return_inverse=True)
    # Labels of `find_objects` begin with 1.
    numbered = index.cpu().numpy() + 1
    found: list[tuple[int, float, float]] = []
    for k, (id, box) in enumerate(
        zip(present.tolist(), ndimage.find_objects(numbered), strict=True), start=1
    ):
        if id == UNLABELLED or box is None:
            continue
        # A rim, so that the border of the picture is a border of the thing.
        inside = np.pad(numbered[box] == k, 1)
        depth = np.asarray(ndimage.distance_transform_edt(inside))
        row, column = np.unravel_index(int(np.argmax(depth)), depth.shape)
        if depth[row, column] < radius:
            continue
        found.append((id, float(box[1].start + column) - 0.5, float(box[0].start + row) - 0.5))
    return found
