"""Objects, their parts and their groups, as clusters at three scales."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import Features, Gaussians
from splatseg.lift.affinity import AffinityHead
from splatseg.lift.decomposition.clusters import sampled, votes, ward
from splatseg.lift.decomposition.options import DecomposeOptions

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
        options: DecomposeOptions,
        rng: np.random.Generator,
    ) -> tuple[Int64[Tensor, "m k"], Float[Tensor, "m k"]]:
        """Clusters of some Gaussians and their shares, the largest first, see `votes`.

        Args:
            granularity: At which they are compared.
            rows: The Gaussians.
            count: How many of them are sampled.
            increase: See `ward`.
            options: Neighbours and votes.
            rng: Draws the sample.
        """
        directions, points = self.at(granularity, rows), self.points[torch.from_numpy(rows)]
        # By the root: what fills the views would leave nothing of small things.
        samples = torch.from_numpy(sampled(np.sqrt(self.weights[rows]), count, rng))
        found = ward(
            directions[samples], points[samples], neighbours=options.neighbours, increase=increase
        )
        return votes(
            directions,
            points,
            samples,
            found,
            voters=options.voters,
            temperature=options.temperature,
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
        count=options.sample,
        increase=options.object_increase,
        options=options,
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
    if features.head.gated and options.part_sample > 0 and options.part_increase > 0:
        order = np.argsort(object_of, kind="stable")
        ends = np.searchsorted(object_of[order], np.arange(int(object_of.max(initial=-1)) + 2))
        for thing, (start, end) in enumerate(pairwise(ends.tolist())):
            rows = order[start:end]
            found, _ = features.clusters(
                PART,
                rows,
                count=options.part_sample,
                increase=options.part_increase,
                options=options,
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
        GROUP, rows, count=options.sample, increase=options.group_increase, options=options, rng=rng
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
