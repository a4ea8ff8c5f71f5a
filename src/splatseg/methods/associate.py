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

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from splatseg._check import check_range
from splatseg.core import (
    ClassTable,
    Gaussians,
    InstanceFacts,
    InstanceTree,
    Labels,
    LayerInfo,
    SegmentSource,
    View,
    tree_level,
    with_info,
)
from splatseg.errors import InputError, RangeError
from splatseg.lift.mass.confusion import DEFAULT_CONFUSION, ConfusionOptions, correct_confusion
from splatseg.lift.memberships import DEFAULT_MEMBERSHIPS, MembershipOptions
from splatseg.lift.segments.ballots import by_mass, majority, view_counts
from splatseg.lift.segments.clustering import Agreement, cluster
from splatseg.lift.segments.flatten import chosen_groups
from splatseg.lift.segments.nesting import nesting
from splatseg.lift.segments.recorded import EvidenceSegments
from splatseg.lift.segments.separate import separated_levels
from splatseg.lift.segments.soft_tree import soft_votes
from splatseg.lift.segments.table import SegmentTable, segment_table
from splatseg.lift.segments.tree import segment_tree
from splatseg.lift.segments.tree_labels import (
    TreeVotes,
    category_of,
    instance_tree,
    tree_votes,
)
from splatseg.methods._method import Method, MethodInputs
from splatseg.render import RenderOptions

Overlapping = Literal["tree", "flat"]
"""What overlapping masks become: a tree of levels, or one label a Gaussian."""

_SURE_SEGMENTS = 3
"""Groups of fewer segments are too few to speak for a small thing: they may be accidents."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AssociateOptions:
    """How segments of views become instances."""

    agreement: float = 0.2
    """Least overlap, in (0, 1], at which two groups of segments are one instance: intersection
    over union on the Gaussians that the views of both see, averaged over all pairs of segments
    of the two groups. Lower joins more."""

    small_things: float = 0.0
    """Exponent with which small instances outweigh large ones where views contradict each other;
    0 treats all alike. 0.25 does most of what correcting confusion does, without it."""

    min_views: int = 2
    """An instance needs segments in so many views, or in all there are if they are fewer."""

    overlapping: Overlapping = "tree"
    """What masks that may overlap become. tree: groups, objects and parts, each in its parent.
    flat: objects alone, whatever level most of the masks have."""

    level: str = "tree"
    """Of a tree, what is given: tree is all of it; group, object or part, or a granularity from 0
    (groups) over 0.5 (objects) to 1 (the finest parts), are one cut of it as labels."""

    min_support: float = 0.3
    """Of a tree: a group of segments is a node if this share, in [0, 1], of the views that could
    have seen it has a segment of it. Higher leaves out what few masks speak for."""

    overlap: float = 0.7
    """Of overlapping masks: a node lies in another if more than this share of it does, in
    [0, 1]; with flat, a group is left out if more than this share of it is covered by groups
    that were taken before."""

    max_views: int = 50
    """Views of each Gaussian that are compared, those that see most of it; bounds memory and
    time."""

    longest_side: int = 640
    """Segments of larger photographs are read at this many pixels along their longest side;
    bounds time. What is thinner than a pixel there may be missed."""

    def __post_init__(self) -> None:
        check_range("agreement", self.agreement, 0.0, 1.0)
        if not (math.isfinite(self.small_things) and self.small_things >= 0):
            raise RangeError(f"small_things: expected 0 or more, got {self.small_things}.")
        check_range("overlap", self.overlap, 0.0, 1.0)
        check_range("min_support", self.min_support, 0.0, 1.0)
        if self.overlapping not in get_args(Overlapping):
            raise InputError(f"overlapping: expected tree or flat, got {self.overlapping!r}.")
        if self.level != "tree":
            tree_level(self.level)
        for name in ("min_views", "max_views", "longest_side"):
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")


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
    agreement = table.agreement()
    if source.overlapping and options.overlapping == "tree":
        sharpened = None
        if memberships is not None:
            sharpened = partial(
                soft_votes,
                gaussians,
                sorted(views, key=lambda view: view.name),
                source,
                table,
                options=memberships,
                longest_side=options.longest_side,
                render_options=render_options,
                backend=backend,
            )
        tree = _tree(
            table, agreement, options, confusion=confusion, classes=classes, sharpened=sharpened
        )
        return tree if options.level == "tree" else tree.cut(tree_level(options.level))
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
        info=_with_instances(
            replace(
                labels.info,
                method="associate",
                options=asdict(options),
                views=tuple(table.views),
                details=dict(labels.info.details)
                | {"associate": _account(table, group, tracked=source.persistent)},
            ),
            table,
            group,
            classes,
        ),
    )


def _tree(
    table: SegmentTable,
    agreement: Agreement,
    options: AssociateOptions,
    *,
    confusion: ConfusionOptions | None,
    classes: ClassTable | None,
    sharpened: Callable[[TreeVotes], TreeVotes] | None,
) -> InstanceTree:
    """Groups, objects and parts of segments that lie inside each other."""
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
    tree = instance_tree(table, found, level, votes, classes)
    account = _account(table, found.node, tracked=False) | {"instances": len(votes.object_rows)}
    info = replace(
        tree.info,
        method="associate",
        options=asdict(options),
        views=tuple(table.views),
        details=dict(tree.info.details) | {"associate": account | {"nodes": len(tree.nodes)}},
    )
    return with_info(tree, info)


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
        named = category > 0 and classes is not None
        name = classes.name_of(category) if named and classes is not None else "object"
        names[id] = f"{name} {id}"
        if category > 0:
            class_of[id] = category
        views = np.unique(table.view[members])
        facts[id] = InstanceFacts(segments=len(members), views=len(views))
    return replace(info, names=names, class_of=class_of, instances=facts)


def _account(table: SegmentTable, group: NDArray[np.int64], *, tracked: bool) -> dict[str, Any]:
    """What became of the segments; of tracks, which were joined and which were divided."""
    there = group >= 0
    pairs = np.stack((group[there], table.view[there]))
    _, counts = np.unique(pairs, axis=1, return_counts=True)
    said: dict[str, Any] = {
        "segments": len(group),
        "instances": int(group.max(initial=-1)) + 1,
        "left_out": int((~there).sum()),
        "joined_within_views": int((counts - 1).sum()),
    }
    if not tracked:
        return said
    of: dict[int, set[int]] = {}
    names: dict[int, set[int]] = {}
    for instance, name in zip(group[there].tolist(), table.name[there].tolist(), strict=True):
        of.setdefault(name, set()).add(instance + 1)
        names.setdefault(instance + 1, set()).add(name)
    merged = {i: found for i, found in sorted(names.items()) if len(found) > 1}
    split = {name: found for name, found in sorted(of.items()) if len(found) > 1}
    return said | {
        "merged": [{"id": i, "from": sorted(found)} for i, found in merged.items()],
        "split": [{"from": name, "ids": sorted(found)} for name, found in split.items()],
    }


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
