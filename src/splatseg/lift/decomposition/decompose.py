r"""Affinity features become a tree of groups, objects and parts, without a prompt.

Directions of a sample of Gaussians, behind the gate of objects, are joined to clusters that hang
together in space (`clusters.ward`), and every Gaussian takes the cluster that the samples around it
vote for, each by how alike their directions are (`clusters.votes`); votes become shares. Parts are
the same at the scale of parts, within the Gaussians of one object; groups are clusters at the scale
of groups that hold most of two or more objects. So children lie inside their parents by
construction, whatever the features say.

References:
    Cen et al., Segment Any 3D Gaussians (2023): automatic decomposition of its published code.
"""

from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, Int32
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
from splatseg.core.threads import one_torch_thread
from splatseg.errors import ShapeError
from splatseg.lift.decomposition.levels import Directed, Objects, groups, objects, parts
from splatseg.lift.decomposition.options import DecomposeOptions

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
    with one_torch_thread():
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
    candidates, shares = _shares(found, deepest, options) if options.candidates else (None, None)
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
    found: Objects, deepest: NDArray[np.int32], options: DecomposeOptions
) -> tuple[Int32[Tensor, "n k"], Float32[Tensor, "n k"]]:
    """Nodes that each Gaussian may belong to, its own first, and their shares.

    Of its own object a Gaussian has the deepest node, of others the whole.
    """
    kept = slice(0, options.candidates)
    candidates = torch.where(found.index >= 0, found.index + 1, UNLABELLED)[:, kept].int()
    candidates[:, 0] = torch.from_numpy(deepest)
    return candidates, found.shares[:, kept]
