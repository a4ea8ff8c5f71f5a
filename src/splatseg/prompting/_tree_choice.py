"""Which node of a tree prompts mean."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import torch

from splatseg.core import InstanceTree
from splatseg.errors import InputError
from splatseg.prompting._layer_regions import RegionCounts

_OBJECT = 0.5
_MOST = 0.5
_CLEARLY = 0.1
"""IoU by which several nodes have to fit better than the best one: their parts that a view hides
are less surely meant than those of one."""


class TreeChoice:
    """Chooses nodes by the prompts on them.

    Args:
        tree: The tree.
        name: What the layer is called, for messages.
    """

    def __init__(self, tree: InstanceTree, *, name: str) -> None:
        self._name = name
        self._paths = {node.id: tree.path(node.id) for node in tree.nodes}
        self._fineness = tree.granularity()

    def ids(
        self,
        positive: Sequence[int],
        negative: Sequence[int],
        regions: Iterable[int],
        granularity: float | None,
    ) -> set[int]:
        """Ids of all nodes at and below those that are meant.

        Args:
            positive: Deepest nodes at positive points.
            negative: Deepest nodes at negative points.
            regions: Nodes that masks and boxes mean.
            granularity: 0 for groups, 0.5 for objects, 1 for the finest parts, None for the
                smallest node that holds all positive points, yet an object at least.

        Raises:
            InputError: If nothing positive is on a node, or negative points are on the same.
        """
        chosen = set(regions)
        chosen |= self._meant(positive, negative, granularity)
        if not chosen:
            raise InputError(
                f"layer {self._name!r}: expected a label where the positive prompts are, got none."
            )
        removed = {
            self._removed(leaf, chosen) for leaf in negative if chosen & set(self._paths[leaf])
        }
        return self.below(chosen) - self.below(removed)

    def below(self, nodes: Iterable[int]) -> set[int]:
        """The nodes themselves, and all inside them."""
        above = set(nodes)
        return {id for id, path in self._paths.items() if above & set(path)}

    def node_at(self, id: int, granularity: float | None) -> int:
        """The node round an id that fits a granularity, see `ids`."""
        return self._of_path(self._paths[id], granularity) if id in self._paths else id

    def sizes(self, counts: Mapping[int, int]) -> dict[int, int]:
        """How many rows each node has with all inside it, from how many are its own."""
        found = dict(counts)
        for id, path in self._paths.items():
            for node in path:
                if node != id:
                    found[node] = found.get(node, 0) + counts.get(id, 0)
        return found

    def best_nodes(self, counts: RegionCounts, granularity: float | None) -> set[int]:
        """Nodes that a mask or box means; none where nothing is there.

        That is the one that fits best. A mask round several things that no node holds together
        means all that lie mostly in it, if those fit clearly better.

        Args:
            counts: Where the deepest nodes lie in the view.
            granularity: Nodes finer than that do not compete; None lets all.
        """
        best: tuple[float, int] | None = None
        mostly: set[int] = set()
        for node in sorted(self._paths, key=lambda id: (self._fineness[id], id)):
            if granularity is not None and not self._allowed(node, granularity):
                continue
            members = self._members(counts, {node})
            if not bool(members.any()):
                continue
            shown = _together(counts, members)
            fit = float(shown.iou()[0])
            if fit > 0 and (best is None or fit > best[0]):
                best = (fit, node)
            if int(shown.inside) > _MOST * int(shown.total):
                mostly.add(node)
        if best is None:
            return set()
        if mostly and not counts.boxed:
            together = _together(counts, self._members(counts, mostly))
            if float(together.iou()[0]) > best[0] + _CLEARLY:
                return mostly
        return {best[1]}

    def _members(self, counts: RegionCounts, nodes: set[int]) -> torch.Tensor:
        """Which of the ids in a view are nodes, or inside them."""
        return torch.isin(counts.ids, torch.tensor(sorted(self.below(nodes))))

    def _allowed(self, node: int, granularity: float) -> bool:
        """Whether a cut at the granularity has this node."""
        path = self._paths[node]
        deepest = [id for id in path if self._fineness[id] <= granularity]
        return node == (deepest[-1] if deepest else path[0])

    def _meant(
        self, positive: Sequence[int], negative: Sequence[int], granularity: float | None
    ) -> set[int]:
        """The node that holds all positive points and no negative one, or one for each point."""
        if not positive:
            return set()
        taken = {node for leaf in negative for node in self._paths[leaf]}
        paths = [self._paths[leaf] for leaf in positive]
        common = [node for node in paths[0] if all(node in path for path in paths)]
        held = [node for node in common if node not in taken]
        if held and (granularity is None or len(positive) == 1):
            return {self._of_path(held, granularity)}
        for leaf in positive:
            if leaf in negative:
                raise self._same(leaf)
        # What is around both at its finest is taken, and the negative part of it cut out.
        free = [[node for node in path if node not in taken] or path[-1:] for path in paths]
        return {self._of_path(path, granularity) for path in free}

    def _of_path(self, path: Sequence[int], granularity: float | None) -> int:
        """The node of a path, coarse to fine, that fits a granularity."""
        if granularity is None:
            return next((id for id in path if self._fineness[id] >= _OBJECT), path[-1])
        fitting = [id for id in path if self._fineness[id] <= granularity]
        return fitting[-1] if fitting else path[0]

    def _removed(self, leaf: int, chosen: set[int]) -> int:
        """The largest node around a negative point that is inside what is chosen."""
        path = self._paths[leaf]
        last = max(i for i, node in enumerate(path) if node in chosen)
        if last + 1 == len(path):
            raise self._same(leaf)
        return path[last + 1]

    def _same(self, node: int) -> InputError:
        return InputError(
            f"layer {self._name!r}: expected positive and negative prompts on different nodes, got "
            f"both on {node}; a finer layer may tell them apart."
        )


def _together(counts: RegionCounts, members: torch.Tensor) -> RegionCounts:
    """The counts of several ids as if they were one."""
    boxes = counts.boxes[members]
    return replace(
        counts,
        ids=counts.ids[members][:1],
        inside=counts.inside[members].sum().reshape(1),
        total=counts.total[members].sum().reshape(1),
        boxes=torch.cat((boxes[:, :2].amin(dim=0), boxes[:, 2:].amax(dim=0))).reshape(1, 4),
    )
