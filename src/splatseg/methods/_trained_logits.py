r"""Logits and probabilities of each Gaussian's own, trained on label maps: no network.

Every Gaussian has a logit of every id, :math:`z_i`. `logits` renders them and classifies what is
seen; `probabilities` renders :math:`\mathrm{softmax}(z_i)` and takes the negative log of what is
seen of a pixel's label:

.. math:: \ell_p = \mathrm{CE}\Bigl(\sum_i w_{pi} z_i, \mathrm{id}(p)\Bigr) \qquad \text{or} \qquad
          \ell_p = -\log \frac{\sum_i w_{pi}\, \mathrm{softmax}(z_i)_{\mathrm{id}(p)}}
                              {\sum_i w_{pi}} .

They are what `identity` would be with as many channels as ids and no neighbour term, and show
what of its strength comes from the loss.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from splatseg.core import ClassTable, Features, Gaussians, LabelSource, View
from splatseg.errors import InputError, RangeError
from splatseg.lift.heads import Blend, ClassifierHead
from splatseg.methods._label_models import LogitModel
from splatseg.methods._trained_labels import (
    TrainingContext,
    features_layer,
    label_data,
    layer_info,
    train_labels,
)
from splatseg.methods._trained_options import LabelTrainingOptions, check_rate

_BYTES = 16
"""Of a logit while it is trained: itself, its two moments, and the best value so far."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LogitOptions(LabelTrainingOptions):
    """How logits of Gaussians are trained."""

    steps: int = 800
    """Steps of Adam at most."""

    rate: float = 0.1
    """Adam's rate for logits."""

    max_bytes: int = 4 << 30
    """Memory of all logits while they are trained, 16 bytes each; a scene with more Gaussians
    and ids than that is refused (`identity` takes 16 numbers a Gaussian whatever the ids)."""

    def __post_init__(self) -> None:
        LabelTrainingOptions.__post_init__(self)
        check_rate("rate", self.rate)
        if self.max_bytes < 1:
            raise RangeError(f"max_bytes: expected at least 1, got {self.max_bytes}.")


def train_own_logits(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    method: str,
    blend: Blend,
    options: LogitOptions | None = None,
    classes: ClassTable | None = None,
    context: TrainingContext | None = None,
) -> Features:
    """Train logits of Gaussians.

    Args:
        gaussians: The Gaussians of the scene; their geometry stays as it is.
        views: Those to learn from.
        evidence: Their label maps; ids mean the same in all of them.
        method: The method's name, for the info.
        blend: Whether logits are rendered and then classified, or probabilities rendered.
        options: How logits are trained.
        classes: Names of the ids, for the info.
        context: Backend, seed, checkpoint and progress.

    Returns:
        The logits, with `ClassifierHead.of` to read them.

    Raises:
        InputError: If there are no views, one has no label map, no pixel has a label, or logits
            would take more memory than the options allow.
        KeyboardInterrupt: If it was cancelled.
    """
    options, context = options or LogitOptions(), context or TrainingContext()
    data = label_data(gaussians, views, evidence, options=options, context=context)
    size = len(gaussians) * len(data.ids) * _BYTES
    if size > options.max_bytes:
        raise InputError(
            f"max_bytes: expected at least {size} for {len(gaussians)} Gaussians and "
            f"{len(data.ids)} ids, got {options.max_bytes}; the method identity needs less."
        )
    model = LogitModel(len(gaussians), len(data.ids), blend=blend, rate=options.rate)
    result = train_labels(method, data, model, options=options, context=context)
    head = ClassifierHead(ids=data.ids, weight=None, bias=None, blend=blend)
    info = layer_info(
        method, asdict(options), data, result, head=head, classes=classes, seed=context.seed
    )
    return features_layer(result.rows["logits"], result, info)
