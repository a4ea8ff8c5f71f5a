"""RandLA-Net's encoder: features of points and of random subsets of them."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary
from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError
from splatseg.lift.point_network.block import ResidualBlock, sample
from splatseg.lift.point_network.config import RandlaConfig
from splatseg.lift.point_network.layers import SharedMlp
from splatseg.lift.point_network.pyramid import PointPyramid


class RandlaEncoder(nn.Module):
    """The encoder of RandLA-Net (Hu et al. 2020), to be trained or frozen.

    In training mode (``train()``) batch norms take the statistics of all points of a call, which
    holds some ten numbers for every pair of neighbours and channel, as it does wherever gradients
    are recorded. Frozen (``eval()``, without gradients) it goes through the points in blocks, with
    the same result on any number of threads.

    Args:
        config: Its shape; `RandlaConfig.classes` is of no concern.

    Example:
        >>> from splatseg.lift.point_network import PyramidOptions, point_pyramid
        >>> config = RandlaConfig(inputs=3, widths=(4, 8), neighbours=4, ratios=(2, 2))
        >>> points = torch.rand(64, 3)
        >>> options = PyramidOptions(neighbours=4, ratios=(2, 2))
        >>> pyramid = point_pyramid(points, options=options, seed=0)
        >>> [tuple(level.shape) for level in RandlaEncoder(config).eval()(pyramid, points)]
        [(64, 8), (32, 8), (16, 16)]
    """

    @boundary
    def __init__(self, config: RandlaConfig) -> None:
        super().__init__()
        self.config = config
        variant = config.variant
        self.start = SharedMlp(
            config.inputs, config.first_width, slope=variant.start_slope, epsilon=variant.epsilon
        )
        before = (config.first_width, *(2 * width for width in config.widths))
        self.blocks = nn.ModuleList(
            ResidualBlock(inputs, width, variant=variant)
            for inputs, width in zip(before, config.widths, strict=False)
        )

    @boundary
    def forward(
        self, pyramid: PointPyramid, inputs: Float[Tensor, "n channels"]
    ) -> tuple[Tensor, ...]:
        """Features of all levels.

        Args:
            pyramid: The points; its neighbours and ratios should be those of `config`.
            inputs: Channels of each point: x, y, z, as in the pyramid, and where `config` asks
                for it red, green, blue in [0, 1].

        Returns:
            Level 0 before sampling, then what each level passes to the next: L + 1 tensors
            (n_l, channels), of `RandlaConfig.level_widths` channels. The decoder of RandLA-Net
            takes the same.

        Raises:
            ShapeError: If `inputs` has not a row a point or the wrong channels.
            RangeError: If a value is not finite.
            InputError: If the pyramid has another number of levels.
        """
        check_shape("inputs", inputs, (len(pyramid.positions), self.config.inputs))
        check_finite("inputs", inputs)
        if len(pyramid.neighbours) != len(self.blocks):
            raise InputError(
                f"pyramid: expected {len(self.blocks)} levels with neighbours, "
                f"got {len(pyramid.neighbours)}."
            )
        if self.training or (torch.is_grad_enabled() and self._has_gradients(inputs)):
            return self._levels(pyramid, inputs)
        with torch.no_grad(), one_torch_thread():
            return self._levels(pyramid, inputs)

    def _has_gradients(self, inputs: Tensor) -> bool:
        return inputs.requires_grad or any(one.requires_grad for one in self.parameters())

    def _levels(self, pyramid: PointPyramid, inputs: Tensor) -> tuple[Tensor, ...]:
        features = self.start(inputs)
        levels: list[Tensor] = []
        for level, block in enumerate(self.blocks):
            positions = pyramid.positions[pyramid.kept[level]]
            found = block(positions, features, pyramid.neighbours[level])
            if level == 0:
                levels.append(found)
            features = sample(
                found, pyramid.neighbours[level], pyramid.pool[level], variant=self.config.variant
            )
            levels.append(features)
        return tuple(levels)
