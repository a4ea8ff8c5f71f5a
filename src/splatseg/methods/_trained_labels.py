"""From label maps to trained features with a head: what methods trained on label maps share."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core import (
    LEARNED_BYTES,
    LOSS_CURVE,
    ClassTable,
    Features,
    Gaussians,
    Labels,
    LabelSource,
    Layer,
    LayerInfo,
    View,
)
from splatseg.core.checkpoints import Checkpoints
from splatseg.lift.heads import ClassifierHead
from splatseg.lift.mass.adjoint import voting_views
from splatseg.lift.training import (
    LabelTargets,
    Model,
    RowSampler,
    TrainingProgress,
    TrainingResult,
    train,
)
from splatseg.methods._method import MethodInputs
from splatseg.methods._trained_options import LabelTrainingOptions
from splatseg.render import RenderOptions

_PARTS = 100
_NOT_TRAINED = ("readout", "min_share", "memory", "max_bytes")
"""Options that decide how what was trained is read, and where rows are kept."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingContext:
    """What a training on label maps gets besides its data and options."""

    render_options: RenderOptions | None = None
    """Switches of the blending model."""

    backend: str = "auto"
    """Name of the rendering backend."""

    progress: Callable[[TrainingProgress], None] | None = None
    """Told after each step."""

    cancelled: Callable[[], bool] | None = None
    """Asked after each step."""

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
        render_options=context.render_options,
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
        cancelled=context.cancelled,
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
    known = () if classes is None else classes.rows
    present = set(data.ids.tolist())
    return LayerInfo(
        method=method,
        options=options,
        views=tuple(view.name for view in data.views),
        names={row.id: row.name for row in known if row.id in present},
        seed=seed,
        head=head.to_json(),
        details={
            "loss": float(np.mean(result.losses[-20:])),
            "steps": len(result.losses),
            "best_step": result.best_step,
            "stopped": result.stopped,
            "scores": [[step, score] for step, score in result.scores],
            LOSS_CURVE: loss_curve(result.losses),
            LEARNED_BYTES: result.learned_bytes,
        },
    )


def features_layer(
    values: Float[Tensor, "n channels"], result: TrainingResult, info: LayerInfo
) -> Features:
    """Trained values as a layer; Gaussians that no drawn pixel shows have a weight of 0."""
    return Features(values=values, weights=result.visibility, info=info)


def runner(train_features: Callable[..., Features]) -> Callable[[MethodInputs, Any], Layer]:
    """The `Method.run` of a method that trains features with a head.

    Args:
        train_features: Takes Gaussians, views and evidence, and by keyword the options, the
            names of classes and a `TrainingContext`.
    """

    def run(inputs: MethodInputs, options: LabelTrainingOptions) -> Layer:
        """Train, and read the features as the options say."""
        features = train_features(
            inputs.gaussians,
            inputs.views,
            inputs.evidence,
            options=options,
            classes=inputs.label_names,
            context=context_of(inputs),
        )
        return features if options.readout == "rendered" else hard_labels(features, options)

    return run


def context_of(inputs: MethodInputs) -> TrainingContext:
    """What a method was given, as a training takes it."""
    told = inputs.progress

    def tell(state: TrainingProgress) -> None:
        if told is not None:
            told(state.step, state.steps)

    return TrainingContext(
        backend=inputs.backend,
        progress=tell,
        checkpoints=inputs.checkpoints,
        seed=inputs.seed,
    )


def hard_labels(features: Features, options: LabelTrainingOptions) -> Labels:
    """Each Gaussian's most likely id, by the head that the layer holds."""
    return ClassifierHead.of(features).labels(features, min_share=options.min_share)
