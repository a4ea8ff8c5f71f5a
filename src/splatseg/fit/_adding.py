"""New photographs of a fitted scene: Gaussians where they show what the scene does not have."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from splatseg.core import Capture, Gaussians, PointCloud, View
from splatseg.core.boundary import boundary
from splatseg.core.sh import degree_of
from splatseg.errors import InputError
from splatseg.fit._options import Background, FitOptions, fixed_colour
from splatseg.fit._parameters import final_gaussians
from splatseg.fit._photographs import TrainingPhotographs
from splatseg.fit._start import (
    COUNT,
    MAX_DIFFERENCE,
    depth_range_of_points,
    initial_parameters,
    random_points,
)
from splatseg.render import render

_LONGEST = 200
"""Longest side at which renders are compared with photographs, pixels."""

_NEIGHBOURS = 8
"""Known photographs that the pixels of each new one are compared with."""

_DIFFERENCE = 0.1
"""Mean difference of colours, [0, 1], from which on a render does not explain a photograph."""

_COVERED = 0.5
"""Opacity under which nothing of the scene is at a pixel."""


@boundary
def added_gaussians(
    gaussians: Gaussians,
    known: Sequence[View],
    new: Sequence[View],
    *,
    options: FitOptions,
    backend: str = "auto",
) -> Gaussians:
    """Gaussians for what new photographs show and the scene does not have.

    A pixel of a new photograph is not explained where nothing of the scene covers it or the
    render is of another colour. Start points of such pixels, at depths on which several
    photographs agree, become Gaussians that are to be optimised with the others.

    Args:
        gaussians: Those of the scene.
        known: Views that it was fitted to, with photographs.
        new: Views with the new photographs, posed.
        options: How photographs are compared; its seed draws the pixels.
        backend: Name of the renderer.

    Returns:
        The new ones alone, of the same degree of harmonics; perhaps none.

    Raises:
        InputError: If there are no new views, or no known ones.
    """
    if not new or not known:
        raise InputError(
            f"known, new: expected at least one view each, got {len(known)} and {len(new)}."
        )
    views = (*new, *_near(known, new))
    photographs = TrainingPhotographs.of(views, options=options)
    unexplained = [
        _unexplained(gaussians, photographs, index, background=options.background, backend=backend)
        for index in range(len(new))
    ]
    generator = torch.Generator().manual_seed(options.seed)
    centres = PointCloud(points=gaussians.means[gaussians.opacities > _COVERED])
    points = random_points(
        photographs,
        count=min(COUNT, max(1, len(gaussians) // 4)),
        generator=generator,
        depth_range=depth_range_of_points(centres, photographs),
        max_difference=MAX_DIFFERENCE,
        first=len(new),
    )
    wanted = torch.zeros(len(points), dtype=torch.bool)
    for index, mask in enumerate(unexplained):
        wanted |= _seen_at(points, photographs, index, mask)
    if not bool(wanted.any()):
        return gaussians[torch.zeros(0, dtype=torch.int64)].replace(extra={})
    colours = None if points.colours is None else points.colours[wanted]
    capture = Capture(
        path=views[0].image.parent,  # pyright: ignore[reportOptionalMemberAccess]
        format="scene",
        views=tuple(views),
        points=PointCloud(points=points.points[wanted], colours=colours),
    )
    start = initial_parameters(
        capture,
        options=replace(
            options, sh_degree=degree_of(gaussians.sh.shape[1]), max_gaussians=len(points)
        ),
        generator=generator,
    )
    return final_gaussians(start).replace(
        antialiased=gaussians.antialiased, low_pass=gaussians.low_pass
    )


def _near(known: Sequence[View], new: Sequence[View]) -> list[View]:
    """The known views next to each new one, in their order."""
    at = torch.stack([view.camera.centre for view in known]).double()
    wanted = torch.stack([view.camera.centre for view in new]).double()
    nearest = torch.cdist(wanted, at).argsort(dim=1, stable=True)[:, :_NEIGHBOURS]
    return [known[i] for i in sorted({int(i) for i in nearest.reshape(-1)})]


def _unexplained(
    gaussians: Gaussians,
    photographs: TrainingPhotographs,
    index: int,
    *,
    background: Background,
    backend: str,
) -> Bool[Tensor, "height width"]:
    """Pixels of a reduced photograph that the scene does not show."""
    camera = photographs.camera(index)
    example = photographs.example(
        index, reduction=max(1, round(max(camera.width, camera.height) / _LONGEST))
    )
    with torch.no_grad():
        rendered = render(gaussians, example.camera, backend=backend)
    difference = (rendered.image.cpu() - example.photograph).abs().mean(dim=-1)
    smooth = torch.nn.functional.avg_pool2d(difference[None, None], 5, 1, 2)[0, 0]
    found = smooth > _DIFFERENCE
    if fixed_colour(background) is None:
        # Whatever colour nothing has, a photograph that is not covered is not explained.
        found |= rendered.alpha.cpu() < _COVERED
    return found if example.mask is None else found & example.mask


def _seen_at(
    points: PointCloud, photographs: TrainingPhotographs, index: int, mask: Tensor
) -> Bool[Tensor, "points"]:
    """Which points a view shows at one of some pixels."""
    camera = photographs.camera(index).resized(mask.shape[1], mask.shape[0])
    pixels, depth = camera.project(points.points.double())
    inside = (depth > 0) & (pixels >= 0).all(dim=1)
    inside &= (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    column = pixels[:, 0].nan_to_num(0).clamp(0, camera.width - 1).long()
    row = pixels[:, 1].nan_to_num(0).clamp(0, camera.height - 1).long()
    return inside & mask[row, column]
