"""The colour behind the Gaussians while they are fitted."""

import re
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.errors import InputError

Background = str | tuple[float, float, float]

_NAMED = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
_HEX = re.compile(r"#[0-9a-fA-F]{6}")


def fixed_colour(background: Background | Sequence[float]) -> tuple[float, float, float] | None:
    """Red, green and blue of a background in [0, 1]; None if each step draws a random one.

    Raises:
        InputError: If it is not a valid background.

    Example:
        >>> fixed_colour("#ff8000")
        (1.0, 0.5019607843137255, 0.0)
    """
    if isinstance(background, str):
        if background == "random":
            return None
        if background in _NAMED:
            return _NAMED[background]
        if _HEX.fullmatch(background):
            red, green, blue = bytes.fromhex(background[1:])
            return (red / 255, green / 255, blue / 255)
    elif len(background) == 3 and all(0 <= value <= 1 for value in background):
        red, green, blue = map(float, background)
        return (red, green, blue)
    raise InputError(
        "background: expected random, black, white, #rrggbb or three numbers in [0, 1], "
        f"got {background!r}."
    )


def background_colour(
    background: Background, *, generator: torch.Generator
) -> Float[Tensor, "3"] | None:
    """The colour of one step; None is black, which needs no blending.

    Args:
        background: As in `FitOptions.background`.
        generator: Source of a random one.
    """
    colour = fixed_colour(background)
    if colour is None:
        return torch.rand(3, generator=generator)
    return torch.tensor(colour) if any(colour) else None
