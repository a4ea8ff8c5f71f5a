r"""SAGA: features of Gaussians that tell what belongs together, distilled from masks of views.

Every Gaussian has a feature of 32 channels; geometry and colour stay as they are. As published
(`SagaOptions.published`), the feature rendered at a pixel is to find each mask that the pixel is in
by the mask's query, the mean of projected 2D features in it (SAM-guidance loss, eq. 4 to 7), and
pixels are to be as alike as the sets of their masks (correspondence loss, eq. 8 to 11):

.. math:: \mathcal{L} = \mathcal{L}_{SAM} + \lambda \mathcal{L}_{corr} .

A step has the grid of 64 x 64 cells of one view, and Adam moves all Gaussians
(docs/decisions/features.md).
Where the text and the published code differ, this follows the code: both losses are means, negative
cosines of the correspondence loss count 0, and a tenth of the mean positive product of queries with
a random tenth of all Gaussians is added. Where there are no 2D features, the query of a mask is the
mean of what is rendered in it.

By default features are directions and are compared behind a gate of the scale that is looked for,
so that one training serves parts, objects and groups: at a scale, pixels belong together that share
a mask up to it (`model.together_at`). The masks are associated first (`methods.associate`):
features start as codes of the nodes that Gaussians are in (`masks`), the scale of a mask is
the level of its node, and training is kept as far as it makes held-out views better.
docs/decisions/features.md.

References:
    Cen et al., Segment Any 3D Gaussians (2023), section 3.3, and its published code for rates,
    counts and, in its second version, the scale gate.
"""

from dataclasses import replace

from splatseg.core import Features, InstanceTree
from splatseg.lift.affinity import AffinityHead
from splatseg.methods._method import Method, MethodInputs
from splatseg.methods._trained import context_of
from splatseg.methods.saga.decomposition import DecomposeOptions, decompose
from splatseg.methods.saga.options import SHORT_STEPS
from splatseg.methods.saga.options import SagaOptions as SagaOptions
from splatseg.methods.saga.options import trained_as_published as trained_as_published
from splatseg.methods.saga.train import train_saga as train_saga

PUBLISHED_DIFFERS = (
    f"It differs: {SHORT_STEPS} steps where the paper has 30 000, at {30_000 // SHORT_STEPS} times "
    "its rate; "
    "both losses on the 64 x 64 grid; 2D features are those at hand, not SAM's alone."
)


def run(inputs: MethodInputs, options: SagaOptions) -> Features | InstanceTree:
    """Train affinity features, see `train_saga`, and decompose them where a tree is asked for."""
    # How features are read is no part of their training, and may differ when it is resumed.
    training = replace(options, readout="features", features=None, decompose=DecomposeOptions())
    features = inputs.trained or train_saga(
        inputs.gaussians,
        inputs.views,
        inputs.evidence,
        features=inputs.features("guidance"),
        options=training,
        context=context_of(inputs),
    )
    if options.readout == "features":
        return features
    AffinityHead.of(features)  # says so of features that are of something else
    return decompose(inputs.gaussians, features, options=options.decompose, seed=inputs.seed)


METHOD = Method(
    name="saga",
    summary="features of what belongs together, begun from associated masks and trained on them",
    reference="SAGA (Cen et al. 2023), eq. 3 to 11",
    evidence=("masks",),
    options=SagaOptions,
    run=run,
    returns="features",
    seeded=True,
    resumes=True,
    published=SagaOptions.published(),
    published_differs=PUBLISHED_DIFFERS,
    companions={"guidance": ("features",)},
    trained="features",
    readouts={"tree": "tree"},
)
