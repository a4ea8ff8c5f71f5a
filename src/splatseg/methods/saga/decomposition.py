r"""Affinity features become a tree of groups, objects and parts, without a prompt.

Directions of a sample of Gaussians, behind the gate of objects, are joined to clusters that hang
together in space, and every Gaussian takes the cluster that the samples around it vote for, each by
how alike their directions are (`votes`); votes become shares. Parts are the same at the scale of
parts, within the Gaussians of one object; groups are clusters at the scale of groups that hold most
of two or more objects. So children lie inside their parents by construction.

Neighbours in space are joined as long as the directions that become one have little to lose: Ward's
method on a graph (`ward`). Joining clusters of a and b of n samples, with means m, raises the mean
squared distance of samples from their means by

.. math:: \Delta = \frac{1}{n} \frac{a b}{a + b} \, \| m_a - m_b \|^2 ,

and clusters stay two where that exceeds what is allowed. Density alone (HDBSCAN, as the published
code of SAGA has it) chains objects together through the Gaussians at their borders, whose features
lie between: `docs/decisions/features.md`.

References:
    Cen et al., Segment Any 3D Gaussians (2023): automatic decomposition of its published code.
    Ward, Hierarchical Grouping to Optimize an Objective Function (1963).
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from heapq import heapify, heappop, heappush
from itertools import pairwise, repeat
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32, Int64
from msgspec import Meta
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_finite, check_range
from splatseg.core import (
    UNLABELLED,
    Features,
    Gaussians,
    InstanceTree,
    Labels,
    LayerInfo,
    TreeLevel,
    TreeNode,
)
from splatseg.core.boundary import boundary
from splatseg.core.options import Share, options
from splatseg.errors import ShapeError
from splatseg.lift.affinity import AffinityHead
from splatseg.neighbours import NeighbourIndex

SAMPLE = 20_000
"""Gaussians that are clustered, drawn by how much of them the views show."""

PART_SAMPLE = 500
"""Gaussians of an object among which its parts are looked for."""

NEIGHBOURS = 12
"""Other samples nearest in space that a sample may be joined with."""

VOTERS = 8
"""Samples nearest in space that vote for the object of a Gaussian."""

TEMPERATURE = 0.1
"""How quickly votes fall with the similarity of directions."""

CANDIDATES = 4
"""Nodes of which a Gaussian has shares."""

_ROWS = 1 << 14
"""Points that are held against their neighbours at a time."""


@options(
    removed=dict.fromkeys(
        ("sample", "part_sample", "neighbours", "voters", "temperature", "candidates"),
        "it is fixed at the value that was best",
    )
)
class DecomposeOptions:
    """How features are decomposed into instances."""

    group_increase: Share = 0.005
    """How much joining two clusters may raise the mean squared distance of directions from the
    mean of their cluster, at the scale of groups; 0 looks for no groups."""

    object_increase: Annotated[float, Meta(gt=0, le=1)] = 0.00005
    """The same at the scale of objects. Smaller ones are told apart the smaller it is."""

    part_increase: Share = 0.02
    """The same at the scale of parts, of the Gaussians of one object; 0 looks for no parts."""


def sampled(
    weights: NDArray[np.float64], count: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Rows drawn without replacement, likely as their weights; ascending.

    Args:
        weights: 0 is never drawn.
        count: How many at most.
        rng: Draws.
    """
    rows = np.flatnonzero(weights > 0)
    if len(rows) <= count:
        return rows
    # The largest of u^(1/w) are a weighted sample (Efraimidis and Spirakis 2006).
    keys = np.log(rng.random(len(rows))) / weights[rows]
    return np.sort(rows[np.argpartition(-keys, count - 1)[:count]])


