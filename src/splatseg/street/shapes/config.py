"""How large an auto-encoder of shapes is."""

from dataclasses import dataclass

from splatseg._check import check_range
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError

MAX_WIDTH = 4096
"""Channels that a layer may have; a file that asks for more is not believed."""
MAX_LAYERS = 12
"""Hidden layers that encoder or decoder may have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeConfig:
    """Widths of the layers. The defaults are the published ones (DNMP, Lu et al. 2023).

    Example:
        >>> ShapeConfig().decoder_widths
        (512, 512, 512, 512)
    """

    code_size: int = 8
    """mu, numbers of a code, at least 2: codes are points of a sphere."""

    encoder_widths: tuple[int, ...] = (512, 512, 512, 512)
    """Channels of a point after each layer, before the maximum over points."""

    decoder_widths: tuple[int, ...] = (512, 512, 512, 512)
    """Channels after each layer of the decoder, before the offsets."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_range("code_size", self.code_size, 2, MAX_WIDTH)
        for name in ("encoder_widths", "decoder_widths"):
            widths: tuple[int, ...] = getattr(self, name)
            if not 1 <= len(widths) <= MAX_LAYERS:
                raise RangeError(f"{name}: expected 1 to {MAX_LAYERS} layers, got {len(widths)}.")
            if any(not 1 <= width <= MAX_WIDTH for width in widths):
                raise RangeError(f"{name}: expected widths of 1 to {MAX_WIDTH}, got {widths}.")


PUBLISHED = ShapeConfig()
"""The published auto-encoder: 1.65 million weights."""
