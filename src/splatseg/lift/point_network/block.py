r"""Local feature aggregation of RandLA-Net (Hu et al. 2020, section 3.3): one level's block.

**Local spatial encoding.** Of point :math:`p_i` and its neighbour :math:`p_k`

.. math:: r_{ik} = \mathrm{MLP}(\lVert p_i - p_k \rVert, p_i - p_k, p_i, p_k),

which the paper writes in the order :math:`(p_i, p_k, p_i - p_k, \lVert p_i - p_k \rVert)`; that of
the authors' code is kept here, and readers of checkpoints permute columns where another one was
used. The ten channels are linear in seven: a layer A of them is

.. math:: A (\ldots) = a_d \lVert o \rVert + (A_o - A_n) o + (A_p + A_n) p_i, \quad o = p_i - p_k,

so that the last term is once a point, and not once a neighbour.

**Attentive pooling.** Of the features :math:`x_k = (f_k, r_{ik})` of the neighbours,

.. math:: \mathrm{MLP}\Bigl(\sum_k x_k \odot \mathrm{softmax}_k(W x_k)\Bigr),

with the softmax over neighbours, for each channel by itself. :math:`W x_k` is
:math:`W_f f_k + W_r r_{ik}`, and the first term is computed once a point and gathered.

**Dilated residual block.** Encoding and pooling twice, then a sum with a shortcut.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor, nn
from torch.nn import functional

from splatseg.lift.point_network.blocks import Make, in_blocks
from splatseg.lift.point_network.config import RandlaVariant
from splatseg.lift.point_network.layers import Affine, SharedMlp

Encode = Callable[[Tensor, slice], Tensor]
"""Encodes the neighbours of some points, given those and the rows of the points."""


class AttentivePooling(nn.Module):
    """Features of neighbours to features of their point.

    Args:
        features: Channels of the features; their encoding has as many.
        outputs: Channels of the result.
        variant: Slope and epsilon; whose features.
    """

    def __init__(self, features: int, outputs: int, *, variant: RandlaVariant) -> None:
        super().__init__()
        width = 2 * features
        self.score = nn.Linear(width, width, bias=False)
        self.mlp = SharedMlp(width, outputs, slope=variant.slope, epsilon=variant.epsilon)
        self.is_own = variant.paired_features == "own"

    def entries(self, features: Float[Tensor, "m half"]) -> Float[Tensor, "m half+width"]:
        """Features and their part of the scores, side by side: one gather brings both."""
        half = features.shape[1]
        return torch.cat((features, functional.linear(features, self.score.weight[:, :half])), 1)

    def over(self, table: Float[Tensor, "n half+width"]) -> "Pooling":
        """The pooling of a level, given the entries of its points."""
        half = self.score.in_features // 2
        return Pooling(
            table=table,
            weight=self.score.weight[:, half:],
            mlp=self.mlp.affine(),
            is_own=self.is_own,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pooling:
    """An attentive pooling of a level."""

    table: Float[Tensor, "n half+width"]
    """`AttentivePooling.entries` of each point."""

    weight: Float[Tensor, "width half"]
    """The part of the scores that encodings have."""

    mlp: Affine
    """What follows."""

    is_own: bool
    """Whether the features are those of the point itself."""

    def __call__(
        self, encoding: Float[Tensor, "k m half"], near: Int32[Tensor, "k m"], rows: slice
    ) -> Float[Tensor, "m outputs"]:
        """Pool the neighbours of some points.

        Args:
            encoding: Spatial encoding of their neighbours.
            near: Rows of their neighbours.
            rows: The points.
        """
        k, m, half = encoding.shape
        if self.is_own:
            seen = self.table[rows].expand(k, m, -1)
        else:
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
        variant: In what it differs from the authors' code.
    """

    def __init__(self, inputs: int, width: int, *, variant: RandlaVariant) -> None:
        super().__init__()
        half, epsilon = width // 2, variant.epsilon
        chained = variant.second_encoding == "chained"
        self.entry = SharedMlp(inputs, half, slope=variant.entry_slope, epsilon=epsilon)
        self.encode1 = SharedMlp(10, half, slope=variant.slope, epsilon=epsilon)
        self.pool1 = AttentivePooling(half, half, variant=variant)
        self.encode2 = SharedMlp(
            half if chained else 10, half, slope=variant.slope, epsilon=epsilon
        )
        self.pool2 = AttentivePooling(half, width, variant=variant)
        self.exit = SharedMlp(width, 2 * width, slope=1, epsilon=epsilon)
        self.shortcut = SharedMlp(inputs, 2 * width, slope=1, epsilon=epsilon)
        self.variant = variant

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
        squared = self.variant.distance == "squared"
        first = _encoder(self.encode1.affine(), positions, squared=squared)
        if recorded:  # a batch norm counts what it sees
            first = _once(first)
        second = self._second(first, positions, squared=squared)

        def made(make: Make) -> Tensor:
            width = self.exit.linear.in_features
            return in_blocks(make, neighbours, width=width, is_recorded=recorded)

        entry = self.entry.affine()
        pool1 = self.pool1.over(made(lambda _, rows: self.pool1.entries(entry(features[rows]))))
        pool2 = self.pool2.over(
            made(lambda near, rows: self.pool2.entries(pool1(first(near, rows), near, rows)))
        )
        leave, shortcut, slope = self.exit.affine(), self.shortcut.affine(), self.variant.sum_slope

        def left(near: Tensor, rows: slice) -> Tensor:
            found = leave(pool2(second(near, rows), near, rows)) + shortcut(features[rows])
            return functional.leaky_relu_(found, slope)

        return made(left)

    def _second(self, first: Encode, positions: Tensor, *, squared: bool) -> Encode:
        affine = self.encode2.affine()
        if self.variant.second_encoding == "chained":
            return lambda near, rows: affine(first(near, rows))
        return _encoder(affine, positions, squared=squared)


def sample(
    features: Float[Tensor, "n channels"],
    neighbours: Int32[Tensor, "n k"],
    kept: Int64[Tensor, "m"],
    *,
    variant: RandlaVariant,
) -> Float[Tensor, "m channels"]:
    """What the points that a level keeps take to the next one.

    Args:
        features: Of the level.
        neighbours: Of its points.
        kept: Rows of the points that are kept.
        variant: The maximum over neighbours, or their own.
    """
    if variant.sampling == "own":
        return features[kept]
    width, recorded = features.shape[1], torch.is_grad_enabled()

    def largest(near: Tensor, _: slice) -> Tensor:
        return features.index_select(0, near.reshape(-1)).reshape(*near.shape, -1).amax(dim=0)

    return in_blocks(largest, neighbours[kept], width=width, is_recorded=recorded)


def _encoder(affine: Affine, positions: Tensor, *, squared: bool) -> Encode:
    """The local spatial encoding of some points, by the seven channels that the ten are made of."""
    of_distance, of_offset, of_point, of_neighbour = affine.weight.split((1, 3, 3, 3), dim=1)
    of_pair = torch.cat((of_distance, of_offset - of_neighbour), dim=1).T
    points = torch.addmm(affine.bias, positions, (of_point + of_neighbour).T)
    columns = positions.T.contiguous()

    def encode(near: Tensor, rows: slice) -> Tensor:
        seen = columns.index_select(1, near.reshape(-1)).reshape(3, *near.shape)
        offset = columns[:, None, rows] - seen
        x, y, z = offset
        distance = x * x + y * y + z * z
        if not squared:
            distance = distance.sqrt()
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
