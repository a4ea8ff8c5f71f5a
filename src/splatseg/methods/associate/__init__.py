r"""Association: segments of unordered views, each with ids of its own, become instances in 3D.

Every segment is a set of Gaussians, those it has most mass on. Segments that agree about the
Gaussians that both their views see are joined (`_clustering`): there is no tracker, no order of
views and no limit on their number or that of ids. Then the views vote,

.. math:: v_{ik} = \sum_{s \in k} \sum_{p \in s} w_{pi},

all pixels alike; small things come to their right by `lift.voting.confusion`: a model that misses a
cup calls its pixels table, far more often than one that sees a cup where there is only table, and
the votes themselves tell how often.

Where masks overlap, segments of one view that lie inside each other are of different levels and
never one instance; nor are those to which a model itself gave different levels. Groups of segments
then become a tree (`_tree`), in which nodes that are two things are divided, and whose shape says
which nodes are objects; masks of objects and of their parts vote for the objects, and within each
object for its parts (`_votes`). Memberships solved for through the pixels sharpen the votes
(`_memberships`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.core import (
    LOCAL,
    UNLABELLED,
    Camera,
    ClassTable,
    Executor,
    Gaussians,
    InstanceFacts,
    InstanceTree,
    Labels,
    LayerInfo,
    MaskSet,
    SegmentSource,
    View,
    camera_of_map,
    tree_level,
    with_info,
)
from splatseg.core.options import Count, Share, options
from splatseg.lift.segments import EvidenceSegments, reduced_size
from splatseg.lift.voting.confusion import DEFAULT_CONFUSION, ConfusionOptions, correct_confusion
from splatseg.methods._method import Method, MethodInputs
from splatseg.methods.associate._clustering import cluster, nesting
from splatseg.methods.associate._levels import separated_levels
from splatseg.methods.associate._memberships import sharpened_votes
from splatseg.methods.associate._table import SegmentTable, segment_table
from splatseg.methods.associate._tree import segment_tree
from splatseg.methods.associate._update import with_views
from splatseg.methods.associate._votes import (
    category_of,
    instance_tree,
    majority,
    sorted_by_mass,
    tree_votes,
    view_counts,
    without_outside,
)

_SOLVED = "memberships are solved for in one way, which `sharpen_votes` turns off"


@options(
    removed={
        "small_things": "`correct_confusion` finds small things without it",
        "overlapping": "`level` object gives one label a Gaussian",
        "overlap": "a node lies in another if more than 0.7 of it does",
        "max_views": "the 50 views that see most of a Gaussian are compared",
    }
)
class AssociateOptions:
    """How segments of views become instances."""

    agreement: Share = 0.2
    """Minimum overlap at which two groups of segments are one instance: intersection over union
    on the Gaussians that the views of both see, averaged over all pairs of segments of the two
    groups, in [0, 1]. Lower values join more."""

    min_views: Count = 2
    """Views that an instance needs segments in, or all there are if they are fewer."""

    level: str = "tree"
    """What overlapping masks become: tree, with groups, objects and parts; or one cut of it as
    labels: group, object or part, or a granularity from 0 (groups) over 0.5 (objects) to 1 (the
    finest parts)."""

    min_support: Share = 0.3
    """Of overlapping masks: share, in [0, 1], of the views that could have seen a group of
    segments that must have a segment of it. Higher leaves out what few masks speak for."""

    longest_side: Count = 640
    """Longest side, in pixels, at which segments of larger photographs are read; bounds time. What
    is thinner than a pixel there may be missed."""

    def __post_init__(self) -> None:
        if self.level != "tree":
            tree_level(self.level)


def associate(
    gaussians: Gaussians,
    views: Sequence[View],
    source: SegmentSource,
    *,
    options: AssociateOptions | None = None,
    confusion: ConfusionOptions | None = DEFAULT_CONFUSION,
    sharpen_votes: bool = True,
    classes: ClassTable | None = None,
    backend: str = "auto",
    executor: Executor = LOCAL,
    progress: Callable[[int, int], None] | None = None,
) -> Labels | InstanceTree:
    """Instances from segments of views.

    The result depends neither on the order of the views nor on ids of segments. Instances are
    numbered from 1, the one with most mass first.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those whose segments count.
        source: Their segments.
        options: How segments become instances.
        confusion: How segments err, see `correct_confusion`. None takes the majority of the votes.
        sharpen_votes: Of a tree: solve for how much of each Gaussian belongs to which node.
        classes: Names of the categories of segments; instances are named after theirs.
        backend: Name of the rendering backend.
        executor: Where masses of views are found; the result does not depend on it.
        progress: Called with the views done and their number.

    Returns:
        Labels, or a tree of groups, objects and parts where masks may overlap. The info says
        among its details, under ``associate``, how many segments there were, what was joined
        within a view, and what was left out. That of labels has names, classes and facts of the
        instances; the nodes of a tree say the same.

    Raises:
        InputError: If there are no views, if one has no segments, or none has any.
        ShapeError: If segments do not have their photograph's proportions.
    """
    options = options or AssociateOptions()
    if source.overlapping:
        tree, _, _ = _associated_tree(
            gaussians,
            views,
            source,
            options,
            confusion=confusion,
            sharpen_votes=sharpen_votes,
            classes=classes,
            backend=backend,
            executor=executor,
            progress=progress,
        )
        return tree if options.level == "tree" else tree.cut(tree_level(options.level))
    table = segment_table(
        gaussians,
        views,
        source,
        longest_side=options.longest_side,
        backend=backend,
        executor=executor,
        progress=progress,
    )
    group = cluster(table.agreement(), options.agreement)
    group = _seen_often(table, group, min(options.min_views, len(table.views)))
    group, votes = sorted_by_mass(group, table.votes(group))
    labels = majority(votes, view_counts(table))
    if confusion is not None:
        labels = correct_confusion(labels, options=confusion)
    summary = _summary(table, group, tracked=source.persistent)
    info = _with_instances(_info(labels.info, options, table, summary), table, group, classes)
    return replace(labels, candidates=None, shares=None, info=info)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AssociatedMasks:
    """A tree of instances, and which mask is which of its nodes."""

    tree: InstanceTree

    nodes: Mapping[str, NDArray[np.int64]]
    """Of each view the ids of the nodes of its masks, (masks,), -1 for none."""


def associate_masks(
    gaussians: Gaussians,
    views: Sequence[View],
    source: SegmentSource,
    *,
    backend: str = "auto",
    executor: Executor = LOCAL,
) -> AssociatedMasks:
    """The tree that `associate` makes of masks by default, and the node of each mask.

    Raises:
        InputError: If there are no views, if one has no masks, or none has any.
        ShapeError: If masks do not have their photograph's proportions.
    """
    tree, node, table = _associated_tree(
        gaussians, views, source, AssociateOptions(), backend=backend, executor=executor
    )
    nodes: dict[str, NDArray[np.int64]] = {}
    for index, name in enumerate(table.views):
        own = table.view == index
        masks = source.segments_of(name)
        nodes[name] = np.full(len(masks) if isinstance(masks, MaskSet) else 0, UNLABELLED)
        nodes[name][table.name[own]] = node[own]
    return AssociatedMasks(tree=tree, nodes=nodes)


def _associated_tree(
    gaussians: Gaussians,
    views: Sequence[View],
    source: SegmentSource,
    options: AssociateOptions,
    *,
    confusion: ConfusionOptions | None = DEFAULT_CONFUSION,
    sharpen_votes: bool = True,
    classes: ClassTable | None = None,
    backend: str,
    executor: Executor,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[InstanceTree, NDArray[np.int64], SegmentTable]:
    """Groups, objects and parts of masks, the node of each mask, and the table of masks."""
    side = options.longest_side
    table = segment_table(
        gaussians,
        views,
        source,
        longest_side=side,
        backend=backend,
        executor=executor,
        progress=progress,
    )
    support, count = options.min_support, min(options.min_views, len(table.views))
    agreement = table.agreement()
    nested = nesting(agreement, table.level)
    group = cluster(nested.agreement, options.agreement, conflicts=nested.conflicts)
    found, level = separated_levels(
        segment_tree(table, agreement, nested, group, min_support=support, min_views=count),
        nested,
        table.objectness,
        min_support=support,
        min_views=count,
    )
    votes = tree_votes(table, found, level, confusion=confusion)
    if sharpen_votes:
        votes = sharpened_votes(
            gaussians,
            views,
            source,
            table,
            votes,
            longest_side=side,
            backend=backend,
            executor=executor,
        )
    votes = without_outside(votes, table, found, min_support=support)
    tree, node = instance_tree(table, found, level, votes, classes)
    summary = _summary(table, found.node, tracked=False)
    summary |= {"instances": len(votes.object_rows), "nodes": len(tree.nodes)}
    return with_info(tree, _info(tree.info, options, table, summary)), node, table


def _seen_often(table: SegmentTable, group: NDArray[np.int64], least: int) -> NDArray[np.int64]:
    """Groups of segments in too few views get the group -1."""
    pairs = np.unique(np.stack((group, table.view)), axis=1)
    views = np.bincount(pairs[0], minlength=int(group.max()) + 1)
    return np.where(views[group] >= least, group, -1)


def _info(
    info: LayerInfo, options: AssociateOptions, table: SegmentTable, summary: dict[str, Any]
) -> LayerInfo:
    return replace(
        info,
        method="associate",
        options=asdict(options),
        views=tuple(table.views),
        details=dict(info.details) | {"associate": summary},
    )


def _with_instances(
    info: LayerInfo, table: SegmentTable, group: NDArray[np.int64], classes: ClassTable | None
) -> LayerInfo:
    """The record with the name, the class where it is known, and the facts of each instance."""
    names: dict[int, str] = {}
    class_of: dict[int, int] = {}
    facts: dict[int, InstanceFacts] = {}
    for index in range(int(group.max(initial=-1)) + 1):
        id, members = index + 1, np.flatnonzero(group == index)
        category = category_of(table, members)
        known = category > 0 and classes is not None
        names[id] = f"{classes.name_of(category) if known and classes else 'object'} {id}"
        if category > 0:
            class_of[id] = category
        views = np.unique(table.view[members])
        facts[id] = InstanceFacts(segments=len(members), views=len(views))
    return replace(info, names=names, class_of=class_of, instances=facts)


def _summary(table: SegmentTable, group: NDArray[np.int64], *, tracked: bool) -> dict[str, Any]:
    """What became of the segments; of tracks, which were joined and which were divided."""
    there = group >= 0
    pairs = np.stack((group[there], table.view[there]))
    _, counts = np.unique(pairs, axis=1, return_counts=True)
    summary: dict[str, Any] = {
        "segments": len(group),
        "instances": int(group.max(initial=-1)) + 1,
        "left_out": int((~there).sum()),
        "joined_within_views": int((counts - 1).sum()),
    }
    if not tracked:
        return summary
    of: dict[int, set[int]] = {}
    names: dict[int, set[int]] = {}
    for instance, name in zip(group[there].tolist(), table.name[there].tolist(), strict=True):
        of.setdefault(name, set()).add(instance + 1)
        names.setdefault(instance + 1, set()).add(name)
    return summary | {
        "merged": [{"id": i, "from": sorted(s)} for i, s in sorted(names.items()) if len(s) > 1],
        "split": [{"from": i, "ids": sorted(s)} for i, s in sorted(of.items()) if len(s) > 1],
    }


@options(
    removed=dict.fromkeys(
        ("pixels", "border_share", "min_weight", "min_votes", "rounds", "solver_steps"), _SOLVED
    )
    | {"min_agreement": _SOLVED, "memberships": _SOLVED}
)
class AssociateMethodOptions:
    """Association, and what corrects its votes."""

    association: AssociateOptions = field(default_factory=AssociateOptions)
    """How segments become instances."""

    correct_confusion: bool = True
    """Relabel under how often the evidence takes one instance for another, which finds small
    things that most views miss."""

    confusion: ConfusionOptions = field(default_factory=ConfusionOptions)
    """How the evidence errs."""

    sharpen_votes: bool = True
    """Of masks that may overlap: solve for how much of each Gaussian belongs to which object, so
    that pixels at borders come out as labelled. Costs about as much as the association."""


def run(inputs: MethodInputs, options: AssociateMethodOptions) -> Labels | InstanceTree:
    """Join segments of views, see `associate`."""
    return associate(
        inputs.gaussians,
        inputs.views,
        EvidenceSegments(evidence=inputs.evidence),
        options=options.association,
        confusion=options.confusion if options.correct_confusion else None,
        sharpen_votes=options.sharpen_votes,
        classes=inputs.categories,
        backend=inputs.backend,
        executor=inputs.executor,
        progress=inputs.progress,
    )


def camera(inputs: MethodInputs, options: AssociateMethodOptions, view: View) -> Camera:
    """The camera of a view's segments, at the size at which they are read."""
    segments = EvidenceSegments(evidence=inputs.evidence).segments_of(view.name)
    size = reduced_size(segments.height, segments.width, options.association.longest_side)
    return camera_of_map(view, *size)


def update(
    inputs: MethodInputs, options: AssociateMethodOptions, layer: Labels | InstanceTree
) -> Labels | InstanceTree:
    """Add the segments of further views, see `with_views`."""

    def associated(source: SegmentSource, views: Sequence[View]) -> Labels | InstanceTree:
        level = "tree" if isinstance(layer, InstanceTree) else "object"
        return associate(
            inputs.gaussians,
            views,
            source,
            options=replace(options.association, level=level),
            confusion=options.confusion if options.correct_confusion else None,
            sharpen_votes=False,
            classes=inputs.categories,
            backend=inputs.backend,
            executor=inputs.executor,
        )

    return with_views(
        layer,
        inputs.gaussians,
        inputs.views,
        EvidenceSegments(evidence=inputs.evidence),
        associated=associated,
        longest_side=options.association.longest_side,
        backend=inputs.backend,
        executor=inputs.executor,
        progress=inputs.progress,
    )


METHOD = Method(
    name="associate",
    summary="segments of all views become instances by the Gaussians they share; no tracker",
    reference="docs/decisions/association.md",
    evidence=("masks", "panoptic", "tracked"),
    options=AssociateMethodOptions,
    run=run,
    update=update,
    camera=camera,
)
