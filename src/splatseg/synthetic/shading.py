"""How a generated surface looks: patterns in a solid's own axes, and the light that reaches it."""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from splatseg.synthetic.solids import Primitive, SyntheticScene, TextureName, Vector

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


# Light in a generated scene: a coarse volume of what reaches each place, and the sun.
#
# The volume is computed once. At each voxel it holds the summed direction of daylight (from the
# planes that glow) and of lamplight (from the other glowing solids), both weakened by the solids
# in between, and how open the place is. Surfaces read it smoothly, a little above themselves,
# which gives soft shadows and dark corners without noise.


_CELL = 0.06
_MAX_CELLS = 500_000
_LIFT = 1.5
_STEPS = 28
_ABSORPTION = 45.0
_DAYLIGHT = (1.0, 0.98, 0.95)
_LAMPLIGHT = (1.0, 0.80, 0.55)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LightVolume:
    """Seven values on a grid over the scene's bounds."""

    low: Float[Tensor, "3"]
    high: Float[Tensor, "3"]

    values: Float[Tensor, "1 7 nz ny nx"]
    """Daylight (x, y, z), lamplight (x, y, z), openness in [0, 1]."""

    cell: float
    """Edge of the cells in which solids were looked for, metres."""

    def irradiance(
        self,
        points: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"],
        *,
        ambient: float,
    ) -> Float[Tensor, "n 3"]:
        """Red, green and blue light that falls on surfaces, without the sun."""
        value = _sample(self.values, points + _LIFT * self.cell * normals, self.low, self.high)
        day, lamp, open_ = value[:, :3], value[:, 3:6], value[:, 6:]
        sky = 0.5 + 0.12 * normals[:, 2:]
        out = ambient * sky * (0.25 + 0.75 * open_)
        for vector, colour in ((day, _DAYLIGHT), (lamp, _LAMPLIGHT)):
            length = (vector * vector).sum(-1, keepdim=True).sqrt()
            # A wide source lights a surface that faces slightly away from it, too.
            facing = 0.5 * (length + (vector * normals).sum(-1, keepdim=True))
            soft = facing * facing / length.clamp_min(1e-6)
            out = out + soft * torch.tensor(colour).to(soft)
        return out


@lru_cache(maxsize=4)
def light_volume(scene: SyntheticScene) -> LightVolume:
    """The light of a scene, computed at the first call."""
    low, high = (torch.tensor(corner, dtype=torch.float32) for corner in scene.bounds)
    # Large scenes get larger cells; a room of up to 108 cubic metres has those of 6 cm.
    volume = float((high - low).prod())
    cell = max(_CELL, (volume / _MAX_CELLS) ** (1 / 3))
    shape = [max(2, int(n)) for n in ((high - low) / (2 * cell)).ceil().tolist()]
    solid = _occupancy(scene, low, high, [2 * n for n in shape])
    points = _cell_centres(low, high, shape)
    day, lamp = torch.zeros_like(points), torch.zeros_like(points)
    for primitive in scene.primitives:
        if primitive.texture.glow <= 0:
            continue
        if primitive.shape == "plane":
            day += _from_plane(primitive, points, solid, low, high)
        else:
            centre = torch.tensor(primitive.centre, dtype=torch.float32)
            lamp += 0.35 * primitive.texture.glow * _from_point(centre, points, solid, low, high)
    return LightVolume(
        low=low,
        high=high,
        values=torch.cat(
            (
                _volume(day, shape),
                _volume(lamp, shape),
                _openness(solid, around=0.0 if scene.is_outdoor else 1.0),
            ),
            dim=1,
        ).contiguous(),
        cell=cell,
    )


def _cell_centres(low: Tensor, high: Tensor, shape: list[int]) -> Float[Tensor, "n 3"]:
    axes = [
        low[i] + (torch.arange(n, dtype=torch.float32) + 0.5) * (high[i] - low[i]) / n
        for i, n in enumerate(shape)
    ]
    z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    return torch.stack((x, y, z), dim=-1).reshape(-1, 3)


def _volume(values: Float[Tensor, "n c"], shape: list[int]) -> Float[Tensor, "1 c nz ny nx"]:
    return values.reshape(1, shape[2], shape[1], shape[0], -1).permute(0, 4, 1, 2, 3)


