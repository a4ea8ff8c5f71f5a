"""Positional encoding, and the perceptrons that are given it."""

import itertools
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional


def encoded_size(size: int, frequencies: int) -> int:
    """Numbers of what `encode` returns.

    Example:
        >>> encoded_size(3, 6)
        39
    """
    return size * (1 + 2 * frequencies)


def encode(values: Float[Tensor, "n d"], frequencies: int) -> Float[Tensor, "n e"]:
    r"""Values with their sines and cosines at octaves.

    .. math:: (x, \sin x, \sin 2 x, \ldots, \sin 2^{L - 1} x, \cos x, \ldots, \cos 2^{L - 1} x)

    References:
        Mildenhall et al., NeRF (ECCV 2020), section 5.1, with the values themselves as in its code.
    """
    if not frequencies:
        return values
    octaves = 2.0 ** torch.arange(frequencies, dtype=values.dtype, device=values.device)
    angles = (values[:, None, :] * octaves[:, None]).flatten(1)
    return torch.cat((values, angles.sin(), angles.cos()), dim=1)


class Layers(nn.Module):
    """Linear layers with ReLUs between them, none after the last.

    Args:
        widths: Channels before the first layer, and after each.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(*pair) for pair in itertools.pairwise(widths))

    def forward(self, x: Float[Tensor, "n a"]) -> Float[Tensor, "n b"]:
        """The last layer's channels."""
        for layer in self.layers[:-1]:
            x = functional.relu(layer(x), inplace=True)
        return self.layers[-1](x)


class Trunk(nn.Module):
    """Linear layers with a ReLU after each, one of which is given the input once more.

    Args:
        size: Numbers of the input.
        width: Channels after each layer.
        depth: How many layers there are.
        skip: The layer (from 1) that is given the input beside the channels; 0 is none.
    """

    def __init__(self, size: int, *, width: int, depth: int, skip: int) -> None:
        super().__init__()
        self._skip = skip
        widths = [size] + [width] * (depth - 1)
        if skip > 1:
            widths[skip - 1] += size
        self.layers = nn.ModuleList(nn.Linear(before, width) for before in widths)

    def forward(self, x: Float[Tensor, "n a"]) -> Float[Tensor, "n b"]:
        """The last layer's channels."""
        hidden = x
        for number, layer in enumerate(self.layers, start=1):
            if number == self._skip > 1:
                hidden = torch.cat((hidden, x), dim=1)
            hidden = functional.relu(layer(hidden), inplace=True)
        return hidden
