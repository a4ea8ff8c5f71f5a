r"""Features that start from the closed form: masks are associated, and nodes get codes and scales.

The channels are divided in three: parts, objects and groups, each node on the way from a Gaussian's
own node to the root with a code of length 1 in its division,

.. math:: c_n = (p_{n},\; o_{\mathrm{object}(n)},\; g_{\mathrm{root}(n)}) / \sqrt 3, \qquad
          f_i = \frac{\sum_n s_{in} c_n}{\| \sum_n s_{in} c_n \|}

with the share :math:`s_{in}` of Gaussian i in node n. Behind a gate that is open for all three two
parts of an object have the similarity 2/3; behind one for objects and groups these are one, and two
objects of a group have 1/2; behind one for groups all of a group is one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from splatseg.core import UNLABELLED, InstanceTree, LabelMap, MaskSet
from splatseg.lift.training import MaskSets

GROUP_SCALE, OBJECT_SCALE, PART_SCALE = 1.0, 0.5, 0.0
"""The scales of levels."""

PARTED_SCALE = 0.125
"""The scale of parts that hold parts."""

PART_END, OBJECT_END = 0.25, 0.75
"""Scales between those of parts and objects, and of objects and groups."""

UNLABELLED_LENGTH = 0.1
"""Length that features without a node start with: a few steps turn them."""

_STEPS = 200
"""Steps of repulsion."""

_SHARPNESS = 12.0
"""How much more than others the nearest of the other codes repels one."""


@dataclass(frozen=True, slots=True)
class MaskSegments:
    """Masks as association wants them."""

    evidence: MaskSets

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have masks."""
        return self.evidence.view_names

    @property
    def overlapping(self) -> bool:
        """They may overlap."""
        return True

    @property
    def persistent(self) -> bool:
        """Their numbers mean nothing."""
        return False

    def segments_of(self, name: str) -> LabelMap | MaskSet:
        """The masks of a view."""
        return self.evidence.masks(name)

    def categories_of(self, name: str) -> Mapping[int, int]:
        """None are known."""
        return {}


def divisions(channels: int) -> tuple[slice, slice, slice]:
    """The channels of parts, of objects and of groups; what does not divide is the objects'."""
    third = channels // 3
    return slice(0, third), slice(third, channels - third), slice(channels - third, channels)


def association_start(
    tree: InstanceTree, channels: int, rng: np.random.Generator
) -> Float[Tensor, "n channels"]:
    """What features start as: the codes of the nodes that each Gaussian has shares in.

    Args:
        tree: The nodes, and the Gaussians' shares in them.
        channels: Width of a feature.
        rng: Draws where codes begin, and the features of Gaussians without a node.
    """
    codes = torch.cat((node_codes(tree, channels, rng), torch.zeros(1, channels)))
    row = {node.id: place for place, node in enumerate(tree.nodes)}
    table = torch.full((max(row, default=0) + 2,), len(row), dtype=torch.int64)
    for id, place in row.items():
        table[id] = place
    labels = tree.labels
    if labels.candidates is None or labels.shares is None:
        found = codes[table[labels.ids.long().cpu()]]
    else:
        found = torch.zeros(len(tree), channels)
        for rank in range(labels.candidates.shape[1]):
            own = table[labels.candidates[:, rank].long().cpu()]
            found += labels.shares[:, rank, None].cpu() * codes[own]
    found = normalize(found, dim=1)
    without = torch.linalg.vector_norm(found, dim=1) == 0
    drawn = rng.standard_normal((len(tree), channels), dtype=np.float32)
    found[without] = UNLABELLED_LENGTH * normalize(torch.from_numpy(drawn)[without], dim=1)
    return found


def node_codes(
    tree: InstanceTree, channels: int, rng: np.random.Generator
) -> Float[Tensor, "nodes channels"]:
    """The code of each node, in their order, with length 1.

    A node that lies in no object, and one that no part is of, stands for itself in the division
    of objects or parts. Nodes with the same object or root have the same code there.
    """
    level = {node.id: node.level for node in tree.nodes}
    named = np.zeros((len(tree.nodes), 3), dtype=np.int64)
    for place, node in enumerate(tree.nodes):
        path = tree.path(node.id)
        objects = [id for id in path if level[id] == "object"]
        named[place] = node.id, objects[0] if objects else node.id, path[0]
    found = torch.zeros(len(tree.nodes), channels)
    for column, where in enumerate(divisions(channels)):
        distinct, index = np.unique(named[:, column], return_inverse=True)
        codes = spread_directions(len(distinct), where.stop - where.start, rng)
        found[:, where] = codes[torch.from_numpy(index.astype(np.int64))]
    return normalize(found, dim=1)


