"""Which ids of a layer, or nodes of a tree, the prompts in a view mean."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import UNLABELLED, InstanceTree, Labels, View
from splatseg.errors import InputError
from splatseg.prompting.seen import ViewCache

_MOST = 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RegionCounts:
    """Of each id that a view shows: its pixels, those inside a region, and its outline."""

    ids: Int64[Tensor, "m"]
    """Ascending, without -1."""

    inside: Int64[Tensor, "m"]
    """Pixels inside the region."""

    total: Int64[Tensor, "m"]
    """Pixels in the view."""

    boxes: Int64[Tensor, "m 4"]
    """First column, first row, one past the last column, one past the last row."""

    region: int
    """Pixels of the region."""

    region_box: Int64[Tensor, "4"]
    """Its outline."""

    boxed: bool
    """Whether the region is a box that was drawn, and not a mask."""

    def iou(self) -> Float[Tensor, "m"]:
        """How well each id fits: IoU of pixels with a mask, of outlines with a box."""
        if self.boxed:
            return box_iou(self.boxes, self.region_box)
        return self.inside.double() / (self.total + self.region - self.inside).double()


def region_counts(
    labels: Labels,
    views: ViewCache,
    view: View,
    inside: Bool[Tensor, "height width"],
    *,
    boxed: bool,
) -> RegionCounts:
    """Draw labels in a view, and count how their ids lie in a region of it.

    Args:
        labels: One id a Gaussian.
        views: Views of the Gaussians.
        view: The view.
        inside: The region, not empty.
        boxed: Whether it is a box that was drawn.
    """
    shown = views.label_map(view, labels).ids.cpu().long()
    ids, index = torch.unique(shown, return_inverse=True)
    flat, mask = index.flatten(), inside.cpu().flatten()
    boxes = _outlines(index, len(ids))
    known = ids != UNLABELLED
    return RegionCounts(
        ids=ids[known],
        inside=torch.bincount(flat[mask], minlength=len(ids))[known],
        total=torch.bincount(flat, minlength=len(ids))[known],
        boxes=boxes[known],
        region=int(mask.sum()),
        region_box=outline(inside.cpu()),
        boxed=boxed,
    )


def best_ids(counts: RegionCounts) -> tuple[int, ...]:
    """Ids that a region means: of a box the one that fits best, of a mask all mostly in it.

    A mask in which no id lies mostly means the one that fits it best.
    """
    iou = counts.iou()
    if not len(iou) or not bool(iou.max() > 0):
        return ()
    mostly = counts.inside.double() > _MOST * counts.total.double()
    if counts.boxed or not bool(mostly.any()):
        return (int(counts.ids[iou.argmax()]),)
    return tuple(counts.ids[mostly].tolist())


def _outlines(index: Int64[Tensor, "height width"], count: int) -> Int64[Tensor, "m 4"]:
    """The box round the pixels of each of `count` numbers, all of which occur."""
    flat = index.flatten()
    sides: list[Tensor] = []
    for axis in (1, 0):
        steps = torch.arange(index.shape[axis])
        place = (steps if axis == 1 else steps.unsqueeze(1)).expand(index.shape).flatten()
        start = torch.zeros(count, dtype=torch.int64)
        low = start.scatter_reduce(0, flat, place, "amin", include_self=False)
        high = start.scatter_reduce(0, flat, place, "amax", include_self=False) + 1
        sides += [low, high]
    left, right, top, bottom = sides
    return torch.stack((left, top, right, bottom), dim=1)


def outline(mask: Tensor) -> Int64[Tensor, "4"]:
    """The box round a mask that is not empty; four zeros for one that is."""
    rows, columns = torch.nonzero(mask.any(dim=1)), torch.nonzero(mask.any(dim=0))
    if not len(rows):
        return torch.zeros(4, dtype=torch.int64)
    return torch.stack((columns.min(), rows.min(), columns.max() + 1, rows.max() + 1))


def box_iou(boxes: Int64[Tensor, "m 4"], box: Int64[Tensor, "4"]) -> Float[Tensor, "m"]:
    """Intersection over union of boxes with one."""
    low, high = torch.maximum(boxes[:, :2], box[:2]), torch.minimum(boxes[:, 2:], box[2:])
    shared = (high - low).clamp_min(0).prod(dim=1)
    areas = (boxes[:, 2:] - boxes[:, :2]).prod(dim=1) + (box[2:] - box[:2]).prod()
    return shared.double() / (areas - shared).clamp_min(1).double()


_OBJECT = 0.5
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
