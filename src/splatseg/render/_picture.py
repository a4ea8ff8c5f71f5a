r"""Pictures in eight bits: colours with a tint mixed in, spelt out.

A tint is a colour and how much of it, :math:`(t_i, a_i)`, for each Gaussian. Blending is linear,
so that mixing colours before it is mixing pictures after it:

.. math:: W (c + a (t - c)) = W c + W (a (t - c))
"""

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatseg.core import Camera, Gaussians
from splatseg.core.sh import evaluate_sh

_LEVELS = 255


def mixed_colours(
    gaussians: Gaussians,
    camera: Camera,
    *,
    tint: UInt8[Tensor, "n 4"] | None,
    signal: Float[Tensor, "n channels"] | None,
    degree: int | None,
) -> Float[Tensor, "n 3"]:
    """Colours of the Gaussians, the signal or the harmonics, with the tint mixed in.

    Args:
        gaussians: The Gaussians.
        camera: From where the harmonics are seen.
        tint: Red, green, blue and how much of them; None is none.
        signal: Grey or colour in place of the harmonics.
        degree: Of the harmonics at most; None is all.
    """
    if signal is None:
        rays = gaussians.means - camera.centre.to(gaussians.means)
        signal = evaluate_sh(
            gaussians.sh, torch.nn.functional.normalize(rays, dim=1), degree=degree
        )
    colours = signal.expand(-1, 3)
    if tint is None:
        return colours
    colour, much = (tint.to(colours) / _LEVELS).split((3, 1), dim=1)
    return colours + (colour - colours) * much


def eight_bits(image: Float[Tensor, "height width 3"]) -> UInt8[Tensor, "height width 3"]:
    """Colours from 0 to 1 as levels. On the CPU."""
    return (image.clamp(0, 1) * _LEVELS).round().to(torch.uint8).cpu()


def without_hidden(gaussians: Gaussians, shown: Bool[Tensor, "n"]) -> Gaussians:
    """The Gaussians, those that are hidden with an opacity of 0: projection leaves them out."""
    opacities = gaussians.opacities * shown.to(gaussians.opacities)
    return gaussians.replace(opacities=opacities)