def ward(
    directions: Float[Tensor, "m channels"],
    points: Float[Tensor, "m 3"],
    *,
    increase: float,
) -> NDArray[np.int64]:
    """The cluster of each sample, counted from 0 in the order of their first samples.

    What no path of neighbours connects is never joined.

    Args:
        directions: Of length 1.
        points: Where the samples are.
        increase: Delta that joining two clusters may cost.
    """
    count = len(directions)
    if count < 2:
        return np.zeros(count, dtype=np.int64)
    k = min(NEIGHBOURS, count - 1)
    near: list[set[int]] = [set() for _ in range(count)]
    for i, others in enumerate(NeighbourIndex(points).nearest_others(k).indices.tolist()):
        for j in others:
            near[i].add(j)
            near[j].add(i)
    # Samples, then clusters in the order in which they were made.
    means = np.concatenate(
        [directions.double().numpy(), np.empty((count - 1, directions.shape[1]))]
    )
    sizes = np.concatenate([np.ones(count), np.zeros(count - 1)])
    joined_to = np.arange(2 * count - 1)

    def joins(i: int, others: NDArray[np.int64]) -> Iterable[tuple[float, int, int]]:
        squared = np.square(means[others] - means[i]).sum(axis=1)
        cost = sizes[i] * sizes[others] / (sizes[i] + sizes[others]) / count * squared
        allowed = cost < increase
        return zip(cost[allowed].tolist(), repeat(i), others[allowed].tolist())

    heap = [
        join
        for i in range(count)
        for join in joins(i, np.array([j for j in near[i] if j < i], np.int64))
    ]
    heapify(heap)
    made = count
    while heap:
        _, i, j = heappop(heap)
        if joined_to[i] != i or joined_to[j] != j:
            continue
        sizes[made] = sizes[i] + sizes[j]
        means[made] = (sizes[i] * means[i] + sizes[j] * means[j]) / sizes[made]
        joined_to[[i, j]] = made
        around = (near[i] | near[j]) - {i, j}
        near[i] = near[j] = set()
        near.append(around)
        for other in around:
            near[other] -= {i, j}
            near[other].add(made)
        for join in joins(made, np.array(sorted(around), np.int64)):
            heappush(heap, join)
        made += 1
    for node in range(made - 1, -1, -1):
        joined_to[node] = joined_to[joined_to[node]]
    _, first, found = np.unique(joined_to[:count], return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[found].astype(np.int64)


def votes(
    directions: Float[Tensor, "n channels"],
    points: Float[Tensor, "n 3"],
    samples: Int64[Tensor, "m"],
    cluster: NDArray[np.int64],
) -> tuple[Int64[Tensor, "n k"], Float[Tensor, "n k"]]:
    r"""Clusters of all, by votes of the samples nearest to them in space.

    .. math:: a_{ic} \propto \sum_{j \in N_k(i),\; c_j = c} \exp(\langle d_i, d_j \rangle / \tau)

    Args:
        directions: Of length 1.
        points: Where they are.
        samples: Rows of the samples.
        cluster: The cluster of each sample.

    Returns:
        Clusters, the one with the largest share first, -1 where there are fewer, and shares, which
        add up to 1.
    """
    k = min(VOTERS, len(samples))
    near = NeighbourIndex(points[samples]).nearest(points, k).indices
    index = torch.full((len(points), k), -1)
    shares = torch.zeros(len(points), k)
    known, of = directions[samples], torch.from_numpy(cluster)
    for start in range(0, len(points), _ROWS):
        rows = slice(start, start + _ROWS)
        similarity = torch.einsum("nc,nkc->nk", directions[rows], known[near[rows]])
        vote = torch.softmax(similarity / TEMPERATURE, dim=1)
        found = of[near[rows]]
        same = found[:, :, None] == found[:, None, :]
        total = (vote[:, None, :] * same).sum(dim=2)
        # Of the voters of one cluster the nearest stands for all.
        later = torch.tril(same, diagonal=-1).any(dim=2)
        total = torch.where(later, -1.0, total)
        total, order = total.sort(dim=1, descending=True, stable=True)
        index[rows] = torch.where(total < 0, -1, found.gather(1, order))
        shares[rows] = total.clamp_min(0)
    return index, shares


GROUP, OBJECT, PART = 0.0, 0.5, 1.0
"""Granularities, see `AffinityHead.scale`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Directed:
    """Features that can be compared at any granularity."""

    values: Float[Tensor, "n channels"]

    points: Float[Tensor, "n 3"]
    """Centres of the Gaussians."""

    head: AffinityHead

    weights: NDArray[np.float64]
    """(n,): how much the views show of each Gaussian; 0 of those without a feature."""

    @classmethod
    def of(cls, gaussians: Gaussians, features: Features) -> "Directed":
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
        return cls(values=values, points=gaussians.means.detach().cpu(), head=head, weights=weights)

    def at(self, granularity: float, rows: NDArray[np.int64]) -> Float[Tensor, "m channels"]:
        """Directions of some Gaussians behind the gate of a granularity."""
        some = self.values[torch.from_numpy(rows)]
        return self.head.directions(some, self.head.scale(granularity))

    def clusters(
        self,
        granularity: float,
        rows: NDArray[np.int64],
        *,
        count: int,
        increase: float,
        rng: np.random.Generator,
    ) -> tuple[Int64[Tensor, "m k"], Float[Tensor, "m k"]]:
        """Clusters of some Gaussians and their shares, the largest first, see `votes`.

        Args:
            granularity: At which they are compared.
            rows: The Gaussians.
            count: How many of them are sampled.
            increase: See `ward`.
            rng: Draws the sample.
        """
        directions, points = self.at(granularity, rows), self.points[torch.from_numpy(rows)]
        # By the root: what fills the views would leave nothing of small things.
        samples = torch.from_numpy(sampled(np.sqrt(self.weights[rows]), count, rng))
        found = ward(directions[samples], points[samples], increase=increase)
        return votes(
            directions,
            points,
            samples,
            found,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Objects:
    """Which object each Gaussian belongs to; objects are numbered by how much they show."""

    index: Int64[Tensor, "n k"]
    """Objects, the one with the largest share first; -1 where there are fewer."""

    shares: Float[Tensor, "n k"]
    """Their shares, which add up to 1 where there are any."""

    @property
    def own(self) -> NDArray[np.int64]:
        """(n,): the object of each Gaussian, -1 for none."""
        return self.index[:, 0].numpy()


def objects(features: Directed, options: DecomposeOptions, rng: np.random.Generator) -> Objects:
    """Clusters at the scale of objects."""
    total = len(features.values)
    rows = np.flatnonzero(features.weights > 0)
    if not len(rows):
        return Objects(index=torch.full((total, 1), -1), shares=torch.zeros(total, 1))
    found, votes_of = features.clusters(
        OBJECT,
        rows,
        count=SAMPLE,
        increase=options.object_increase,
        rng=rng,
    )
    count = int(found.max()) + 1
    shown = np.bincount(found[:, 0].numpy(), features.weights[rows], minlength=count)
    rank = np.full(count + 1, -1)
    # Those that are nobody's first come last, and are the nodes of nobody.
    order = np.lexsort((np.arange(count), -shown))
    order = order[shown[order] > 0]
    rank[order] = np.arange(len(order))
    index = torch.full((total, found.shape[1]), -1)
    shares = torch.zeros(total, found.shape[1])
    index[rows] = torch.from_numpy(rank)[found]
    shares[rows] = torch.where(index[rows] >= 0, votes_of, 0.0)
    return Objects(index=index, shares=shares)


def parts(
    features: Directed,
    object_of: NDArray[np.int64],
    options: DecomposeOptions,
    rng: np.random.Generator,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
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
    if features.head.gated and options.part_increase > 0:
        order = np.argsort(object_of, kind="stable")
        ends = np.searchsorted(object_of[order], np.arange(int(object_of.max(initial=-1)) + 2))
        for thing, (start, end) in enumerate(pairwise(ends.tolist())):
            rows = order[start:end]
            found, _ = features.clusters(
                PART,
                rows,
                count=PART_SAMPLE,
                increase=options.part_increase,
                rng=rng,
            )
            names, within = np.unique(found[:, 0].numpy(), return_inverse=True)
            if len(names) > 1:
                part_of[rows] = within + len(owner)
                owner += [thing] * len(names)
    return part_of, np.asarray(owner, dtype=np.int64)


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
    if not features.head.gated or options.group_increase == 0 or count < 2:
        return np.full(count, -1)
    rows = np.flatnonzero(object_of >= 0)
    found, _ = features.clusters(
        GROUP, rows, count=SAMPLE, increase=options.group_increase, rng=rng
    )
    cluster = found[:, 0].numpy()
    held = np.zeros((count, int(cluster.max()) + 1))
    np.add.at(held, (object_of[rows], cluster), features.weights[rows])
    most = held.argmax(axis=1)
    members = np.bincount(most)
    shared = np.flatnonzero(members >= 2)
    rank = np.full(len(members), -1)
    rank[shared] = np.arange(len(shared))
    return rank[most]


_SEED = 0xDEC0
"""What the generator of samples is seeded with besides the seed."""


@boundary
def decompose(
    gaussians: Gaussians,
    features: Features,
    *,
    options: DecomposeOptions | None = None,
    seed: int = 0,
) -> InstanceTree:
    """Decompose a scene into groups, objects and parts by the features of its Gaussians.

    Same seed, same tree, whatever the number of threads. Gaussians that no view showed when the
    features were made, and those without a feature, belong to nothing. Features without a scale
    gate tell one level: their tree has objects only.

    Args:
        gaussians: The Gaussians of the scene.
        features: Affinity features (``segment --method saga``), or any others that are alike
            where Gaussians belong together.
        options: How they are decomposed.
        seed: Of the samples.

    Returns:
        The tree; objects have the ids from 1 on, the most visible first, then come groups, then
        parts. The confidence is the share of the votes for the object, in [0, 1].

    Raises:
        ShapeError: If the features are of another scene.
        RangeError: If a feature or a weight is not finite, or the seed is below 0.
        InputError: If the layer's head is not one of affinity features.
    """
    if len(features) != len(gaussians):
        raise ShapeError(
            f"features: expected {len(gaussians)} rows, one a Gaussian of the scene, got "
            f"{len(features)}; they are of another scene."
        )
    check_finite("features", features.values)
    if features.weights is not None:
        check_finite("weights", features.weights)
    check_range("seed", seed, 0, 2**63 - 1)
    options = options or DecomposeOptions()
    rng = np.random.default_rng((seed, _SEED))
    directed = Directed.of(gaussians, features)
    found = objects(directed, options, rng)
    part_of, owner = parts(directed, found.own, options, rng)
    group_of = groups(directed, found.own, options, rng)
    return _tree(
        found,
        _Rows(
            part_of=part_of,
            owner=owner,
            group_of=group_of,
            shown=directed.weights,
        ),
        options,
        features.info,
        seed,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Rows:
    """How objects hang together with what is above and below them."""

    part_of: NDArray[np.int64]
    """(n,): the part of each Gaussian, -1 for none."""

    owner: NDArray[np.int64]
    """(parts,): the object of each part."""

    group_of: NDArray[np.int64]
    """(objects,): the group of each object, -1 for none."""

    shown: NDArray[np.float64]
    """(n,): how much the views show of each Gaussian."""

    @property
    def counts(self) -> tuple[int, int, int]:
        """How many objects, groups and parts there are."""
        return len(self.group_of), int(self.group_of.max(initial=-1)) + 1, len(self.owner)


def _tree(
    found: Objects, rows: _Rows, options: DecomposeOptions, info: LayerInfo, seed: int
) -> InstanceTree:
    things, sets, _ = rows.counts
    # Objects have the ids from 1 on, then come groups, then parts.
    deepest = np.where(rows.part_of >= 0, 1 + things + sets + rows.part_of, found.own + 1)
    deepest = np.where(found.own >= 0, deepest, UNLABELLED).astype(np.int32)
    confidence = np.where(found.own >= 0, found.shares[:, 0].numpy(), 0.0)
    candidates, shares = _shares(found, deepest)
    labels = Labels(
        ids=torch.from_numpy(deepest),
        confidence=torch.from_numpy(confidence.astype(np.float32)),
        candidates=candidates,
        shares=shares,
        evidence=torch.from_numpy(rows.shown.astype(np.float32)),
        info=replace(info, head=None, seed=seed if info.seed is None else info.seed).with_edit(
            "decompose", {**asdict(options), "seed": seed}
        ),
    )
    return InstanceTree(nodes=_nodes(rows), labels=labels)


def _nodes(rows: _Rows) -> tuple[TreeNode, ...]:
    things, sets, pieces = rows.counts

    def node(id: int, level: TreeLevel, parent: int) -> TreeNode:
        return TreeNode(id=id, parent=parent, level=level, name=f"{level} {id}")

    made = [
        node(1 + i, "object", UNLABELLED if group < 0 else 1 + things + group)
        for i, group in enumerate(rows.group_of.tolist())
    ]
    made += [node(1 + things + i, "group", UNLABELLED) for i in range(sets)]
    made += [node(1 + things + sets + i, "part", 1 + int(rows.owner[i])) for i in range(pieces)]
    return tuple(made)


def _shares(
    found: Objects, deepest: NDArray[np.int32]
) -> tuple[Int32[Tensor, "n k"], Float32[Tensor, "n k"]]:
    """Nodes that each Gaussian may belong to, its own first, and their shares.

    Of its own object a Gaussian has the deepest node, of others the whole.
    """
    kept = slice(0, CANDIDATES)
    candidates = torch.where(found.index >= 0, found.index + 1, UNLABELLED)[:, kept].int()
    candidates[:, 0] = torch.from_numpy(deepest)
    return candidates, found.shares[:, kept]
