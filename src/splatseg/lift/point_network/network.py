"""RandLA-Net whole: the encoder, its decoder and a head, to train checkpoints with."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatseg.core.boundary import boundary
from splatseg.lift.point_network.config import RandlaConfig
from splatseg.lift.point_network.encoder import RandlaEncoder
from splatseg.lift.point_network.layers import SharedMlp
from splatseg.lift.point_network.pyramid import PointPyramid

_HEAD = (64, 32)
"""Channels of the head's two layers."""
_DROPPED = 0.5
"""Share of channels that the head drops while training."""


class RandlaNet(nn.Module):
    """RandLA-Net (Hu et al. 2020, figure 7): logits of points.

    The decoder goes from the last level to level 0. At each step features go from the nearest
    point of the coarser level to the points of the finer one, stand behind what the encoder
    found there (a skip), and pass one layer. The head's two layers, drop-out and a linear layer
    follow.

    Args:
        config: Its shape.

    Example:
        >>> from splatseg.lift.point_network import PyramidOptions, point_pyramid
        >>> config = RandlaConfig(inputs=3, widths=(4, 8), neighbours=4, ratios=(2, 2), classes=5)
        >>> points = torch.rand(64, 3)
        >>> options = PyramidOptions(neighbours=4, ratios=(2, 2))
        >>> pyramid = point_pyramid(points, options=options, seed=0)
        >>> RandlaNet(config).eval()(pyramid, points).shape
        torch.Size([64, 5])
    """

    @boundary
    def __init__(self, config: RandlaConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = RandlaEncoder(config)
        widths = config.level_widths
        slope, epsilon = config.variant.slope, config.variant.epsilon

        def layer(inputs: int, outputs: int) -> SharedMlp:
            return SharedMlp(inputs, outputs, slope=slope, epsilon=epsilon)

        self.middle = layer(widths[-1], widths[-1])
        # A step ends with as many channels as its skip has.
        befores = (widths[-1], *widths[-2:0:-1])
        self.steps = nn.ModuleList(
            layer(skip + before, skip) for skip, before in zip(widths[-2::-1], befores, strict=True)
        )
        self.head = nn.Sequential(
            layer(widths[0], _HEAD[0]),
            layer(*_HEAD),
            nn.Dropout(_DROPPED),
            nn.Linear(_HEAD[1], config.classes),
        )

    @boundary
    def forward(
        self, pyramid: PointPyramid, inputs: Float[Tensor, "n channels"]
    ) -> Float[Tensor, "n classes"]:
        """Logits of the classes of each point.

        Args:
            pyramid: The points, see `RandlaEncoder.forward`.
            inputs: Channels of each point.

        Raises:
            ShapeError: If `inputs` has not a row a point or the wrong channels.
            RangeError: If a value is not finite.
            InputError: If the pyramid has another number of levels.
        """
        levels = self.encoder(pyramid, inputs)
        features = self.middle(levels[-1])
        for step, skip, up in zip(
            self.steps, reversed(levels[:-1]), reversed(pyramid.up), strict=True
        ):
            features = step(torch.cat((skip, features[up]), dim=1))
        return self.head(features)
