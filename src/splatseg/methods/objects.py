"""Features of objects as a method: each Gaussian takes the vector of its object.

Masks are associated into objects (`methods.associate`), and their features are solved for all
together (`lift.words.object_features`), so that small things do not look like what they stand on.
"""

from dataclasses import asdict, dataclass, field

import torch

from splatseg.core import Features, InstanceTree, LayerInfo
from splatseg.errors import InputError
from splatseg.lift.segments import EvidenceSegments
from splatseg.lift.words import UnmixOptions, object_features
from splatseg.methods._method import Method, MethodInputs
from splatseg.methods.associate import associate


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectFeaturesOptions:
    """How features of objects are found."""

    masks: str | None = None
    """Name of the evidence of masks, or of panoptic or tracked segments, that objects are found
    by; it is needed."""

    unmixing: UnmixOptions = field(default_factory=UnmixOptions)
    """How features that share cells are told apart."""


def run(inputs: MethodInputs, options: ObjectFeaturesOptions) -> Features:
    """Associate masks, and solve for the features of the objects.

    Returns:
        The vector of its object for each Gaussian, zeros where it has none or no view shows it.
        Weights of the Gaussians of an object add up to the cells that show it.
    """
    masks = inputs.companions.get("masks")
    if masks is None:
        raise InputError(
            "masks: expected evidence of masks, such as masks_sam, to find objects by, got none."
        )
    found = associate(
        inputs.gaussians, inputs.views, EvidenceSegments(evidence=masks), backend=inputs.backend
    )
    objects = found.cut("object") if isinstance(found, InstanceTree) else found
    solved = object_features(
        inputs.gaussians,
        inputs.views,
        inputs.evidence,
        objects,
        options=options.unmixing,
        backend=inputs.backend,
        progress=inputs.progress,
    )
    row = solved.of_gaussians(objects)
    known = (row >= 0) & (solved.cells[row.clamp_min(0)] > 0)
    row = row.clamp_min(0)
    size = torch.bincount(row[known], minlength=len(solved.ids)).clamp_min(1)
    return Features(
        values=torch.where(known[:, None], solved.values[row], 0.0),
        weights=torch.where(known, (solved.cells / size)[row], 0.0),
        info=LayerInfo(
            method="objects",
            options=asdict(options),
            views=tuple(sorted(view.name for view in inputs.views)),
            details={
                "objects": int((solved.cells > 0).sum()),
                "blur": solved.blur,
                "residual": round(solved.residual, 6),
            },
        ),
    )


METHOD = Method(
    name="objects",
    summary="each Gaussian takes the feature of its object, solved for all objects together",
    reference="linear spectral unmixing (Keshava and Mustard 2002), eq. 2",
    evidence=("features",),
    options=ObjectFeaturesOptions,
    run=run,
    returns="features",
    companions={"masks": ("masks", "panoptic", "tracked")},
    complete=False,
    words="span",
)
