r"""Logits of each Gaussian's own, trained on label maps; see `methods._trained_logits`.

.. math:: \ell_p = \mathrm{CE}\Bigl(\sum_i w_{pi} z_i, \mathrm{id}(p)\Bigr)
"""

from functools import partial

from splatseg.methods._method import Method
from splatseg.methods._trained_labels import TrainingContext as TrainingContext
from splatseg.methods._trained_labels import runner
from splatseg.methods._trained_logits import LogitOptions as LogitOptions
from splatseg.methods._trained_logits import train_own_logits

train_logits = partial(train_own_logits, method="logits", blend="features")
"""Train logits of Gaussians on label maps, see `train_own_logits`."""

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
