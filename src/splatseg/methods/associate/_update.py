r"""Further views of a scene whose instances are known.

A segment of a further view is the node with which it has the largest intersection over union in
that view (`lift.segments.MatchedMaps`); its pixels vote for that node, and the votes are added to
those of before (`lift.voting.more_votes`). What known nodes do not explain are new things: segments
that match no node are associated among themselves, and become nodes where they lie on Gaussians
that belong to nothing yet. The cost is that of the further views, however many came before.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from splatseg.core import (
    LOCAL,
    UNLABELLED,
    Executor,
    Gaussians,
    InstanceTree,
    LabelMap,
    Labels,
    LabelSource,
    MaskSet,
    SegmentSource,
    View,
)
from splatseg.lift.segments import MatchedMaps, at_middles
from splatseg.lift.voting.confusion import CANDIDATES
from splatseg.lift.voting.more_votes import with_votes
from splatseg.lift.voting.uplift import UpliftOptions, uplift

_MIN_LABELLED = 0.15
"""Share of a segment that must lie on known nodes for it to be one of them: more than the rim of
something new beside them, less than the known end of a wall that goes on."""

_MIN_FREE = 0.5
"""Share of a new thing's Gaussians that must belong to nothing."""


def with_views(
    layer: Labels | InstanceTree,
    gaussians: Gaussians,
    views: Sequence[View],
    source: SegmentSource,
    *,
    associated: Callable[[SegmentSource, Sequence[View]], Labels | InstanceTree],
    longest_side: int,
    backend: str = "auto",
    executor: Executor = LOCAL,
    progress: Callable[[int, int], None] | None = None,
) -> Labels | InstanceTree:
    """A layer of instances with the segments of further views.

    Args:
        layer: The instances that are known, one row for each Gaussian.
        gaussians: The Gaussians of the scene.
        views: The further views.
        source: Their segments.
        associated: Association of segments that are none of the known instances.
        longest_side: Longest side at which segments are read, pixels.
        backend: Name of the rendering backend.
        executor: Where views are worked on.
        progress: Called with the views done and all there are.

    Returns:
        The layer with as many nodes, or more; ids that were there mean what they meant.
    """
    known = layer.labels if isinstance(layer, InstanceTree) else layer
    maps = _NodeMaps(
        objects=_objects(layer),
        matched=tuple(
            MatchedMaps(
                gaussians=gaussians, views=views, source=source, labels=labels,
                min_labelled=_MIN_LABELLED, longest_side=longest_side, backend=backend,
            )
            for labels in _cuts(layer)
        ),
    )  # fmt: skip
    shown = {view.name: maps.label_map(view.name) for view in views}
    if any(bool((one.ids != UNLABELLED).any()) for one in shown.values()):
        votes = uplift(
            gaussians,
            views,
            _Maps(shown),
            options=UpliftOptions().with_candidates(CANDIDATES),
            backend=backend,
            executor=executor,
            progress=progress,
        )
        known = with_votes(known, votes)
    unknown = _Segments(
        source=source,
        found={name: _unmatched(source.segments_of(name), shown[name]) for name in shown},
    )
    if unknown.any:
        return _with_new(layer, known, associated(unknown, views))
    return replace(layer, labels=known) if isinstance(layer, InstanceTree) else known


def _cuts(layer: Labels | InstanceTree) -> tuple[Labels, ...]:
    """Labels that segments may be, the coarser first; nodes lie in those of the cut before."""
    if not isinstance(layer, InstanceTree):
        return (layer,)
    objects, parts = layer.cut("object"), layer.cut("part")
    return (objects,) if torch.equal(objects.ids, parts.ids) else (objects, parts)


def _objects(layer: Labels | InstanceTree) -> Tensor:
    """`_NodeMaps.objects` of a layer."""
    if not isinstance(layer, InstanceTree):
        return torch.full((1,), UNLABELLED, dtype=torch.int32)
    levels = {node.id: node.level for node in layer.nodes}
    found = torch.full((max(levels, default=0) + 2,), UNLABELLED, dtype=torch.int32)
    for id in levels:
        found[id] = next((n for n in layer.path(id) if levels[n] == "object"), UNLABELLED)
    return found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _NodeMaps:
    """Of each pixel the deepest node that a segment over it is."""

    matched: tuple[LabelSource, ...]
    """Of objects, and of the deepest nodes where these differ."""

    objects: Tensor
    """Of each id of a node the object that it is or lies in, -1 for none; the last is for -1."""

    def label_map(self, name: str) -> LabelMap:
        """Ids of nodes in a view."""
        coarse = self.matched[0].label_map(name)
        if len(self.matched) == 1:
            return coarse
        fine = self.matched[1].label_map(name)
        above = self.objects
        # A part is meant where it lies in the object that the pixel shows.
        inside = (fine.ids != UNLABELLED) & (above[fine.ids.long()] == coarse.ids)
        return LabelMap(ids=torch.where(inside, fine.ids, coarse.ids))


@dataclass(frozen=True, slots=True, eq=False)
class _Maps:
    """Label maps at hand."""

    maps: Mapping[str, LabelMap]

    @property
    def view_names(self) -> Sequence[str]:
        return tuple(self.maps)

    def label_map(self, name: str) -> LabelMap:
        return self.maps[name]


