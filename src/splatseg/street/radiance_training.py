"""One step's loss and gradients: rays in shares of a fixed size, each on one thread.

What a share gives does not depend on the others, and shares are added up in their order: the same
bits for any number of threads. Features are not part of the graph: the gradient at a sample is
handed to the three vertices that it interpolates, and only vertices that rays met move.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from splatseg.core import View
from splatseg.core.boundary import boundary
from splatseg.core.threads import caller_threads
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence
from splatseg.lift.training import AdamConstants, RowAdam, RowMoments
from splatseg.street.hits import MeshCaster, MeshHits
from splatseg.street.primitives import PrimitiveMesh
from splatseg.street.radiance import RadianceModel, RadianceOptions, checked_ids, ray_weights
from splatseg.street.radiance_rendering import Surface
from splatseg.street.training_rays import (
    CachedHits,
    Reader,
    TrainingRays,
    by_view,
    cached_hits,
    label_ids,
    training_rays,
)

_SHARE = 1024
"""Rays of a share."""

_SMALLEST = 1e-6
"""Probabilities are not taken to be less in logarithms."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RadianceGradients:
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

    def step(self, drawn: Int64[Tensor, "b"]) -> RadianceGradients:
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
        return RadianceGradients(
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


# Training: hits once, then steps on rays drawn from all views (eq. 6 to 8).


_BLOCK = 1 << 16
"""Rays whose hits are found together."""

_MEMORY = 1 << 30
"""Bytes of hits of training rays that are kept in memory; more lie in files."""

_FINAL_RATE = 0.1
"""Share of the rates that is left at the last step; they fall exponentially."""

_DRAWN = 1
"""What the generator of a step is seeded with besides the seed and the step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RadianceRecord:
    """What one step found."""

    iteration: int
    """From 1."""

    iterations: int
    """Steps of the training."""

    colour_loss: float
    """Mean squared colour error of its rays, summed over red, green, blue (eq. 6)."""

    semantic_loss: float
    """Cross-entropy (eq. 7); rays without a label count 0."""

    loss: float
    """Eq. 8."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RadianceFit:
    """A trained field, and how it came to be."""

    model: RadianceModel
    """The field."""

    records: tuple[RadianceRecord, ...]
    """Of each step."""

    rays: int
    """Rays there were to learn from."""

    hits: int
    """Triangles that they meet, together."""

    cache_bytes: int
    """Bytes of these hits, in memory or in files."""

    in_files: bool
    """Whether they were in files."""

    seen: Float[Tensor, "v"]
    """How many of these rays saw each vertex of the mesh, by their weights of eq. 5, estimated
    from those that were drawn."""


@boundary
def train_radiance(
    mesh: PrimitiveMesh,
    views: Sequence[View],
    evidence: Evidence | None,
    *,
    ids: Sequence[int] | None = None,
    options: RadianceOptions | None = None,
    seed: int = 0,
    read: Reader | None = None,
    progress: Callable[[RadianceRecord], None] | None = None,
) -> RadianceFit:
    """Learn colour, opacity and classes of primitives from photographs and label maps.

    The primitives stay as they are. Same seed, same bits, whatever the number of threads and
    wherever hits are kept. An exception from `progress` ends it and leaves nothing behind.

    Args:
        mesh: The primitives.
        views: To learn from, with photographs. Where a view has a mask, pixels that are 0 in it
            (what moves) teach nothing.
        evidence: Label maps of the views, of the kind ``labels``. Pixels without a label, and views
            without a map, teach colours alone. None teaches colours alone; `ids` is needed then.
        ids: Ids of the classes; None takes those of the evidence's table, else of its maps.
        options: Sizes of the field, and how training goes.
        seed: Of the weights at the start and of the drawn rays.
        read: Gives the photograph of a view as floats in [0, 1], (height, width, 3), instead of
            its file.
        progress: Called after each step.

    Raises:
        InputError: If there are no primitives, views or classes, the evidence is of another kind,
            a label is not among the ids, or a photograph is not what it should be.
        RangeError: If a photograph that was given has values that are not in [0, 1].
        OutputError: If hits cannot be written.
    """
    options = options or RadianceOptions()
    if not len(mesh):
        raise InputError("mesh: expected at least one primitive, got none.")
    if evidence is not None and evidence.kind != "labels":
        raise InputError(
            f"evidence: expected evidence of the kind labels, got {evidence.kind} of "
            f"{evidence.folder}."
        )
    if ids is None and evidence is None:
        raise InputError("ids: expected ids of classes where there is no evidence, got none.")
    found = label_ids(views, evidence) if ids is None and evidence is not None else ids or ()
    classes = checked_ids(tuple(found))
    threads = caller_threads()
    with ExitStack() as stack:
        rays = training_rays(views, evidence, classes, read=read)
        surface = Surface(mesh)
        hits = _hits(mesh, surface, rays, options)
        stack.callback(hits.close)
        model = RadianceModel(mesh, classes, options, seed=seed)
        pool = stack.enter_context(ThreadPoolExecutor(threads)) if threads > 1 else None
        worker = StepWorker(model, surface, rays, hits, pool)
        records = _steps(model, worker, len(rays), seed=seed, progress=progress)
        return RadianceFit(
            model=model.eval().requires_grad_(requires_grad=False),
            records=records,
            rays=len(rays),
            hits=hits.hits,
            cache_bytes=hits.nbytes,
            in_files=hits.folder is not None,
            seen=worker.seen * (len(rays) / (options.iterations * options.rays)),
        )


def _hits(
    mesh: PrimitiveMesh, surface: Surface, rays: TrainingRays, options: RadianceOptions
) -> CachedHits:
    caster = MeshCaster(mesh)

    def parts() -> Iterator[MeshHits]:
        for origin, directions in by_view(rays):
            for block in directions.split(_BLOCK):
                yield surface.ray_hits(caster, origin, block, options)

    return cached_hits(parts(), memory=_MEMORY)


def _steps(
    model: RadianceModel,
    worker: StepWorker,
    rays: int,
    *,
    seed: int,
    progress: Callable[[RadianceRecord], None] | None,
) -> tuple[RadianceRecord, ...]:
    options = model.options
    features = model.features.detach()
    moments = RowMoments.zeros(features)
    adam = RowAdam(AdamConstants(), max_steps=options.iterations)
    parameters = network_parameters(model)
    optimiser = torch.optim.Adam(parameters, lr=options.rate)
    records: list[RadianceRecord] = []
    for iteration in range(1, options.iterations + 1):
        found = worker.step(_drawn(rays, options.rays, seed, iteration))
        factor = _FINAL_RATE ** ((iteration - 1) / options.iterations)
        for parameter, gradient in zip(parameters, found.parameters, strict=True):
            parameter.grad = gradient
        for group in optimiser.param_groups:
            group["lr"] = options.rate * factor
        optimiser.step()
        adam.step(
            features,
            moments,
            rows=found.rows,
            gradient=found.features,
            rate=options.feature_rate * factor,
        )
        record = RadianceRecord(
            iteration=iteration,
            iterations=options.iterations,
            colour_loss=found.colour_loss,
            semantic_loss=found.semantic_loss,
            loss=found.colour_loss + options.semantic_weight * found.semantic_loss,
        )
        records.append(record)
        if progress is not None:
            progress(record)
    return tuple(records)


def _drawn(total: int, count: int, seed: int, iteration: int) -> Tensor:
    """Rays of a step, any of them as likely as every other, with replacement."""
    rng = np.random.default_rng((seed, _DRAWN, iteration))
    return torch.from_numpy(rng.integers(0, total, count))
