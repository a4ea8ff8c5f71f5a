"""Objects, their parts and their groups, as clusters at three scales."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import Features
from splatseg.lift.affinity import AffinityHead
from splatseg.lift.decomposition.clusters import hdbscan, nearest, sampled
from splatseg.lift.decomposition.options import DecomposeOptions

GROUP, OBJECT, PART = 0.0, 0.5, 1.0
"""Granularities, see `AffinityHead.scale`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Directed:
    """Features that can be compared at any granularity."""

    values: Float[Tensor, "n channels"]
    head: AffinityHead

    weights: NDArray[np.float64]
    """(n,): how much the views show of each Gaussian; 0 of those without a feature."""

    @classmethod
    def of(cls, features: Features) -> "Directed":
        """Features with their head, or with none compared as they are."""
        values = features.values.detach().cpu().float()
        channels = values.shape[1]
        head = (
            AffinityHead(channels=channels, unit=True)
            if features.info.head is None
            else AffinityHead.of(features)
        )
        seen = torch.ones(len(values)) if features.weights is None else features.weights.cpu()
        there = (values != 0).any(dim=1)
        weights = torch.where(there, seen.double(), 0.0).clamp_min(0).numpy()
        return cls(values=values, head=head, weights=weights)

    def at(self, granularity: float, rows: NDArray[np.int64]) -> Float[Tensor, "m channels"]:
        """Directions of some Gaussians behind the gate of a granularity."""
        some = self.values[torch.from_numpy(rows)]
        return self.head.directions(some, self.head.scale(granularity))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Clusters:
    """Which cluster each Gaussian belongs to."""

    index: Int64[Tensor, "n k"]
    """Clusters, the one most like it first; -1 where there are fewer, or it has no direction."""

    similarity: Float32[Tensor, "n k"]
    """With their centres."""

    own: NDArray[np.int64]
    """(n,): the first of them if it is alike enough, else -1."""


def objects(features: Directed, options: DecomposeOptions, rng: np.random.Generator) -> Clusters:
    """Clusters at the scale of objects, those that show most first.

    After each round, the Gaussians that are like no centre are sampled once more.
    """
    there = np.flatnonzero(features.weights > 0)
    directions = features.at(OBJECT, there)
    centres = directions[:0]
    weights = features.weights[there]
    left = weights.copy()
    for _ in range(options.rounds):
        rows = torch.from_numpy(sampled(left, options.sample, rng))
        found = hdbscan(directions[rows], min_cluster=options.min_cluster, epsilon=options.epsilon)
        if not len(found):
            break
        centres = torch.cat((centres, found))
        similarity, _ = nearest(directions, centres, 1)
        left[similarity[:, 0].numpy() >= options.similarity] = 0
    return _ordered(_assigned(directions, centres, options), there, features.weights)


def _assigned(
    directions: Float[Tensor, "m channels"],
    centres: Float[Tensor, "clusters channels"],
    options: DecomposeOptions,
) -> Clusters:
    similarity, index = nearest(directions, centres, max(options.candidates, 1))
    if not len(centres):
        return Clusters(
            index=torch.full((len(directions), 1), -1), similarity=torch.zeros(len(directions), 1),
            own=np.full(len(directions), -1),
        )  # fmt: skip
    alike = similarity[:, 0] >= options.similarity
    return Clusters(
        index=index, similarity=similarity, own=torch.where(alike, index[:, 0], -1).numpy()
    )


def _ordered(found: Clusters, rows: NDArray[np.int64], weights: NDArray[np.float64]) -> Clusters:
    """Clusters of some rows for all, numbered by what they show; those of nobody are dropped."""
    held = found.own >= 0
    count = int(found.index.max()) + 1 if found.index.numel() else 0
    shown = np.bincount(found.own[held], weights[rows][held], minlength=count)
    order = np.lexsort((np.arange(count), -shown))
    order = order[shown[order] > 0]
    rank = np.full(count + 1, -1)
    rank[order] = np.arange(len(order))
    total, k = len(weights), found.index.shape[1]
    index = torch.full((total, k), -1)
    similarity = torch.zeros(total, k)
    own = np.full(total, -1)
    index[rows] = torch.from_numpy(rank)[found.index]
    similarity[rows] = found.similarity
    own[rows] = rank[found.own]
    return Clusters(index=index, similarity=similarity, own=own)


