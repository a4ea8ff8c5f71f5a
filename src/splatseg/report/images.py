"""Label maps, depth, errors and selections as pictures, and galleries of them."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from splatseg.core import ClassTable
from splatseg.core.boundary import convert_fields
from splatseg.report.colours import NOTHING, Colour, colour_labels

_WRONG: Colour = (226, 48, 48)
_UNKNOWN: Colour = (90, 120, 220)
SHADES: tuple[Colour, ...] = (
    (22, 24, 60),
    (26, 74, 118),
    (38, 132, 138),
    (126, 184, 126),
    (244, 226, 150),
)
"""From far to near, from little to much: dark blue, teal, sand. Brightness grows steadily."""


@dataclass(frozen=True, slots=True, eq=False)
class GalleryImage:
    """An image for a page or sheet."""

    image: UInt8[Tensor, "height width 3"]
    """sRGB."""

    caption: str = ""
    """A few words under it; also what is read out for it."""

    kind: Literal["photo", "chart"] = "photo"
    """A photo is embedded as JPEG, a chart (few flat colours) as PNG without loss."""

    def __post_init__(self) -> None:
        convert_fields(self)


@dataclass(frozen=True, slots=True, eq=False)
class Gallery:
    """Rows of pictures under common column titles: one row a view, say."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[GalleryImage, ...]], ...]
    """Label and pictures of each row."""

    note: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectCard:
    """One object of a layer, as a page shows it."""

    id: int
    name: str
    """Empty where it has none."""

    colour: Colour
    """That of its id in every picture."""

    image: GalleryImage | None
    """It, cut out of the view that shows it best; None where no view that was looked at does."""

    facts: tuple[tuple[str, str], ...]
    """What is known of it: names and values."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectGallery:
    """Objects beside each other."""

    title: str
    cards: tuple[ObjectCard, ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Scale:
    """What the shades of `colour_share` mean."""

    title: str
    low: str
    """What is shown darkest."""

    high: str
    """What is shown lightest."""

    note: str = ""


def colour_depth(
    depth: Float[Tensor, "height width"], *, near: float | None = None, far: float | None = None
) -> UInt8[Tensor, "height width 3"]:
    """Depth from dark blue (far) to sand (near); nearly black where it is 0, nothing.

    Args:
        depth: z-depth, scene units.
        near: Depth that is shown lightest; None is the nearest hundredth of the map.
        far: Depth that is shown darkest; None is the farthest hundredth.
    """
    known = depth > 0
    values = depth[known].double()
    if not len(values):
        return torch.tensor(NOTHING, dtype=torch.uint8).expand(*depth.shape, 3).clone()
    if near is None:
        near = float(torch.quantile(_thinned(values), 0.01))
    if far is None:
        far = float(torch.quantile(_thinned(values), 0.99))
    share = ((far - depth.double()) / max(far - near, 1e-9)).clamp(0, 1)
    return torch.where(
        known.unsqueeze(-1), _ramp(share).round(), torch.tensor(NOTHING, dtype=torch.float64)
    ).to(torch.uint8)


def overlay_labels(
    image: UInt8[Tensor, "height width 3"],
    ids: Int[Tensor, "height width"],
    classes: ClassTable | None = None,
) -> UInt8[Tensor, "height width 3"]:
    """A photograph tinted by its labels, with a light line where the label changes.

    Pixels without a label keep their colours.
    """
    tinted = 0.45 * image.double() + 0.55 * colour_labels(ids, classes).double()
    out = torch.where((ids < 0).unsqueeze(-1), image.double(), tinted)
    edge = torch.zeros(ids.shape, dtype=torch.bool)
    edge[:, 1:] |= ids[:, 1:] != ids[:, :-1]
    edge[1:] |= ids[1:] != ids[:-1]
    return torch.where(edge.unsqueeze(-1), 0.5 * out + 120, out).round().to(torch.uint8)


def colour_share(
    values: Float[Tensor, "height width"], *, low: float = 0.0, high: float = 1.0
) -> UInt8[Tensor, "height width 3"]:
    """Values from dark blue (`low` and less) to sand (`high` and more).

    Nearly black where they are negative: nothing is there.
    """
    stretched = (values.double() - low) / max(high - low, 1e-9)
    mixed = _ramp(stretched.clamp(0, 1)).round()
    nothing = torch.tensor(NOTHING, dtype=torch.float64)
    return torch.where((values >= 0).unsqueeze(-1), mixed, nothing).to(torch.uint8)


def colour_difference(
    one: UInt8[Tensor, "height width 3"], other: UInt8[Tensor, "height width 3"]
) -> UInt8[Tensor, "height width 3"]:
    """How far two images differ in each channel, times four: black where they agree."""
    return (4 * (one.int() - other.int()).abs()).clamp(max=255).to(torch.uint8)


def mark_errors(
    image: UInt8[Tensor, "height width 3"],
    ids: Int[Tensor, "height width"],
    *,
    truth: Int[Tensor, "height width"],
) -> UInt8[Tensor, "height width 3"]:
    """A grey photograph with wrong pixels in red, unlabelled ones in blue.

    Pixels whose truth is not known (-1) stay grey.
    """
    grey = image.double().mean(dim=-1, keepdim=True).expand(*image.shape) * 0.75 + 50
    wrong = (ids != truth) & (truth >= 0)
    out = torch.where(wrong.unsqueeze(-1), 0.25 * grey + 0.75 * torch.tensor(_WRONG).double(), grey)
    missing = wrong & (ids < 0)
    out = torch.where(
        missing.unsqueeze(-1), 0.25 * grey + 0.75 * torch.tensor(_UNKNOWN).double(), out
    )
    return out.clamp(0, 255).round().to(torch.uint8)


def _ramp(share: Tensor) -> Tensor:
    """Colours, as float64, of values in [0, 1]."""
    steps = torch.tensor(SHADES, dtype=torch.float64)
    position = share * (len(steps) - 1)
    low = position.floor().long().clamp(max=len(steps) - 2)
    return torch.lerp(steps[low], steps[low + 1], (position - low).unsqueeze(-1))


def _thinned(values: Tensor) -> Tensor:
    """At most about a million values: `torch.quantile` takes no more than 16 million."""
    return values[:: max(1, len(values) // 1_000_000)]


# A view with a selection outlined and the prompts that made it.


_OUTLINE = (255, 214, 10)
_POSITIVE = (52, 199, 89)
_NEGATIVE = (226, 48, 48)
_EDGE = (16, 16, 20)
_DIMMED = 0.45


def selection_picture(
    image: UInt8[Tensor, "height width 3"],
    mask: Bool[Tensor, "height width"],
    *,
    points: Float[Tensor, "p 2"] | None = None,
    positive: Bool[Tensor, "p"] | None = None,
    polygons: tuple[Float[Tensor, "corners 2"], ...] = (),
    strokes: Bool[Tensor, "height width"] | None = None,
    negative_strokes: Bool[Tensor, "height width"] | None = None,
) -> UInt8[Tensor, "height width 3"]:
    """Draw what is selected bright within a yellow outline, the rest dimmed, prompts on top.

    Args:
        image: The view.
        mask: What is selected of it.
        points: Clicks, x and y in pixels: discs, green on the thing and red beside it.
        positive: Whether each click is on the thing; None means that all are.
        polygons: Boxes and lassos, corners in pixels.
        strokes: Pixels of strokes on the thing.
        negative_strokes: Pixels of strokes beside it.
    """
    lit = np.where(mask.numpy()[..., None], 1.0, _DIMMED)
    colours = (image.numpy() * lit + 0.5).astype(np.uint8)
    for pixels, colour in ((strokes, _POSITIVE), (negative_strokes, _NEGATIVE)):
        if pixels is not None:
            colours[pixels.numpy()] = colour
    inner = mask.numpy().astype(np.uint8)
    edge = inner - cv2.erode(inner, np.ones((3, 3), np.uint8), borderValue=0)
    colours[edge > 0] = _OUTLINE
    picture = Image.fromarray(colours)
    draw = ImageDraw.Draw(picture)
    for polygon in polygons:
        corners = [(float(x), float(y)) for x, y in polygon.tolist()]
        draw.line([*corners, corners[0]], fill=_POSITIVE, width=2)
    if points is not None:
        signs = torch.ones(len(points)).bool() if positive is None else positive
        radius = max(3.0, min(image.shape[:2]) / 100)
        for (x, y), sign in zip(points.tolist(), signs.tolist(), strict=True):
            where = (x - radius, y - radius, x + radius, y + radius)
            draw.ellipse(where, fill=_POSITIVE if sign else _NEGATIVE, outline=_EDGE, width=1)
    return torch.from_numpy(np.array(picture))