_MIN_UNKNOWN = 0.5
"""Share of a segment's pixels that must be in no known node for it to be something new."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Segments:
    """Some of the segments of views."""

    source: SegmentSource
    """All of them."""

    found: Mapping[str, LabelMap | MaskSet]

    @property
    def view_names(self) -> Sequence[str]:
        return tuple(self.found)

    @property
    def overlapping(self) -> bool:
        return self.source.overlapping

    @property
    def persistent(self) -> bool:
        return self.source.persistent

    @property
    def any(self) -> bool:
        """Whether a view has one."""
        return any(
            len(one) > 0 if isinstance(one, MaskSet) else bool((one.ids != UNLABELLED).any())
            for one in self.found.values()
        )

    def categories_of(self, name: str) -> Mapping[int, int]:
        return self.source.categories_of(name)

    def segments_of(self, name: str) -> LabelMap | MaskSet:
        return self.found[name]


def _unmatched(segments: LabelMap | MaskSet, shown: LabelMap) -> LabelMap | MaskSet:
    """The segments of a view that lie where no known node was recognised."""
    free = at_middles(shown.ids == UNLABELLED, segments.height, segments.width)
    if isinstance(segments, LabelMap):
        ids, place = torch.unique(segments.ids.cpu().long(), return_inverse=True)
        inside = torch.zeros(len(ids)).index_add_(0, place.reshape(-1), free.reshape(-1).float())
        share = inside / torch.bincount(place.reshape(-1), minlength=len(ids))
        new = share >= _MIN_UNKNOWN
        return replace(segments, ids=torch.where(new[place], segments.ids, UNLABELLED))
    rows = [
        i
        for i in range(len(segments))
        if float(free[segments.dense(i)].float().mean()) >= _MIN_UNKNOWN
    ]
    return segments.subset(rows)


def _with_new(
    layer: Labels | InstanceTree, known: Labels, found: Labels | InstanceTree
) -> Labels | InstanceTree:
    """The layer with the things that were found, where they belong to nothing yet."""
    labels = found.labels if isinstance(found, InstanceTree) else found
    free = known.ids == UNLABELLED
    if known.inferred is not None:
        free |= known.inferred
    there = labels.ids != UNLABELLED
    count = int(labels.ids.max().clamp_min(0)) + 1
    size = torch.bincount(labels.ids[there].long(), minlength=count)
    own = torch.bincount(labels.ids[there & free].long(), minlength=count)
    taken = there & free & (own >= _MIN_FREE * size)[labels.ids.clamp_min(0).long()]
    new = _new_ids(found, labels.ids[taken], first=max(_ids_of(layer, known), default=0) + 1)
    table = torch.full((max(new, default=0) + 1,), UNLABELLED, dtype=torch.int32)
    table[list(new)] = torch.tensor(list(new.values()), dtype=torch.int32)
    new_of = torch.where(taken, labels.ids, 0).long()
    ids = torch.where(taken, table[new_of], known.ids)
    changed = replace(
        known,
        ids=ids,
        confidence=torch.where(taken, labels.confidence, known.confidence),
        candidates=None
        if known.candidates is None
        else _first_column(known.candidates, ids, taken, UNLABELLED),
        shares=None
        if known.shares is None
        else _first_column(known.shares, labels.confidence, taken, 0),
        evidence=known.evidence
        if known.evidence is None or labels.evidence is None
        else torch.where(taken, labels.evidence, known.evidence),
        inferred=None if known.inferred is None else known.inferred & ~taken,
    )
    if isinstance(layer, InstanceTree) and isinstance(found, InstanceTree):
        nodes = tuple(
            replace(
                node,
                id=new[node.id],
                parent=UNLABELLED if node.parent == UNLABELLED else new[node.parent],
                name=f"{node.level} {new[node.id]}",
            )
            for node in found.nodes
            if node.id in new
        )
        return replace(layer, nodes=(*layer.nodes, *nodes), labels=changed)
    names = {**changed.info.names, **{id: f"object {id}" for id in new.values()}}
    return replace(changed, info=replace(changed.info, names=names))


def _new_ids(found: Labels | InstanceTree, ids: Tensor, *, first: int) -> dict[int, int]:
    """The ids of things that are taken over, and of nodes above them, by what they were."""
    used = {int(id) for id in ids.unique()}
    if isinstance(found, InstanceTree):
        used = {node for id in used for node in found.path(id)}
    return {id: first + place for place, id in enumerate(sorted(used))}


def _ids_of(layer: Labels | InstanceTree, known: Labels) -> list[int]:
    if isinstance(layer, InstanceTree):
        return [node.id for node in layer.nodes]
    return known.present.tolist()


def _first_column(columns: Tensor, values: Tensor, rows: Tensor, rest: float) -> Tensor:
    """Columns of which some rows have one value alone."""
    alone = torch.full_like(columns, rest)
    alone[:, 0] = values.to(columns)
    return torch.where(rows.unsqueeze(1), alone, columns)