def parts(
    features: Directed,
    object_of: NDArray[np.int64],
    options: DecomposeOptions,
    rng: np.random.Generator,
) -> tuple[NDArray[np.int64], list[int]]:
    """Clusters at the scale of parts, among the Gaussians of each object alone.

    Args:
        features: The features.
        object_of: (n,): the object of each Gaussian, -1 for none.
        options: How parts are looked for.
        rng: Draws samples.

    Returns:
        The part of each Gaussian, (n,), -1 for none, and the object of each part.
    """
    part_of, owner = np.full(len(object_of), -1), list[int]()
    if not features.head.gated or options.part_sample == 0:
        return part_of, owner
    order = np.argsort(object_of, kind="stable")
    ends = np.searchsorted(object_of[order], np.arange(int(object_of.max(initial=-1)) + 2))
    for thing, (start, end) in enumerate(pairwise(ends.tolist())):
        rows = order[start:end]
        within = _parts_of(features, rows, options, rng)
        held = within >= 0
        part_of[rows[held]] = within[held] + len(owner)
        owner += [thing] * (int(within.max(initial=-1)) + 1)
    return part_of, owner


def _parts_of(
    features: Directed,
    rows: NDArray[np.int64],
    options: DecomposeOptions,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """The part of each Gaussian of one object, -1 for none: two parts at least, or none."""
    none = np.full(len(rows), -1)
    weights = features.weights[rows]
    directions = features.at(PART, rows)
    sample = torch.from_numpy(sampled(weights, options.part_sample, rng))
    centres = hdbscan(directions[sample], min_cluster=options.min_cluster, epsilon=options.epsilon)
    for _ in range(2):  # small parts go, and what was in them to the others
        if len(centres) < 2:
            return none
        found = _assigned(directions, centres, options).own
        held = found >= 0
        shown = np.bincount(found[held], weights[held], minlength=len(centres))
        kept = (shown > 0) & (shown >= options.min_part * weights.sum())
        if kept.all():
            break
        centres = centres[torch.from_numpy(kept)]
    if len(centres) < 2:
        return none
    return _assigned(directions, centres, options).own


def groups(
    features: Directed,
    object_of: NDArray[np.int64],
    options: DecomposeOptions,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """The group of each object, -1 for none.

    It is the cluster at the scale of groups that has most of the object, where it has most of
    another one too.

    Args:
        features: The features.
        object_of: (n,): the object of each Gaussian, -1 for none.
        options: How groups are looked for.
        rng: Draws the sample.
    """
    count = int(object_of.max(initial=-1)) + 1
    if not features.head.gated or not options.groups or count < 2:
        return np.full(count, -1)
    rows = np.flatnonzero(object_of >= 0)
    directions = features.at(GROUP, rows)
    sample = torch.from_numpy(sampled(features.weights[rows], options.sample, rng))
    centres = hdbscan(directions[sample], min_cluster=options.min_cluster, epsilon=options.epsilon)
    if not len(centres):
        return np.full(count, -1)
    cluster = _assigned(directions, centres, options).own
    held = np.zeros((count, len(centres) + 1))
    # The last column is of Gaussians in no group.
    np.add.at(held, (object_of[rows], cluster), features.weights[rows])
    most = held.argmax(axis=1)
    group = np.where(most < len(centres), most, -1)
    members = np.bincount(group[group >= 0], minlength=len(centres))
    shared = np.flatnonzero(members >= 2)
    rank = np.full(len(centres) + 1, -1)
    rank[shared] = np.arange(len(shared))
    return rank[group]
