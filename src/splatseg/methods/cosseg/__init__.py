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

from collections.abc import Callable, Mapping
from functools import partial
from typing import TypeVar

from splatseg.core import ClassTable, Layer
from splatseg.errors import InputError
from splatseg.io.evidence import PanopticEvidence, TrackedEvidence
from splatseg.lift.segments.recorded import EvidenceSegments
from splatseg.methods._method import Method, MethodInputs, Refined
from splatseg.methods._trained_labels import context_of, hard_labels
from splatseg.methods.cosseg._linked import CategoryMaps, LinkedLabels, linked_labels
from splatseg.methods.cosseg._objects import label_objects
from splatseg.methods.cosseg._options import PUBLISHED_DIFFERS
from splatseg.methods.cosseg._options import CossegOptions as CossegOptions
from splatseg.methods.cosseg._train import train_cosseg as train_cosseg
from splatseg.methods.cosseg._train_jointly import train_cosseg_jointly as train_cosseg_jointly

_Made = TypeVar("_Made")


def run(inputs: MethodInputs, options: CossegOptions) -> Layer | Refined:
    """Find labels of objects, or train the decoder and read it, as the options say."""
    if options.decide == "objects":
        return _closed_form(inputs, options)
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


def _closed_form(inputs: MethodInputs, options: CossegOptions) -> Layer:
    """Of label maps the classes of Gaussians, of segments the objects with a class each."""
    evidence = inputs.evidence
    masks = inputs.companions.get("masks", evidence)
    if masks.kind == "labels":
        raise InputError(
            "masks: expected evidence of masks, such as masks_sam, to find objects by, got none; "
            "`decide` by decoder wants none."
        )
    tracked = isinstance(evidence, TrackedEvidence)
    found = label_objects(
        inputs.gaussians,
        inputs.views,
        CategoryMaps(evidence=evidence) if isinstance(evidence, PanopticEvidence) else evidence,
        features=inputs.features("features"),
        masks=EvidenceSegments(evidence=masks),
        options=options,
        object_options=options.classification,
        classes=inputs.label_names if evidence.kind == "labels" else inputs.categories,
        context=context_of(inputs),
        categories=_categories(evidence, inputs.categories) if tracked else None,
        told=inputs.progress,
    )
    if found.classes is None or evidence.kind != "labels":
        return found.objects
    return found.classes


def _categories(
    evidence: TrackedEvidence, table: ClassTable | None
) -> Mapping[int, Mapping[int, float]]:
    """How many pixels under each track were taken for which class."""
    if table is None:
        raise InputError(
            f"{evidence.folder}: expected a table of classes to tell what tracks are of, and "
            "neither the capture nor the evidence has one."
        )
    ids = {row.name: row.id for row in table.rows}
    return {
        track.id: {ids[name]: float(votes) for name, votes in track.votes.items() if name in ids}
        for track in evidence.tracks
    }


METHOD = Method(
    name="cosseg",
    summary="labels that contradict each other, decided by objects or by a decoder of features",
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
    companions={"features": ("features",), "masks": ("masks", "panoptic", "tracked")},
)
