r"""Identity: the Gaussian Grouping baseline on frozen geometry.

Every Gaussian has an identity feature :math:`f_i` of 16 channels, which is rendered like colour;
one linear classifier turns the rendered feature of a pixel into logits of ids. Both are trained
so that pixels get the ids of their label maps, and Gaussians that are neighbours the same ids:

.. math:: \mathcal{L} = \frac{1}{\log C} \, \mathrm{mean}_p \,
              \mathrm{CE}\Bigl(A \sum_i w_{pi} f_i + b, \; \mathrm{id}(p)\Bigr)
          + \frac{\lambda}{C} \, \mathrm{mean}_{i, j \in N_k(i)} \,
              \mathrm{KL}\bigl(q_i \,\|\, q_j\bigr),
          \qquad q_i = \mathrm{softmax}(A f_i + b)

with C the number of ids; the second term is added every fifth step. Gaussian Grouping trains
geometry, colour and identity together on whole pictures; here geometry is frozen, so that rows
of W never change and training runs on cached rows of sampled pixels (`methods._identity_rows`).
Rates, weights and counts are the published code's unless an option says otherwise.

References:
    Ye et al., Gaussian Grouping: Segment and Edit Anything in 3D Scenes (2024), eq. 3 to 5.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import (
    UNLABELLED,
    Camera,
    ClassTable,
    Features,
    Gaussians,
    LabelMap,
    Labels,
    LabelSource,
    View,
)
from splatseg.core.sh import SH_C0
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.mass.adjoint import voting_views
from splatseg.methods._identity_loss import NeighbourLoss, pixel_loss
from splatseg.methods._identity_rows import Batch, Sampler, batches_of
from splatseg.methods._method import Method, MethodInputs
from splatseg.render import RenderOptions, options_for, render

_ROWS = 65536
"""Gaussians classified at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentityOptions:
    """How identities are trained."""

    identity_channels: int = 16
    """Width of the identity feature."""

    identity_steps: int = 2000
    """Steps of Adam. The published code takes 30000, with whole pictures."""

    identity_batch: int = 8192
    """Pixels a step, from all views."""

    identity_pixels: int = 1500
    """Labelled pixels of each view whose rows are kept."""

    identity_rounds: int = 1
    """How often the pixels are drawn anew, in equal parts of the steps."""

    identity_rate: float = 2.5e-3
    """Adam's rate for features."""

    identity_classifier_rate: float = 5e-4
    """Adam's rate for the classifier."""

    identity_kl_weight: float = 2.0
    """Lambda, the weight of the neighbour term; 0 is without."""

    identity_kl_every: int = 5
    """Steps from one neighbour term to the next."""

    identity_kl_neighbours: int = 5
    """Neighbours of a Gaussian, itself counted."""

    identity_kl_samples: int = 1000
    """Gaussians that are compared with their neighbours in a step."""

    identity_kl_points: int = 200_000
    """Gaussians that take part in the neighbour term at most."""

    identity_min_share: float = 0.0
    """Least probability in [0, 1] that the winner needs; below it there is no label."""

    identity_memory: int = 1 << 30
    """Bytes of kept rows, 16 for each pixel and Gaussian it shows; more are not kept, and the
    views give fewer pixels."""

    def __post_init__(self) -> None:
        for name in (
            "identity_channels",
            "identity_steps",
            "identity_batch",
            "identity_pixels",
            "identity_rounds",
            "identity_kl_every",
            "identity_kl_neighbours",
            "identity_kl_samples",
            "identity_kl_points",
            "identity_memory",
        ):
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        for name in ("identity_rate", "identity_classifier_rate", "identity_kl_weight"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise RangeError(f"{name}: expected 0 or more, got {value}.")
        check_range("identity_min_share", self.identity_min_share, 0.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IdentityField:
    """Trained identities: features of Gaussians and the classifier that reads them."""

    features: Float[Tensor, "n channels"]
    weight: Float[Tensor, "classes channels"]
    """A."""

    bias: Float[Tensor, "classes"]
    """b."""

    ids: Int64[Tensor, "classes"]
    """The id of each class, ascending."""

    evidence: Float[Tensor, "n"]
    """Labelled light that each Gaussian got, estimated from the sampled pixels."""

    losses: tuple[float, ...]
    """The pixel term of each step."""

    def probabilities(self, features: Float[Tensor, "m channels"]) -> Float[Tensor, "m classes"]:
        """What the classifier says of features, rendered or of Gaussians."""
        return torch.softmax(features @ self.weight.T + self.bias, dim=-1)

    def label_map(
        self,
        gaussians: Gaussians,
        camera: Camera,
        *,
        options: RenderOptions | None = None,
        backend: str = "auto",
    ) -> LabelMap:
        """The label map of a view as published: the feature is rendered, then classified.

        Pixels that nothing covers have the label that the classifier gives to nothing, its
        largest bias.

        Raises:
            ShapeError: If `gaussians` has another number of rows than `features`.
        """
        if len(gaussians) != len(self.features):
            raise ShapeError(
                f"gaussians: expected {len(self.features)}, one a feature, got {len(gaussians)}."
            )
        with torch.no_grad():
            drawn = render(
                gaussians,
                camera,
                self.features.to(gaussians.means),
                options=options,
                backend=backend,
                warp="nearest",
            )
        chances = self.probabilities(drawn.image.float().cpu())
        best, place = chances.max(dim=-1)
        return LabelMap(ids=self.ids[place].to(torch.int32), confidence=best.clamp(0, 1))


def identity(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    options: IdentityOptions | None = None,
    classes: ClassTable | None = None,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
    seed: int = 0,
) -> Labels:
    """Label Gaussians by identity features trained on label maps.

    Ids must mean the same in all views. Same seed, same result; the order of the views does not
    matter.

    Args:
        gaussians: The Gaussians of the scene; their geometry stays as it is.
        views: Those to learn from: a method that is to be measured uses train views only.
        evidence: Their label maps, as large as the photographs or reduced in proportion.
        options: How identities are trained.
        classes: Names of the ids, for the metadata.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.
        progress: Called with the steps done and all there are to do.
        seed: Of the pixels, the first features and the order of batches.

    Returns:
        Each Gaussian's most likely id, with its probability as the confidence. Gaussians that no
        sampled pixel shows have the id -1. The metadata holds the loss in the end.

    Raises:
        InputError: If there are no views, if one has no label map, or no pixel has a label.
        ShapeError: If a label map does not have its photograph's proportions.
    """
    options = options or IdentityOptions()
    ordered = voting_views(views, evidence, "a label map")
    field = train_identity(
        gaussians,
        ordered,
        evidence,
        options=options,
        render_options=render_options,
        backend=backend,
        progress=progress,
        seed=seed,
    )
    place = torch.zeros(len(gaussians), dtype=torch.int64)
    share = torch.zeros(len(gaussians))
    for start in range(0, len(gaussians), _ROWS):
        rows = slice(start, start + _ROWS)
        share[rows], place[rows] = field.probabilities(field.features[rows]).max(dim=-1)
    sure = (field.evidence > 0) & (share >= options.identity_min_share)
    known = () if classes is None else classes.rows
    present = set(field.ids.tolist())
    return Labels(
        ids=torch.where(sure, field.ids[place], UNLABELLED),
        confidence=torch.where(sure, share.clamp(0, 1), 0.0),
        evidence=field.evidence,
        metadata={
            "method": "identity",
            "options": asdict(options),
            "views": [view.name for view in ordered],
            "names": {str(row.id): row.name for row in known if row.id in present},
            "seed": seed,
            "loss": float(np.mean(field.losses[-20:])),
        },
    )


def identity_features(field: IdentityField) -> Features:
    """Trained identity features as a layer; its metadata holds the classifier."""
    metadata: dict[str, Any] = {
        "method": "identity",
        "ids": field.ids.tolist(),
        "weight": field.weight.tolist(),
        "bias": field.bias.tolist(),
    }
    return Features(values=field.features, weights=field.evidence, metadata=metadata)


def train_identity(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    options: IdentityOptions | None = None,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
    seed: int = 0,
) -> IdentityField:
    """Train identity features and their classifier, see `identity`."""
    options = options or IdentityOptions()
    ordered = voting_views(views, evidence, "a label map")
    gaussians.check_values()
    ids = _all_ids(ordered, evidence)
    rng = np.random.default_rng(seed)
    sampler = Sampler(
        gaussians=gaussians,
        views=ordered,
        evidence=evidence,
        ids=ids,
        pixels=options.identity_pixels,
        memory=options.identity_memory,
        options=render_options or options_for(gaussians, backend),
        backend=backend,
    )
    trainer = _Trainer(gaussians, len(ids), options, rng)
    seen = torch.zeros(len(gaussians))
    done = 0
    for round in range(options.identity_rounds):
        rows, light = sampler.draw(rng)
        seen += light / options.identity_rounds
        batches = batches_of(rows, options.identity_batch, rng)
        del rows
        last = options.identity_steps * (round + 1) // options.identity_rounds
        while done < last:
            for place in rng.permutation(len(batches))[: last - done].tolist():
                trainer.step(batches[place])
                done += 1
                if progress is not None:
                    progress(done, options.identity_steps)
    return IdentityField(
        features=trainer.features.detach(),
        weight=trainer.weight.detach(),
        bias=trainer.bias.detach(),
        ids=ids,
        evidence=seen,
        losses=tuple(trainer.losses),
    )


def _all_ids(views: Sequence[View], evidence: LabelSource) -> Int64[Tensor, "classes"]:
    found: set[int] = set()
    for view in views:
        found.update(torch.unique(evidence.label_map(view.name).ids).tolist())
    found.discard(UNLABELLED)
    if not found:
        raise InputError(f"evidence: expected a labelled pixel in {len(views)} views, found none.")
    return torch.tensor(sorted(found))


class _Trainer:
    """Features, classifier and their optimiser."""

    def __init__(
        self,
        gaussians: Gaussians,
        classes: int,
        options: IdentityOptions,
        rng: np.random.Generator,
    ) -> None:
        channels = options.identity_channels
        # As published, features start like colours: uniform in [0, 1], as a harmonic.
        start = (rng.random((len(gaussians), channels), dtype=np.float32) - 0.5) / SH_C0
        bound = 1 / math.sqrt(channels)  # what a linear layer starts with
        self.features = torch.from_numpy(start).requires_grad_()
        self.weight = torch.from_numpy(
            rng.uniform(-bound, bound, (classes, channels)).astype(np.float32)
        ).requires_grad_()
        self.bias = torch.from_numpy(
            rng.uniform(-bound, bound, classes).astype(np.float32)
        ).requires_grad_()
        self.losses: list[float] = []
        self._options = options
        self._rng = rng
        self._gradient = torch.zeros_like(self.features)
        self._neighbours = NeighbourLoss(
            gaussians.means.detach().cpu(),
            neighbours=options.identity_kl_neighbours,
            points=options.identity_kl_points,
            rng=rng,
        )
        self._adam = torch.optim.Adam(
            [
                {"params": [self.features], "lr": options.identity_rate},
                {"params": [self.weight, self.bias], "lr": options.identity_classifier_rate},
            ],
            fused=True,
        )

    def step(self, batch: Batch) -> None:
        """One step of Adam on one batch."""
        self._adam.zero_grad()
        self._gradient.zero_()
        drawn = batch.render(self.features.detach()).requires_grad_()
        loss = pixel_loss(drawn, self.weight, self.bias, batch.rows.classes, batch.rows.says)
        loss.backward()
        self.losses.append(float(loss.detach()))
        if drawn.grad is not None:
            self._gradient[batch.touched] = batch.back_project(drawn.grad)
        options = self._options
        if options.identity_kl_weight > 0 and len(self.losses) % options.identity_kl_every == 0:
            self._listen()
        self.features.grad = self._gradient
        self._adam.step()

    def _listen(self) -> None:
        """Add the neighbour term's gradient."""
        pairs = self._neighbours.draw(self._options.identity_kl_samples, self._rng)
        names, place = torch.unique(pairs, return_inverse=True)
        told = self.features.detach()[names].requires_grad_()
        loss = self._neighbours.loss(told, place, self.weight, self.bias)
        (self._options.identity_kl_weight * loss).backward()
        if told.grad is not None:
            self._gradient[names] += told.grad


def run(inputs: MethodInputs, options: IdentityOptions) -> Labels:
    """Train identities, see `identity`."""
    return identity(
        inputs.gaussians,
        inputs.views,
        inputs.evidence,
        options=options,
        classes=inputs.label_names,
        backend=inputs.backend,
        progress=inputs.progress,
        seed=inputs.seed,
    )


METHOD = Method(
    name="identity",
    summary="features of 16 channels and a classifier are trained; for comparison",
    reference="Gaussian Grouping (Ye et al. 2024), eq. 3 to 5",
    evidence=("labels", "tracked"),
    options=IdentityOptions,
    run=run,
    keeps_ids=True,
    seeded=True,
)
