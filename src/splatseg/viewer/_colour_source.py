"""A source of selections of our own, for scenes that know nothing better: colour and place."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Gaussians, View
from splatseg.prompting.pipeline import SceneIndex
from splatseg.prompting.seen import ViewCache, VisiblePrompt
from splatseg.selection import pieces

_WIDEST, _FINEST = 0.62, 0.10
"""Distances of colours in [0, 1] that are alike to a group, and to the finest part."""

_POINTED_AT = 0.1
"""Least blending weight of a Gaussian in a pixel that points at it."""

_MAX_SEEDS = 16
"""Most Gaussians that were pointed at whose colours others are compared with."""

_IN, _OUT = 0.501, 0.499


class ColourSource:
    """What is connected to a click and of about its colour: for scenes that know nothing better.

    With d the distance of a Gaussian's mean colour to the nearest colour that was pointed at, and t
    how far is alike, it may belong where d < t, and belongs if touching ones of these lead to it
    from what was pointed at. Where something else was pointed at too, colour and place together
    must be nearer to the thing.

    Args:
        gaussians: The Gaussians of the scene.
        neighbours: Which of them touch.
        views: Where they are seen in views.
    """

    def __init__(self, gaussians: Gaussians, neighbours: SceneIndex, views: ViewCache) -> None:
        self._gaussians = gaussians
        self._neighbours = neighbours
        self._views = views

    def membership(
        self, prompts: Sequence[VisiblePrompt], *, granularity: float | None
    ) -> Float[Tensor, "n"]:
        """How likely each Gaussian belongs to what prompts show, see `MembershipSource`."""
        inside, outside = (
            self._pointed_at(prompts, positive=True),
            self._pointed_at(prompts, positive=False),
        )
        fineness = 0.5 if granularity is None else granularity
        alike = _WIDEST + (_FINEST - _WIDEST) * fineness
        colour = self._nearest(self._colours, inside)
        likely = (1 - 0.5 * colour / alike).clamp(0, 1)
        candidates = colour < alike
        if len(outside):
            means = self._gaussians.means.detach().cpu().double()
            apart = float(self._nearest(means, inside)[outside].mean())
            near = colour / alike + self._nearest(means, inside) / max(apart, 1e-9)
            far = self._nearest(self._colours, outside) / alike
            far = far + self._nearest(means, outside) / max(apart, 1e-9)
            candidates &= near < far
        for prompt in prompts:
            if prompt.inside is not None:
                candidates &= self._seen_within(prompt.view, prompt.inside)
        candidates[inside] = True
        member = self._connected(candidates, inside)
        return torch.where(member, likely.clamp_min(_IN), likely.clamp_max(_OUT)).float()

    @property
    def _colours(self) -> Tensor:
        return self._gaussians.colours.detach().cpu().double().clamp(0, 1)

    def _pointed_at(self, prompts: Sequence[VisiblePrompt], *, positive: bool) -> Tensor:
        """Rows of what pixels of one sign show most of, the most first."""
        mass = torch.zeros(len(self._gaussians), dtype=torch.float64)
        for prompt in prompts:
            rows = prompt.positive_rows if positive else prompt.negative_rows
            weights = rows.weights.detach().cpu().double()
            sure = weights >= min(_POINTED_AT, float(weights.max()) if len(weights) else 0.0)
            mass.index_add_(0, rows.ids.long().cpu()[sure], weights[sure])
        return torch.argsort(mass, descending=True, stable=True)[: int((mass > 0).sum())]

    def _nearest(self, values: Tensor, rows: Tensor) -> Tensor:
        """Distance of each Gaussian's values to the nearest of some rows."""
        return torch.cdist(values, values[rows[:_MAX_SEEDS]]).amin(dim=1)

    def _connected(self, candidates: Tensor, seeds: Tensor) -> Tensor:
        rows = torch.nonzero(candidates).squeeze(1)
        position = torch.full((len(candidates),), -1, dtype=torch.int64)
        position[rows] = torch.arange(len(rows))
        edges = self._neighbours.graph.edges(rows)
        linked = edges.touching & (position[edges.second] >= 0)
        piece_of = pieces(len(rows), edges.first[linked], position[edges.second[linked]])
        reached = torch.isin(piece_of, piece_of[position[seeds]])
        member = torch.zeros_like(candidates)
        member[rows[reached]] = True
        return member

    def _seen_within(self, view: View, inside: Tensor) -> Tensor:
        """Which Gaussians have their centre where a box or a mask allows the thing to be."""
        shown, camera = self._views.shown(view), view.camera
        pixels, depth = camera.project(shown.gaussians.means.detach().cpu().double())
        x, y = pixels.floor().long().unbind(dim=1)
        there = (depth > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        found = torch.zeros(len(shown), dtype=torch.bool)
        found[there] = inside.cpu()[y[there], x[there]]
        return shown.rows_before(found, len(self._gaussians))
