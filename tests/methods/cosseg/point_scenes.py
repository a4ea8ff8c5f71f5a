"""Small scenes, and networks with random weights and batch statistics."""

from typing import TypeVar

import torch
from torch import Tensor, nn

from splatseg.methods.cosseg.pyramid import (
    PointPyramid,
    PyramidOptions,
    RandlaConfig,
    point_pyramid,
)

M = TypeVar("M", bound=nn.Module)


def small_config(sum_slope: float = 0.2, inputs: int = 6) -> RandlaConfig:
    """Three levels with neighbours, of widths that no two layers share."""
    return RandlaConfig(
        inputs=inputs, first_width=5, widths=(4, 8, 6), neighbours=4, ratios=(2, 3, 2),
        classes=3, sum_slope=sum_slope,
    )  # fmt: skip


def scene(count: int = 40, seed: int = 3) -> tuple[Tensor, Tensor]:
    """Positions and colours."""
    generator = torch.Generator().manual_seed(seed)
    positions = torch.randn(count, 3, generator=generator)
    return positions, torch.rand(count, 3, generator=generator)


def pyramid_of(positions: Tensor, config: RandlaConfig, seed: int = 0) -> PointPyramid:
    options = PyramidOptions(neighbours=config.neighbours, ratios=config.ratios)
    return point_pyramid(positions, options=options, seed=seed)


def randomised(module: M, seed: int = 1) -> M:
    """A network, evaluating, of which no parameter and no statistic is what it begins with."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, tensor in module.state_dict().items():
            if name.endswith("running_var"):
                tensor.copy_(torch.rand(tensor.shape, generator=generator) + 0.5)
            elif tensor.is_floating_point():
                spread = tensor.shape[-1] ** -0.5 if tensor.ndim == 2 else 0.5
                tensor.copy_(torch.randn(tensor.shape, generator=generator) * spread)
                if name.endswith("norm.weight"):
                    tensor.add_(1.0)
    return module.eval()
