r"""The fusion decoder: distilled features and spatial encodings to one feature, from far to near.

Every level l of the points has the spatial encoding :math:`e_l` of the frozen network and the
distilled feature :math:`d_l` of one block, the shallowest at the points themselves, the deepest
farthest up. From the last level L on, what is decoded goes to the nearest points of the level
below and is joined to what is there:

.. math:: x_L = \phi(A_L (e_L \oplus d_L)), \qquad
          x_l = \phi(A_l (x_{l+1}[\mathrm{up}_l] \oplus e_l \oplus d_l)), \qquad
          h = \mathrm{head}(x_0)

with :math:`\phi` a batch norm and a leaky ReLU, and a head of more such layers. While training,
batch norms take mean and variance of the points that a view's pixels need, and running ones are
kept, which count afterwards; drop-out falls on h. A linear classifier of h gives the
logits of ids; it is kept apart (`lift.heads.ClassifierHead`), so that what is stored of a Gaussian
does not grow with their number. A matrix is applied to what comes from above before it is spread:
each point above stands for four below.

References:
    Dou et al., CoSSegGaussians (2024), section 3.3, Figs. 3 and 4.
    Hu et al., RandLA-Net (2020), Fig. 7: the skips and the head.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import batch_norm, embedding, leaky_relu

from splatseg.errors import ShapeError
from splatseg.lift.training import Batch, Parameter, Values
from splatseg.methods._trained import TINY, LabelCounts, linear_start
from splatseg.methods.cosseg.network import MOMENTUM
from splatseg.methods.cosseg.options import CossegOptions
from splatseg.methods.cosseg.points import FusionInputs, PointSet

SLOPE = 0.2
"""Of the leaky ReLUs, as RandLA-Net has them."""

EPSILON = 1e-6
"""Added to variances, as RandLA-Net has it."""

RUNNING = (".mean", ".variance")
"""How the names of running statistics end; no gradient moves these."""

_ROWS = 1 << 16
"""Points decoded at a time where no gradient is asked for."""

Weights = Mapping[str, Tensor]


START, DROPPED = 0xC055, 0xC056
"""What generators of first weights and of drop-out are seeded with besides the seed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionShape:
    """Widths of the decoder's layers."""

    inputs: tuple[int, ...]
    """Channels of `FusionInputs.levels`."""

    decoded: tuple[int, ...]
    """Channels decoded at each of these levels."""

    head: tuple[int, ...]
    """Channels of the head's layers, one after the other; the last is what is classified."""

    def start(self, rng: np.random.Generator) -> dict[str, Tensor]:
        """First weights: uniform within 1 / sqrt(inputs), as torch's linear layers.

        A batch norm takes a bias away, so there is none.
        """
        found: dict[str, Tensor] = {}

        def layer(name: str, parts: Mapping[str, int], outputs: int) -> None:
            bound = 1 / math.sqrt(sum(parts.values()))
            for part, width in parts.items():
                found[f"{name}.{part}"] = _uniform(rng, bound, (width, outputs))
            found[f"{name}.scale"], found[f"{name}.shift"] = (
                torch.ones(outputs),
                torch.zeros(outputs),
            )
            found[f"{name}.mean"], found[f"{name}.variance"] = (
                torch.zeros(outputs),
                torch.ones(outputs),
            )

        last = len(self.inputs) - 1
        for level in range(last, -1, -1):
            parts = {"own": self.inputs[level]}
            if level < last:
                parts["above"] = self.decoded[level + 1]
            layer(f"level{level}", parts, self.decoded[level])
        widths = (self.decoded[0], *self.head)
        for index, (inputs, outputs) in enumerate(pairwise(widths)):
            layer(f"head{index}", {"own": inputs}, outputs)
        return found


Statistics = dict[str, Tensor]
"""Mean and variance of the rows of each batch norm, named as the running ones."""


