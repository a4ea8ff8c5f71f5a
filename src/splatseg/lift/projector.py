r"""The network that takes 2D features into the space of Gaussians' features (SAGA, eq. 4).

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

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import layer_norm, leaky_relu

from splatseg.errors import ShapeError

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
