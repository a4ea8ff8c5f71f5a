"""The order in which a tracker goes through views."""

import re
from collections.abc import Sequence
from typing import Literal

import torch

from splatseg.core import View

ViewOrder = Literal["name", "path"]

_NUMBER = re.compile(r"(\d+)")


def ordered_views(views: Sequence[View], order: ViewOrder) -> tuple[View, ...]:
    r"""Views by name, or each followed by the nearest of those that are left.

    The path starts at the first view by name. With centres :math:`c` and unit optical axes
    :math:`a`, the distance of two views is

    .. math:: d = \lVert c_1 - c_2 \rVert / s + \arccos(a_1 \cdot a_2)

    where :math:`s` is the mean distance of the centres from their mean.

    Args:
        views: The views.
        order: ``name``, numbers in names by their value, or ``path``.
    """
    by_name = sorted(views, key=lambda view: _natural(view.name))
    if order == "name" or len(by_name) < 3:
        return tuple(by_name)
    poses = torch.stack([view.camera.world_from_cam.double().cpu() for view in by_name])
    centres, axes = poses[:, :3, 3], poses[:, :3, 2]
    scale = float((centres - centres.mean(0)).norm(dim=1).mean()) or 1.0
    left = torch.ones(len(by_name), dtype=torch.bool)
    path = [0]
    while len(path) < len(by_name):
        left[path[-1]] = False
        distance = (centres - centres[path[-1]]).norm(dim=1) / scale
        distance += (axes @ axes[path[-1]]).clamp(-1, 1).acos()
        path.append(int(distance.masked_fill(~left, torch.inf).argmin()))
    return tuple(by_name[i] for i in path)


def _natural(name: str) -> tuple[tuple[tuple[bool, int, str], ...], str]:
    """Sorts frame_9 before frame_10; of names that differ in leading zeros alone by text."""
    parts = [part for part in _NUMBER.split(name) if part]
    key = tuple((not p.isdecimal(), int(p) if p.isdecimal() else 0, p) for p in parts)
    return tuple((text, number, part if text else "") for text, number, part in key), name
