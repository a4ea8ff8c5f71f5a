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

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor, nn
from torch.nn import functional

from splatseg.lift.point_network.config import RandlaVariant
from splatseg.lift.point_network.layers import Affine, SharedMlp

_VALUES = 1 << 18
"""Numbers of the largest array of a block of points, which is to stay in the processor's caches."""

Encode = Callable[[Tensor, slice], Tensor]


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
        self.own = variant.paired_features == "own"

    def prepare(self, features: Float[Tensor, "n half"]) -> "Pooling":
        """The pooling of all points of a level, of which some can be asked for."""
        half = features.shape[1]
        weight = self.score.weight
        return Pooling(
            table=torch.cat((features, functional.linear(features, weight[:, :half])), dim=1),
            weight=weight[:, half:],
            mlp=self.mlp.affine(),
            own=self.own,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pooling:
    """An attentive pooling with the features of a level."""

    table: Float[Tensor, "n half+width"]
    """Features of each point and their part of the scores, side by side: one gather brings both."""

    weight: Float[Tensor, "width half"]
    """The part of the scores that encodings have."""

    mlp: Affine
    """What follows."""

    own: bool
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
        if self.own:
            seen = self.table[rows].expand(k, m, -1)
        else:
            seen = self.table.index_select(0, near.reshape(-1)).reshape(k, m, -1)
        features, scores = seen[..., :half], seen[..., half:]
        pairs = torch.addmm(
            scores.reshape(k * m, -1), encoding.reshape(k * m, half), self.weight.T
        ).reshape(k, m, -1)
        # The largest is taken away for the range of exponentials, and does not change the shares.
        shares = pairs.sub_(pairs.detach().amax(dim=0)).exp_()
        total = shares.sum(dim=0)
        pooled = torch.cat(
            ((features * shares[..., :half]).sum(0), (encoding * shares[..., half:]).sum(0)), dim=1
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

        While evaluating, points are gone through in blocks, so memory besides the result is for 3 d
        numbers a point; batch norms of training need all at once.
        """
        width = self.exit.linear.in_features
        size = max(16, _VALUES // (width * neighbours.shape[1]))
        size = len(positions) if self.training else size
        squared = self.variant.distance == "squared"
        first = _encoder(self.encode1.affine(), positions, squared=squared)
        if self.training:  # a batch norm counts what it sees
            first = _once(first)
        second = self._second(first, positions, squared=squared)

        pool1 = self.pool1.prepare(self.entry(features))
        pooled = torch.cat(
            [pool1(first(near, rows), near, rows) for near, rows in _blocks(neighbours, size)]
        )
        pool2, leave = self.pool2.prepare(pooled), self.exit.affine()
        shortcut, slope = self.shortcut.affine(), self.variant.sum_slope
        return torch.cat(
            [
                functional.leaky_relu_(
                    leave(pool2(second(near, rows), near, rows)) + shortcut(features[rows]),
                    slope,
                )
                for near, rows in _blocks(neighbours, size)
            ]
        )

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
    size = max(16, _VALUES // (features.shape[1] * neighbours.shape[1]))
    return torch.cat(
        [
            features.index_select(0, near.reshape(-1)).reshape(*near.shape, -1).amax(dim=0)
            for near, _ in _blocks(neighbours[kept], size)
        ]
    )


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


def _blocks(neighbours: Tensor, size: int) -> Iterator[tuple[Tensor, slice]]:
    """Rows of a level in blocks, each with its neighbours.

    They are (k, m), so that a sum over neighbours is a sum of whole arrays.
    """
    for start in range(0, len(neighbours), size):
        rows = slice(start, start + size)
        yield neighbours[rows].T.contiguous(), rows
