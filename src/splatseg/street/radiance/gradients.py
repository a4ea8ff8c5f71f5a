"""One step's loss and gradients: rays in shares of a fixed size, each on one thread.

What a share gives does not depend on the others, and shares are added up in their order: the same
bits for any number of threads. Features are not part of the graph: the gradient at a sample is
handed to the three vertices that it interpolates, and only vertices that rays met move.
"""

from concurrent.futures import Executor
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from splatseg.street.radiance.cache import CachedHits
from splatseg.street.radiance.compositing import ray_weights
from splatseg.street.radiance.model import RadianceModel
from splatseg.street.radiance.rays import TrainingRays
from splatseg.street.radiance.samples import Surface

_SHARE = 1024
"""Rays of a share."""

_SMALLEST = 1e-6
"""Probabilities are not taken to be less in logarithms."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StepGradients:
    """What a step found."""

    colour_loss: float
    """Eq. 6."""

    semantic_loss: float
    """Eq. 7."""

    parameters: list[Tensor]
    """Of the networks' parameters."""

    rows: Int64[Tensor, "t"]
    """Vertices that rays met, ascending."""

    features: Float[Tensor, "t f"]
    """Of their features."""


class StepWorker:
    """Finds gradients of batches.

    Args:
        model: What is trained.
        surface: Its primitives.
        rays: What there is to learn.
        hits: What the rays meet.
        pool: Does shares; None does one after the other.
    """

    def __init__(
        self,
        model: RadianceModel,
        surface: Surface,
        rays: TrainingRays,
        hits: CachedHits,
        pool: Executor | None,
    ) -> None:
        self._model = model
        self._surface = surface
        self._rays = rays
        self._hits = hits
        self._pool = pool
        self._parameters = network_parameters(model)
        count = len(model.features)
        self._met = torch.zeros(count, dtype=torch.bool)
        self._place = torch.zeros(count, dtype=torch.int64)
        self._seen = torch.zeros(count)

    @property
    def seen(self) -> Float[Tensor, "v"]:
        """What rays of all steps so far saw of each vertex: their weights of eq. 5 there."""
        return self._seen

    def step(self, drawn: Int64[Tensor, "b"]) -> StepGradients:
        """Losses and gradients of a batch of rays."""
        shares = drawn.split(_SHARE)
        total = len(drawn)
        apply = map if self._pool is None else self._pool.map
        found = list(apply(self._share, shares, [total] * len(shares)))
        parameters = found[0].parameters
        for other in found[1:]:
            for one, two in zip(parameters, other.parameters, strict=True):
                one += two
        rows, features = self._features(found)
        return StepGradients(
            colour_loss=sum(one.colour_loss for one in found),
            semantic_loss=sum(one.semantic_loss for one in found),
            parameters=parameters,
            rows=rows,
            features=features,
        )

    def _features(self, found: list["_Share"]) -> tuple[Tensor, Tensor]:
        """Gradients of samples, handed to the vertices of their triangles."""
        corners = torch.cat([one.corners for one in found])
        weights = torch.cat([one.weights for one in found])
        gradients = torch.cat([one.features for one in found])
        self._met.index_fill_(0, corners.reshape(-1), value=True)
        rows = self._met.nonzero()[:, 0]
        self._met.index_fill_(0, rows, value=False)
        self._place.index_copy_(0, rows, torch.arange(len(rows)))
        shown = torch.cat([one.shown for one in found])
        sums, seen = torch.zeros(len(rows), gradients.shape[1]), torch.zeros(len(rows))
        for k in range(3):
            at = self._place.index_select(0, corners[:, k])
            sums.index_add_(0, at, weights[:, k, None] * gradients)
            seen.index_add_(0, at, weights[:, k] * shown)
        self._seen[rows] += seen
        return rows, sums

    def _share(self, drawn: Int64[Tensor, "b"], total: int) -> "_Share":
        model = self._model
        width = model.options.max_hits
        places, faces, weights = self._hits.of(drawn, width)
        samples = self._surface.samples(faces, weights)
        features = samples.interpolate(model.features.detach()).requires_grad_()
        directions = self._rays.directions(drawn)
        hidden = model.hidden(samples.positions, features)
        opacity = torch.zeros(len(drawn) * width).index_copy(0, places, model.opacity_of(hidden))
        shares, passed = ray_weights(opacity.view(len(drawn), width))
        ray = places // width
        each = shares.reshape(-1).index_select(0, places)
        colours = model.colour_of(hidden, directions.index_select(0, ray), samples.normals)
        behind, behind_classes = model.background_of(directions)
        colour = (passed[:, None] * behind).index_add(0, ray, each[:, None] * colours)
        truth = self._rays.colours.index_select(0, drawn).float() / 255
        colour_loss = (colour - truth).square().sum() / total
        columns = self._rays.columns.index_select(0, drawn).long()
        known = columns >= 0
        wanted = columns.clamp_min(0)
        # Eq. 7 asks for the label's probability alone: no other class is composited.
        at = model.probabilities_of(hidden).gather(1, wanted[ray, None])[:, 0]
        probability = (passed * behind_classes.gather(1, wanted[:, None])[:, 0]).index_add(
            0, ray, each * at
        )
        logs = probability[known].clamp_min(_SMALLEST).log()
        semantic_loss = -logs.sum() / total
        loss = colour_loss + model.options.semantic_weight * semantic_loss
        gradients = torch.autograd.grad(
            loss, [*self._parameters, features], allow_unused=True, materialize_grads=True
        )
        return _Share(
            colour_loss=float(colour_loss.detach()),
            semantic_loss=float(semantic_loss.detach()),
            parameters=list(gradients[:-1]),
            corners=samples.corners,
            weights=samples.weights,
            shown=each.detach(),
            features=gradients[-1],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Share:
    """What some of the rays of a batch give."""

    colour_loss: float
    semantic_loss: float
    parameters: list[Tensor]
    corners: Tensor
    weights: Tensor
    shown: Tensor
    features: Tensor


def network_parameters(model: RadianceModel) -> list[nn.Parameter]:
    """All parameters but the features."""
    return [p for name, p in model.named_parameters() if name != "features"]
