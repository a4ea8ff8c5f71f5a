r"""Logits of each Gaussian's own, trained on label maps; see `methods._trained_logits`.

.. math:: \ell_p = \mathrm{CE}\Bigl(\sum_i w_{pi} z_i, \mathrm{id}(p)\Bigr)
"""

from collections.abc import Sequence

from splatseg.core import ClassTable, Features, Gaussians, LabelSource, View
from splatseg.methods._method import Method
from splatseg.methods._trained_labels import TrainingContext as TrainingContext
from splatseg.methods._trained_labels import runner
from splatseg.methods._trained_logits import LogitOptions as LogitOptions
from splatseg.methods._trained_logits import train_own_logits


def train_logits(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    options: LogitOptions | None = None,
    classes: ClassTable | None = None,
    context: TrainingContext | None = None,
) -> Features:
    """Train logits of Gaussians on label maps, see `train_own_logits`."""
    return train_own_logits(
        "logits",
        "features",
        gaussians=gaussians,
        views=views,
        evidence=evidence,
        options=options,
        classes=classes,
        context=context,
    )


METHOD = Method(
    name="logits",
    summary="a logit of each id for every Gaussian, rendered and then classified; no network",
    reference="docs/training.md",
    evidence=("labels", "tracked"),
    options=LogitOptions,
    run=runner(train_logits),
    keeps_ids=True,
    seeded=True,
    resumes=True,
)
