r"""More like this: what else in the scene is like what was selected.

With objects (a layer of labels, or a tree at one of its levels) each is compared as a whole by a
descriptor: the mean of its Gaussians' unit features, weighted by their visibility, or, where there
are no features, colour and shape (`describe_objects`). Descriptors are compared by cosine.

Without objects single Gaussians are compared with the mean feature of the selection, and taken
above the adaptive threshold of the mean of all similarities plus some standard deviations (SAGA's
threshold for mask prompts, :math:`\tau^{SAM} = \mathrm{mean}(S) + \mathrm{std}(S)`); what hangs
together is one thing.

References:
    Cen et al., Segment Any 3D Gaussians (2023), section 3.4: the threshold.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import UNLABELLED, Features, Gaussians, Labels, Selection
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.prompting.graph import NeighbourGraph
from splatseg.prompting.holes import pieces_of


@dataclass(frozen=True, slots=True, kw_only=True)
class SimilarOptions:
    """What counts as alike."""

    min_similarity: float = 0.8
    """Minimum cosine, in [-1, 1], of an object that is like the selected one."""

    max_objects: int = 20
    """Most objects, the most alike first."""

    min_size: int = 20
    """Minimum number of Gaussians of an object."""

    deviations: float = 1.0
    """Standard deviations above the mean of all similarities that a Gaussian's must be, where
    there are no objects."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_range("min_similarity", self.min_similarity, -1.0, 1.0)
        for name in ("max_objects", "min_size"):
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        if not math.isfinite(self.deviations):
            raise RangeError(f"deviations: expected a finite number, got {self.deviations}.")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimilarObjects:
    """Objects like the selected one, the most alike first."""

    ids: Int64[Tensor, "m"]
    """Ids of the layer, or numbers of connected pieces where there was none."""

    similarity: Float[Tensor, "m"]
    """Cosine of each with the selected one, in [-1, 1]."""

    rows: tuple[Int64[Tensor, "k"], ...]
    """The Gaussians of each."""

    def selection(self, count: int) -> Selection:
        """All of them as a selection over `count` Gaussians."""
        mask = torch.zeros(count, dtype=torch.bool)
        for rows in self.rows:
            mask[rows] = True
        return Selection(mask=mask)


@boundary
def similar_objects(
    gaussians: Gaussians,
    labels: Labels,
    selection: Selection,
    *,
    features: Features | None = None,
    options: SimilarOptions | None = None,
) -> SimilarObjects:
    """Objects of a layer that are most like what is selected.

    Args:
        gaussians: The Gaussians of the scene.
        labels: The objects. Those of which half or more is selected are what is selected, and are
            not among those found.
        selection: What others are to be like.
        features: What is compared; None compares colours and shapes.
        options: What counts as alike.

    Returns:
        The objects, of equal ones the smaller id first.

    Raises:
        ShapeError: If a value is of other Gaussians.
        InputError: If nothing is selected, or nothing selected has a feature.
    """
    options = options or SimilarOptions()
    _check(gaussians, selection, features, labels)
    ids, of = torch.unique(labels.ids.cpu().long(), return_inverse=True)
    count = len(ids)
    sizes = torch.bincount(of, minlength=count)
    chosen = selection.mask.cpu()
    # The selection is one object more, behind all others.
    rows = torch.cat((torch.arange(len(of)), torch.nonzero(chosen).squeeze(1)))
    of_all = torch.cat((of, torch.full((selection.count,), count)))
    if features is None:
        descriptors = describe_objects(gaussians, rows, of_all, count + 1)
    else:
        descriptors = _mean_features(features, rows, of_all, count + 1)
        if not bool(descriptors[count].any()):
            raise InputError("selection: expected a Gaussian with a feature, got none.")
    similarity = torch.nn.functional.cosine_similarity(
        descriptors[:count], descriptors[count : count + 1], dim=1
    )
    selected = torch.bincount(of[chosen], minlength=count)
    candidate = (ids != UNLABELLED) & (sizes >= options.min_size) & (2 * selected < sizes)
    candidate &= similarity >= options.min_similarity
    index = torch.nonzero(candidate).squeeze(1)
    order = torch.argsort(similarity[index], descending=True, stable=True)
    index = index[order[: options.max_objects]]
    return SimilarObjects(
        ids=ids[index],
        similarity=similarity[index].float(),
        rows=tuple(torch.nonzero(of == i).squeeze(1) for i in index),
    )


