"""Patterns of the generated surfaces: functions of a point in a solid's own axes.

Each gives a value in [0, 2] that walks along a palette of three colours. They are solid
textures, so that no surface needs a parametrisation, and soft at the scale of a pixel seen
from across the room, so that a photograph of 320 x 240 can show them.
"""

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.synthetic._shapes import TextureName, Vector

_LATTICE = 32


@lru_cache(maxsize=1)
def _lattice() -> Tensor:
    generator = torch.Generator().manual_seed(20240229)
    return torch.rand(_LATTICE**3, generator=generator, dtype=torch.float32)


def noise(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Smooth noise in [0, 1] with features of about one unit, periodic after 32."""
    lattice = _lattice().to(points)
    cell = points.floor()
    part = points - cell
    part = part * part * (3 - 2 * part)
    low = cell.long() % _LATTICE
    high = (low + 1) % _LATTICE
    rows = {
        (i, j): ((low, high)[i][:, 0] * _LATTICE + (low, high)[j][:, 1]) * _LATTICE
        for i in (0, 1)
        for j in (0, 1)
    }

    def along_z(i: int, j: int) -> Tensor:
        return torch.lerp(
            lattice[rows[i, j] + low[:, 2]],
            lattice[rows[i, j] + high[:, 2]],
            part[:, 2],
        )

    return torch.lerp(
        torch.lerp(along_z(0, 0), along_z(0, 1), part[:, 1]),
        torch.lerp(along_z(1, 0), along_z(1, 1), part[:, 1]),
        part[:, 0],
    )


def _random_of(cells: Float[Tensor, "n"], salt: int) -> Float[Tensor, "n"]:
    """A fixed random number in [0, 1] for each integer."""
    index = (cells.long() * 7919 + salt * 104729) % _LATTICE**3
    return _lattice().to(cells)[index]


def _soft(x: Tensor, sharpness: float = 3.0) -> Tensor:
    """From a wave in [-1, 1] to soft steps in [0, 2]."""
    return 1 + torch.tanh(sharpness * x)


def pattern(kind: TextureName, points: Float[Tensor, "n 3"], scale: float) -> Float[Tensor, "n"]:
    """Value in [0, 2] of a pattern.

    Args:
        kind: Its name.
        points: In the solid's own axes, from its middle, metres.
        scale: Size of the pattern's features in metres.
    """
    p = points / scale
    x, y, z = p.unbind(-1)
    tau = 2 * torch.pi
    if kind == "wood":
        stretch = torch.tensor([0.35, 3.0, 3.0]).to(p)
        rings = torch.sin(tau * (0.6 * y + 0.6 * z + 1.3 * noise(p * stretch * 0.3)))
        return (0.35 + 0.9 * noise(p * stretch) + 0.25 * rings).clamp(0, 2)
    if kind == "planks":
        row = y.floor()
        along = x / 9 + _random_of(row, 1)
        board = row * 131 + along.floor()
        tone = 0.45 + 1.25 * _random_of(board, 2)
        grain = noise(torch.stack((x * 0.8, y * 6, board), dim=-1)) - 0.5
        # 0.5 on a board's rim, measured in board widths along both axes.
        across = (y - row - 0.5).abs()
        lengthways = 9 * ((along - along.floor() - 0.5).abs() - 0.5) + 0.5
        edge = torch.maximum(across, lengthways)
        seam = ((edge - 0.43) / 0.07).clamp(0, 1)
        return ((tone + 0.7 * grain) * (1 - 0.8 * seam)).clamp(0, 2)
    if kind == "stripes":
        return (_soft(torch.sin(tau * x)) * (0.85 + 0.3 * noise(p * 4))).clamp(0, 2)
    if kind == "checker":
        return _soft(torch.sin(tau * 0.5 * x) * torch.sin(tau * 0.5 * y), 4.0)
    if kind == "weave":
        fine = torch.sin(tau * x) * torch.sin(tau * y) * torch.sin(tau * (z + 0.25))
        return (0.35 + 1.3 * noise(p * 0.6) + 0.35 * fine).clamp(0, 2)
    if kind == "dots":
        odd = (y.floor() % 2) * 0.5
        u, v = (x + odd) - (x + odd).floor() - 0.5, y - y.floor() - 0.5
        dot = _soft((0.24 - (u * u + v * v).sqrt()) * 6) * 0.8
        return (dot + 0.5 * noise(p * 0.35)).clamp(0, 2)
    if kind == "painting":
        broad = noise(torch.stack((x * 0.8, y * 1.4, z * 0 + scale * 977), dim=-1))
        middle = noise(torch.stack((x * 2.5, y * 2.5, z * 0 + scale * 3011), dim=-1))
        return (_soft((broad + 0.35 * middle - 0.68) * 3.0) * 0.8 + 0.5 * middle).clamp(0, 2)
    if kind == "spines":
        book = x.floor()
        seam = (((x - book - 0.5).abs() - 0.38) / 0.1).clamp(0, 1)
        band = torch.sin(tau * z * (0.3 + 0.3 * _random_of(book, 4))) > 0.75
        tone = 2 * _random_of(book, 3)
        return (torch.where(band, 2 - tone, tone) * (1 - 0.7 * seam)).clamp(0, 2)
    if kind == "sky":
        hills = 0.25 * (noise(torch.stack((x, x * 0, x * 0), dim=-1)) - 0.5)
        above = _soft((y + 0.15 - hills) * 8) * 0.5
        clouds = (noise(torch.stack((x * 1.2, y * 3.0, z * 0), dim=-1)) - 0.35).clamp(0, 1)
        return (above * (1 + 1.3 * clouds)).clamp(0, 2)
    return (0.55 + 0.6 * noise(p) + 0.3 * noise(p * 3.1)).clamp(0, 2)


def palette_colour(
    palette: tuple[Vector, Vector, Vector], values: Float[Tensor, "n"]
) -> Float[Tensor, "n 3"]:
    """Colours at `values` in [0, 2] along a palette."""
    value = values.unsqueeze(-1)
    dark, middle, light = torch.tensor(palette).to(values)
    lower = torch.lerp(dark, middle, value.clamp(0, 1))
    return torch.lerp(lower, light, (value - 1).clamp(0, 1))