def decode(
    inputs: FusionInputs,
    weights: Weights,
    rows: Int64[Tensor, "t"],
    *,
    statistics: Statistics | None = None,
) -> Float[Tensor, "t channels"]:
    """What is decoded of some points, differentiable towards the weights.

    Only what these points depend on is computed.

    Args:
        inputs: Of the points.
        weights: Named as `FusionShape.start` names them.
        rows: Rows of level 0, distinct.
        statistics: While training: batch norms are by the points that are computed, and their
            statistics are put here. None takes the running ones of `weights`.
    """
    needed, position = [rows], []
    for level, up in enumerate(inputs.up):
        above, where = _distinct(up[needed[-1]], len(inputs.levels[level + 1]))
        needed.append(above)
        position.append(where)
    last = len(inputs.levels) - 1
    decoded = _own(inputs, weights, last, needed[last], statistics=statistics)
    for level in range(last - 1, -1, -1):
        # The gradient of `embedding` is a sum in the order of entries, in one pass.
        spread = embedding(position[level], decoded @ weights[f"level{level}.above"])
        decoded = _own(inputs, weights, level, needed[level], spread, statistics=statistics)
    return _headed(weights, decoded, statistics)


def running(weights: Weights, statistics: Statistics, momentum: float) -> dict[str, Tensor]:
    """Running statistics after a batch: the share `momentum` is the batch's."""
    return {
        name: weights[name].detach().lerp(value, momentum) for name, value in statistics.items()
    }


def running_momentum(step: int) -> float:
    """The share of a batch in running statistics: RandLA-Net's, and more in the first steps."""
    return max(MOMENTUM, 1 / step)


def dropped(
    values: Float[Tensor, "n channels"], share: float, rng: np.random.Generator
) -> Float[Tensor, "n channels"]:
    """Drop-out: a share of all numbers 0, at random, and the others larger by what is missing."""
    if not share:
        return values
    stay = torch.from_numpy(rng.random(tuple(values.shape), dtype=np.float32) >= share)
    return values * (stay / (1 - share))


def decode_all(inputs: FusionInputs, weights: Weights) -> Float[Tensor, "n channels"]:
    """`decode` of all points: level by level, some at a time, without gradients."""
    with torch.no_grad():
        decoded: Tensor | None = None
        for level in range(len(inputs.levels) - 1, -1, -1):
            above = None if decoded is None else decoded @ weights[f"level{level}.above"]
            parts: list[Tensor] = []
            for rows in torch.arange(len(inputs.levels[level])).split(_ROWS):
                spread = None if above is None else above[inputs.up[level][rows]]
                own = _own(inputs, weights, level, rows, spread)
                parts.append(own if level else _headed(weights, own))
            decoded = torch.cat(parts)
    if decoded is None:
        raise ShapeError("levels: expected at least one, got none.")
    return decoded


def _own(
    inputs: FusionInputs,
    weights: Weights,
    level: int,
    rows: Tensor,
    above: Tensor | None = None,
    *,
    statistics: Statistics | None = None,
) -> Tensor:
    own = inputs.levels[level].index_select(0, rows).float() @ weights[f"level{level}.own"]
    return _activated(weights, f"level{level}", own if above is None else own + above, statistics)


def _headed(weights: Weights, decoded: Tensor, statistics: Statistics | None = None) -> Tensor:
    layers = sum(name.startswith("head") and name.endswith(".own") for name in weights)
    for index in range(layers):
        name = f"head{index}"
        decoded = _activated(weights, name, decoded @ weights[f"{name}.own"], statistics)
    return decoded


def _activated(
    weights: Weights, name: str, values: Tensor, statistics: Statistics | None
) -> Tensor:
    """Batch norm and leaky ReLU."""
    mean, variance = (weights[name + end].detach() for end in RUNNING)
    batch = statistics is not None and len(values) > 1  # one row has no variance
    if batch:
        mean, variance = torch.zeros_like(mean), torch.zeros_like(variance)
    found = batch_norm(
        values,
        mean,
        variance,
        weights[f"{name}.scale"],
        weights[f"{name}.shift"],
        training=batch,
        momentum=1.0,  # what is in the two is that of the batch alone
        eps=EPSILON,
    )
    if statistics is not None and batch:
        statistics |= {name + end: one for end, one in zip(RUNNING, (mean, variance), strict=True)}
    return leaky_relu(found, SLOPE, inplace=True)


def _distinct(rows: Int64[Tensor, "m"], count: int) -> tuple[Tensor, Tensor]:
    """Distinct rows below `count`, ascending, and the position of each among them."""
    marked = torch.zeros(count, dtype=torch.bool)
    marked[rows] = True
    return torch.nonzero(marked).squeeze(1), (torch.cumsum(marked, 0) - 1)[rows]


