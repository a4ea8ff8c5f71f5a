"""From label maps to trained features with a head: what methods trained on label maps share."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core import (
    JSON,
    LEARNED_BYTES,
    LOCAL,
    LOSS_CURVE,
    ClassTable,
    Executor,
    Features,
    Gaussians,
    Labels,
    LabelSource,
    LayerInfo,
    View,
)
from splatseg.core.checkpoints import Checkpoints
from splatseg.core.options import Share, options
from splatseg.lift.label_maps import ClassifierHead
from splatseg.lift.training import (
    LabelTargets,
    Model,
    RowSampler,
    RowTrainingOptions,
    TrainingResult,
    train,
)
from splatseg.lift.voting.uplift import names_of, voting_views
from splatseg.methods._method import MethodInputs


@options
class LabelTrainingOptions(RowTrainingOptions):
    """How a method is trained on label maps."""

    readout: Literal["hard", "rendered"] = "hard"
    """hard: the layer has each Gaussian's id. rendered: it has what was trained, with the
    classifier that reads it, by which views are rendered first and decided then."""

    min_share: Share = 0.0
    """Minimum probability, in [0, 1], of a Gaussian's id; below it there is no label."""


TINY = 1e-10
"""Added to probabilities before their logarithm."""


def logit_loss(
    logits: Float[Tensor, "pixels classes"],
    label: Int64[Tensor, "pixels"],
    confidence: Float[Tensor, "pixels"],
) -> Float[Tensor, ""]:
    r"""Mean cross-entropy of rendered logits, over the log of the number of classes.

    .. math:: \frac{1}{P \log C} \sum_p s_p \, \mathrm{CE}(z_p, c_p)

    With a single class there is nothing to learn, and the loss is 0.
    """
    each = torch.nn.functional.cross_entropy(logits, label, reduction="none")
    return (each * confidence).mean() / math.log(max(logits.shape[1], 2))


def probability_loss(
    own: Float[Tensor, "pixels"],
    alpha: Float[Tensor, "pixels"],
    confidence: Float[Tensor, "pixels"],
    classes: int,
) -> Float[Tensor, ""]:
    r"""Mean negative log of the rendered probability, over the log of the number of classes.

    .. math:: -\frac{1}{P \log C} \sum_p s_p \log \frac{\sum_i w_{pi} q_{i c_p}}{\sum_i w_{pi}}

    A pixel that shows nothing has no say.

    Args:
        own: Rendered probability of each pixel's own class, the numerator.
        alpha: Sum of each pixel's blending weights.
        confidence: s.
        classes: C.
    """
    each = torch.log(alpha + TINY) - torch.log(own + TINY)
    return (each * confidence).mean() / math.log(max(classes, 2))


def linear_start(
    channels: int, classes: int, rng: np.random.Generator
) -> tuple[Float[Tensor, "classes channels"], Float[Tensor, "classes"]]:
    """What a linear layer starts with: weight and bias uniform within 1 / sqrt(channels)."""
    bound = 1 / math.sqrt(channels)
    return tuple(
        torch.from_numpy(rng.uniform(-bound, bound, shape).astype(np.float32))
        for shape in ((classes, channels), (classes,))
    )  # pyright: ignore[reportReturnType]


class LabelCounts:
    """Counts of held-out pixels by label and answer, for a mean intersection over union.

    Args:
        classes: How many classes there are.
    """

    def __init__(self, classes: int) -> None:
        self._right = torch.zeros(classes, dtype=torch.float64)
        self._labelled = torch.zeros(classes, dtype=torch.float64)
        self._answered = torch.zeros(classes, dtype=torch.float64)

    def add(
        self,
        label: Int64[Tensor, "pixels"],
        answer: Int64[Tensor, "pixels"],
        weight: Float[Tensor, "pixels"],
    ) -> None:
        """Count pixels; each counts its weight."""
        classes, weight = len(self._right), weight.double()
        self._labelled += torch.bincount(label, weights=weight, minlength=classes)
        self._answered += torch.bincount(answer, weights=weight, minlength=classes)
        self._right += torch.bincount(label, weights=weight * (label == answer), minlength=classes)

    @property
    def mean_iou(self) -> float:
        """Mean intersection over union of the classes that have a label; 0 where none has."""
        present = self._labelled > 0
        if not bool(present.any()):
            return 0.0
        union = self._labelled + self._answered - self._right
        return float((self._right[present] / union[present]).mean())


