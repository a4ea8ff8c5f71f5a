"""Options of the blending model. The constants behind them are in `_constants`."""

import math
from dataclasses import dataclass

from splatseg.core.boundary import convert_fields
from splatseg.core.gaussians import LOW_PASS
from splatseg.errors import RangeError


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderOptions:
    """How Gaussians become pixels. The defaults are 3DGS's, but for the near plane."""

    near: float = 0.01
    """Gaussians whose z-depth is not greater are left out, scene units."""

    alpha_max: float = 0.99
    """Largest alpha of one Gaussian at one pixel. gsplat's CUDA kernels have 0.999."""

    low_pass: float = LOW_PASS
    """Added to both variances of the projected Gaussian, square pixels."""

    antialiased: bool = False
    """Scale opacities to compensate for the low-pass filter (Mip-Splatting, eq. 9)."""

    sh_degree: int | None = None
    """Maximum degree of the spherical harmonics in use; None is all."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if not (math.isfinite(self.near) and self.near > 0):
            raise RangeError(f"near: expected a positive depth, got {self.near}.")
        if not 1 / 255 < self.alpha_max < 1:
            raise RangeError(f"alpha_max: expected a value in (1/255, 1), got {self.alpha_max}.")
        if not (math.isfinite(self.low_pass) and self.low_pass >= 0):
            raise RangeError(f"low_pass: expected 0 or more, got {self.low_pass}.")
        if self.sh_degree is not None and not 0 <= self.sh_degree <= 3:
            raise RangeError(f"sh_degree: expected 0 to 3, got {self.sh_degree}.")
