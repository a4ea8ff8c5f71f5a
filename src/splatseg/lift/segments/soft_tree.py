"""Votes of a tree sharpened: how much of each Gaussian belongs to each object.

The segments of each view are painted as objects, large ones first, and memberships are solved for
through the pixels (`lift.memberships`), from where the votes ended. Votes give what a pixel says to
all its Gaussians alike; solved for, Gaussians at a border share it so that the pixels come out.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import UNLABELLED, Gaussians, LabelMap, MaskSet, SegmentSource, View
from splatseg.lift.memberships import MembershipOptions, fit_memberships
from splatseg.lift.segments.reduced import reduced_segments
from splatseg.lift.segments.table import SegmentTable
from splatseg.lift.segments.tree_labels import TreeVotes
from splatseg.render import RenderOptions

_OWN = 0.95
"""Where memberships begin: this much of the decided object, the rest as the votes are."""

_KEPT = 4
"""Nodes of a Gaussian that are kept."""

_LEAST = 0.02
"""Memberships below it are dropped."""


def soft_votes(
    gaussians: Gaussians,
    views: Sequence[View],
    source: SegmentSource,
    table: SegmentTable,
    votes: TreeVotes,
    *,
    options: MembershipOptions,
    longest_side: int | None,
    render_options: RenderOptions | None,
    backend: str,
) -> TreeVotes:
    """The votes with memberships, and each Gaussian with the object it belongs to most.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those whose segments count, by name.
        source: Their segments.
        table: The same, as masses.
        votes: What they say.
        options: How memberships are solved for.
        longest_side: As `segment_table` had it.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.
    """
    decided = votes.objects.ids.numpy() - 1
    start = _start(votes.own, np.where(decided < 0, -1, decided), options.min_votes)
    if not start.nnz:
        return votes
    found = fit_memberships(
        gaussians,
        views,
        painted(table, votes.object_of_segment, source, longest_side),
        start,
        options=options,
        render_options=render_options,
        backend=backend,
    )
    objects, shares = _strongest(found)
    best = objects[:, 0]
    moved = (best >= 0) & (best != decided)
    row = np.append(votes.object_rows, -1)
    node = np.where(moved, row[best], votes.node)
    # A Gaussian is in a part of its own object; of others it has the whole.
    nodes = np.where(objects == decided[:, None], votes.node[:, None], row[objects])
    ids = np.where(moved, best + 1, votes.objects.ids.numpy()).astype(np.int32)
    return replace(
        votes,
        objects=replace(votes.objects, ids=torch.from_numpy(ids), candidates=None, shares=None),
        node=node,
        soft=(np.where(objects < 0, -1, nodes), shares),
    )


def painted(
    table: SegmentTable,
    group: NDArray[np.int64],
    source: SegmentSource,
    longest_side: int | None,
) -> Callable[[View], LabelMap]:
    """Label maps of groups of segments: where several lie over each other the smallest counts.

    Args:
        table: The segments.
        group: The group of each, -1 for none.
        source: Where their pixels are.
        longest_side: Larger maps are reduced to it; None keeps all pixels.
    """

    def label_map(view: View) -> LabelMap:
        segments = source.segments_of(view.name)
        if longest_side is not None:
            segments = reduced_segments(segments, longest_side)
        own = np.flatnonzero(table.view == table.views.index(view.name))
        if isinstance(segments, MaskSet):
            ids = torch.full((segments.height, segments.width), UNLABELLED, dtype=torch.int32)
            areas = np.array([segments.masks[int(table.name[s])].area for s in own])
            for segment in own[np.argsort(-areas, kind="stable")].tolist():
                if group[segment] >= 0:
                    ids[segments.dense(int(table.name[segment]))] = int(group[segment])
            return LabelMap(ids=ids)
        names = segments.ids.numpy()
        table_of = np.full(int(names.max(initial=0)) + 2, UNLABELLED, np.int32)
        table_of[table.name[own]] = group[own]
        return LabelMap(ids=torch.from_numpy(table_of[names]))

    return label_map


def _start(votes: Any, decided: NDArray[np.int64], least: float) -> Any:
    """Sparse (Gaussians, objects) of float32: memberships to begin with."""
    import scipy.sparse

    total = np.asarray(votes.sum(axis=1)).ravel()
    share = votes.data / np.repeat(np.maximum(total, 1e-12), np.diff(votes.indptr))
    row = np.repeat(np.arange(votes.shape[0]), np.diff(votes.indptr))
    own = votes.indices == decided[row]
    kept = (share >= least) | own
    values = (1 - _OWN) * share + _OWN * own
    ends = np.append(0, np.cumsum(kept))[votes.indptr]
    return scipy.sparse.csr_matrix(
        (values[kept].astype(np.float32), votes.indices[kept].astype(np.int32), ends),
        shape=votes.shape,
    )


def _strongest(found: Any) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Objects (Gaussians, k), the one with the largest membership first, and memberships.

    Each object is solved for alone, so that those of a Gaussian may add up to more than 1, where
    pixels lack the light that small weights had. Scaled to 1 they would show less than the pixels
    do: on `office` the IoU of a click falls from 0.884 to 0.869.
    """
    row = np.repeat(np.arange(found.shape[0]), np.diff(found.indptr))
    order = np.lexsort((found.indices, -found.data, row))
    rank = np.arange(len(order)) - np.repeat(found.indptr[:-1], np.diff(found.indptr))
    chosen = (rank < _KEPT) & (found.data[order] >= _LEAST)
    objects = np.full((found.shape[0], _KEPT), -1)
    shares = np.zeros((found.shape[0], _KEPT), np.float32)
    place = order[chosen]
    objects[row[place], rank[chosen]] = found.indices[place]
    shares[row[place], rank[chosen]] = found.data[place]
    return objects, shares
