"""Where a drive went: the places of its views in the order in which they were taken."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import View
from splatseg.core.boundary import boundary
from splatseg.core.scene import frame_number
from splatseg.errors import InputError

RIG = 5.0
"""Metres that cameras of one vehicle may stand apart."""


@boundary
def frame_centres(views: Sequence[View], *, metres_per_unit: float = 1.0) -> Float[Tensor, "n 3"]:
    """Places along a drive, one for all cameras of a vehicle at one time.

    The last number in a view's name counts the frames: ``train_0003_L`` and
    ``image_01/0000000003`` are of frame 3. Views of one number are one place, their mean, as long
    as no two of them stand more than 5 m apart; otherwise the names are of several drives, which
    follow each other by the rest of their names. Without numbers views are in the order of names.

    Args:
        views: Views of a drive, in any order; the training views, as others may be beside it.
        metres_per_unit: Length of a scene unit.

    Returns:
        World, scene units, float64.

    Raises:
        InputError: If there are no views.

    Example:
        >>> from splatseg.core import Camera
        >>> def at(name, x):
        ...     pose = torch.eye(4)
        ...     pose[0, 3] = -x
        ...     camera = Camera(width=4, height=4, fx=4, fy=4, cx=2, cy=2, cam_from_world=pose)
        ...     return View(name=name, camera=camera)
        >>> frame_centres([at("a_2_L", 9.0), at("a_2_R", 11.0), at("a_1_L", 0.0)])[:, 0].tolist()
        [0.0, 10.0]
    """
    if not views:
        raise InputError("views: expected views along a drive, got none.")
    named = sorted(views, key=lambda view: view.name)
    numbers = [frame_number(view.name) for view in named]
    drives: dict[tuple[str, int], list[Tensor]] = {}
    frames: dict[int, list[Tensor]] = {}
    for view, number in zip(named, numbers, strict=True):
        if number is None:
            return torch.stack([view.camera.centre for view in named]).double()
        drives.setdefault(number, []).append(view.camera.centre.double())
        frames.setdefault(number[1], []).append(view.camera.centre.double())
    one_rig = all(_extent(places) * metres_per_unit <= RIG for places in frames.values())
    return _means(frames if one_rig else drives)


def _extent(places: Sequence[Tensor]) -> float:
    """Length of the diagonal of the box of some places."""
    stacked = torch.stack(list(places))
    return float(torch.linalg.vector_norm(stacked.amax(dim=0) - stacked.amin(dim=0)))


def _means(frames: Mapping[int, list[Tensor]] | Mapping[tuple[str, int], list[Tensor]]) -> Tensor:
    rows = sorted(frames.items())
    return torch.stack([torch.stack(places).mean(dim=0) for _, places in rows])
