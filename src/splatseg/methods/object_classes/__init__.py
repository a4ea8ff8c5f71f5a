"""Labels that contradict each other, decided object by object, by votes and by what looks alike.

Labels of views err: a segmenter is wrong about an object from a whole range of views. Objects are
found by masks, whose errors are others; each gets the class that its own votes and those of objects
that look like it speak for (`_objects`), in closed form: nothing is trained.

No publication has this as a whole. Its parts are known: features of a class are Gaussian about a
mean that is Gaussian itself (probabilistic linear discriminant analysis, `lift.object_classes`),
and what the objects of a track are is found by expectation maximization. Features are lifted as
those of `methods.cosseg` are; the network of that paper is not in it. Decisions 0035 and 0046.

References:
    Ioffe, Probabilistic Linear Discriminant Analysis (2006).
    Dempster, Laird and Rubin, Maximum Likelihood from Incomplete Data via the EM Algorithm (1977).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from splatseg.core import ClassTable, LabelMap, Labels
from splatseg.errors import InputError
from splatseg.io.evidence import PanopticEvidence, TrackedEvidence
from splatseg.lift.segments import EvidenceSegments
from splatseg.methods._method import Method, MethodInputs
from splatseg.methods.object_classes._objects import label_objects
from splatseg.methods.object_classes._options import ObjectLabelOptions as ObjectLabelOptions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _CategoryMaps:
    """Categories of panoptic segments as a `LabelSource`."""

    evidence: PanopticEvidence

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have a file."""
        return self.evidence.view_names

    def label_map(self, name: str) -> LabelMap:
        """Category ids of a view."""
        return self.evidence.category_map(name)


def run(inputs: MethodInputs, options: ObjectLabelOptions) -> Labels:
    """Of label maps the classes of Gaussians, of segments the objects with a class each."""
    evidence = inputs.evidence
    masks = inputs.companions.get("masks", evidence)
    if masks.kind == "labels":
        raise InputError(
            "masks: expected evidence of masks, such as masks_sam, to find objects by, got none."
        )
    tracked = isinstance(evidence, TrackedEvidence)
    found = label_objects(
        inputs.gaussians,
        inputs.views,
        _CategoryMaps(evidence=evidence) if isinstance(evidence, PanopticEvidence) else evidence,
        features=inputs.features("features"),
        masks=EvidenceSegments(evidence=masks),
        options=options,
        classes=inputs.label_names if evidence.kind == "labels" else inputs.categories,
        categories=_categories(evidence, inputs.categories) if tracked else None,
        backend=inputs.backend,
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
    name="object-classes",
    summary="labels that contradict each other, decided object by object by votes and likeness",
    reference="docs/decisions/0046-object-classes.md; PLDA (Ioffe 2006), EM (Dempster et al. 1977)",
    evidence=("labels", "tracked", "panoptic"),
    options=ObjectLabelOptions,
    run=run,
    keeps_ids=True,
    repairs=True,
    companions={"features": ("features",), "masks": ("masks", "panoptic", "tracked")},
)
