"""What single pairs say: where their second camera stands, and how deep both see."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.pose.pointmaps._resection import resect
from splatseg.pose.pointmaps._samples import PairSamples

_RESECTED = 256
"""Pixels of a pair from which its second camera is found."""

_CHUNK = 256
"""Pairs that are resected together: memory stays that of these."""

_MIN_DEPTH_SHARE = 1e-2
"""Least depth, as a share of the median of its map."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairGeometry:
    """Relative poses and depths of pairs, float64, in the unit of each pair."""

    rotation: Float[Tensor, "pairs 3 3"]
    """``second_from_first``."""

    centre: Float[Tensor, "pairs 3"]
    """Of the second camera, in the first one's frame."""

    levels: Float[Tensor, "pairs 2"]
    """log of the depth that both photographs have, relative to `profiles`."""

    profiles: Float[Tensor, "views samples"]
    """log of each photograph's depths up to a constant: the median over its maps."""


def ray_directions(
    offsets: Float[Tensor, "*batch n 2"], focal: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch n 3"]:
    """Rays of pixels in their camera's frame, z = 1."""
    plane = offsets / focal[..., None, None]
    return torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1)


def pair_geometry(samples: PairSamples, focal: Float[Tensor, "views"]) -> PairGeometry:
    """Resect the second camera of each pair, and compare depths of photographs over their pairs."""
    rays = ray_directions(samples.offsets, focal)
    count = samples.offsets.shape[1]
    some = torch.linspace(0, count - 1, min(count, _RESECTED)).round().long()
    rotations: list[Tensor] = []
    translations: list[Tensor] = []
    for begin in range(0, len(samples), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        rotation, translation = resect(
            samples.points[part, 1][:, some].double(),
            rays[samples.second[part]][:, some],
            samples.weights[part, 1][:, some].double(),
        )
        rotations.append(rotation)
        translations.append(translation)
    rotation, translation = torch.cat(rotations), torch.cat(translations)
    depth = torch.stack(
        (
            samples.points[:, 0, :, 2].double(),
            (samples.points[:, 1].double() @ rotation[:, 2].unsqueeze(-1)).squeeze(-1)
            + translation[:, 2:],
        ),
        dim=1,
    )
    typical = depth.median(dim=-1, keepdim=True).values.clamp_min(1e-12)
    logs = torch.maximum(depth, _MIN_DEPTH_SHARE * typical).log()
    profiles, levels = _profiles(logs, samples)
    return PairGeometry(
        rotation=rotation,
        centre=-(rotation.transpose(1, 2) @ translation.unsqueeze(-1)).squeeze(-1),
        levels=levels,
        profiles=profiles,
    )


def _profiles(logs: Tensor, samples: PairSamples) -> tuple[Tensor, Tensor]:
    """Median log depths of each photograph, and how far each of its maps lies above."""
    about = logs - logs.median(dim=-1, keepdim=True).values
    profiles = torch.zeros(samples.offsets.shape[:2], dtype=torch.float64)
    levels = torch.zeros(logs.shape[:2], dtype=torch.float64)
    views = samples.views
    for view in range(len(profiles)):
        pairs, slots = (views == view).nonzero(as_tuple=True)
        profiles[view] = about[pairs, slots].median(dim=0).values
        levels[pairs, slots] = (logs[pairs, slots] - profiles[view]).median(dim=-1).values
    return profiles, levels
