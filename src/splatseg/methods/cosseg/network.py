r"""RandLA-Net (Hu et al. 2020): features of points from their neighbourhoods, at ever wider scales.

The block of a level is its local feature aggregation, section 3.3.

**Local spatial encoding.** Of point :math:`p_i` and its neighbour :math:`p_k`

.. math:: r_{ik} = \mathrm{MLP}(\lVert p_i - p_k \rVert, p_i - p_k, p_i, p_k),

which the paper writes in the order :math:`(p_i, p_k, p_i - p_k, \lVert p_i - p_k \rVert)`; that
of the authors' code is kept here. The ten channels are linear in seven: a layer A of them is

.. math:: A (\ldots) = a_d \lVert o \rVert + (A_o - A_n) o + (A_p + A_n) p_i, \quad o = p_i - p_k,

so that the last term is once a point, and not once a neighbour.

**Attentive pooling.** Of the features :math:`x_k = (f_k, r_{ik})` of the neighbours,

.. math:: \mathrm{MLP}\Bigl(\sum_k x_k \odot \mathrm{softmax}_k(W x_k)\Bigr),

with the softmax over neighbours, for each channel by itself. :math:`W x_k` is
:math:`W_f f_k + W_r r_{ik}`, and the first term is computed once a point and gathered.

**Dilated residual block.** Encoding and pooling twice, then a sum with a shortcut.

Points are worked on in blocks whose arrays fit the processor's caches, each by one thread of
torch's: its own threads would share out each of some twenty small operations and wait for each
other after each. So results do not depend on the number of threads either.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor, nn
from torch.nn import functional

from splatseg import _native
from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary
from splatseg.core.threads import in_threads
from splatseg.errors import InputError
from splatseg.methods.cosseg.pyramid import PointPyramid, RandlaConfig

MOMENTUM = 0.01
"""Share of a batch in the running statistics of batch norms: 0.99 of the old ones stays."""

SLOPE, EPSILON = 0.2, 1e-6
"""Slope of LeakyReLUs below 0, and what is added to variances, as in the authors' code."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Affine:
    """A linear map and what follows it.

    Apart, so that a sum of maps of different inputs can be taken before what follows.
    """

    weight: Float[Tensor, "outputs inputs"]
    """The matrix; while evaluating, the batch norm is in it."""

    bias: Float[Tensor, "outputs"]
    """Added to the product."""

    finish: Callable[[Tensor], Tensor]
    """The batch norm, while training, and the activation. It may write over its argument."""

    def __call__(self, values: Float[Tensor, "*rows inputs"]) -> Float[Tensor, "*rows outputs"]:
        """Map, and what follows."""
        return self.finish(functional.linear(values, self.weight, self.bias))


class SharedMlp(nn.Module):
    """``LeakyReLU(BatchNorm(A x + b))`` of every row by itself.

    Args:
        inputs: Channels of x.
        outputs: Channels of the result.
        slope: Of the LeakyReLU below 0; 1 is none.
    """

    def __init__(self, inputs: int, outputs: int, *, slope: float = SLOPE) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs)
        self.norm = nn.BatchNorm1d(outputs, eps=EPSILON, momentum=MOMENTUM)
        self.slope = slope

    def affine(self) -> Affine:
        """The layer as a linear map and what follows it.

        While evaluating, the batch norm is a fixed scale and shift and goes into the map.
        """
        weight, bias = self.linear.weight, self.linear.bias
        if self.training:
            return Affine(weight=weight, bias=bias, finish=self._normalised)
        norm = self.norm
        mean, variance = norm.running_mean, norm.running_var
        if mean is None or variance is None:  # it was made with running statistics
            return Affine(weight=weight, bias=bias, finish=self._normalised)
        scale = norm.weight * torch.rsqrt(variance + norm.eps)
        return Affine(
            weight=weight * scale[:, None],
            bias=(bias - mean) * scale + norm.bias,
            finish=self._activated,
        )

    def forward(self, values: Float[Tensor, "*rows inputs"]) -> Float[Tensor, "*rows outputs"]:
        """The layer of rows."""
        return self.affine()(values)

    def _normalised(self, values: Tensor) -> Tensor:
        rows = self.norm(values.reshape(-1, values.shape[-1]))
        return self._activated(rows.reshape(values.shape))

    def _activated(self, values: Tensor) -> Tensor:
        if self.slope == 1:
            return values
        return functional.leaky_relu_(values, self.slope)


Make = Callable[[Int32[Tensor, "k m"], slice], Float[Tensor, "m channels"]]
"""Makes something of some points: it gets their neighbours, and their rows."""

