"""The adjoint of rendering: evidence of views, read once each, summed onto Gaussians."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import UNLABELLED, Camera, Gaussians, LabelMap, View, ViewNames
from splatseg.errors import InputError
from splatseg.lift.mass.view_votes import ViewVotes
from splatseg.lift.mass.vote_table import VoteTable
from splatseg.render import PreparedView, RenderOptions, SparseImage, prepare


def voting_views(views: Sequence[View], evidence: ViewNames, what: str) -> list[View]:
    """The views in the order of their names, in which everything is summed.

    Sums of floats depend on their order a little, so a fixed one makes results independent of
    the order in which views are given.

    Raises:
        InputError: If there are none, if one comes twice, or if one has no evidence.
    """
    if not views:
        raise InputError("views: expected at least one view that votes, got none.")
    known = set(evidence.view_names)
    missing = [view.name for view in views if view.name not in known]
    if missing:
        raise InputError(
            f"evidence: expected {what} of every view that votes, {len(missing)} of "
            f"{len(views)} have none, the first is {missing[0]}."
        )
    ordered = sorted(views, key=lambda view: view.name)
    for first, second in pairwise(ordered):
        if first.name == second.name:
            raise InputError(f"views: expected every view once, got {first.name} twice.")
    return ordered


def pixel_votes(label_map: LabelMap) -> tuple[Int64[Tensor, "ids"], Tensor, Float[Tensor, "ids"]]:
    """Ids of a map ascending without -1, each pixel's index among them (or -1), and their votes.

    A pixel counts 1, or its confidence.
    """
    ids, index = torch.unique(label_map.ids.cpu().long(), return_inverse=True)
    confidence = label_map.confidence
    weights = None if confidence is None else confidence.cpu().double().reshape(-1)
    votes = torch.bincount(index.reshape(-1), weights=weights, minlength=len(ids)).double()
    if len(ids) and int(ids[0]) == UNLABELLED:
        return ids[1:], index - 1, votes[1:]
    return ids, index, votes


def near_an_edge(label_map: LabelMap, width: int) -> Bool[Tensor, "height width"]:
    """Pixels with another id, or none beside an id, at most `width` pixels away along each axis."""
    _, index, _ = pixel_votes(label_map)
    window = 2 * width + 1
    image = index.double()[None, None]
    largest = torch.nn.functional.max_pool2d(image, window, stride=1, padding=width)
    smallest = -torch.nn.functional.max_pool2d(-image, window, stride=1, padding=width)
    return (largest != smallest)[0, 0]


@dataclass(kw_only=True)
class LabelMass:
    """Mass of each id: of all its pixels, and the part of it that lies on Gaussians."""

    total: dict[int, float] = field(default_factory=dict[int, float])
    """Pixels of each id, or their confidences, summed over views."""

    on_gaussians: dict[int, float] = field(default_factory=dict[int, float])
    """Blending weight of all Gaussians on these pixels; the rest passes all Gaussians."""

    def add(self, ids: Sequence[int], total: Tensor, on_gaussians: Tensor) -> None:
        """Add one view's."""
        for id, more_total, more_on_gaussians in zip(
            ids, total.tolist(), on_gaussians.tolist(), strict=True
        ):
            self.total[id] = self.total.get(id, 0.0) + more_total
            self.on_gaussians[id] = self.on_gaussians.get(id, 0.0) + more_on_gaussians


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RenderAdjoint:
    """The adjoint of rendering: images of views summed onto Gaussians by blending weight."""

    gaussians: Gaussians
    options: RenderOptions
    backend: str
    equal_views: float = 0.0
    """Power of a view's visible weight that its votes are divided by."""
    by_view: ViewVotes | None = None
    """Where a sample of the votes is kept view by view."""

    def add_view(
        self, table: VoteTable, label_mass: LabelMass, camera: Camera, label_map: LabelMap
    ) -> Tensor:
        """Add a view's votes; returns how much of each Gaussian the view shows, (n,).

        One pass over the view, whatever the number of ids.
        """
        ids, index, votes = pixel_votes(label_map)
        index = index.reshape(-1)
        labelled = index >= 0
        values = torch.ones(int(labelled.sum()))
        if label_map.confidence is not None:
            values = label_map.confidence.cpu().float().reshape(-1)[labelled]
        image = SparseImage(
            indptr=torch.cat((torch.zeros(1, dtype=torch.int64), labelled.cumsum(0))),
            channels=index[labelled].to(torch.int32),
            values=values,
            count=len(ids),
        )
        with torch.no_grad(), self.prepared(camera) as view:
            projected = view.back_project_sparse(image)
        view_weight = self._view_weight(projected.weights)
        sums = (
            projected.sums
            if view_weight is None
            else projected.sums * view_weight[projected.gaussians]
        )
        table.add_sparse(ids[projected.channels], projected.gaussians, sums)
        if self.by_view is not None:
            self.by_view.add_sparse(ids[projected.channels], projected.gaussians, projected.sums)
        on_gaussians = torch.bincount(
            projected.channels, weights=projected.sums.double(), minlength=len(ids)
        )
        label_mass.add(ids.tolist(), votes, on_gaussians)
        return projected.weights if view_weight is None else projected.weights * view_weight

    def prepared(self, camera: Camera) -> PreparedView:
        """A view, to be used more than once."""
        return prepare(self.gaussians, camera, options=self.options, backend=self.backend)

    def back_project(
        self, view: PreparedView, image: Float[Tensor, "h w c"]
    ) -> tuple[Tensor, Tensor]:
        """Sums (n, c) and weights (n,) of an image, on the CPU, by the nearest warp."""
        with torch.no_grad():
            projected = view.back_project(image.to(self.gaussians.means), warp="nearest")
        return projected.sums.float().cpu(), projected.weights.float().cpu()

    def _view_weight(self, visible: Float[Tensor, "n"]) -> Float[Tensor, "n"] | None:
        """Factor of this view's weight on each Gaussian; None is 1 everywhere."""
        if not self.equal_views:
            return None
        return torch.where(visible > 0, visible, 1.0) ** -self.equal_views
