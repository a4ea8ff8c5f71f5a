r"""Identity: Gaussian Grouping on frozen geometry.

Every Gaussian has an identity feature :math:`f_i`, and one linear classifier A, b turns features
into logits of ids. Both are trained so that pixels get the ids of their label maps, and
Gaussians that are neighbours the same ids:

.. math:: \mathcal{L} = \frac{1}{\log C} \, \mathrm{mean}_p \, \ell_p
          + \frac{\lambda}{C} \, \mathrm{mean}_{i, j \in N_k(i)} \,
              \mathrm{KL}\bigl(q_i \,\|\, q_j\bigr),
          \qquad q_i = \mathrm{softmax}(A f_i + b)

with C the number of ids; the second term is added every so many steps. As published, the feature
is rendered like colour and what is seen is classified
(:math:`\ell_p = \mathrm{CE}(A \sum_i w_{pi} f_i + b, \mathrm{id}(p))`); by default here Gaussians
are classified and their probabilities rendered
(:math:`\ell_p = -\log \sum_i w_{pi} q_{i, \mathrm{id}(p)}` over the pixel's weights). Rendered
logits are unbounded, so that labels which contradict each other are learnt by heart in different
views; rendered probabilities settle for their majority. docs/decisions/features.md.

Gaussian Grouping trains geometry, colour and identity together on whole pictures; here geometry
is frozen, so that rows of W never change, and training runs on rows of sampled pixels
(`splatseg.lift.training`).

References:
    Ye et al., Gaussian Grouping: Segment and Edit Anything in 3D Scenes (ECCV 2024), eq. 3 to 5,
    and its published code for rates and counts.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import embedding

from splatseg.core import ClassTable, Features, Gaussians, Labels, LabelSource, Layer, View
from splatseg.core.options import Count, NonNegative, options
from splatseg.core.sh import SH_C0
from splatseg.lift.label_maps import Blend, ClassifierHead
from splatseg.lift.training import Batch, Parameter, Values
from splatseg.methods._method import Method, MethodInputs
from splatseg.methods._trained import (
    TINY,
    LabelCounts,
    LabelTrainingOptions,
    context_of,
    hard_labels,
    label_data,
    layer_info,
    linear_start,
    logit_loss,
    probability_loss,
    train_labels,
)
from splatseg.methods._trained import TrainingContext as TrainingContext
from splatseg.neighbours import NeighbourIndex

# Ye et al. 2024, sections 3.2 and 4.1 and the published code.
PUBLISHED_CHANNELS = 16
PUBLISHED_FEATURE_RATE = 2.5e-3
PUBLISHED_CLASSIFIER_RATE = 5e-4
PUBLISHED_KL_WEIGHT = 2.0
PUBLISHED_STEPS = 30_000
"""Each with one whole picture."""

KL_EVERY = 5
"""Steps from one neighbour term to the next, as published."""

KL_NEIGHBOURS = 5
"""Neighbours of a Gaussian, itself counted, as published."""

KL_SAMPLES = 1000
"""Gaussians that are compared with their neighbours in a step, as published."""

KL_POINTS = 200_000
"""Gaussians that take part in the neighbour term at most, as published."""

_START = 0xF
"""What the generator of first values is seeded with besides the seed."""

_ROWS = 2048
"""Gaussians classified at a time: their logits stay in the cache."""


@options(
    removed=dict.fromkeys(
        ("kl_every", "kl_neighbours", "kl_samples", "kl_points"), "it is as published"
    )
)
class IdentityOptions(LabelTrainingOptions):
    """How identities are trained."""

    blend: Blend = "probabilities"
    """features: features are rendered and what is seen is classified, as published.
    probabilities: Gaussians are classified and their probabilities rendered."""

    channels: Count = PUBLISHED_CHANNELS
    """Width of the identity feature."""

    rate: NonNegative = 0.1
    """Adam's rate for features."""

    classifier_rate: NonNegative = 0.05
    """Adam's rate for the classifier."""

    kl_weight: NonNegative = PUBLISHED_KL_WEIGHT
    """Lambda, the weight of the neighbour term; 0 is without."""

    @classmethod
    def published(cls, *, steps: int = 2000) -> "IdentityOptions":
        """The published setting: its loss, rates, schedule and neighbour term.

        Nothing is held out and all steps are done. Steps are of sampled pixels of all views
        where the published code takes whole pictures, and fewer (`PUBLISHED_STEPS` there), so
        that it ends within minutes.
        """
        return cls(
            steps=steps,
            batch=8192,
            blend="features",
            rate=PUBLISHED_FEATURE_RATE,
            classifier_rate=PUBLISHED_CLASSIFIER_RATE,
            schedule="constant",
            min_weight=0.0,
            held_out=0.0,
            patience=0,
        )


