r"""Association: segments of unordered views, each with ids of its own, become instances in 3D.

Every segment is a set of Gaussians, those it has most mass on. Segments that agree about the
Gaussians that both their views see are joined (`splatseg.lift.segments.clustering`): there is no
tracker, no order of views and no limit on their number or that of ids. Then the views vote:

.. math:: v_{ik} = \sum_{s \in k} q_k \sum_{p \in s} w_{pi}, \qquad
          q_k = \Bigl(\tfrac{1}{|k|} \sum_{s \in k} m_s\Bigr)^{-\gamma}

with the mass :math:`m_s` of a segment over all Gaussians. The exponent :math:`\gamma` speaks for
small things where it is above 0. At 0 all pixels vote alike, and small things come to their right
by `lift.mass.confusion`: a model that misses a cup calls its pixels table, far more often than one
that sees a cup where there is only table, and the votes themselves tell how often.

Where masks overlap, segments of one view that lie inside each other are of different levels and
never one instance (`splatseg.lift.segments.nesting`); nor are those to which a model itself gave
different levels. Groups of segments then become a tree
(`splatseg.lift.segments.tree`), in which nodes that are two things are divided
(`splatseg.lift.segments.separate`) and whose levels say which nodes are objects
(`splatseg.lift.segments.levels`); masks of objects and of their parts vote for the objects, and
within each object for its parts. With ``overlapping="flat"`` there are no levels: groups of masks
are taken one after another, those that most of the views that could have seen them did see
first, and a group that mostly covers what is taken already is left out.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from splatseg.core import (
    UNLABELLED,
    ClassTable,
    Gaussians,
    InstanceTree,
    Labels,
    MaskSet,
    SegmentSource,
    View,
    tree_level,
    with_info,
)
from splatseg.lift.mass.confusion import DEFAULT_CONFUSION, ConfusionOptions, correct_confusion
from splatseg.lift.memberships import DEFAULT_MEMBERSHIPS, MembershipOptions
from splatseg.lift.segments.ballots import by_mass, majority, view_counts
from splatseg.lift.segments.clustering import cluster
from splatseg.lift.segments.flatten import chosen_groups
from splatseg.lift.segments.nesting import nesting
from splatseg.lift.segments.outside import without_outside
from splatseg.lift.segments.recorded import EvidenceSegments
from splatseg.lift.segments.separate import separated_levels
from splatseg.lift.segments.soft_tree import soft_votes
from splatseg.lift.segments.table import SegmentTable, segment_table
from splatseg.lift.segments.tree import segment_tree
from splatseg.lift.segments.tree_labels import (
    TreeVotes,
    instance_tree,
    tree_votes,
)
from splatseg.methods._associate_options import AssociateOptions as AssociateOptions
from splatseg.methods._association_info import account, with_instances
from splatseg.methods._method import Method, MethodInputs
from splatseg.render import RenderOptions

_SURE_SEGMENTS = 3
"""Groups of fewer segments are too few to speak for a small thing: they may be accidents."""


def associate(
    gaussians: Gaussians,
    views: Sequence[View],
    source: SegmentSource,
    *,
    options: AssociateOptions | None = None,
    confusion: ConfusionOptions | None = DEFAULT_CONFUSION,
    memberships: MembershipOptions | None = DEFAULT_MEMBERSHIPS,
    classes: ClassTable | None = None,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
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
        memberships: Of a tree, how votes are sharpened (`lift.segments.soft_tree`): the layer says
            how much of each Gaussian belongs to which node. None leaves them as they are.
        classes: Names of the categories of segments; instances are named after theirs.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.
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
    table = segment_table(
        gaussians,
        views,
        source,
        max_views=options.max_views,
        longest_side=options.longest_side,
        render_options=render_options,
        backend=backend,
        progress=progress,
    )
    if source.overlapping and options.overlapping == "tree":
        tree, _ = _tree(
            table,
            options,
            confusion=confusion,
            classes=classes,
            sharpened=None
            if memberships is None
            else partial(
                soft_votes,
                gaussians,
                sorted(views, key=lambda view: view.name),
                source,
                table,
                options=memberships,
                longest_side=options.longest_side,
                render_options=render_options,
                backend=backend,
            ),
        )
        return tree if options.level == "tree" else tree.cut(tree_level(options.level))
    agreement = table.agreement()
    group = cluster(agreement, options.agreement)
    group = _seen_often(table, group, min(options.min_views, len(table.views)))
    if source.overlapping:
        group = chosen_groups(table, agreement, group, overlap=options.overlap)
    votes = table.votes(group, _say(table, group, options.small_things))
    group, votes = by_mass(group, votes)
    labels = majority(votes, view_counts(table))
    if confusion is not None:
        labels = correct_confusion(labels, options=confusion)
    return replace(
        labels,
        candidates=None,
        shares=None,
        info=with_instances(
            replace(
                labels.info,
                method="associate",
                options=asdict(options),
                views=tuple(table.views),
                details=dict(labels.info.details)
                | {"associate": account(table, group, tracked=source.persistent)},
            ),
            table,
            group,
            classes,
        ),
    )


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
    render_options: RenderOptions | None = None,
    backend: str = "auto",
) -> AssociatedMasks:
    """The tree that `associate` makes of masks by default, and the node of each mask.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those whose masks count.
        source: Their masks, which may overlap.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.

    Raises:
        InputError: If there are no views, if one has no masks, or none has any.
        ShapeError: If masks do not have their photograph's proportions.
    """
    options = AssociateOptions()
    table = segment_table(
        gaussians,
        views,
        source,
        max_views=options.max_views,
        longest_side=options.longest_side,
        render_options=render_options,
        backend=backend,
    )
    tree, node = _tree(
        table,
        options,
        confusion=DEFAULT_CONFUSION,
        classes=None,
        sharpened=partial(
            soft_votes,
            gaussians,
            sorted(views, key=lambda view: view.name),
            source,
            table,
            options=DEFAULT_MEMBERSHIPS,
            longest_side=options.longest_side,
            render_options=render_options,
            backend=backend,
        ),
    )
    nodes: dict[str, NDArray[np.int64]] = {}
    for place, name in enumerate(table.views):
        own = table.view == place
        masks = source.segments_of(name)
        nodes[name] = np.full(len(masks) if isinstance(masks, MaskSet) else 0, UNLABELLED)
        nodes[name][table.name[own]] = node[own]
    return AssociatedMasks(tree=tree, nodes=nodes)


def _tree(
    table: SegmentTable,
    options: AssociateOptions,
    *,
    confusion: ConfusionOptions | None,
    classes: ClassTable | None,
    sharpened: Callable[[TreeVotes], TreeVotes] | None,
) -> tuple[InstanceTree, NDArray[np.int64]]:
    """Groups, objects and parts of segments inside each other, and the node of each segment."""
    agreement = table.agreement()
    nested = nesting(agreement, table.level)
    group = cluster(nested.agreement, options.agreement, conflicts=nested.conflicts)
    found = segment_tree(
        table,
        agreement,
        nested,
        group,
        min_support=options.min_support,
        min_views=min(options.min_views, len(table.views)),
        overlap=options.overlap,
    )
    found, level = separated_levels(
        found,
        nested,
        min_support=options.min_support,
        min_views=min(options.min_views, len(table.views)),
    )
    votes = tree_votes(
        table, found, level, _say(table, found.node, options.small_things), confusion=confusion
    )
    if sharpened is not None:
        votes = sharpened(votes)
    votes = without_outside(votes, table, found, min_support=options.min_support)
    tree, node = instance_tree(table, found, level, votes, classes)
    said = account(table, found.node, tracked=False) | {"instances": len(votes.object_rows)}
    info = replace(
        tree.info,
        method="associate",
        options=asdict(options),
        views=tuple(table.views),
        details=dict(tree.info.details) | {"associate": said | {"nodes": len(tree.nodes)}},
    )
    return with_info(tree, info), node


def _seen_often(table: SegmentTable, group: NDArray[np.int64], least: int) -> NDArray[np.int64]:
    """Groups of segments in too few views get the group -1."""
    pairs = np.unique(np.stack((group, table.view)), axis=1)
    views = np.bincount(pairs[0], minlength=int(group.max()) + 1)
    return np.where(views[group] >= least, group, -1)


def _say(table: SegmentTable, group: NDArray[np.int64], exponent: float) -> NDArray[np.float64]:
    """The factor q of each segment's votes."""
    there = group >= 0
    if not there.any():
        return np.ones(len(group))
    members = np.bincount(group[there])
    mean = np.bincount(group[there], table.size[there]) / np.maximum(members, 1)
    largest = float(mean.max())
    size = np.where(members >= _SURE_SEGMENTS, mean, largest) / max(largest, 1e-12)
    return np.where(there, np.maximum(size, 1e-12)[group] ** -exponent, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
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

    memberships: MembershipOptions = field(default_factory=MembershipOptions)
    """How votes are sharpened."""


def run(inputs: MethodInputs, options: AssociateMethodOptions) -> Labels | InstanceTree:
    """Join segments of views, see `associate`."""
    return associate(
        inputs.gaussians,
        inputs.views,
        EvidenceSegments(evidence=inputs.evidence),
        options=options.association,
        confusion=options.confusion if options.correct_confusion else None,
        memberships=options.memberships if options.sharpen_votes else None,
        classes=inputs.categories,
        backend=inputs.backend,
        progress=inputs.progress,
    )


METHOD = Method(
    name="associate",
    summary="segments of all views become instances by the Gaussians they share; no tracker",
    reference="docs/decisions/0012-association.md",
    evidence=("masks", "panoptic", "tracked"),
    options=AssociateMethodOptions,
    run=run,
)