@boundary
def similar_gaussians(
    graph: NeighbourGraph,
    features: Features,
    selection: Selection,
    *,
    options: SimilarOptions | None = None,
) -> SimilarObjects:
    """Connected pieces of Gaussians whose features are like those of what is selected.

    Args:
        graph: The neighbours of the scene's Gaussians, see `build_graph`.
        features: What is compared, by cosine; rows of zeros are like nothing.
        selection: What others are to be like; its Gaussians are not among those found.
        options: What counts as alike.

    Returns:
        Pieces of at least `SimilarOptions.min_size` Gaussians, numbered from 0 by their first
        one, with their mean similarities.

    Raises:
        ShapeError: If a value is of other Gaussians than the graph.
        InputError: If nothing is selected, or nothing selected has a feature.
    """
    options = options or SimilarOptions()
    graph.check("features", features.values)
    graph.check("selection", selection.mask)
    _check_selected(selection)
    chosen = selection.mask.cpu()
    unit = _unit(features)
    known = unit.abs().sum(dim=1) > 0
    query = unit[chosen & known].mean(dim=0) if bool((chosen & known).any()) else None
    if query is None or not bool(query.any()):
        raise InputError("selection: expected a Gaussian with a feature, got none.")
    similarity = unit @ torch.nn.functional.normalize(query, dim=0)
    scores = similarity[known].double()
    threshold = float(scores.mean() + options.deviations * scores.std(correction=0))
    alike = known & ~chosen & (similarity > threshold)
    rows = torch.nonzero(alike).squeeze(1)
    piece_of = pieces_of(graph, rows)
    sizes = torch.bincount(piece_of)
    means = torch.bincount(piece_of, weights=similarity[rows].double()) / sizes.clamp_min(1)
    index = torch.nonzero(sizes >= options.min_size).squeeze(1)
    order = torch.argsort(means[index], descending=True, stable=True)
    index = index[order[: options.max_objects]]
    return SimilarObjects(
        ids=index,
        similarity=means[index].float(),
        rows=tuple(rows[piece_of == i] for i in index),
    )


def describe_objects(
    gaussians: Gaussians, rows: Int64[Tensor, "k"], of: Int64[Tensor, "k"], count: int
) -> Float[Tensor, "count 9"]:
    """Colour and shape of objects, each channel in deviations of its spread over the objects.

    Channels: mean colour (3), deviation of colour (3), and the logarithms of the three standard
    deviations of the centres, descending, in scene units; whatever way an object lies.

    Args:
        gaussians: The Gaussians of the scene.
        rows: Gaussians, each as often as it is in an object.
        of: The object of each.
        count: Number of objects.
    """
    colours = gaussians.colours.detach().cpu().double().clamp(0, 1)[rows]
    means = gaussians.means.detach().cpu().double()[rows]
    size = torch.bincount(of, minlength=count).clamp_min(1).double().unsqueeze(1)
    colour = _sums(colours, of, count) / size
    spread = (_sums((colours - colour[of]) ** 2, of, count) / size).sqrt()
    offsets = means - (_sums(means, of, count) / size)[of]
    products = (offsets.unsqueeze(2) * offsets.unsqueeze(1)).flatten(1)
    covariance = (_sums(products, of, count) / size).reshape(count, 3, 3)
    widths = torch.linalg.eigvalsh(covariance).clamp_min(1e-12).sqrt().flip(1).log()
    descriptors = torch.cat((colour, spread, widths), dim=1)
    descriptors -= descriptors.mean(dim=0)
    return descriptors / descriptors.std(dim=0, correction=0).clamp_min(1e-9)


def _mean_features(features: Features, rows: Tensor, of: Tensor, count: int) -> Tensor:
    """Mean unit feature of each object, weighted by visibility where that is known."""
    unit = _unit(features).double()
    if features.weights is not None:
        unit = unit * features.weights.detach().cpu().double().unsqueeze(1)
    return _sums(unit[rows], of, count)


def _unit(features: Features) -> Tensor:
    return torch.nn.functional.normalize(features.values.detach().cpu().float(), dim=1)


def _sums(values: Tensor, of: Tensor, count: int) -> Tensor:
    return values.new_zeros(count, values.shape[1]).index_add_(0, of, values)


def _check(
    gaussians: Gaussians, selection: Selection, features: Features | None, labels: Labels
) -> None:
    for name, rows in (("labels", labels), ("selection", selection), ("features", features)):
        if rows is not None and len(rows) != len(gaussians):
            raise ShapeError(f"{name}: expected {len(gaussians)} rows, got {len(rows)}.")
    _check_selected(selection)


def _check_selected(selection: Selection) -> None:
    if not selection.count:
        raise InputError("selection: expected at least one Gaussian, got none.")