class NeighbourLoss:
    r"""How far Gaussians' ids are from those of their neighbours in space.

    .. math:: \frac{1}{C} \, \mathrm{mean}_{i, j \in N_k(i)}
              \sum_c q_{ic} (\log q_{ic} - \log q_{jc})

    Args:
        means: Centres of all Gaussians.
        rng: Draws `KL_POINTS` of them, if they are more, once and for all.
    """

    def __init__(self, means: Float[Tensor, "n 3"], rng: np.random.Generator) -> None:
        kept = np.arange(len(means))
        if len(means) > KL_POINTS:
            kept = np.sort(rng.choice(len(means), KL_POINTS, replace=False))
        self._kept = kept
        self._index = NeighbourIndex(means[torch.from_numpy(kept)])
        self._neighbours = min(KL_NEIGHBOURS, len(kept))

    def draw(self, rng: np.random.Generator) -> Int64[Tensor, "samples k"]:
        """The neighbours of some Gaussians, nearest first: each itself, then the nearest others."""
        count = min(KL_SAMPLES, len(self._kept))
        rows = torch.from_numpy(rng.choice(len(self._kept), count, replace=False))
        near = rows[:, None]
        if self._neighbours > 1:
            others = self._index.nearest_others(self._neighbours - 1, rows=rows)
            near = torch.cat((near, others.indices), dim=1)
        return torch.from_numpy(self._kept)[near]

    def loss(
        self,
        features: Float[Tensor, "m channels"],
        pairs: Int64[Tensor, "samples k"],
        weight: Float[Tensor, "classes channels"],
        bias: Float[Tensor, "classes"],
    ) -> Float[Tensor, ""]:
        """The term, for rows `pairs` of `features`: each row's first against all of it."""
        probabilities = torch.softmax(features @ weight.T + bias, dim=-1)
        logs = torch.log(probabilities + TINY)
        own = pairs[:, :1]
        divergence = (probabilities[own] * (logs[own] - logs[pairs])).sum(dim=-1)
        return divergence.mean() / len(bias)


def linear_own_probability(
    batch: Batch,
    label: Int64[Tensor, "pixels"],
    features: Float[Tensor, "t channels"],
    weight: Float[Tensor, "classes channels"],
    bias: Float[Tensor, "classes"],
) -> Float[Tensor, "pixels"]:
    r"""The rendered probability of each pixel's own label, without those of all others.

    .. math:: \sum_i w_{pi} \exp(z_{i, c_p} - \log \sum_c e^{z_{ic}})

    of touched Gaussians' features and a linear classifier, differentiable towards all three, needs
    one logit for each entry of W and one log-sum-exp for each Gaussian. A matrix of all touched
    Gaussians and all classes is never made.
    """
    rows = batch.weights.rows
    gaussian, own = rows.ids.long(), torch.repeat_interleave(label, rows.indptr.diff())
    # The gradient of `embedding` is a sum in the order of entries, in one pass.
    logit = (embedding(gaussian, features) * embedding(own, weight)).sum(dim=1)
    logit = logit + embedding(own, bias[:, None]).squeeze(1)
    normaliser = _LinearLogSumExp.apply(features, weight, bias)
    each = torch.exp(logit - embedding(gaussian, normaliser[:, None]).squeeze(1))
    # Rows whose entries are columns of their own: sums of each pixel's entries.
    entries = torch.arange(len(gaussian), dtype=torch.int32)
    return replace(rows, ids=entries, gaussians=len(entries)).product(each[:, None]).squeeze(1)


