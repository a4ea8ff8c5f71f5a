r"""Which id a click means, where it is close to the rim of something small.

People click at things, not at areas, and miss by a pixel; and the rims of small things are where
masks err. The pixels around a click have a say, less the farther they are, and a small thing is
likelier meant than a large one. With the distances :math:`d_p` of pixels from the click, in pixels,
and the :math:`n_k` Gaussians of a thing k, a click means the k of the largest

.. math:: \frac{1}{\sqrt{n_k}} \sum_{p \text{ shows } k} e^{-d_p^2 / 2}.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Int64
from torch import Tensor

_REACH = 3
"""Pixels to each side that have a say; what is farther would have less than 1 %."""

_SHARED = 0.2
"""Share of what other clicks mean around a click from which on it is at their border."""


def pixels_around(
    pixel: Int64[Tensor, "2"], height: int, width: int
) -> tuple[Int64[Tensor, "p 2"], Tensor]:
    """Pixels of a picture around one, column and row, and how much each has to say."""
    steps = torch.arange(-_REACH, _REACH + 1)
    offsets = torch.cartesian_prod(steps, steps)
    pixels = pixel.cpu() + offsets
    inside = ((pixels >= 0) & (pixels < torch.tensor([width, height]))).all(dim=1)
    votes = torch.exp(-0.5 * offsets[inside].double().square().sum(dim=1))
    return pixels[inside], votes


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """What a click means."""

    id: int
    """Of the ids of the thing, the one that most pixels around the click show."""

    thing: int
    shares: Mapping[int, float]
    """Of each thing around the click, its share in what the pixels say; they add up to 1."""


def claim(
    ids: Sequence[int],
    votes: Sequence[float],
    *,
    thing_of: Callable[[int], int],
    sizes: Mapping[int, int],
) -> Claim:
    """What a click means; equal claims go to the smaller thing, then id.

    Args:
        ids: What the pixels around it show, at least one.
        votes: How much each has to say.
        thing_of: The thing that an id is of.
        sizes: Gaussians of each thing.
    """
    of_id: dict[int, float] = defaultdict(float)
    of_thing: dict[int, float] = defaultdict(float)
    for id, vote in zip(ids, votes, strict=True):
        of_id[id] += vote
        of_thing[thing_of(id)] += vote
    size = {thing: max(1, sizes.get(thing, 0)) for thing in of_thing}
    best = min(of_thing, key=lambda t: (-of_thing[t] / size[t] ** 0.5, size[t], t))
    own = [id for id in of_id if thing_of(id) == best]
    total = sum(of_thing.values())
    return Claim(
        id=min(own, key=lambda id: (-of_id[id], id)),
        thing=best,
        shares={thing: vote / total for thing, vote in of_thing.items()},
    )


def agreed(claims: Sequence[Claim]) -> list[int]:
    """Ids that several clicks on one thing mean together, each once.

    A click at the border of what another click means already says that this much belongs to the
    thing, and not that all of the neighbour does: it adds nothing.
    """
    found: dict[int, None] = {}
    things: set[int] = set()
    # Clicks in the middle of something come before those at borders.
    for one in sorted(claims, key=lambda one: -one.shares[one.thing]):
        if one.thing in things or sum(one.shares.get(t, 0) for t in things) < _SHARED:
            things.add(one.thing)
            found[one.id] = None
    return list(found)