def _occupancy(
    scene: SyntheticScene, low: Tensor, high: Tensor, shape: list[int]
) -> Float[Tensor, "1 1 nz ny nx"]:
    """1 where a solid that gives no light is; planes are too thin to count."""
    points = _cell_centres(low, high, shape).reshape(shape[2], shape[1], shape[0], 3)
    inside = torch.zeros(points.shape[:3], dtype=torch.bool)
    step = (high - low) / torch.tensor(shape)
    for primitive in scene.primitives:
        if primitive.shape == "plane" or primitive.texture.glow > 0:
            continue
        centre = torch.tensor(primitive.centre, dtype=torch.float32)
        reach = primitive.radius + 0.03
        first = ((centre - reach - low) / step).floor().clamp_min(0).int().tolist()
        last = ((centre + reach - low) / step).ceil().clamp_min(0).int().tolist()
        near = tuple(slice(a, z) for a, z in zip(first[::-1], last[::-1], strict=True))
        cells = points[near]
        inside[near] |= primitive.contains(cells.reshape(-1, 3), 0.02).reshape(cells.shape[:3])
    inside = inside.reshape(-1)
    return _volume(inside.float().unsqueeze(-1), shape)


def _openness(
    solid: Float[Tensor, "1 1 nz ny nx"], *, around: float
) -> Float[Tensor, "1 1 mz my mx"]:
    """Share of free space within four cells of twice the size (half a metre in a room).

    Outside the bounds nothing is free in a room (`around` 1), everything under a sky (0) but
    below the ground.
    """
    coarse = functional.avg_pool3d(solid, 2)
    padded = functional.pad(coarse, (4,) * 6, value=around)
    padded[:, :, :4] = 1.0
    blurred = functional.avg_pool3d(functional.avg_pool3d(padded, 5, stride=1), 5, stride=1)
    return 1 - blurred


def _sample(volume: Tensor, points: Tensor, low: Tensor, high: Tensor) -> Float[Tensor, "n c"]:
    where = 2 * (points.float() - low) / (high - low) - 1
    grid = where.reshape(1, 1, 1, -1, 3)
    found = functional.grid_sample(volume, grid, padding_mode="border", align_corners=False)
    return found.reshape(volume.shape[1], -1).T


def _from_point(
    light: Float[Tensor, "3"],
    points: Float[Tensor, "n 3"],
    solid: Tensor,
    low: Tensor,
    high: Tensor,
) -> Float[Tensor, "n 3"]:
    """Direction to a light of unit power, divided by the squared distance, times visibility."""
    way = light - points
    distance = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
    # The first decimetre is left out, so that a surface does not shade itself.
    start = (0.1 / distance).clamp(max=1.0)
    passed = torch.zeros_like(distance)
    for step in range(_STEPS):
        share = start + (1 - start) * (step + 0.5) / _STEPS
        passed += _sample(solid, points + share * way, low, high) * (1 - start) / _STEPS
    seen = torch.exp(-_ABSORPTION * passed * distance)
    return way / distance.clamp_min(1e-6) * seen / (distance * distance + 0.15)


def _from_plane(
    primitive: Primitive,
    points: Float[Tensor, "n 3"],
    solid: Tensor,
    low: Tensor,
    high: Tensor,
) -> Float[Tensor, "n 3"]:
    """Daylight through a window, from six places of it, each with Lambert's cosine."""
    turn = primitive.rotation.float()
    centre = torch.tensor(primitive.centre, dtype=torch.float32)
    half = torch.tensor(primitive.half_size, dtype=torch.float32)
    power = primitive.texture.glow * 4 * float(half[0] * half[1]) / 6
    total = torch.zeros_like(points)
    for u in (-2 / 3, 0.0, 2 / 3):
        for v in (-0.5, 0.5):
            light = centre + turn[:, 0] * u * half[0] + turn[:, 1] * v * half[1]
            vector = _from_point(light, points, solid, low, high)
            length = torch.linalg.vector_norm(vector, dim=-1, keepdim=True).clamp_min(1e-9)
            cosine = (vector @ turn[:, 2:]).abs() / length
            total += power * cosine * vector
    return total