class _LinearLogSumExp(torch.autograd.Function):
    r"""``logsumexp(features @ weight.T + bias, dim=1)``, a block of rows at a time.

    With :math:`q = \mathrm{softmax}(A f + b)` and g the gradient towards the result, gradients
    are :math:`g A^\top q` towards f, and sums of :math:`g q f^\top` and :math:`g q` towards A, b.
    """

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, bias: Tensor) -> Tensor:  # type: ignore[override]
        result = features.new_empty(len(features))
        for begin in range(0, len(features), _ROWS):
            block = slice(begin, begin + _ROWS)
            logits = torch.addmm(bias, features[block], weight.T)
            result[block] = torch.logsumexp(logits, dim=1)
        ctx.save_for_backward(features, weight, bias, result)
        return result

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        features, weight, bias, result = ctx.saved_tensors
        gradient = gradients[0]
        towards = (
            torch.empty_like(features), torch.zeros_like(weight), torch.zeros_like(bias),
        )  # fmt: skip
        for begin in range(0, len(features), _ROWS):
            block = slice(begin, begin + _ROWS)
            each = torch.addmm(bias, features[block], weight.T)
            each.sub_(result[block, None]).exp_().mul_(gradient[block, None])
            torch.mm(each, weight, out=towards[0][block])
            towards[1].addmm_(each.T, features[block])
            towards[2].add_(each.sum(dim=0))
        return towards


class IdentityModel:
    """Identity features, one linear classifier for all, and the neighbour term.

    Args:
        means: Centres of the Gaussians.
        classes: How many ids there are.
        options: How identities are trained.
        rng: Draws what features and the classifier start as.
    """

    def __init__(
        self,
        means: Float[Tensor, "n 3"],
        classes: int,
        options: IdentityOptions,
        rng: np.random.Generator,
    ) -> None:
        # As published, features start like colours: uniform in [0, 1], as a harmonic.
        start = (rng.random((len(means), options.channels), dtype=np.float32) - 0.5) / SH_C0
        weight, bias = linear_start(options.channels, classes, rng)
        self._options = options
        self.row_parameters: Mapping[str, Parameter] = {
            "features": Parameter(start=torch.from_numpy(start), rate=options.rate)
        }
        """``features``."""
        self.shared_parameters: Mapping[str, Parameter] = {
            "weight": Parameter(start=weight, rate=options.classifier_rate),
            "bias": Parameter(start=bias, rate=options.classifier_rate),
        }
        """The classifier: ``weight`` and ``bias``."""
        self._neighbours = NeighbourLoss(means, rng) if options.kl_weight > 0 else None

    def loss(self, batch: Batch, values: Values) -> Float[Tensor, ""]:
        """The pixel term, and every so often the neighbour term."""
        weight, bias = values.shared["weight"], values.shared["bias"]
        features = values.rows("features", batch.weights.touched)
        label, confidence = batch.target("label"), batch.target("confidence")
        if self._options.blend == "features":
            logits = batch.weights.product(features) @ weight.T + bias
            loss = logit_loss(logits, label, confidence)
        else:
            own = linear_own_probability(batch, label, features, weight, bias)
            alpha = batch.weights.rows.row_sums()
            loss = probability_loss(own, alpha, confidence, len(bias))
        if self._neighbours is None or values.step % KL_EVERY:
            return loss
        pairs = self._neighbours.draw(values.rng)
        names, position = torch.unique(pairs, return_inverse=True)
        term = self._neighbours.loss(values.rows("features", names), position, weight, bias)
        return loss + self._options.kl_weight * term

    def score(self, batches: Sequence[Batch], values: Values) -> float:
        """Mean intersection over union of what is rendered with the held-out labels."""
        weight, bias = values.shared["weight"], values.shared["bias"]
        counts = LabelCounts(len(bias))
        for batch in batches:
            features = values.rows("features", batch.weights.touched)
            if self._options.blend == "features":
                rendered = batch.weights.product(features) @ weight.T + bias
            else:
                probabilities = torch.softmax(features @ weight.T + bias, dim=-1)
                rendered = batch.weights.product(probabilities)
            counts.add(
                batch.target("label"),
                rendered.argmax(dim=1),
                batch.target("confidence") * batch.stands_for,
            )
        return counts.mean_iou


