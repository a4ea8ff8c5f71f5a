r"""Probabilities of each Gaussian's own, trained on label maps; see `methods._trained_logits`.

.. math:: \ell_p = -\log \frac{\sum_i w_{pi}\, \mathrm{softmax}(z_i)_{\mathrm{id}(p)}}
                              {\sum_i w_{pi}}
"""

from functools import partial

from splatseg.methods._method import Method
from splatseg.methods._trained_labels import TrainingContext as TrainingContext
from splatseg.methods._trained_labels import runner
from splatseg.methods._trained_logits import LogitOptions as LogitOptions
from splatseg.methods._trained_logits import train_own_logits

train_probabilities = partial(train_own_logits, method="probabilities", blend="probabilities")
"""Train probabilities of Gaussians on label maps, see `train_own_logits`."""

METHOD = Method(
    name="probabilities",
    summary="a logit of each id for every Gaussian, whose probabilities are rendered; no network",
    reference="docs/training.md",
    evidence=("labels", "tracked"),
    options=LogitOptions,
    run=runner(train_probabilities),
    keeps_ids=True,
    seeded=True,
    resumes=True,
)
