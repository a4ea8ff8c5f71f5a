r"""CoSSegGaussians: labels decoded from features of photographs and from the shape in space.

Labels of views contradict each other: a segmenter is wrong about an object from a whole range of
views. Numbers of each Gaussian's own learn that by heart; a small network that is given what
Gaussians look like and how they lie in space cannot, and gives alike things one label.

Features of four blocks of a network are unprojected onto Gaussians (`_distilled`, eq. 2), a frozen
RandLA-Net encodes their centres (`lift.point_network`), and a decoder fuses both from far to near
(`_fusion`, Figs. 3 and 4). It is trained so that pixels get the labels of their label maps:

.. math:: \ell_s = -\sum_p \log \mathrm{softmax}(A \sum_i w_{pi} h_i + b)_{\mathrm{id}(p)}

Geometry stays as it is, so that rows of W never change (`splatseg.lift.training`). The weight
:math:`\lambda_s` of the loss is nothing to Adam where it is the only loss.

References:
    Dou et al., CoSSegGaussians: Compact and Swift Scene Segmenting 3D Gaussians (2024), eq. 2 to 5.
    Hu et al., RandLA-Net: Efficient Semantic Segmentation of Large-Scale Point Clouds (2020).
"""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

from splatseg.core import Layer
from splatseg.methods._method import Method, MethodInputs, Refined
from splatseg.methods._trained import context_of, hard_labels
from splatseg.methods.cosseg._blocks import BlockSource as BlockSource
from splatseg.methods.cosseg._distilled import distilled_features as distilled_features
from splatseg.methods.cosseg._linked import LinkedLabels, linked_labels
from splatseg.methods.cosseg._options import PUBLISHED_DIFFERS
from splatseg.methods.cosseg._options import CossegOptions as CossegOptions
from splatseg.methods.cosseg._train import train_cosseg as train_cosseg
from splatseg.methods.cosseg._train_jointly import train_cosseg_jointly as train_cosseg_jointly

_Made = TypeVar("_Made")


def run(inputs: MethodInputs, options: CossegOptions) -> Layer | Refined:
    """Train the decoder and read it, as the options say."""
    linked = linked_labels(inputs, options.link)
    gaussians = None
    if options.joint is None:
        found = _trained(train_cosseg, inputs, linked, options)
    else:
        train = partial(train_cosseg_jointly, told=inputs.progress)
        gaussians, found = _trained(train, inputs, linked, options)
    layer: Layer = found
    if options.readout == "hard":
        layer = linked.told(hard_labels(found, options))
    return layer if gaussians is None else Refined(layer=layer, gaussians=gaussians)


def _trained(
    train: Callable[..., _Made], inputs: MethodInputs, linked: LinkedLabels, options: CossegOptions
) -> _Made:
    """What a training makes of the inputs."""
    return train(
        inputs.gaussians,
        inputs.views,
        linked.source,
        features=inputs.features("features"),
        options=options,
        classes=inputs.label_names,
        metres_per_unit=inputs.metres_per_unit,
        up=inputs.up,
        context=context_of(inputs),
    )


METHOD = Method(
    name="cosseg",
    summary="a decoder of features of photographs and of the shape in space is trained on labels",
    reference="CoSSegGaussians (Dou et al. 2024), eq. 2 to 5",
    evidence=("labels", "tracked", "panoptic"),
    options=CossegOptions,
    run=run,
    keeps_ids=True,
    repairs=True,
    seeded=True,
    resumes=True,
    published=CossegOptions.published(),
    published_differs=PUBLISHED_DIFFERS,
    refines="joint",
    companions={"features": ("features",)},
)