_PARTS = 100
_NOT_TRAINED = ("readout", "min_share", "memory")
"""Options that decide how what was trained is read, and where rows are kept."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingContext:
    """What a training on label maps gets besides its data and options."""

    backend: str = "auto"
    """Name of the rendering backend."""

    executor: Executor = LOCAL
    """Where views are worked on before the training."""

    progress: Callable[[int, int], None] | None = None
    """Called after each step with the steps done and all there are to do."""

    checkpoints: Checkpoints | None = None
    """Where and how often the state is written; None writes none."""

    seed: int = 0
    """Of the pixels, the first values and the order of batches."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelData:
    """Label maps ready to be drawn from."""

    sampler: RowSampler
    ids: Int64[Tensor, "classes"]
    """All ids, ascending."""

    views: Sequence[View]
    """In the order of their names."""


def label_data(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    options: LabelTrainingOptions,
    context: TrainingContext,
) -> LabelData:
    """Check the views and find all ids.

    Raises:
        InputError: If there are no views, if one has no label map, or no pixel has a label.
    """
    ordered = voting_views(views, evidence, "a label map")
    source = LabelTargets(evidence, [view.name for view in ordered])
    sampler = RowSampler(
        gaussians,
        ordered,
        source,
        options=options.drawing(),
        backend=context.backend,
    )
    return LabelData(sampler=sampler, ids=source.ids, views=ordered)


def train_labels(
    method: str,
    data: LabelData,
    model: Model,
    *,
    options: LabelTrainingOptions,
    context: TrainingContext,
    extra: Mapping[str, Any] | None = None,
) -> TrainingResult:
    """Train a model of the method of this name, see `splatseg.lift.training.train`.

    `extra` is what else must be the same to resume, in values that JSON holds.
    """
    return train(
        model,
        data.sampler,
        options=options.training(),
        seed=context.seed,
        checkpoints=context.checkpoints,
        settings={"method": method} | _settings(options) | dict(extra or {}),
        defaults=_settings(type(options)()),
        progress=context.progress,
    )


def _settings(options: LabelTrainingOptions) -> dict[str, Any]:
    """Options without those that change nothing that is trained, in values that JSON holds."""
    values = recorded_options(options)
    return {name: values[name] for name in values if name not in _NOT_TRAINED}


def recorded_options(options: LabelTrainingOptions) -> dict[str, Any]:
    """All options, in values that JSON holds: of a file its name, as folders are of one machine."""
    found: dict[str, Any] = asdict(options)
    for name, value in found.items():
        if isinstance(value, Path):
            found[name] = value.name
        elif isinstance(value, tuple):
            found[name] = list(cast("tuple[object, ...]", value))
    return found


def loss_curve(losses: Sequence[float]) -> list[list[float]]:
    """Losses in brief: the last step and the mean loss of at most 100 equal parts of a training."""
    ends = [len(losses) * part // _PARTS for part in range(_PARTS + 1)]
    return [
        [end, float(np.mean(losses[begin:end]))] for begin, end in pairwise(ends) if end > begin
    ]


def layer_info(
    method: str,
    options: dict[str, Any],
    data: LabelData,
    result: TrainingResult,
    *,
    head: ClassifierHead,
    classes: ClassTable | None,
    seed: int,
) -> LayerInfo:
    """How a layer was made."""
    return LayerInfo(
        method=method,
        options=options,
        views=tuple(view.name for view in data.views),
        names=names_of(classes, data.ids.tolist()),
        seed=seed,
        head=head.to_json(),
        details=training_details(result),
    )


def training_details(result: TrainingResult) -> dict[str, JSON]:
    """How a training went, for the info of a layer."""
    return {
        "loss": float(np.mean(result.losses[-20:])),
        "steps": len(result.losses),
        "best_step": result.best_step,
        "stopped": result.stopped,
        "scores": [[step, score] for step, score in result.scores],
        LOSS_CURVE: loss_curve(result.losses),
        LEARNED_BYTES: result.learned_bytes,
    }


def context_of(inputs: MethodInputs) -> TrainingContext:
    """What a method was given, as a training takes it."""
    return TrainingContext(
        backend=inputs.backend,
        executor=inputs.executor,
        progress=inputs.progress,
        checkpoints=inputs.checkpoints,
        seed=inputs.seed,
    )


def hard_labels(features: Features, options: LabelTrainingOptions) -> Labels:
    """Each Gaussian's most likely id, by the head that the layer holds."""
    return ClassifierHead.of(features).labels(features, min_share=options.min_share)
