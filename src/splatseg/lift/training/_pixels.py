"""Which pixels of a view are drawn, and how many each of them stands for."""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg.lift.training._targets import Ragged

Sampling = Literal["uniform", "groups", "strata"]

_GOLDEN = (5**0.5 - 1) / 2


def draw_uniformly(
    pixels: Int64[Tensor, "m"], count: int, rng: np.random.Generator
) -> tuple[Int64[Tensor, "p"], Float[Tensor, "p"]]:
    """Some pixels in random order, and how many each stands for: m / p.

    Every pixel is as likely as every other.
    """
    total = len(pixels)
    taken = min(count, total)
    drawn = rng.choice(total, taken, replace=False, shuffle=True)
    return pixels[torch.from_numpy(drawn)], torch.full((taken,), total / max(taken, 1))


def draw_by_strata(
    pixels: Int64[Tensor, "m"], width: int, count: int, rng: np.random.Generator
) -> tuple[Int64[Tensor, "p"], Float[Tensor, "p"]]:
    r"""One pixel of each of p parts of the picture that hold equally many pixels, give or take one.

    Parts are runs of the pixels in Morton order (bits of row and column in turn), so each is a
    patch or a few that touch. They come in the order of the fractions of :math:`u + i \phi`, with
    :math:`\phi` the golden ratio: any so many pixels one after the other lie evenly over the
    picture, too, and are a stratified draw by themselves.

    Args:
        pixels: Those that may be drawn, numbered row by row.
        width: Of the picture.
        count: How many at most.
        rng: Draws them.
    """
    total = len(pixels)
    taken = min(count, total)
    if not taken:
        return pixels, torch.zeros(0)
    flat = pixels.numpy()
    ordered = flat[np.argsort(_morton(flat // width, flat % width), kind="stable")]
    starts = np.arange(taken + 1) * total // taken
    sizes = np.diff(starts)
    drawn = ordered[starts[:-1] + rng.integers(sizes)]
    rank = np.argsort(np.argsort((rng.random() + np.arange(taken) * _GOLDEN) % 1.0))
    return torch.from_numpy(drawn[rank]), torch.from_numpy(sizes[rank].astype(np.float32))


def _morton(rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Bits of row and column in turn."""
    code = np.zeros_like(rows)
    for bit in range(31):
        code |= ((columns >> bit) & 1) << (2 * bit) | ((rows >> bit) & 1) << (2 * bit + 1)
    return code


def draw_by_group(
    groups: Ragged, size: int, count: int, rng: np.random.Generator
) -> tuple[Int64[Tensor, "p"], Float[Tensor, "p"]]:
    r"""Distinct pixels in random order, equally many of each group, and what each stands for.

    A pixel that is in the groups g of sizes :math:`m_g`, of which :math:`d_g` are drawn, stands
    for one over its probability to be drawn,

    .. math:: 1 \Big/ \Bigl(1 - \prod_g (1 - d_g / m_g)\Bigr),

    so that sums over drawn pixels, weighted so, estimate sums over all pixels of the groups
    (Horvitz and Thompson 1952).

    Args:
        groups: Pixels of each group.
        size: Pixels of the view.
        count: How many at most. Overlapping groups may draw a pixel twice; it comes once.
        rng: Draws them.
    """
    shares = equal_shares(torch.diff(groups.starts).tolist(), count, rng)
    parts = [groups.values[:0]]
    missed = torch.ones(size, dtype=torch.float64)
    for index, share in enumerate(shares):
        members = groups.row(index)
        drawn = rng.choice(len(members), share, replace=False)
        parts.append(members[torch.from_numpy(drawn)])
        missed[members] *= 1.0 - share / len(members)
    pixels = torch.unique(torch.cat(parts))
    pixels = pixels[torch.from_numpy(rng.permutation(len(pixels)))]
    return pixels, (1.0 / (1.0 - missed[pixels])).float()


def equal_shares(sizes: list[int], count: int, rng: np.random.Generator) -> list[int]:
    """How many of `count` each group gives: equally many, or all it has.

    What does not divide goes to groups drawn by chance.
    """
    shares = [0] * len(sizes)
    left, open_groups = min(count, sum(sizes)), list(range(len(sizes)))
    while left > 0:
        each = left // len(open_groups)
        if each == 0:
            for position in rng.permutation(len(open_groups))[:left].tolist():
                shares[open_groups[position]] += 1
            break
        for group in open_groups:
            more = min(each, sizes[group] - shares[group])
            shares[group] += more
            left -= more
        open_groups = [group for group in open_groups if shares[group] < sizes[group]]
    return shares
