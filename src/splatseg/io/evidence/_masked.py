"""Evidence of the pixels that masks of views leave: what is left out has no labels."""

from collections.abc import Iterable
from dataclasses import replace
from typing import TypeVar

from splatseg.core import View
from splatseg.core.boundary import boundary
from splatseg.io.evidence._base import Evidence
from splatseg.io.evidence._labels import LabelEvidence
from splatseg.io.evidence._segments import TableEvidence

AnyEvidence = TypeVar("AnyEvidence", bound=Evidence)


@boundary
def without_masked(evidence: AnyEvidence, views: Iterable[View]) -> AnyEvidence:
    """Label maps without the pixels that masks of views leave out, such as those of moving things.

    Evidence of other kinds (masks, features, depth) is given back as it is.

    Args:
        evidence: Labels, panoptic or tracked.
        views: Views with their masks; maps of others are as they were.
    """
    masked = {view.name: view for view in views if view.mask is not None}
    if not masked:
        return evidence
    if isinstance(evidence, LabelEvidence):
        return replace(evidence, masked=masked)
    if isinstance(evidence, TableEvidence):
        return replace(evidence, maps=replace(evidence.maps, masked=masked))
    return evidence
