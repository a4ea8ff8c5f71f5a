r"""Features that are compared (SAGA): the head that reads them, and its projector (eq. 4).

Two hidden layers of 64, each a linear map, layer normalisation and a leaky ReLU, and a linear map:

.. math:: \varphi(x) = A_2 \, h_1(h_0(x)) + b_2, \qquad
          h_k(x) = \mathrm{LeakyReLU}(\mathrm{LayerNorm}(A_k x + b_k)) .

Its weights are plain arrays by name, so that a training steps them and the info of a layer holds
them.

References:
    Cen et al., Segment Any 3D Gaussians (2023), eq. 4, and the published code for the widths.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor
from torch.nn.functional import layer_norm, leaky_relu, normalize

from splatseg._check import check_finite, check_range, check_shape
from splatseg.core import JSON, Features
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.options import Count, Share
from splatseg.errors import InputError, RangeError, ShapeError

HIDDEN = 64
"""Width of both hidden layers, as published."""


def projector_shapes(inputs: int, outputs: int) -> dict[str, tuple[int, ...]]:
    """The arrays of a projector, by name.

    Args:
        inputs: Channels of the 2D features.
        outputs: Channels of a Gaussian's feature.
    """
    return {
        "weight0": (HIDDEN, inputs),
        "bias0": (HIDDEN,),
        "gain0": (HIDDEN,),
        "shift0": (HIDDEN,),
        "weight1": (HIDDEN, HIDDEN),
        "bias1": (HIDDEN,),
        "gain1": (HIDDEN,),
        "shift1": (HIDDEN,),
        "weight2": (outputs, HIDDEN),
        "bias2": (outputs,),
    }


def projector_start(inputs: int, outputs: int, rng: np.random.Generator) -> dict[str, Tensor]:
    """What a projector's arrays start as.

    Linear maps are uniform within 1 / sqrt(inputs); normalisation changes nothing at first.
    """
    start: dict[str, Tensor] = {}
    width = inputs
    for name, shape in projector_shapes(inputs, outputs).items():
        if name.startswith("weight"):
            width = shape[1]
        if name.startswith(("gain", "shift")):
            start[name] = torch.full(shape, float(name.startswith("gain")))
        else:
            bound = 1 / math.sqrt(width)
            start[name] = torch.from_numpy(rng.uniform(-bound, bound, shape).astype(np.float32))
    return start


def project_features(
    arrays: Mapping[str, Tensor], features: Float[Tensor, "*batch inputs"]
) -> Float[Tensor, "*batch outputs"]:
    """The projector's output, differentiable.

    Args:
        arrays: Those that `projector_shapes` names.
        features: 2D features, channels last.

    Raises:
        ShapeError: If the features have other channels than the projector takes.
    """
    inputs = arrays["weight0"].shape[1]
    if features.shape[-1] != inputs:
        raise ShapeError(f"features: expected {inputs} channels, got {features.shape[-1]}.")
    found = features
    for layer in (0, 1):
        found = found @ arrays[f"weight{layer}"].T + arrays[f"bias{layer}"]
        found = layer_norm(found, (HIDDEN,), arrays[f"gain{layer}"], arrays[f"shift{layer}"])
        found = leaky_relu(found)
    return found @ arrays["weight2"].T + arrays["bias2"]


KIND = "affinity"
"""What tells this head from a classifier's in the info of a layer."""