def identity(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    options: IdentityOptions | None = None,
    classes: ClassTable | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
    seed: int = 0,
) -> Labels:
    """Label Gaussians by identity features trained on label maps: the hard readout.

    Ids must mean the same in all views. Same seed, same result, whatever the number of threads;
    the order of the views does not matter.

    Args:
        gaussians: The Gaussians of the scene; their geometry stays as it is.
        views: Those to learn from: a method that is to be measured uses train views only.
        evidence: Their label maps, as large as the photographs or reduced in proportion.
        options: How identities are trained.
        classes: Names of the ids, for the info.
        backend: Name of the rendering backend.
        progress: Called with the steps done and all there are to do.
        seed: Of the pixels, the first features and the order of batches.

    Returns:
        Each Gaussian's most likely id, with its probability as the confidence. Gaussians that no
        sampled pixel shows have the id -1. The info holds the loss in the end, and the
        scores on held-out views.

    Raises:
        InputError: If there are no views, if one has no label map, or no pixel has a label.
        ShapeError: If a label map does not have its photograph's proportions.
    """
    options = options or IdentityOptions()
    context = TrainingContext(backend=backend, progress=progress, seed=seed)
    features = train_identity(
        gaussians, views, evidence, options=options, classes=classes, context=context
    )
    return hard_labels(features, options)


def train_identity(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    options: IdentityOptions | None = None,
    classes: ClassTable | None = None,
    context: TrainingContext | None = None,
) -> Features:
    """Train identity features and their classifier, see `identity`.

    Returns:
        The features, with `ClassifierHead.of` to read them: ``labels`` is the hard readout,
        ``label_map`` the rendered one.

    Raises:
        InputError: As `identity`; also if a checkpoint is of another training.
        KeyboardInterrupt: If it was interrupted.
    """
    options, context = options or IdentityOptions(), context or TrainingContext()
    data = label_data(gaussians, views, evidence, options=options, context=context)
    rng = np.random.default_rng((context.seed, _START))
    model = IdentityModel(gaussians.means.detach().cpu(), len(data.ids), options, rng)
    result = train_labels("identity", data, model, options=options, context=context)
    head = ClassifierHead(
        ids=data.ids,
        weight=result.shared["weight"],
        bias=result.shared["bias"],
        blend=options.blend,
    )
    info = layer_info(
        "identity", asdict(options), data, result, head=head, classes=classes, seed=context.seed
    )
    return Features(values=result.rows["features"], weights=result.visibility, info=info)


def run(inputs: MethodInputs, options: IdentityOptions) -> Layer:
    """Train, and read the features as the options say."""
    features = train_identity(
        inputs.gaussians,
        inputs.views,
        inputs.evidence,  # pyright: ignore[reportArgumentType]  (of a kind that it takes)
        options=options,
        classes=inputs.label_names,
        context=context_of(inputs),
    )
    return features if options.readout == "rendered" else hard_labels(features, options)


METHOD = Method(
    name="identity",
    summary="features of 16 channels and a classifier are trained, with a term for neighbours",
    reference="Gaussian Grouping (Ye et al. 2024), eq. 3 to 5",
    evidence=("labels", "tracked"),
    options=IdentityOptions,
    run=run,
    keeps_ids=True,
    seeded=True,
    resumes=True,
    published=IdentityOptions.published(),
)
