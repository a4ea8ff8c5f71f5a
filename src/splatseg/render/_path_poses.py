"""Poses of a camera path, and distances between them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_RADIAN_SHARE = 0.5
"""A radian counts as this share of the spread of the captured positions."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Poses:
    """Positions and orientations, world from camera."""

    centres: Float[Tensor, "n 3"]
    quaternions: Float[Tensor, "n 4"]

    def __len__(self) -> int:
        return len(self.centres)

    def __getitem__(self, index: Tensor) -> "Poses":
        return Poses(centres=self.centres[index], quaternions=self.quaternions[index])


def radian_length(poses: Poses) -> float:
    """Length that one radian counts as; 1 for a capture from one position."""
    offsets = poses.centres - poses.centres.mean(dim=0)
    spread = float(offsets.square().sum(dim=1).mean().sqrt())
    return _RADIAN_SHARE * spread if spread > 1e-9 else 1.0


def angles_between(a: Float[Tensor, "*n 4"], b: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n"]:
    """Radians between orientations."""
    # The arc cosine of the product would be off by 1e-8 where they agree.
    chord = torch.minimum((a - b).norm(dim=-1), (a + b).norm(dim=-1))
    return 4 * torch.asin((chord / 2).clamp(max=1.0))
