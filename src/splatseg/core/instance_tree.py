"""A tree of instances over Gaussians: groups above objects, parts below them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, overload

import torch
from msgspec import Meta
from torch import Tensor

from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.evidence import UNLABELLED
from splatseg.core.layer_info import TREE_LEVELS, InstanceFacts, LayerInfo, TreeLevel, tree_level
from splatseg.core.layers import Features, Labels, Selection, merged_candidates
from splatseg.core.options import Natural, Share
from splatseg.core.upward import Previewed
from splatseg.core.voxels import VoxelFeatures
from splatseg.errors import InputError, RangeError

_FOLLOWS: dict[TreeLevel, tuple[TreeLevel | None, ...]] = {
    "group": (None, "group"),
    "object": (None, "group"),
    "part": ("object", "part"),
}
"""Levels that the parent of a node may have; None is no parent."""

_OBJECT_GRANULARITY = 0.5
_MAX_ID = 2**31 - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class TreeNode:
    """One group, object or part."""

    id: Annotated[int, Meta(ge=1, le=_MAX_ID)]
    """1 or more; no two nodes of a tree share one."""

    parent: Annotated[int, Meta(ge=UNLABELLED, le=_MAX_ID)] = UNLABELLED
    """Id of the node that it lies in, -1 for none."""

    level: TreeLevel = "object"
    """group, object or part. Parents of objects are groups; those of parts are objects or parts."""

    name: str = ""
    """What it is called; empty where it has no name."""

    class_id: Annotated[int, Meta(ge=UNLABELLED, le=_MAX_ID)] = 0
    """Its class, 0 where it is not known."""

    support: Share = 1.0
    """How much speaks for it, in [0, 1]: the share of the views that could have seen it which
    did."""

    segments: Natural = 0
    """Masks that it was made of."""

    views: Natural = 0
    """Views that these come from."""

    def __post_init__(self) -> None:
        convert_fields(self)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InstanceTree(Previewed):
    """Nodes inside each other, and of every Gaussian the deepest node that it belongs to.

    A Gaussian of a node is one of all the nodes above it, so that children always lie inside
    their parents and two nodes are inside each other or apart.

    Raises:
        InputError: If two nodes share an id, a parent is missing or of a level that has no such
            children, a node is above itself, or Gaussians have a node that is not there.
        RangeError: If an id is less than 1 or a support is outside [0, 1].

    Example:
        A lamp of two parts, and a table with it on it:

        >>> nodes = (TreeNode(id=1, level="group"), TreeNode(id=2, parent=1),
        ...          TreeNode(id=3, parent=2, level="part"), TreeNode(id=4, parent=1))
        >>> ids = torch.tensor([3, 2, 4, -1])
        >>> tree = InstanceTree(nodes=nodes, labels=Labels(ids=ids, confidence=torch.ones(4)))
        >>> tree.cut().ids.tolist(), tree.cut("group").ids.tolist()
        ([2, 2, 4, -1], [1, 1, 1, -1])
    """

    nodes: tuple[TreeNode, ...]

    labels: Labels
    """Of each Gaussian the id of its deepest node, -1 for none, and how sure it is."""

    def __post_init__(self) -> None:
        convert_fields(self)
        by_id = {node.id: node for node in self.nodes}
        if len(by_id) != len(self.nodes):
            raise InputError("nodes: expected ids that differ, got one twice.")
        for node in self.nodes:
            _check_node(node, by_id)
        unknown = sorted(set(self.labels.present.tolist()) - set(by_id))
        if unknown:
            raise InputError(f"labels: expected ids of nodes, got {unknown[0]}, which is none.")

    def __len__(self) -> int:
        return len(self.labels)

    def __repr__(self) -> str:
        counts = {level: sum(n.level == level for n in self.nodes) for level in TREE_LEVELS}
        words = ", ".join(f"{n} {level}{'s'[: n != 1]}" for level, n in counts.items())
        return f"InstanceTree({len(self):,} rows; {words})"

    def __getitem__(self, index: slice | Tensor) -> "InstanceTree":
        """Rows, in step with `Gaussians.__getitem__`; all nodes stay."""
        return replace(self, labels=self.labels[index])

    @property
    def info(self) -> LayerInfo:
        """How it was made, and what was done to it since."""
        return self.labels.info

    @property
    def depth(self) -> int:
        """Nodes on the longest path from a root."""
        return max((len(self.path(node.id)) for node in self.nodes), default=0)

    @boundary
    def node(self, id: int) -> TreeNode:
        """The node of an id.

        Raises:
            InputError: If there is none.
        """
        for node in self.nodes:
            if node.id == id:
                return node
        raise InputError(f"node: expected an id of the tree's, got {id}.")

    @boundary
    def path(self, id: int) -> tuple[int, ...]:
        """Ids of the nodes from the root to a node, the node included."""
        parents = {node.id: node.parent for node in self.nodes}
        found: list[int] = []
        while id != UNLABELLED:
            found.append(id)
            id = parents[id]
        return tuple(reversed(found))

    def granularity(self) -> dict[int, float]:
        """How fine each node is, in [0, 1]; it grows along every path.

        Groups that are roots have 0, objects 0.5, the last of the parts 1, with even steps
        between them.
        """
        height: dict[int, int] = {}
        paths = {node.id: self.path(node.id) for node in self.nodes}
        levels: dict[int, TreeLevel] = {node.id: node.level for node in self.nodes}
        for path in paths.values():
            for steps, id in enumerate(reversed(path)):
                height[id] = max(height.get(id, 0), steps)
        found: dict[int, float] = {}
        for id, path in sorted(paths.items(), key=lambda item: len(item[1])):
            above = found[path[-2]] if len(path) > 1 else 0.0
            match levels[id]:
                case "object":
                    found[id] = _OBJECT_GRANULARITY
                case "part":
                    found[id] = above + (1.0 - above) / (height[id] + 1)
                case "group":
                    steps = len([node for node in path if levels[node] == "group"])
                    found[id] = _OBJECT_GRANULARITY * (1 - 1 / steps)
        return found

    @boundary
    def cut(self, level: TreeLevel | float = "object") -> Labels:
        """One id a Gaussian, at a level or a granularity.

        Args:
            level: ``object`` gives objects, and no label to what is only in a group. ``part``
                gives the deepest nodes, which are objects where these have no parts. ``group``
                gives the roots. A number in [0, 1] gives the deepest nodes that are no finer.

        Returns:
            Labels with the ids of nodes. Their info says the level (``cut``), and has the names,
            the classes and the facts of the nodes of the cut.

        Raises:
            InputError: If there is no such level.
            RangeError: If a granularity is outside [0, 1].
        """
        wanted = self._cut_ids(level)
        table = torch.full((max(wanted, default=0) + 2,), UNLABELLED, dtype=torch.int32)
        for id, taken in wanted.items():
            table[id] = taken

        def relabelled(ids: Tensor) -> Tensor:
            # The last row is of -1.
            return table.to(ids.device)[ids.long()]

        labels = self.labels
        ids = relabelled(labels.ids)
        candidates, shares = None, None
        if labels.candidates is not None and labels.shares is not None:
            candidates, shares = merged_candidates(relabelled(labels.candidates), labels.shares)
        background = int(relabelled(torch.tensor([labels.background]))[0])
        return replace(
            labels,
            ids=ids,
            confidence=torch.where(ids == UNLABELLED, 0.0, labels.confidence),
            background=background,
            candidates=candidates,
            shares=shares,
            info=self._cut_info(level, set(wanted.values())),
        )

    def with_cut(self, labels: Labels, level: TreeLevel | float = "object") -> "InstanceTree":
        """The tree after a cut of it was changed.

        Args:
            labels: The cut, with other ids of nodes for some of the Gaussians.
            level: The level of the cut.

        Returns:
            The tree in which these Gaussians belong to their new node; the others stay in the
            deepest node that they are in.
        """
        stays = self.cut(level).ids == labels.ids
        return replace(
            self,
            labels=replace(
                self.labels,
                ids=torch.where(stays, self.labels.ids, labels.ids),
                confidence=torch.where(stays, self.labels.confidence, labels.confidence),
                candidates=None,
                shares=None,
                evidence=labels.evidence,
                effective_views=labels.effective_views,
                inferred=labels.inferred,
                info=replace(labels.info, cut=None, names={}, class_of={}, instances={}),
            ),
        )

    def _cut_ids(self, level: TreeLevel | float) -> dict[int, int]:
        """The node of the cut for each node, -1 where there is none."""
        levels = {node.id: node.level for node in self.nodes}
        paths = {node.id: self.path(node.id) for node in self.nodes}
        if isinstance(level, str):
            match level:
                case "part":
                    return {id: id for id in paths}
                case "group":
                    return {id: path[0] for id, path in paths.items()}
                case "object":
                    return {
                        id: next((n for n in path if levels[n] == "object"), UNLABELLED)
                        for id, path in paths.items()
                    }
                case _:
                    raise InputError(
                        f"level: expected {', '.join(TREE_LEVELS)} or a number from 0 to 1, "
                        f"got {level!r}."
                    )
        if not (math.isfinite(level) and 0 <= level <= 1):
            raise RangeError(f"level: expected a granularity from 0 to 1, got {level}.")
        fine = self.granularity()
        return {
            id: next((node for node in reversed(path) if fine[node] <= level), path[0])
            for id, path in paths.items()
        }

    def _cut_info(self, level: TreeLevel | float, ids: set[int]) -> LayerInfo:
        nodes = [node for node in self.nodes if node.id in ids]
        return replace(
            self.info,
            cut=level,
            names={node.id: node.name for node in nodes},
            class_of={node.id: node.class_id for node in nodes if node.class_id > 0},
            instances={
                node.id: InstanceFacts(segments=node.segments, views=node.views)
                for node in nodes
                if node.segments
            },
        )


FlatLayer = Labels | Features | VoxelFeatures | Selection
"""Layers without levels."""

Layer = FlatLayer | InstanceTree
"""What a scene keeps of its Gaussians under a name."""


@boundary
def layer_address(text: str) -> tuple[str, TreeLevel | float | None]:
    """The name of a layer and the level of it that is meant, None for all of it.

    Raises:
        InputError: If what follows an @ is no level.

    Example:
        >>> layer_address("masks"), layer_address("masks@part")
        (('masks', None), ('masks', 'part'))
    """
    name, at, level = text.partition("@")
    return name, tree_level(level) if at else None


@boundary
def layer_kind(layer: Layer) -> str:
    """What a layer is called in a sentence: labels, features, voxels, selection or tree."""
    if isinstance(layer, VoxelFeatures):
        return "voxels"
    return "tree" if isinstance(layer, InstanceTree) else type(layer).__name__.lower()


@boundary
def flat_layer(layer: Layer, level: TreeLevel | float | None, *, name: str) -> FlatLayer:
    """The layer, or of a tree the cut that is asked for; None asks for objects.

    Raises:
        InputError: If a level is asked for of a layer that has none.
    """
    if isinstance(layer, InstanceTree):
        return layer.cut("object" if level is None else level)
    if level is not None:
        raise InputError(f"layer {name!r}: expected a tree, of which {level} is a level, got none.")
    return layer


@overload
def with_info(layer: InstanceTree, info: LayerInfo) -> InstanceTree: ...
@overload
def with_info(layer: Layer, info: LayerInfo) -> Layer: ...
@boundary
def with_info(layer: Layer, info: LayerInfo) -> Layer:
    """The layer with another record of how it was made."""
    if isinstance(layer, InstanceTree):
        return replace(layer, labels=replace(layer.labels, info=info))
    return replace(layer, info=info)


@boundary
def node_row(node: TreeNode) -> dict[str, Any]:
    """A node as JSON holds it."""
    return {
        "id": node.id,
        "parent": node.parent if node.parent != UNLABELLED else 0,
        "level": node.level,
        "name": node.name,
        "class": node.class_id,
        "support": node.support,
        "segments": node.segments,
        "views": node.views,
    }


def _check_node(node: TreeNode, by_id: Mapping[int, TreeNode]) -> None:
    parent = by_id.get(node.parent)
    if parent is None and node.parent != UNLABELLED:
        raise InputError(f"node {node.id}: expected a parent that is there, got {node.parent}.")
    above = None if parent is None else parent.level
    if above not in _FOLLOWS[node.level]:
        raise InputError(
            f"node {node.id}: expected a {node.level} "
            f"{'in an object or a part' if node.level == 'part' else 'in a group or alone'}, "
            f"got one in {'nothing' if above is None else above}."
        )
    seen: set[int] = set()
    while parent is not None:
        if parent.id in seen or parent.id == node.id:
            raise InputError(f"node {node.id}: expected a tree, got a node above itself.")
        seen.add(parent.id)
        parent = by_id.get(parent.parent)
