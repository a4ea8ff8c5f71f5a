"""Readable twins of what is done for many at once: the equations, a point at a time."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor


def point_columns(
    vertices: Float[Tensor, "v 3"],
    opacity: Float[Tensor, "v"],
    probabilities: Float[Tensor, "v k"],
    points: Float[Tensor, "p 3"],
    *,
    radius: float,
) -> Int64[Tensor, "p"]:
    """What `BallQuery.columns` finds: eq. 9 of the paper, -1 where it is undefined."""
    columns: list[int] = []
    for point in points.double():
        distance = torch.linalg.vector_norm(vertices.double() - point, dim=1)
        ball = distance <= radius
        if bool((distance[ball] == 0).any()):
            ball = distance == 0
        weight = torch.where(distance == 0, 1.0, 1 / distance)[ball]
        score = (weight * opacity[ball].double()) @ probabilities[ball].double() / weight.sum()
        columns.append(int(score.argmax()) if bool(ball.any()) and bool(score.sum() > 0) else -1)
    return torch.tensor(columns, dtype=torch.int64)
