"""Each pair of pointmaps, read once and reduced to the same few pixels of each photograph."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core.models import Pointmap
from splatseg.errors import InputError, quoted

MIN_WEIGHT = 1e-3
"""Weight of a pixel of confidence 1, which says nothing: where all are such, all count alike."""


class PairSource(Protocol):
    """Who answers for pairs of photographs, by their file names."""

    def pointmaps(self, first: str, second: str) -> tuple[Pointmap, Pointmap]:
        """Points of both photographs in the frame of the first one's camera."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotographSize:
    """A photograph as this package knows it."""

    name: str
    """File name."""

    width: int
    """Upright, pixels."""

    height: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairSamples:
    """Pixels of pairs. E pairs, N photographs, S pixels of each."""

    first: Int64[Tensor, "pairs"]
    """Index of the photograph in whose camera's frame the points are."""

    second: Int64[Tensor, "pairs"]
    points: Float[Tensor, "pairs 2 samples 3"]
    """Of the first photograph and of the second; float32, in the unit of the pair."""

    weights: Float[Tensor, "pairs 2 samples"]
    """log of the confidence, as DUSt3R takes it, at least `MIN_WEIGHT`; float32."""

    offsets: Float[Tensor, "views samples 2"]
    """Right and down from the middle of the photograph, its pixels; float64."""

    lenses: Int64[Tensor, "views"]
    """A number for each photograph; those with the same one share a focal length."""

    sizes: tuple[tuple[int, int], ...]
    """Rows and columns of each photograph's pointmaps."""

    def __len__(self) -> int:
        return len(self.first)

    @property
    def views(self) -> Int64[Tensor, "pairs 2"]:
        """Photographs of each pair."""
        return torch.stack((self.first, self.second), dim=1)


def read_samples(
    photographs: Sequence[PhotographSize],
    pairs: Sequence[tuple[int, int]],
    source: PairSource,
    *,
    count: int,
    shared_focal: bool,
    seed: int,
    progress: Callable[[int, int], None],
) -> PairSamples:
    """Ask about each pair once and keep `count` pixels of each map, about evenly spread.

    Memory is 32 bytes a pixel that is kept, times pairs.

    Raises:
        InputError: If maps of one photograph differ in size, or one is a single point.
    """
    rng = np.random.default_rng([seed, 31])
    sizes: dict[int, tuple[int, int]] = {}
    chosen: dict[int, tuple[Tensor, Tensor]] = {}
    points = torch.empty(len(pairs), 2, count, 3)
    weights = torch.empty(len(pairs), 2, count)
    for e, pair in enumerate(pairs):
        names = [photographs[i].name for i in pair]
        for slot, (i, one) in enumerate(zip(pair, source.pointmaps(*names), strict=True)):
            size = (int(one.points.shape[0]), int(one.points.shape[1]))
            if i not in sizes:
                sizes[i] = size
                chosen[i] = _spread(size, count, rng)
            if size != sizes[i]:
                raise InputError(
                    f"pointmaps: expected all of {quoted(names[slot])} of {sizes[i][1]}x"
                    f"{sizes[i][0]} points, got {size[1]}x{size[0]} in the pair "
                    f"{quoted(names[0])}, {quoted(names[1])}."
                )
            rows, columns = chosen[i]
            points[e, slot] = one.points[rows, columns].cpu().float()
            if bool((points[e, slot] == points[e, slot, 0]).all()):
                raise InputError(
                    f"pointmaps: expected points of {quoted(names[slot])} that differ, got one "
                    f"point for all its pixels in the pair {quoted(names[0])}, {quoted(names[1])}."
                )
            sure = one.confidence[rows, columns].cpu().float()
            weights[e, slot] = sure.log().clamp_min(MIN_WEIGHT)
        progress(e + 1, len(pairs))
    return PairSamples(
        first=torch.tensor([i for i, _ in pairs]),
        second=torch.tensor([j for _, j in pairs]),
        points=points,
        weights=weights,
        offsets=torch.stack(
            [pixel_offsets(one, sizes[i], *chosen[i]) for i, one in enumerate(photographs)]
        ),
        lenses=_lenses(photographs, shared=shared_focal),
        sizes=tuple(sizes[i] for i in range(len(photographs))),
    )


def pixel_offsets(
    photograph: PhotographSize, size: tuple[int, int], rows: Tensor, columns: Tensor
) -> Float[Tensor, "*n 2"]:
    """Where points of a map lie, right and down from the middle of the photograph, its pixels.

    Rows and columns divide the photograph evenly; eq. 4 takes these for i' and j'.
    """
    u = (columns.double() + 0.5) / size[1] - 0.5
    v = (rows.double() + 0.5) / size[0] - 0.5
    return torch.stack((u * photograph.width, v * photograph.height), dim=-1)


def _lenses(photographs: Sequence[PhotographSize], *, shared: bool) -> Tensor:
    if not shared:
        return torch.arange(len(photographs))
    kinds = [(one.width, one.height) for one in photographs]
    return torch.tensor([kinds.index(kind) for kind in kinds])


def _spread(size: tuple[int, int], count: int, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Rows and columns of `count` pixels: one drawn in each cell of a grid, the rest anywhere."""
    rows, columns = size
    down = max(1, min(count, round(math.sqrt(count * rows / columns))))
    across = max(1, count // down)
    grid = rng.uniform(size=(down, across, 2))
    grid += np.stack(np.meshgrid(np.arange(down), np.arange(across), indexing="ij"), axis=-1)
    grid /= (down, across)
    anywhere = rng.uniform(size=(count - down * across, 2))
    places = np.concatenate((grid.reshape(-1, 2), anywhere)) * size
    found = torch.from_numpy(np.minimum(places.astype(np.int64), np.array(size) - 1))
    return found[:, 0], found[:, 1]
