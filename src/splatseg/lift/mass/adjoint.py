"""Evidence of views, read once each, and carried onto the Gaussians by the adjoint."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import UNLABELLED, Camera, Gaussians, LabelMap, View, ViewNames
from splatseg.errors import InputError
from splatseg.lift.mass.segment_masses import view_masses
from splatseg.lift.mass.view_votes import ViewVotes
from splatseg.lift.mass.vote_table import VoteTable
from splatseg.render import RenderOptions, back_project

_CHANNELS = 64
"""Ids or feature channels that one back-projection carries; bounds the memory of images."""

_DENSE_IDS = 128
"""Ids in a view above which the sparse product is faster than back-projecting one-hot images:
they take 0.5 and 0.004 CPU seconds an id at 512x384 and 30 million entries of W."""


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
        """Add a view's votes; returns how much of each Gaussian the view shows, (n,)."""
        ids, place, votes = pixel_votes(paper)
        if len(ids) > _DENSE_IDS:
            return self._cast_sparse(table, light, camera, paper)
        visible = torch.zeros(len(self.gaussians))
        names = ids.tolist()
        for start in range(0, max(len(names), 1), _CHANNELS):
            part = names[start : start + _CHANNELS]
            # One channel of nothing where no pixel has an id: the view still shows Gaussians.
            columns = torch.arange(start, start + max(len(part), 1))
            image = (place.unsqueeze(-1) == columns).float()
            if paper.confidence is not None:
                image = image * paper.confidence.cpu().float().unsqueeze(-1)
            found = self.collect(camera, image)
            visible = found[1]
            if part:
                say = self._say(visible)
                # A view shows a small part of a scene: what it does not show need not be touched.
                rows = torch.nonzero(visible > 0).squeeze(1)
                sums = found[0][rows]
                table.add(part, sums if say is None else sums * say[rows].unsqueeze(1), rows=rows)
                if self.by_view is not None:
                    self.by_view.add(part, sums, rows=rows)
                caught = sums.sum(dim=0, dtype=torch.float64)
                light.add(part, votes[start : start + len(part)], caught)
        say = self._say(visible)
        return visible if say is None else visible * say

    def collect(self, camera: Camera, image: Float[Tensor, "h w c"]) -> tuple[Tensor, Tensor]:
        """Sums (n, c) and weights (n,) of an image, on the CPU, by the nearest warp."""
        with torch.no_grad():
            found = back_project(
                self.gaussians,
                camera,
                image.to(self.gaussians.means),
                options=self.options,
                backend=self.backend,
                warp="nearest",
            )
        return found.sums.float().cpu(), found.weights.float().cpu()

    def _cast_sparse(
        self, table: VoteTable, light: Light, camera: Camera, paper: LabelMap
    ) -> Tensor:
        found = view_masses(
            self.gaussians, camera, paper, options=self.options, backend=self.backend
        )
        say = self._say(found.visible)
        weight = found.weight if say is None else found.weight * say[found.gaussian]
        table.add_sparse(found.segment, found.gaussian, weight)
        if self.by_view is not None:
            self.by_view.add_sparse(found.segment, found.gaussian, found.weight)
        ids, _, votes = pixel_votes(paper)
        place = torch.searchsorted(ids, found.segment)
        caught = torch.bincount(place, weights=found.weight.double(), minlength=len(ids))
        light.add(ids.tolist(), votes, caught)
        return found.visible if say is None else found.visible * say

    def _say(self, visible: Float[Tensor, "n"]) -> Float[Tensor, "n"] | None:
        """What a unit of this view's light on each Gaussian counts; None is 1 everywhere."""
        if not self.equal_views:
            return None
        return torch.where(visible > 0, visible, 1.0) ** -self.equal_views
