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

from collections.abc import Mapping

from splatseg.core import ClassTable, Layer
from splatseg.errors import InputError
from splatseg.io.evidence import TrackedEvidence
from splatseg.lift.segments.recorded import EvidenceSegments
from splatseg.methods._method import Method, MethodInputs, Refined
from splatseg.methods._trained_labels import context_of, hard_labels
from splatseg.methods.cosseg._objects import label_objects
from splatseg.methods.cosseg._options import CossegOptions as CossegOptions
from splatseg.methods.cosseg._train import train_cosseg as train_cosseg
from splatseg.methods.cosseg._train_jointly import train_cosseg_jointly as train_cosseg_jointly


def run(inputs: MethodInputs, options: CossegOptions) -> Layer | Refined:
    """Find labels of objects, or train the decoder and read it, as the options say."""
    if options.decide == "objects":
        return _closed_form(inputs, options)
    features, gaussians = inputs.features("features"), None
    if options.joint is None:
        found = train_cosseg(
            inputs.gaussians,
            inputs.views,
            inputs.evidence,
            features=features,
            options=options,
            classes=inputs.label_names,
            metres_per_unit=inputs.metres_per_unit,
            up=inputs.up,
            context=context_of(inputs),
        )
    else:
        gaussians, found = train_cosseg_jointly(
            inputs.gaussians,
            inputs.views,
            inputs.evidence,
            features=features,
            options=options,
            classes=inputs.label_names,
            metres_per_unit=inputs.metres_per_unit,
            up=inputs.up,
            context=context_of(inputs),
            told=inputs.progress,
        )
    layer = found if options.readout == "rendered" else hard_labels(found, options)
    return layer if gaussians is None else Refined(layer=layer, gaussians=gaussians)


def _closed_form(inputs: MethodInputs, options: CossegOptions) -> Layer:
    """Of label maps the classes of Gaussians, of tracks the objects with a class each."""
    masks = inputs.companions.get("masks")
    if masks is None:
        raise InputError(
            "masks: expected evidence of masks, such as masks_sam, to find objects by, got none; "
            "`decide` by decoder wants none."
        )
    evidence = inputs.evidence
    tracked = isinstance(evidence, TrackedEvidence)
    found = label_objects(
        inputs.gaussians,
        inputs.views,
        evidence,
        features=inputs.features("features"),
        masks=EvidenceSegments(evidence=masks),
        options=options,
        object_options=options.classification,
        classes=inputs.categories if tracked else inputs.label_names,
        context=context_of(inputs),
        categories=_categories(evidence, inputs.categories) if tracked else None,
        told=inputs.progress,
    )
    return found.objects if found.classes is None else found.classes


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
    summary="labels are decoded from features of photographs and the shape in space",
    reference="CoSSegGaussians (Dou et al. 2024), eq. 2 to 5",
    evidence=("labels", "tracked"),
    options=CossegOptions,
    run=run,
    keeps_ids=True,
    seeded=True,
    resumes=True,
    published=CossegOptions.published(),
    refines="joint",
    companions={"features": ("features",), "masks": ("masks",)},
)
