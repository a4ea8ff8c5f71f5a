r"""``segment --method dnmp``: labels of Gaussians from a mesh field of the same drive.

Primitives are put where the Gaussians show surfaces and fitted to the depth that they show; the
field learns from photographs and label maps, as the paper has it. A Gaussian takes the label of
its centre, by eq. 9; one without a vertex near it that the rule asks has none, and is completed as
usual. The layer's record has the rule (option ``vertex_rule``), and how many Gaussians eq. 9 left
undefined (``undefined``).

References:
    DNMP with semantics (papers/002).
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace

import torch

from splatseg.core import UNLABELLED, Labels, View
from splatseg.errors import InputError
from splatseg.lift import GaussianField
from splatseg.methods import Method, MethodInputs
from splatseg.street.build import METHOD_NAME, build_mesh_field
from splatseg.street.field import MeshField
from splatseg.street.geometry import DepthView, field_views
from splatseg.street.options import PUBLISHED, DnmpOptions
from splatseg.street.sources import depth_points

_CELLS = 5
"""Points are thinned to so many cells along the side of the finest voxel."""

_BACKGROUND_VIEWS = 8
_SHAPING = 300
_STEPS = 1000
"""Progress of the whole, of which the geometry is the first part."""


def run(inputs: MethodInputs, options: DnmpOptions) -> Labels:
    """Build a mesh field and read it at the centres of Gaussians."""
    if not len(inputs.gaussians):
        raise InputError("gaussians: expected Gaussians to label, got none.")
    metres = inputs.metres_per_unit or 1.0
    field = GaussianField(inputs.gaussians, backend=inputs.backend)  # pyright: ignore[reportArgumentType]

    def depths() -> Iterator[DepthView]:
        return field_views(field, [view.camera for view in inputs.views])

    points = depth_points(
        depths(),
        min(options.voxels) / metres / _CELLS,
        max_depth=options.geometry.max_depth / metres,
    )
    made = build_mesh_field(
        points,
        depths(),
        inputs.views,
        inputs.evidence,
        options=options,
        classes=inputs.label_names,
        metres_per_unit=metres,
        seed=inputs.seed,
        progress=None if inputs.progress is None else _told(inputs.progress),
    )
    labels = made.field.labels_at(inputs.gaussians.means.detach().cpu(), made.field.layer_names[0])
    info = made.field.info
    undefined = int((labels.ids == UNLABELLED).sum())
    return Labels(
        ids=labels.ids,
        confidence=labels.confidence,
        background=_background(made.field, inputs.views),
        info=replace(info, details={**info.details, "undefined": undefined}),
    )


def _told(progress: Callable[[int, int], None]) -> Callable[[str, int, int], None]:
    def told(stage: str, done: int, total: int) -> None:
        share = done / max(total, 1)
        whole = _SHAPING * share if stage == "geometry" else _SHAPING + (_STEPS - _SHAPING) * share
        progress(round(whole), _STEPS)

    return told


def _background(field: MeshField, views: tuple[View, ...]) -> int:
    """What most pixels without a primitive show, in a few views; -1 where there are none."""
    seen: Counter[int] = Counter()
    for view in views[:: max(1, len(views) // _BACKGROUND_VIEWS)]:
        with field.view(view.camera) as looked_at:
            alpha = looked_at.signals(colour=False).alpha
            shown = looked_at.label_map(field.layer_names[0]).ids
        ids, counts = torch.unique(shown[alpha == 0], return_counts=True)
        seen.update(dict(zip(ids.tolist(), counts.tolist(), strict=True)))
    # Of equally frequent ones the smallest id.
    return min(seen, key=lambda id: (-seen[id], id), default=UNLABELLED)


METHOD = Method(
    name=METHOD_NAME,
    summary="primitives of a mesh learn colour and classes along rays; Gaussians take the label "
    "of the vertices around their centre",
    reference="DNMP with semantics (papers/002); Lu et al. (ICCV 2023)",
    evidence=("labels",),
    options=DnmpOptions,
    run=run,
    keeps_ids=True,
    seeded=True,
    published=PUBLISHED,
    published_differs=(
        "It differs: shapes are decoded by our own weights, surfaces come from scans or the depth "
        "of Gaussians instead of multi-view stereo, and labels are those at hand."
    ),
)
