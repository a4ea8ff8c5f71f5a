"""Gaussians made by hand."""

import pytest
import torch

from splatseg.core import Gaussians
from splatseg.core.sh import SH_C0


@pytest.fixture
def make():
    """Gaussians at given places, of one size, opacity and colour unless told otherwise."""

    def gaussians(means, *, scales=0.0, opacities=1.0, colours=(0.5, 0.5, 0.5), **rest):
        means = torch.as_tensor(means, dtype=torch.float32).reshape(-1, 3)
        n = len(means)
        colours = torch.as_tensor(colours, dtype=torch.float32).expand(n, 3)
        return Gaussians(
            means=means,
            rotations=rest.pop("rotations", torch.eye(4)[:1].expand(n, 4)),
            scales=torch.as_tensor(scales, dtype=torch.float32).expand(n, 3).clone(),
            opacities=torch.as_tensor(opacities, dtype=torch.float32).expand(n).clone(),
            sh=((colours - 0.5) / SH_C0).unsqueeze(1),
            **rest,
        )

    return gaussians
