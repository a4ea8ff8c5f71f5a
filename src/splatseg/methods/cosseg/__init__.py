r"""CoSSegGaussians: labels decoded from features of photographs and from the shape in space.

Labels of views contradict each other: a segmenter is wrong about an object from a whole range of
views. Numbers of each Gaussian's own learn that by heart; a small network that is given what
Gaussians look like and how they lie in space cannot, and gives alike things one label.

Features of four blocks of a network are unprojected onto Gaussians (`features`, eq. 2), a frozen
RandLA-Net encodes their centres (`network`), and a decoder fuses both from far to near (`decoder`,
Figs. 3 and 4). It is trained so that pixels get the labels of their label maps:

.. math:: \ell_s = -\sum_p \log \mathrm{softmax}(A \sum_i w_{pi} h_i + b)_{\mathrm{id}(p)}

Geometry stays as it is, so that rows of W never change (`splatseg.lift.training`). The weight
:math:`\lambda_s` of the loss is nothing to Adam where it is the only loss.

References:
    Dou et al., CoSSegGaussians: Compact and Swift Scene Segmenting 3D Gaussians (2024), eq. 2 to 5.
    Hu et al., RandLA-Net: Efficient Semantic Segmentation of Large-Scale Point Clouds (2020).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from splatseg.core import InstanceTree, Labels, LabelSource, Layer
from splatseg.io.evidence import TrackedEvidence
from splatseg.lift.segments import EvidenceSegments, MatchedMaps
from splatseg.methods._method import Method, MethodInputs, Refined
from splatseg.methods._trained import context_of, hard_labels
from splatseg.methods.associate import associate
from splatseg.methods.cosseg.features import BlockSource as BlockSource
from splatseg.methods.cosseg.features import distilled_features as distilled_features
from splatseg.methods.cosseg.joint import train_cosseg_jointly as train_cosseg_jointly
from splatseg.methods.cosseg.options import PUBLISHED_DIFFERS
from splatseg.methods.cosseg.options import CossegOptions as CossegOptions
from splatseg.methods.cosseg.train import train_cosseg as train_cosseg


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinkedLabels:
    """Label maps whose ids mean the same in all views, and what class each is of."""

    source: LabelSource
    class_of: Mapping[int, int] = field(default_factory=dict[int, int])
    """Of ids that are of objects the class, where it is known."""

    names: Mapping[int, str] = field(default_factory=dict[int, str])

    def described(self, labels: Labels) -> Labels:
        """The layer, with what its ids are of."""
        if not self.class_of:
            return labels
        present = set(labels.present.tolist())
        info = replace(
            labels.info,
            class_of={id: kind for id, kind in self.class_of.items() if id in present},
            names={id: name for id, name in self.names.items() if id in present},
        )
        return replace(labels, info=info)


def linked_labels(inputs: MethodInputs) -> LinkedLabels:
    """Label maps of classes or tracks as they are; panoptic segments are associated to objects."""
    evidence = inputs.evidence
    if evidence.kind == "labels":
        return LinkedLabels(source=evidence)
    segments = EvidenceSegments(evidence=evidence)
    if isinstance(evidence, TrackedEvidence):
        class_of = dict(segments.categories_of(""))
        kinds = {} if inputs.categories is None else {r.id: r.name for r in inputs.categories.rows}
        names = {id: f"{kinds.get(kind, kind)} {id}" for id, kind in class_of.items()}
        return LinkedLabels(source=evidence, class_of=class_of, names=names)
    objects = associate(
        inputs.gaussians,
        inputs.views,
        segments,
        classes=inputs.categories,
        backend=inputs.backend,
        executor=inputs.executor,
    )
    flat = objects.cut("object") if isinstance(objects, InstanceTree) else objects
    return LinkedLabels(
        source=MatchedMaps(
            gaussians=inputs.gaussians,
            views=inputs.views,
            source=segments,
            labels=flat,
            backend=inputs.backend,
        ),
        class_of=flat.info.class_of,
        names=flat.info.names,
    )


def run(inputs: MethodInputs, options: CossegOptions) -> Layer | Refined:
    """Train the decoder and read it, as the options say."""
    linked = linked_labels(inputs)
    scene = inputs.gaussians, inputs.views, linked.source
    given: dict[str, Any] = {
        "features": inputs.features("features"),
        "options": options,
        "classes": inputs.label_names,
        "metres_per_unit": inputs.metres_per_unit,
        "up": inputs.up,
        "context": context_of(inputs),
    }
    gaussians = None
    if options.joint is None:
        found = train_cosseg(*scene, **given)
    else:
        gaussians, found = train_cosseg_jointly(*scene, **given, progress=inputs.progress)
    layer: Layer = found
    if options.readout == "hard":
        layer = linked.described(hard_labels(found, options))
    return layer if gaussians is None else Refined(layer=layer, gaussians=gaussians)


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
