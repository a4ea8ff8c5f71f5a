"""Training: hits once, then steps on rays drawn from all views (eq. 6 to 8)."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import View
from splatseg.core.boundary import boundary
from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence
from splatseg.lift.training import AdamConstants, RowAdam, RowMoments
from splatseg.street.hits import MeshCaster, MeshHits
from splatseg.street.mesh import PrimitiveMesh
from splatseg.street.radiance.cache import CachedHits, cached_hits
from splatseg.street.radiance.gradients import StepWorker, network_parameters
from splatseg.street.radiance.model import RadianceModel, checked_ids
from splatseg.street.radiance.options import RadianceOptions
from splatseg.street.radiance.rays import Reader, TrainingRays, by_view, label_ids, training_rays
from splatseg.street.radiance.samples import Surface

_BLOCK = 1 << 16
"""Rays whose hits are found together."""

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
    cache_folder: Path | None = None,
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
        cache_folder: Where hits that exceed the memory given are kept for the next training of
            the same rays; its parent exists. None keeps them in a temporary place for this one.
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
    threads = torch.get_num_threads()
    with ExitStack() as stack:
        stack.enter_context(one_torch_thread())
        rays = training_rays(views, evidence, classes, options, seed=seed, read=read)
        surface = Surface(mesh)
        hits = _hits(mesh, surface, rays, options, cache_folder)
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
    mesh: PrimitiveMesh,
    surface: Surface,
    rays: TrainingRays,
    options: RadianceOptions,
    folder: Path | None,
) -> CachedHits:
    caster = MeshCaster(mesh)

    def parts() -> Iterator[MeshHits]:
        for origin, directions in by_view(rays):
            for block in directions.split(_BLOCK):
                yield surface.ray_hits(caster, origin, block, options)

    digest = hashlib.sha256(rays.fingerprint.encode())
    digest.update(mesh.vertices.detach().cpu().numpy().tobytes())
    digest.update(mesh.levels.cpu().numpy().tobytes())
    limits = (
        options.max_hits,
        options.fine_hits,
        options.coarse_hits,
        options.order,
        options.sides,
    )
    digest.update(repr(limits).encode())
    return cached_hits(
        parts(),
        triangles=len(mesh.faces),
        memory=options.cache_memory,
        folder=folder,
        identity=digest.hexdigest(),
    )


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
        factor = options.final_rate ** ((iteration - 1) / options.iterations)
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
