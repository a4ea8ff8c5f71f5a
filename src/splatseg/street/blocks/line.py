"""Lines through places in order: lengths, pieces, and distances of points from them."""

import torch
from jaxtyping import Float
from torch import Tensor

_POINTS = 16384


def thinned(places: Float[Tensor, "n 3"], step: float) -> Float[Tensor, "m 3"]:
    """The first place, each that is a step from the last one kept, and the last."""
    kept = [places[0]]
    for place in places[1:]:
        if float(torch.linalg.vector_norm(place - kept[-1])) >= step:
            kept.append(place)
    if not torch.equal(kept[-1], places[-1]):
        kept.append(places[-1])
    return torch.stack(kept)


def simplified(line: Float[Tensor, "n 3"], tolerance: float) -> Float[Tensor, "m 3"]:
    """Fewest corners that the method of Douglas and Peucker finds within a tolerance of all.

    What lies between two kept corners is no farther from their connection than the tolerance.
    """
    kept = {0, len(line) - 1}
    open_pieces = [(0, len(line) - 1)]
    while open_pieces:
        first, last = open_pieces.pop()
        if last - first < 2:
            continue
        off = distances(line[first + 1 : last], line[[first, last]])
        middle = first + 1 + int(off.argmax())
        if float(off.max()) > tolerance:
            kept.add(middle)
            open_pieces += [(first, middle), (middle, last)]
    return line[sorted(kept)]


def lengths(line: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """How far along a line its corners are."""
    steps = torch.linalg.vector_norm(line[1:] - line[:-1], dim=1)
    return torch.cat((steps.new_zeros(1), steps.cumsum(0)))


def between(
    line: Float[Tensor, "n 3"], along: Float[Tensor, "n"], start: float, end: float
) -> Float[Tensor, "m 3"]:
    """The piece of a line from one length to another, cut where the line begins and ends."""
    inside = (along > start) & (along < end)
    ends = (_place(line, along, start), _place(line, along, end))
    return torch.cat((ends[0][None], line[inside], ends[1][None]))


def _place(
    line: Float[Tensor, "n 3"], along: Float[Tensor, "n"], length: float
) -> Float[Tensor, "3"]:
    at = min(max(length, 0.0), float(along[-1]))
    i = int(torch.searchsorted(along, at, right=True)) - 1
    if i >= len(line) - 1:
        return line[-1]
    share = (at - float(along[i])) / float(along[i + 1] - along[i])
    return line[i] + share * (line[i + 1] - line[i])


def distances(points: Float[Tensor, "n 3"], line: Float[Tensor, "m 3"]) -> Float[Tensor, "n"]:
    """Distance of each point from the nearest place of a line.

    Nothing but operations on single numbers, so that a point has the same bits in any company.
    """
    parts = [_distances(part, line) for part in points.split(_POINTS)]
    return torch.cat(parts) if parts else points.new_zeros(0)


def _distances(points: Float[Tensor, "n 3"], line: Float[Tensor, "m 3"]) -> Float[Tensor, "n"]:
    start = line[:1] if len(line) == 1 else line[:-1]
    way = torch.zeros_like(start) if len(line) == 1 else line[1:] - line[:-1]
    squared = _sum(way * way)
    offset = [points[:, k : k + 1] - start[:, k] for k in range(3)]
    dot = offset[0] * way[:, 0] + offset[1] * way[:, 1] + offset[2] * way[:, 2]
    share = torch.where(squared > 0, dot / torch.where(squared > 0, squared, 1.0), 0.0).clamp(0, 1)
    rest = [offset[k] - share * way[:, k] for k in range(3)]
    return (rest[0] ** 2 + rest[1] ** 2 + rest[2] ** 2).amin(dim=1).sqrt()


def _sum(values: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    return values[:, 0] + values[:, 1] + values[:, 2]
