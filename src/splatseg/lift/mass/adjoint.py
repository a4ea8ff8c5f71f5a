"""Evidence of views, read once each, and carried onto the Gaussians by the adjoint."""

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


def pixel_votes(paper: LabelMap) -> tuple[Int64[Tensor, "ids"], Tensor, Float[Tensor, "ids"]]:
    """Ids of a map ascending without -1, each pixel's place among them (or -1), and their votes.

    A pixel counts 1, or its confidence.
    """
    ids, place = torch.unique(paper.ids.cpu().long(), return_inverse=True)
    confidence = paper.confidence
    weights = None if confidence is None else confidence.cpu().double().reshape(-1)
    votes = torch.bincount(place.reshape(-1), weights=weights, minlength=len(ids)).double()
    if len(ids) and int(ids[0]) == UNLABELLED:
        return ids[1:], place - 1, votes[1:]
    return ids, place, votes


def near_an_edge(paper: LabelMap, width: int) -> Bool[Tensor, "height width"]:
    """Pixels with another id, or none beside an id, at most `width` pixels away along each axis."""
    _, place, _ = pixel_votes(paper)
    window = 2 * width + 1
    image = place.double()[None, None]
    highest = torch.nn.functional.max_pool2d(image, window, stride=1, padding=width)
    lowest = -torch.nn.functional.max_pool2d(-image, window, stride=1, padding=width)
    return (highest != lowest)[0, 0]


@dataclass(kw_only=True)
class Light:
    """How much voting light there was for each id, and how much of it Gaussians caught."""

    cast: dict[int, float] = field(default_factory=dict[int, float])
    caught: dict[int, float] = field(default_factory=dict[int, float])

    def add(self, ids: Sequence[int], cast: Tensor, caught: Tensor) -> None:
        """Add one view's."""
        for id, given, taken in zip(ids, cast.tolist(), caught.tolist(), strict=True):
            self.cast[id] = self.cast.get(id, 0.0) + given
            self.caught[id] = self.caught.get(id, 0.0) + taken


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Engine:
    """The adjoint of rendering label maps."""

    gaussians: Gaussians
    options: RenderOptions
    backend: str
    equal_views: float = 0.0
    """Power of a view's visible weight that its votes are divided by."""
    by_view: ViewVotes | None = None
    """Where a sample of the votes is kept view by view."""

    def cast(self, table: VoteTable, light: Light, camera: Camera, paper: LabelMap) -> Tensor:
        """Add a view's votes; returns how much of each Gaussian the view shows, (n,).

        One pass over the view, whatever the number of ids.
        """
        ids, place, votes = pixel_votes(paper)
        place = place.reshape(-1)
        labelled = place >= 0
        values = torch.ones(int(labelled.sum()))
        if paper.confidence is not None:
            values = paper.confidence.cpu().float().reshape(-1)[labelled]
        image = SparseImage(
            indptr=torch.cat((torch.zeros(1, dtype=torch.int64), labelled.cumsum(0))),
            channels=place[labelled].to(torch.int32),
            values=values,
            count=len(ids),
        )
        with torch.no_grad(), self.prepared(camera) as view:
            found = view.back_project_sparse(image)
        say = self._say(found.weights)
        sums = found.sums if say is None else found.sums * say[found.gaussians]
        table.add_sparse(ids[found.channels], found.gaussians, sums)
        if self.by_view is not None:
            self.by_view.add_sparse(ids[found.channels], found.gaussians, found.sums)
        caught = torch.bincount(found.channels, weights=found.sums.double(), minlength=len(ids))
        light.add(ids.tolist(), votes, caught)
        return found.weights if say is None else found.weights * say

    def prepared(self, camera: Camera) -> PreparedView:
        """A view, to be used more than once."""
        return prepare(self.gaussians, camera, options=self.options, backend=self.backend)

    def collect(self, view: PreparedView, image: Float[Tensor, "h w c"]) -> tuple[Tensor, Tensor]:
        """Sums (n, c) and weights (n,) of an image, on the CPU, by the nearest warp."""
        with torch.no_grad():
            found = view.back_project(image.to(self.gaussians.means), warp="nearest")
        return found.sums.float().cpu(), found.weights.float().cpu()

    def _say(self, visible: Float[Tensor, "n"]) -> Float[Tensor, "n"] | None:
        """What a unit of this view's light on each Gaussian counts; None is 1 everywhere."""
        if not self.equal_views:
            return None
        return torch.where(visible > 0, visible, 1.0) ** -self.equal_views
