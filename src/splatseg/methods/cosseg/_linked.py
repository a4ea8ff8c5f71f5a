"""Labels whose ids mean the same in all views, and what class each is of."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from splatseg.core import InstanceTree, Labels, LabelSource
from splatseg.errors import InputError
from splatseg.io.evidence import TrackedEvidence
from splatseg.lift.segments import EvidenceSegments, MatchedMaps
from splatseg.methods._method import MethodInputs
from splatseg.methods.associate import associate

Link = Literal["given", "associate"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinkedLabels:
    """Label maps that a decoder can learn from."""

    source: LabelSource
    class_of: Mapping[int, int] = field(default_factory=dict[int, int])
    """Of ids that are of objects the class, where it is known."""

    names: Mapping[int, str] = field(default_factory=dict[int, str])

    def told(self, labels: Labels) -> Labels:
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


def linked_labels(inputs: MethodInputs, link: Link | None) -> LinkedLabels:
    """Label maps with ids that mean the same in all views.

    Args:
        inputs: Evidence of classes, of tracks, or of segments with ids of each view's own.
        link: How ids of views are linked. None: as given where they are of classes or tracks.

    Raises:
        InputError: If ids are to be taken as given that are each view's own, or classes are to be
            associated.
    """
    evidence = inputs.evidence
    if evidence.kind == "labels":
        if link == "associate":
            raise InputError(
                f"{evidence.folder}: link: expected segments of objects (panoptic, tracked) to "
                f"associate, got {evidence.kind}."
            )
        return LinkedLabels(source=evidence)
    segments = EvidenceSegments(evidence=evidence)
    if isinstance(evidence, TrackedEvidence) and link != "associate":
        class_of = dict(segments.categories_of(""))
        kinds = {} if inputs.categories is None else {r.id: r.name for r in inputs.categories.rows}
        names = {id: f"{kinds.get(kind, kind)} {id}" for id, kind in class_of.items()}
        return LinkedLabels(source=evidence, class_of=class_of, names=names)
    if link == "given":
        raise InputError(
            f"{evidence.folder}: link: expected associate, since ids of panoptic segments mean "
            "something in their own view only, got given."
        )
    objects = associate(
        inputs.gaussians,
        inputs.views,
        segments,
        classes=inputs.categories,
        backend=inputs.backend,
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
