"""What tests of primitives share: the shipped shapes and the code of their sphere, made once."""

import functools

import torch

from splatseg.street.primitives import Primitives
from splatseg.street.shape_files import load_shapes
from splatseg.street.shapes import ShapeAutoEncoder, sphere_code


@functools.cache
def shipped() -> ShapeAutoEncoder:
    """The auto-encoder that comes with the package."""
    return load_shapes()


@functools.cache
def sphere() -> torch.Tensor:
    """The code of its near sphere."""
    return sphere_code(shipped())


def spheres(
    centres: torch.Tensor,
    *,
    scale: float = 0.5,
    levels: list[int] | None = None,
    sizes: tuple[float, ...] = (0.5, 1.0),
) -> Primitives:
    """Near spheres at given places."""
    return Primitives(
        codes=sphere().expand(len(centres), -1),
        centres=centres,
        scales=torch.full((len(centres),), scale),
        levels=torch.tensor(levels if levels is not None else [0] * len(centres)),
        sizes=sizes,
    )