def _uniform(rng: np.random.Generator, bound: float, shape: tuple[int, ...]) -> Tensor:
    return torch.from_numpy(rng.uniform(-bound, bound, shape).astype(np.float32))


def first_weights(shape: FusionShape, classes: int, rng: np.random.Generator) -> dict[str, Tensor]:
    """Of the decoder and of the classifier that reads it."""
    start = shape.start(rng)
    weight, bias = linear_start(shape.head[-1], classes, rng)
    return start | {"classifier.weight": weight, "classifier.bias": bias}


def decoded_widths(decoded: Sequence[int], levels: int) -> tuple[int, ...]:
    """Channels of each level; the last number stands for all that are not given."""
    given = tuple(decoded[:levels])
    return given + (given[-1],) * (levels - len(given))


PointsOf = Callable[[int], PointSet]
"""The points that a view shows, by the view's number; all Gaussians where it does not matter."""


class FusionModel:
    """A decoder and a classifier for all Gaussians; no array has a row a Gaussian.

    Args:
        shape: Of the decoder.
        classes: How many ids there are.
        points: The points of a view that is learnt from.
        scored_points: The points of a held-out view.
        options: Rate, drop-out, and what is rendered.
        rng: Draws the first weights.
    """

    def __init__(
        self,
        shape: FusionShape,
        classes: int,
        *,
        points: PointsOf,
        scored_points: PointsOf,
        options: CossegOptions,
        rng: np.random.Generator,
    ) -> None:
        self.shared_parameters: Mapping[str, Parameter] = {
            name: Parameter(start=one, rate=0.0 if name.endswith(RUNNING) else options.rate)
            for name, one in first_weights(shape, classes, rng).items()
        }
        """The decoder's and the classifier's weights."""
        self._classes = classes
        self._points, self._scored_points = points, scored_points
        self._options = options

    @property
    def row_parameters(self) -> Mapping[str, Parameter]:
        """None."""
        return {}

    def loss(self, batch: Batch, values: Values) -> Float[Tensor, ""]:
        """Of what the pixels show, over the log of the number of ids."""
        label, confidence = batch.target("label"), batch.target("confidence")
        statistics: Statistics = {}
        found = self._probabilities(
            batch, values.shared, self._points, statistics=statistics, rng=values.rng
        )
        momentum = running_momentum(values.step)
        for name, value in running(values.shared, statistics, momentum).items():
            values.keep(name, value)
        each = -torch.log(found.gather(1, label[:, None]).squeeze(1) + TINY)
        return (each * confidence).mean() / math.log(max(self._classes, 2))

    def score(self, batches: Sequence[Batch], values: Values) -> float:
        """Mean intersection over union of what is rendered with the held-out labels."""
        counts = LabelCounts(self._classes)
        for batch in batches:
            found = self._probabilities(batch, values.shared, self._scored_points)
            weight = batch.target("confidence") * batch.stands_for
            counts.add(batch.target("label"), found.argmax(dim=1), weight)
        return counts.mean_iou

    def _probabilities(
        self,
        batch: Batch,
        weights: Mapping[str, Tensor],
        points: PointsOf,
        *,
        statistics: Statistics | None = None,
        rng: np.random.Generator | None = None,
    ) -> Float[Tensor, "pixels classes"]:
        """Of each id at each pixel; with statistics and a generator while training."""
        touched = batch.weights.touched
        found = points(int(batch.views[0]))
        rows = found.rows[touched]
        there = torch.nonzero(rows >= 0).squeeze(1)
        decoded = decode(found.inputs, weights, rows[there], statistics=statistics)
        if rng is not None:
            decoded = dropped(decoded, self._options.dropout, rng)
        weight, bias = weights["classifier.weight"], weights["classifier.bias"]
        if self._options.blend == "features":
            rendered = batch.weights.product(_spread(decoded, there, len(touched)))
            return torch.softmax(rendered @ weight.T + bias, dim=1)
        each = torch.softmax(decoded @ weight.T + bias, dim=1)
        rendered = batch.weights.product(_spread(each, there, len(touched)))
        # What passes all points that are decoded says nothing.
        return rendered / (rendered.sum(dim=1, keepdim=True) + TINY)


def _spread(values: Tensor, rows: Int64[Tensor, "m"], count: int) -> Tensor:
    """Rows among so many, of which the others are 0."""
    if len(rows) == count:
        return values
    return values.new_zeros(count, values.shape[1]).index_copy(0, rows, values)