QUANTILES = 101
"""Numbers that the distribution of scales is kept in: percentiles from 0 to 100."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AffinityHead:
    r"""Reads features by comparing them.

    Such features (SAGA's, `methods.saga`) have no classes: two of them are compared,

    .. math:: \cos\bigl(g(s) \odot f_i, \; g(s) \odot f_j\bigr), \qquad g(s) = \sigma(w s + b),

    where the gate g keeps the channels that matter at the scale s of what is looked for: 0 the
    smallest things of the scene, 1 the largest. Scales mean the same in every scene: they are
    levels (0 parts, 0.5 objects, 1 groups), or ranks of size.
    """

    channels: Count
    """Width of a feature."""

    unit: bool
    """Whether features were trained as directions of length 1, rather than freely."""

    gate_weight: Float[Tensor, "channels"] | None = None
    """w of the scale gate; None where there is no gate, and then one scale."""

    gate_bias: Float[Tensor, "channels"] | None = None
    """b of the scale gate."""

    scale_quantiles: Float64[Tensor, "quantiles"] | None = None
    """Percentiles of the scales of masks, in scene units, ascending; None where none were
    measured, or scales are levels."""

    levels: tuple[Share, Share, Share] = (0.5, 0.5, 0.5)
    """The scales, in [0, 1], that stand for groups, objects and their finest parts."""

    projector: Mapping[str, Tensor] = field(default_factory=dict[str, Tensor])
    """Arrays of the network that projects 2D features, see `lift.projector`; none where the
    features were trained from masks alone."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if (self.gate_weight is None) != (self.gate_bias is None):
            raise InputError("gate_weight, gate_bias: expected both or none of them.")
        for name in ("gate_weight", "gate_bias"):
            if (found := getattr(self, name)) is not None:
                check_shape(name, found, (self.channels,))
                check_finite(name, found)
        if self.scale_quantiles is not None:
            check_shape("scale_quantiles", self.scale_quantiles, (QUANTILES,))
            check_finite("scale_quantiles", self.scale_quantiles)
            if bool((self.scale_quantiles.diff() < 0).any()):
                raise RangeError("scale_quantiles: expected ascending numbers, got others.")
        if self.projector:
            _check_projector(self.projector, self.channels)

    @property
    def gated(self) -> bool:
        """Whether similarity depends on the scale."""
        return self.gate_weight is not None

    def scale(self, granularity: float) -> float:
        """The scale in [0, 1] of a granularity: 0 groups, 0.5 objects, 1 their finest parts.

        Between them it is linear.

        Raises:
            RangeError: If the granularity is outside [0, 1].
        """
        check_range("granularity", granularity, 0.0, 1.0)
        return float(np.interp(granularity, (0.0, 0.5, 1.0), self.levels))

    def gate(self, scale: float) -> Float[Tensor, "channels"]:
        """The gate g of a scale in [0, 1]; ones where there is none.

        Raises:
            RangeError: If the scale is outside [0, 1].
        """
        check_range("scale", scale, 0.0, 1.0)
        if self.gate_weight is None or self.gate_bias is None:
            return torch.ones(self.channels)
        return torch.sigmoid(self.gate_weight * scale + self.gate_bias)

    def directions(
        self, features: Float[Tensor, "*batch channels"], scale: float
    ) -> Float[Tensor, "*batch channels"]:
        """Gated features with length 1, whose products are similarities in [-1, 1].

        Args:
            features: Of Gaussians, or rendered; the zero vector stays zero.
            scale: In [0, 1], see `scale`.
        """
        check_shape("features", features, (*features.shape[:-1], self.channels))
        return normalize(features * self.gate(scale).to(features), dim=-1)

    def project(self, features: Float[Tensor, "*batch inputs"]) -> Float[Tensor, "*batch channels"]:
        """2D features, such as a feature map's, in the space of the Gaussians' features.

        Raises:
            InputError: If the features were trained from masks alone.
            ShapeError: If the channels are not those that it was trained on.
        """
        if not self.projector:
            raise InputError(
                "project: expected features trained with the guidance of 2D features, "
                "got some trained from masks alone."
            )
        with torch.no_grad():
            return project_features(self.projector, features.float())

    def to_json(self) -> dict[str, JSON]:
        """The head in values that JSON holds, for the info of a layer of features."""
        return {
            "kind": KIND,
            "channels": self.channels,
            "unit": self.unit,
            "gate_weight": _listed(self.gate_weight),
            "gate_bias": _listed(self.gate_bias),
            "scale_quantiles": _listed(self.scale_quantiles),
            "levels": list(self.levels),
            "projector": {name: _listed(value) for name, value in self.projector.items()},
        }

    @classmethod
    @boundary
    def of(cls, features: Features) -> "AffinityHead":
        """The head that a layer of features holds in its info. Inverse of `to_json`.

        Raises:
            InputError: If it holds none, or one that cannot be read.
        """
        found = cast("Mapping[str, Any] | None", features.info.head)
        if found is None or found.get("kind") != KIND:
            raise InputError(
                "features: expected a layer of affinity features (splatseg segment --method saga), "
                "got one without their head."
            )
        try:
            return cls(
                channels=int(found["channels"]),
                unit=bool(found["unit"]),
                gate_weight=_floats(found["gate_weight"]),
                gate_bias=_floats(found["gate_bias"]),
                scale_quantiles=_doubles(found["scale_quantiles"]),
                levels=cast("tuple[float, float, float]", tuple(map(float, found["levels"]))),
                projector={
                    name: torch.tensor(value, dtype=torch.float32)
                    for name, value in found["projector"].items()
                },
            )
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"features: expected an affinity head, got one that cannot be read ({error})."
            ) from error


def _check_projector(arrays: Mapping[str, Tensor], channels: int) -> None:
    first = arrays.get("weight0")
    inputs = int(first.shape[-1]) if first is not None and first.ndim else 0
    expected = projector_shapes(inputs, channels)
    found = {name: tuple(value.shape) for name, value in arrays.items()}
    if found != expected:
        raise InputError("projector: expected the arrays of lift.projector, got others.")


def _listed(values: Tensor | None) -> JSON:
    return None if values is None else cast(JSON, values.tolist())


def _floats(values: Any) -> Tensor | None:
    return None if values is None else torch.tensor(values, dtype=torch.float32)


def _doubles(values: Any) -> Tensor | None:
    return None if values is None else torch.tensor(values, dtype=torch.float64)
