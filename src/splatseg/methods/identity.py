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
views; rendered probabilities settle for their majority. Decision 0018.

Gaussian Grouping trains geometry, colour and identity together on whole pictures; here geometry
is frozen, so that rows of W never change, and training runs on rows of sampled pixels
(`splatseg.lift.training`).

References:
    Ye et al., Gaussian Grouping: Segment and Edit Anything in 3D Scenes (ECCV 2024), eq. 3 to 5,
    and its published code for rates and counts.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch

from splatseg.core import ClassTable, Features, Gaussians, Labels, LabelSource, View
from splatseg.core.sh import SH_C0
from splatseg.errors import RangeError
from splatseg.lift.heads import Blend, ClassifierHead
from splatseg.lift.training import TrainingProgress
from splatseg.methods._identity_loss import NeighbourLoss
from splatseg.methods._label_models import IdentityModel, linear_start
from splatseg.methods._method import Method
from splatseg.methods._trained_labels import (
    LabelData,
    features_layer,
    hard_labels,
    label_data,
    layer_info,
    runner,
    train_labels,
)
from splatseg.methods._trained_labels import TrainingContext as TrainingContext
from splatseg.methods._trained_options import LabelTrainingOptions, check_rate
from splatseg.render import RenderOptions

# Ye et al. 2024, sections 3.2 and 4.1 and the published code: what `published` is made of.
PUBLISHED_CHANNELS = 16
PUBLISHED_FEATURE_RATE = 2.5e-3
PUBLISHED_CLASSIFIER_RATE = 5e-4
PUBLISHED_KL_WEIGHT = 2.0
PUBLISHED_KL_EVERY = 5
PUBLISHED_KL_NEIGHBOURS = 5
PUBLISHED_KL_SAMPLES = 1000
PUBLISHED_KL_POINTS = 200_000
PUBLISHED_STEPS = 30_000
"""Each with one whole picture."""

_START = 0xF
"""What the generator of first values is seeded with besides the seed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentityOptions(LabelTrainingOptions):
    """How identities are trained."""

    blend: Blend = "probabilities"
    """features: features are rendered and what is seen is classified, as published.
    probabilities: Gaussians are classified and their probabilities rendered."""

    channels: int = PUBLISHED_CHANNELS
    """Width of the identity feature."""

    rate: float = 0.1
    """Adam's rate for features."""

    classifier_rate: float = 0.05
    """Adam's rate for the classifier."""

    kl_weight: float = PUBLISHED_KL_WEIGHT
    """Lambda, the weight of the neighbour term; 0 is without."""

    kl_every: int = PUBLISHED_KL_EVERY
    """Steps from one neighbour term to the next."""

    kl_neighbours: int = PUBLISHED_KL_NEIGHBOURS
    """Neighbours of a Gaussian, itself counted."""

    kl_samples: int = PUBLISHED_KL_SAMPLES
    """Gaussians that are compared with their neighbours in a step."""

    kl_points: int = PUBLISHED_KL_POINTS
    """Gaussians that take part in the neighbour term at most."""

    def __post_init__(self) -> None:
        LabelTrainingOptions.__post_init__(self)
        for name in ("channels", "kl_every", "kl_neighbours", "kl_samples", "kl_points"):
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        for name in ("rate", "classifier_rate", "kl_weight"):
            check_rate(name, getattr(self, name))

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
    """Label Gaussians by identity features trained on label maps: the hard readout.

    Ids must mean the same in all views. Same seed, same result, whatever the number of threads;
    the order of the views does not matter.

    Args:
        gaussians: The Gaussians of the scene; their geometry stays as it is.
        views: Those to learn from: a method that is to be measured uses train views only.
        evidence: Their label maps, as large as the photographs or reduced in proportion.
        options: How identities are trained.
        classes: Names of the ids, for the info.
        render_options: Switches of the blending model.
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

    def tell(state: TrainingProgress) -> None:
        if progress is not None:
            progress(state.step, state.steps)

    features = train_identity(
        gaussians,
        views,
        evidence,
        options=options,
        classes=classes,
        context=TrainingContext(
            render_options=render_options, backend=backend, progress=tell, seed=seed
        ),
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
        KeyboardInterrupt: If it was cancelled.
    """
    options, context = options or IdentityOptions(), context or TrainingContext()
    data = label_data(gaussians, views, evidence, options=options, context=context)
    model = _model(gaussians, data, options, context.seed)
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
    return features_layer(result.rows["features"], result, info)


def _model(
    gaussians: Gaussians, data: LabelData, options: IdentityOptions, seed: int
) -> IdentityModel:
    rng = np.random.default_rng((seed, _START))
    # As published, features start like colours: uniform in [0, 1], as a harmonic.
    start = (rng.random((len(gaussians), options.channels), dtype=np.float32) - 0.5) / SH_C0
    weight, bias = linear_start(options.channels, len(data.ids), rng)
    neighbours = None
    if options.kl_weight > 0:
        neighbours = NeighbourLoss(
            gaussians.means.detach().cpu(),
            neighbours=options.kl_neighbours,
            points=options.kl_points,
            rng=rng,
        )
    return IdentityModel(
        torch.from_numpy(start),
        weight,
        bias,
        blend=options.blend,
        feature_rate=options.rate,
        classifier_rate=options.classifier_rate,
        neighbours=neighbours,
        neighbour_weight=options.kl_weight,
        neighbour_every=options.kl_every,
        neighbour_samples=options.kl_samples,
    )


METHOD = Method(
    name="identity",
    summary="features of 16 channels and a classifier are trained, with a term for neighbours",
    reference="Gaussian Grouping (Ye et al. 2024), eq. 3 to 5",
    evidence=("labels", "tracked"),
    options=IdentityOptions,
    run=runner(train_identity),
    keeps_ids=True,
    seeded=True,
    resumes=True,
    published=IdentityOptions.published(),
)