VALUES = 1 << 18
"""Numbers of the largest array of a block."""
MIN_POINTS = 16
"""Points of a block at least: shorter products of matrices cost more than they save."""


def in_blocks(
    make: Make, neighbours: Int32[Tensor, "n k"], *, width: int, is_recorded: bool
) -> Float[Tensor, "n channels"]:
    """Make something of each point, block by block.

    Neighbours are handed out as (k, m), so that a sum over them is a sum of whole arrays.

    Args:
        make: Of some points. It is called by several threads at once.
        neighbours: Of all points.
        width: Numbers of a pair of a point and a neighbour, by which blocks are cut.
        is_recorded: Whether gradients are recorded or batch norms count: all points are one block
            then.
    """
    if is_recorded:
        return make(neighbours.T.contiguous(), slice(0, len(neighbours)))
    size = max(MIN_POINTS, VALUES // (width * neighbours.shape[1]))
    rows = [slice(start, start + size) for start in range(0, len(neighbours), size)]
    threads = min(_native.threads(), len(rows))
    call = partial(_made, make, neighbours)
    return _filled(len(neighbours), rows, in_threads(call, rows, threads))


def _filled(count: int, rows: Sequence[slice], parts: Iterable[Tensor]) -> Tensor:
    """Parts as one array: no two copies of all at once."""
    found: Tensor | None = None
    for chosen, part in zip(rows, parts, strict=True):
        found = part.new_empty(count, part.shape[1]) if found is None else found
        found[chosen] = part
    if found is None:
        raise InputError("neighbours: expected at least one point, got none.")
    return found


def _made(make: Make, neighbours: Tensor, rows: slice) -> Tensor:
    with torch.no_grad():  # each thread has its own switch
        return make(neighbours[rows].T.contiguous(), rows)


Encode = Callable[[Tensor, slice], Tensor]
"""Encodes the neighbours of some points, given those and the rows of the points."""


class AttentivePooling(nn.Module):
    """Features of neighbours to features of their point.

    Args:
        features: Channels of the features; their encoding has as many.
        outputs: Channels of the result.
    """

    def __init__(self, features: int, outputs: int) -> None:
        super().__init__()
        width = 2 * features
        self.score = nn.Linear(width, width, bias=False)
        self.mlp = SharedMlp(width, outputs)

    def entries(self, features: Float[Tensor, "m half"]) -> Float[Tensor, "m half+width"]:
        """Features and their part of the scores, side by side: one gather brings both."""
        half = features.shape[1]
        return torch.cat((features, functional.linear(features, self.score.weight[:, :half])), 1)

    def over(self, table: Float[Tensor, "n half+width"]) -> "Pooling":
        """The pooling of a level, given the entries of its points."""
        half = self.score.in_features // 2
        return Pooling(table=table, weight=self.score.weight[:, half:], mlp=self.mlp.affine())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pooling:
    """An attentive pooling of a level."""

    table: Float[Tensor, "n half+width"]
    """`AttentivePooling.entries` of each point."""

    weight: Float[Tensor, "width half"]
    """The part of the scores that encodings have."""

    mlp: Affine
    """What follows."""

    def __call__(
        self, encoding: Float[Tensor, "k m half"], near: Int32[Tensor, "k m"]
    ) -> Float[Tensor, "m outputs"]:
        """Pool the neighbours of some points.

        Args:
            encoding: Spatial encoding of their neighbours.
            near: Rows of their neighbours.
        """
        k, m, half = encoding.shape
        seen = self.table.index_select(0, near.reshape(-1)).reshape(k, m, -1)
        features, scores = seen.split((half, 2 * half), dim=-1)
        pairs = torch.addmm(
            scores.reshape(k * m, -1), encoding.reshape(k * m, half), self.weight.T
        ).reshape(k, m, -1)
        # The largest is taken away for the range of exponentials, and does not change the shares.
        shares = pairs.sub_(pairs.detach().amax(dim=0)).exp_()
        total = shares.sum(dim=0)
        of_features, of_encoding = shares.split(half, dim=-1)
        pooled = torch.cat(
            ((features * of_features).sum(dim=0), (encoding * of_encoding).sum(dim=0)), dim=1
        )
        return self.mlp(pooled / total)


class ResidualBlock(nn.Module):
    """The dilated residual block of a level.

    Args:
        inputs: Channels of the features of the level.
        width: d, even; the result has 2 d channels.
        sum_slope: `RandlaConfig.sum_slope`.
    """

    def __init__(self, inputs: int, width: int, *, sum_slope: float) -> None:
        super().__init__()
        half = width // 2
        self.entry = SharedMlp(inputs, half)
        self.encode1 = SharedMlp(10, half)
        self.pool1 = AttentivePooling(half, half)
        self.encode2 = SharedMlp(half, half)
        self.pool2 = AttentivePooling(half, width)
        self.exit = SharedMlp(width, 2 * width, slope=1)
        self.shortcut = SharedMlp(inputs, 2 * width, slope=1)
        self.sum_slope = sum_slope

    def forward(
        self,
        positions: Float[Tensor, "n 3"],
        features: Float[Tensor, "n inputs"],
        neighbours: Int32[Tensor, "n k"],
    ) -> Float[Tensor, "n twice_width"]:
        """The block of all points of a level.

        Without gradients, points are gone through in blocks, so memory besides the result is for
        3 d numbers a point; otherwise for some 10 d of each pair of neighbours.
        """
        recorded = self.training or torch.is_grad_enabled()
        first = _encoder(self.encode1.affine(), positions)
        if recorded:  # a batch norm counts what it sees
            first = _once(first)
        second = self.encode2.affine()

        def made(make: Make) -> Tensor:
            width = self.exit.linear.in_features
            return in_blocks(make, neighbours, width=width, is_recorded=recorded)

        entry = self.entry.affine()
        pool1 = self.pool1.over(made(lambda _, rows: self.pool1.entries(entry(features[rows]))))
        pool2 = self.pool2.over(
            made(lambda near, rows: self.pool2.entries(pool1(first(near, rows), near)))
        )
        leave, shortcut = self.exit.affine(), self.shortcut.affine()

        def left(near: Tensor, rows: slice) -> Tensor:
            found = leave(pool2(second(first(near, rows)), near)) + shortcut(features[rows])
            return functional.leaky_relu_(found, self.sum_slope)

        return made(left)


def sample(
    features: Float[Tensor, "n channels"],
    neighbours: Int32[Tensor, "n k"],
    kept: Int64[Tensor, "m"],
) -> Float[Tensor, "m channels"]:
    """What the points that a level keeps take to the next one: the maximum over their neighbours.

    Args:
        features: Of the level.
        neighbours: Of its points.
        kept: Rows of the points that are kept.
    """
    width, recorded = features.shape[1], torch.is_grad_enabled()

    def largest(near: Tensor, _: slice) -> Tensor:
        return features.index_select(0, near.reshape(-1)).reshape(*near.shape, -1).amax(dim=0)

    return in_blocks(largest, neighbours[kept], width=width, is_recorded=recorded)


def _encoder(affine: Affine, positions: Tensor) -> Encode:
    """The local spatial encoding of some points, by the seven channels that the ten are made of."""
    of_distance, of_offset, of_point, of_neighbour = affine.weight.split((1, 3, 3, 3), dim=1)
    of_pair = torch.cat((of_distance, of_offset - of_neighbour), dim=1).T
    points = torch.addmm(affine.bias, positions, (of_point + of_neighbour).T)
    columns = positions.T.contiguous()

    def encode(near: Tensor, rows: slice) -> Tensor:
        seen = columns.index_select(1, near.reshape(-1)).reshape(3, *near.shape)
        offset = columns[:, None, rows] - seen
        x, y, z = offset
        distance = (x * x + y * y + z * z).sqrt()
        pairs = torch.cat((distance[None], offset)).reshape(4, -1).T @ of_pair
        return affine.finish(pairs.reshape(*near.shape, -1) + points[rows])

    return encode


def _once(encode: Encode) -> Encode:
    """An encoding of all points at once, which is asked for twice and made once."""
    found: list[Tensor] = []

    def encoded(near: Tensor, rows: slice) -> Tensor:
        if not found:
            found.append(encode(near, rows))
        return found[0]

    return encoded


class RandlaEncoder(nn.Module):
    """The encoder of RandLA-Net (Hu et al. 2020), to be trained or frozen.

    In training mode (``train()``) batch norms take the statistics of all points of a call, which
    holds some ten numbers for every pair of neighbours and channel, as it does wherever gradients
    are recorded. Frozen (``eval()``, without gradients) it goes through the points in blocks, with
    the same result on any number of threads.

    Args:
        config: Its shape; `RandlaConfig.classes` is of no concern.

    Example:
        >>> from splatseg.methods.cosseg.pyramid import PyramidOptions, point_pyramid
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
        self.start = SharedMlp(config.inputs, config.first_width)
        before = (config.first_width, *(2 * width for width in config.widths))
        self.blocks = nn.ModuleList(
            ResidualBlock(inputs, width, sum_slope=config.sum_slope)
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
        with torch.no_grad():
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
            features = sample(found, pyramid.neighbours[level], pyramid.pool[level])
            levels.append(features)
        return tuple(levels)
