"""How Gaussians are trained together with a decoder."""

from dataclasses import dataclass

from splatseg._check import check_range
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError
from splatseg.methods._trained import check_rate

PUBLISHED_RGB_WEIGHT = 0.2
"""On L1, as equation 5 is printed; the usual is 0.8."""
PUBLISHED_LABEL_WEIGHT = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class JointOptions:
    """How Gaussians and decoder are trained together."""

    joint_steps: int = 2000
    """Steps, each with one whole picture."""

    rgb_weight: float = PUBLISHED_RGB_WEIGHT
    """Lambda_rgb, in [0, 1]: the share of L1 beside D-SSIM. 0.2 as printed, usually 0.8."""

    label_weight: float = PUBLISHED_LABEL_WEIGHT
    """Lambda_s, the weight of labels beside that of photographs, 0 or more."""

    joint_start: float = 0.6
    """Progress, in [0, 1], of a fit whose rates Gaussians begin with."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.joint_steps < 1:
            raise RangeError(f"joint_steps: expected at least 1, got {self.joint_steps}.")
        check_range("rgb_weight", self.rgb_weight, 0.0, 1.0)
        check_range("joint_start", self.joint_start, 0.0, 1.0)
        check_rate("label_weight", self.label_weight)
