r"""A layer as a source: what belongs together was decided when the scene was segmented.

A click means the id that its pixel shows, the one with the largest blending weight in its row of
W, as in a label map, unless it is at the rim of something smaller. People click at things, not at
areas, and miss by a pixel; and the rims of small things are where masks err. So the pixels around a
click have a say, less the farther they are, and a small thing is likelier meant than a large one.
With the distances :math:`d_p` of pixels from the click, in pixels, and the :math:`n_k` Gaussians of
a thing k, a click means the k of the largest

.. math:: \frac{1}{\sqrt{n_k}} \sum_{p \text{ shows } k} e^{-d_p^2 / 2}.

Of a tree it means a node on the path of that id. How sure the answer is comes from the layer: with
the evidence :math:`s_{in}` for the ids that were chosen and :math:`s_{out}` for the strongest other
one,

.. math:: c = \frac{s_{in}}{s_{in} + s_{out}}.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from splatseg.core import UNLABELLED, Gaussians, InstanceTree, Labels, Layer, Selection
from splatseg.core.boundary import boundary
from splatseg.core.instance_tree import layer_kind
from splatseg.errors import InputError, ShapeError
from splatseg.prompting.seen import ViewCache, VisiblePrompt
from splatseg.prompting.tree_choice import RegionCounts, TreeChoice, best_ids, region_counts
from splatseg.render import SparseWeights

_REACH = 3
"""Pixels to each side that have a say; what is farther would have less than 1 %."""

_SHARED = 0.2
"""Share of what other clicks mean around a click from which on it is at their border."""


def neighbouring_pixels(
    pixel: Int64[Tensor, "2"], height: int, width: int
) -> tuple[Int64[Tensor, "p 2"], Tensor]:
    """Pixels of a picture around one, column and row, and how much each has to say."""
    steps = torch.arange(-_REACH, _REACH + 1)
    offsets = torch.cartesian_prod(steps, steps)
    pixels = pixel.cpu() + offsets
    inside = ((pixels >= 0) & (pixels < torch.tensor([width, height]))).all(dim=1)
    votes = torch.exp(-0.5 * offsets[inside].double().square().sum(dim=1))
    return pixels[inside], votes


@dataclass(frozen=True, slots=True, kw_only=True)
class NearestId:
    """What a click means."""

    id: int
    """Of the ids of the thing, the one that most pixels around the click show."""

    thing: int
    shares: Mapping[int, float]
    """Of each thing around the click, its share in what the pixels say; they add up to 1."""


def nearest_id(
    ids: Sequence[int],
    votes: Sequence[float],
    *,
    thing_of: Callable[[int], int],
    sizes: Mapping[int, int],
) -> NearestId:
    """What a click means; of equal ones the smaller thing, then id.

    Args:
        ids: What the pixels around it show, at least one.
        votes: How much each has to say.
        thing_of: The thing that an id is of.
        sizes: Gaussians of each thing.
    """
    of_id: dict[int, float] = defaultdict(float)
    of_thing: dict[int, float] = defaultdict(float)
    for id, vote in zip(ids, votes, strict=True):
        of_id[id] += vote
        of_thing[thing_of(id)] += vote
    size = {thing: max(1, sizes.get(thing, 0)) for thing in of_thing}
    best = min(of_thing, key=lambda t: (-of_thing[t] / size[t] ** 0.5, size[t], t))
    own = [id for id in of_id if thing_of(id) == best]
    total = sum(of_thing.values())
    return NearestId(
        id=min(own, key=lambda id: (-of_id[id], id)),
        thing=best,
        shares={thing: vote / total for thing, vote in of_thing.items()},
    )


def agreed(nearest: Sequence[NearestId]) -> list[int]:
    """Ids that several clicks on one thing mean together, each once.

    A click at the border of what another click means already says that this much belongs to the
    thing, and not that all of the neighbour does: it adds nothing.
    """
    found: dict[int, None] = {}
    things: set[int] = set()
    # Clicks in the middle of something come before those at borders.
    for one in sorted(nearest, key=lambda one: -one.shares[one.thing]):
        if one.thing in things or sum(one.shares.get(t, 0) for t in things) < _SHARED:
            things.add(one.thing)
            found[one.id] = None
    return list(found)


_MIN_STROKE_SHARE = 0.2
"""Least share of the pixels of the id that a stroke shows most of, with which another one is meant
as well: strokes slip over borders, and may go over many small things."""

_MIN_SURE = 0.501
"""Confidence of what was chosen by a hair; above 0.5, so that the ids chosen are all selected."""


class LayerSource:
    """Answers prompts by the ids of a layer of labels, or the nodes of a tree.

    Of labels, several positive points mean all their ids, and negative ones take theirs away. Of
    a tree, they mean the smallest node that holds all positive points and no negative one, yet no
    finer than is asked for (objects, where nothing is). A mask means the ids that it shows most
    of, of a tree the node that fits it best or, where none holds all that it shows, several; a box
    means the id or node whose outline fits it best. Points in the same prompts are added.

    Args:
        layer: Labels, or a tree.
        gaussians: The Gaussians that it is of.
        name: What the layer is called, for messages.
        views: Views of the Gaussians that are prepared already; None prepares them.

    Raises:
        InputError: If the layer has no ids.
        ShapeError: If it is of another scene.
    """

    @boundary
    def __init__(
        self,
        layer: Layer,
        gaussians: Gaussians,
        *,
        name: str = "layer",
        views: ViewCache | None = None,
    ) -> None:
        if not isinstance(layer, Labels | InstanceTree):
            kind = layer_kind(layer)
            raise InputError(f"layer {name!r}: expected labels or a tree, got {kind}.")
        if len(layer) != len(gaussians):
            raise ShapeError(
                f"layer {name!r}: expected {len(gaussians)} rows, one a Gaussian of the scene, got "
                f"{len(layer)}; it is of another scene."
            )
        self._layer = layer
        self._name = name
        self._labels = layer.labels if isinstance(layer, InstanceTree) else layer
        self._choice = TreeChoice(layer, name=name) if isinstance(layer, InstanceTree) else None
        self._rows = _RowsById(self._labels.ids.unsqueeze(1))
        self._sizes = self._rows.counts()
        if self._choice is not None:
            self._sizes = self._choice.sizes(self._sizes)
        several = self._labels.candidates
        self._candidate_rows = self._rows if several is None else _RowsById(several)
        self._views = ViewCache(gaussians, capacity=1) if views is None else views

    @boundary
    def membership(
        self, prompts: Sequence[VisiblePrompt], *, granularity: float | None = None
    ) -> Float[Tensor, "n"]:
        """How likely each Gaussian belongs to what is shown, see `MembershipSource`.

        Raises:
            InputError: If no positive prompt is on anything that the layer has a label for, or
                the layer cannot tell positive prompts from negative ones.
        """
        hidden = self._shown(prompts, positive=False)
        shown = self._clicked(prompts, granularity, set(hidden))
        shown += self._shown([one for one in prompts if one.dense], positive=True)
        choice = self._choice
        if choice is not None:
            nodes = {
                node
                for counts in self._regions(prompts)
                for node in choice.best_nodes(counts, granularity)
            }
            return self._of_ids(choice.ids(shown, hidden, nodes, granularity))
        ids = set(shown)
        for counts in self._regions(prompts):
            ids |= set(best_ids(counts))
        if ids and not ids - set(hidden):
            both = sorted(ids & set(hidden))[0]
            raise InputError(
                f"layer {self._name!r}: expected positive and negative prompts on different ids, "
                f"got both on {both}; a finer layer may tell them apart."
            )
        return self._of_ids(ids - set(hidden))

    @boundary
    def similar(self, selection: Selection) -> Float[Tensor, "n"]:
        """How likely each Gaussian is of a thing of the same class as what is selected.

        Classes are those that the layer's record or its tree gives to ids; where none has one,
        ids of labels are taken for classes themselves.

        Raises:
            InputError: If what is selected has no label here, or a tree knows no class of it.
            ShapeError: If the selection is of another scene.
        """
        if len(selection) != len(self._labels):
            raise ShapeError(
                f"similar: expected a selection of {len(self._labels)} Gaussians, those of the "
                f"scene, got one of {len(selection)}; it is of another scene."
            )
        labels = self._layer.cut() if isinstance(self._layer, InstanceTree) else self._layer
        ids = labels.ids[selection.mask]
        ids = ids[ids != UNLABELLED]
        if not len(ids):
            raise InputError(
                f"layer {self._name!r}: expected labels where something is selected, got none."
            )
        id = int(torch.mode(ids).values)
        class_of = labels.info.class_of
        if id in class_of:
            alike = {other for other, its in class_of.items() if its == class_of[id]}
        elif isinstance(self._layer, InstanceTree) or class_of:
            raise InputError(
                f"layer {self._name!r}: expected a class of id {id}, by which others are like it, "
                "got none."
            )
        else:
            alike = {id}
        if self._choice is not None:
            alike = self._choice.below(alike)
        return self._of_ids(alike)

    def _clicked(
        self, prompts: Sequence[VisiblePrompt], granularity: float | None, hidden: set[int]
    ) -> list[int]:
        """Ids that positive points mean, -1 not among them.

        Args:
            prompts: Of which points count.
            granularity: How large things are.
            hidden: Ids at negative points; only a click right on them means them.
        """
        nearest: list[NearestId] = []
        for one in prompts:
            for pixel in () if one.dense else one.pixels[one.positive].cpu():
                camera = one.view.camera
                pixels, votes = neighbouring_pixels(pixel, camera.height, camera.width)
                ids = shown_ids(self._labels, self._views.weights(one.view, pixels))
                own = (pixels == pixel).all(dim=1)
                said = own | torch.tensor([id not in hidden for id in ids.tolist()])
                nearest.append(
                    nearest_id(
                        ids[said].tolist(),
                        votes[said].tolist(),
                        thing_of=lambda id: self._thing_of(id, granularity),
                        sizes=self._sizes,
                    )
                )
        return [id for id in agreed(nearest) if id != UNLABELLED]

    def _thing_of(self, id: int, granularity: float | None) -> int:
        """The node that an id is of at a granularity; the id itself where there is no tree."""
        if self._choice is None or id == UNLABELLED:
            return id
        return self._choice.node_at(id, granularity)

    def _shown(self, prompts: Sequence[VisiblePrompt], *, positive: bool) -> list[int]:
        """Ids right at points and under strokes of one sign, each once; -1 is not among them."""
        found: dict[int, None] = {}
        for one in prompts:
            # What a mask or a box shows is decided by all of its pixels.
            if one.dense and one.inside is not None and positive:
                continue
            ids = shown_ids(self._labels, one.positive_rows if positive else one.negative_rows)
            values, counts = torch.unique(ids[ids != UNLABELLED], return_counts=True)
            if one.dense and len(counts):
                values = values[counts >= _MIN_STROKE_SHARE * counts.max()]
            found |= dict.fromkeys(values.tolist())
        return list(found)

    def _regions(self, prompts: Sequence[VisiblePrompt]) -> list[RegionCounts]:
        """How the layer lies in the masks and boxes that say by themselves where the thing is."""
        return [
            region_counts(self._labels, self._views, one.view, one.inside, boxed=one.guessed)
            for one in prompts
            if one.inside is not None and one.dense and bool(one.positive.any())
        ]

    def _of_ids(self, ids: set[int]) -> Float[Tensor, "n"]:
        """The confidence of all that has one of the ids."""
        labels = self._labels
        if not ids:
            raise InputError(
                f"layer {self._name!r}: expected a label where the positive prompts are, got none."
            )
        confidence = torch.zeros(len(labels), device=labels.ids.device)
        mask = torch.zeros(len(labels), dtype=torch.bool, device=labels.ids.device)
        own = self._rows.of(ids)
        mask[own] = True
        if labels.candidates is None or labels.shares is None:
            confidence[own] = labels.confidence[own].float().clamp(_MIN_SURE, 1)
            return confidence
        # What no candidate of is chosen, which is nearly everything, has confidence 0.
        some = torch.unique(torch.cat((own, self._candidate_rows.of(ids))))
        candidates, mask = labels.candidates[some], mask[some]
        wanted = torch.tensor(sorted(ids), dtype=candidates.dtype, device=candidates.device)
        chosen = torch.isin(candidates, wanted)
        shares = labels.shares[some].float() * (candidates != UNLABELLED)
        within = (shares * chosen).sum(dim=1)
        confidence[some] = within.clamp(0, 1)
        return confidence


class _RowsById:
    """Rows of a table of ids by id, so that those of an id are found without a look at the rest.

    Args:
        ids: One or more a row, -1 for none.
    """

    def __init__(self, ids: Int[Tensor, "n k"]) -> None:
        ordered, order = torch.sort(ids.flatten(), stable=True)
        self._rows = order // max(ids.shape[1], 1)
        self._ids, counts = torch.unique_consecutive(ordered, return_counts=True)
        self._ends = counts.cumsum(0)

    def counts(self) -> dict[int, int]:
        """Rows of each id."""
        starts = torch.cat((self._ends.new_zeros(1), self._ends))
        return dict(zip(self._ids.tolist(), starts.diff().tolist(), strict=True))

    def of(self, ids: set[int]) -> Int64[Tensor, "m"]:
        """All rows that have one of the ids; one that has several comes as often."""
        found = [self._rows[:0]]
        for id in sorted(ids):
            index = int(torch.searchsorted(self._ids, id))
            if index < len(self._ids) and int(self._ids[index]) == id:
                start = int(self._ends[index - 1]) if index else 0
                found.append(self._rows[start : int(self._ends[index])])
        return torch.cat(found)


def shown_ids(labels: Labels, rows: SparseWeights) -> Int64[Tensor, "p"]:
    """The id of each row of W: the one with the largest weight, -1 competing; ties to the lowest.

    Args:
        labels: One id a Gaussian.
        rows: Rows of pixels.
    """
    rows = rows.to("cpu")
    if not len(rows):
        return torch.zeros(0, dtype=torch.int64)
    ids, index = torch.unique(labels.ids.cpu()[rows.ids.long()].long(), return_inverse=True)
    row = torch.repeat_interleave(torch.arange(len(rows)), rows.indptr.diff())
    sums = torch.bincount(
        row * len(ids) + index, weights=rows.weights.double(), minlength=len(rows) * len(ids)
    )
    if not len(ids):
        return torch.full((len(rows),), UNLABELLED, dtype=torch.int64)
    return ids[sums.reshape(len(rows), len(ids)).argmax(dim=1)]