def spread_directions(
    count: int, channels: int, rng: np.random.Generator
) -> Float[Tensor, "count channels"]:
    """Directions that have little to do with each other.

    At right angles where there are as many dimensions: opposite ones would be less alike than
    what has nothing in common. Otherwise random ones, each pushed away from those nearest to it.

    Args:
        count: How many.
        channels: In how many dimensions.
        rng: Draws the random ones.
    """
    drawn: Float64[Tensor, "count channels"] = torch.from_numpy(
        rng.standard_normal((count, channels))
    )
    if count <= channels:
        return torch.linalg.qr(drawn.T)[0].T.float().contiguous()
    found = normalize(drawn, dim=1)
    for step in range(_STEPS if channels > 1 else 0):
        cosine = found @ found.T
        cosine.fill_diagonal_(-torch.inf)
        nearness = torch.softmax(_SHARPNESS * cosine, dim=1) * cosine.clamp_min(0)
        found = normalize(found - (1 - step / _STEPS) * nearness @ found, dim=1)
    return found.float()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LevelMasks:
    """What the masks of all views are at each level: the part, the object, the group."""

    nodes: Int64[Tensor, "levels masks"]
    """Of parts, objects and groups: the node that each mask is or lies in there, or the mask's
    own where that is of a coarser level; -1 where the mask is no node."""

    scales: Float[Tensor, "levels masks"]
    """The scales of these nodes; 0 where there is none."""

    def at(
        self, inside: Bool[Tensor, "pixels masks"], numbers: Int64[Tensor, "masks"], scale: float
    ) -> tuple[Bool[Tensor, "pixels nodes"], Float[Tensor, "nodes"], Bool[Tensor, "pixels"]]:
        """Which pixels each node of a view contains at a scale, by all of its masks together.

        A mask of a part stands for its object, too, where that has no mask of its own.

        Args:
            inside: Which pixels each mask contains.
            numbers: The masks' numbers.
            scale: The scale that is asked about.

        Returns:
            The pixels of nodes, the scales of these, and the pixels of which something is known:
            those in a mask that is a node, and those in no mask.
        """
        level = 0 if scale < PART_END else 1 if scale < OBJECT_END else 2
        nodes, column = torch.unique(self.nodes[level, numbers], return_inverse=True)
        shown = torch.zeros(len(inside), len(nodes), dtype=torch.bool)
        scales = torch.zeros(len(nodes))
        for mask, place in enumerate(column.tolist()):
            shown[:, place] |= inside[:, mask]
            scales[place] = self.scales[level, numbers[mask]]
        there = nodes != UNLABELLED
        shown, scales = shown[:, there], scales[there]
        return shown, scales, shown.any(dim=1) | ~inside.any(dim=1)


def level_masks(tree: InstanceTree, nodes: Int64[Tensor, "masks"]) -> LevelMasks:
    """What masks are at each level.

    Args:
        tree: The nodes.
        nodes: Id of the node of each mask, -1 for none.
    """
    scale = node_scales(tree)
    lifted = {UNLABELLED: (UNLABELLED,) * 3}
    level = {node.id: node.level for node in tree.nodes}
    for node in tree.nodes:
        path = tree.path(node.id)
        objects = [id for id in path if level[id] == "object"]
        lifted[node.id] = node.id, (objects or [node.id])[0], path[0]
    found = torch.tensor([lifted[id] for id in nodes.tolist()], dtype=torch.int64).reshape(-1, 3)
    scales = [[scale.get(id, 0.0) for id in row] for row in found.T.tolist()]
    return LevelMasks(nodes=found.T.contiguous(), scales=torch.tensor(scales))


def node_scales(tree: InstanceTree) -> dict[int, float]:
    """The scale of each node by its level, from 0 for parts over objects to 1 for groups."""
    parents = {node.parent for node in tree.nodes}
    found: dict[int, float] = {}
    for node in tree.nodes:
        part = PARTED_SCALE if node.id in parents else PART_SCALE
        found[node.id] = {"group": GROUP_SCALE, "object": OBJECT_SCALE, "part": part}[node.level]
    return found


def level_cut(scale: float) -> float:
    """The largest scale of masks that count at a scale: all of the level that it stands for."""
    if scale < PART_END:
        return scale
    return OBJECT_SCALE if scale < OBJECT_END else GROUP_SCALE
