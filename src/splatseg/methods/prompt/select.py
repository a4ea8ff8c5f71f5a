r"""Objects found in some views become shares of Gaussians: points, masks of views, votes.

Views are gone through once for all objects, each prepared once.

With :math:`L_{ij} = [P_j \mu_i \in m_j]` (Prompt SA-GS, eq. 7) the share of a Gaussian is

.. math:: s_i = \frac{1}{N} \sum_j L_{ij} \quad \text{(published, eq. 8)}, \qquad
          s_i = \frac{\sum_j v_{ij} L_{ij}}{\sum_j v_{ij}} \quad \text{(visible)}, \qquad
          s_i = \frac{\sum_j (W_j^\top m_j)_i}{\sum_j (W_j^\top 1)_i} \quad \text{(transposed)}

with :math:`v_{ij} = 1` where view j has the centre of Gaussian i in its picture, and nothing that
is rendered hides it. Published, a view that does not see a Gaussian votes against it, and one that
sees the object through it votes for it. Views without a mask of the object vote when published
only: against.

Of a Gaussian that hardly shows in the views that vote, such as one in the corner of a single mask,
little is known. Where its transposed share is above tau it takes the mean share of its neighbours
that show well: specks go, and the backs of things stay.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core import Gaussians, Prompt, Rle, View
from splatseg.methods.prompt.masks import PromptedMasks
from splatseg.methods.prompt.options import PromptOptions, VoteRule
from splatseg.methods.prompt.views import (
    lifted,
    neighbouring_points,
    points_inside,
    projected_views,
    seed_of,
)
from splatseg.methods.prompt.words import FoundObject
from splatseg.methods.vote import centres_in, unoccluded
from splatseg.neighbours import NeighbourIndex
from splatseg.render import PreparedView, RenderOptions, SparseImage, options_for, prepare

POINTS, NEGATIVES = 2, 4
"""Points taken in each initial mask, and around it; around it none of random ones."""

DEPTH_TOLERANCE = 0.05
"""How far behind the rendered median depth a point may lie, as a part of that depth."""

MIN_VISIBILITY = 0.2
"""With transposed votes: light in the views that vote, in shares of that of the median Gaussian of
the object, below which one of it takes the share of its neighbours instead."""

_STEEPNESS = 20.0
_MOSTLY = 0.5
_NEIGHBOURS = 8


class MaskVotes:
    """Sums the votes for some objects, view after view.

    Args:
        gaussians: The Gaussians of the scene.
        objects: How many objects there are.
        rule: How views vote.
        render_options: Switches of the blending model.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        objects: int,
        *,
        rule: VoteRule,
        render_options: RenderOptions,
    ) -> None:
        self._gaussians, self._rule, self._options = gaussians, rule, render_options
        self._inside = torch.zeros(objects, len(gaussians))
        self._total = torch.zeros(objects, 1 if rule == "published" else len(gaussians))

    def add_views(self, counts: Sequence[int]) -> None:
        """How many views there are for each object, which the published rule divides by."""
        if self._rule == "published":
            self._total += torch.tensor(counts, dtype=torch.float32)[:, None]

    def add(self, view: View, prepared: PreparedView, masks: Sequence[tuple[int, Rle]]) -> None:
        """Add what the masks of a view say.

        Args:
            view: The view.
            prepared: The same, prepared.
            masks: Object and mask.
        """
        if not masks:
            return
        if self._rule == "transposed":
            self._add_transposed(prepared, masks)
            return
        centres = centres_in(self._gaussians.means, view.camera, near=self._options.near)
        if self._rule == "visible":
            seen = unoccluded(centres, self._gaussians, prepared, tolerance=DEPTH_TOLERANCE)
            centres = centres[seen]
        column, row = centres.pixels.unbind(dim=1)
        for at, mask in masks:
            self._inside[at, centres.gaussians] += mask.decode()[row, column].float()
            if self._rule == "visible":
                self._total[at, centres.gaussians] += 1

    def _add_transposed(self, prepared: PreparedView, masks: Sequence[tuple[int, Rle]]) -> None:
        pixels = torch.stack([mask.decode().reshape(-1) for _, mask in masks], dim=1)
        channel = torch.nonzero(pixels)[:, 1].to(torch.int32)
        starts = torch.cat((torch.zeros(1, dtype=torch.int64), pixels.sum(dim=1).cumsum(0)))
        image = SparseImage(
            indptr=starts, channels=channel, values=torch.ones(len(channel)), count=len(masks)
        )
        with torch.no_grad():
            found = prepared.back_project_sparse(image)
        objects = torch.tensor([at for at, _ in masks])
        # A Gaussian has each channel at most once.
        self._inside[objects[found.channels.long()], found.gaussians] += found.sums
        self._total[objects] += found.weights

    def shares(self, tau: float) -> Float[Tensor, "objects n"]:
        """Of each object and Gaussian, in [0, 1]; 0 where no view votes.

        Args:
            tau: Share above which a Gaussian is of an object.
        """
        # Sums of half precision weights may leave a share a hair above 1.
        found = (self._inside / self._total.clamp_min(1e-12)).clamp(0, 1)
        if self._rule == "transposed":
            for share, light in zip(found, self._total, strict=True):
                share.copy_(self._mended(share, light, tau))
        return found

    def _mended(
        self, share: Float[Tensor, "n"], light: Float[Tensor, "n"], tau: float
    ) -> Float[Tensor, "n"]:
        """With the shares of neighbours for Gaussians that hardly show."""
        inside = share > _MOSTLY
        if not bool(inside.any()):
            return share
        shows = (light > 0) & (light >= MIN_VISIBILITY * light[inside].median())
        faint = torch.nonzero((share > tau) & ~shows).squeeze(1)
        if not len(faint):
            return share
        known = torch.nonzero(shows).squeeze(1)
        means = self._gaussians.means.detach().cpu().double()
        near = NeighbourIndex(means[known]).nearest(means[faint], min(_NEIGHBOURS, len(known)))
        mended = share.clone()
        mended[faint] = share[known[near.indices.long()]].mean(dim=1)
        return mended


def confidence_of(shares: Float[Tensor, "*batch"], tau: float) -> Float[Tensor, "*batch"]:
    r"""Probabilities :math:`\sigma(20 (s - \tau))`: above 0.5 where a share is above tau.

    Selections are rendered softly, and a probability that is as flat as the share itself draws a
    soft rim: it costs 1.5 points of IoU beside a hard one.

    Args:
        shares: In [0, 1].
        tau: In [0, 1].
    """
    # In double, and with the least float above one half: what is above tau by a rounding is inside.
    found = torch.sigmoid(_STEEPNESS * (shares.double() - tau)).float()
    least = 0.5 + torch.finfo(torch.float32).eps
    return torch.where(shares > tau, found.clamp(least, 1.0), found.clamp(0.0, 0.5))


_LIGHT = 0.5
"""Share of the light of a pixel that is of an object from which on it shows the object."""

_MIN_PIXELS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WorldPrompt:
    """What is shown of an object, as points of the world."""

    key: str
    """Word and rank, or the points by hand: what random choices are seeded by."""

    points: Float[Tensor, "k 3"]
    """float64."""

    positive: Bool[Tensor, "k"]
    """Whether each is on the object."""

    size: float | None = None
    """Area that it would cover at a depth of 1, in squares of the focal length; None where nobody
    knows."""

    def area_in(self, view: View) -> float | None:
        """Pixels that it covers in a view, as far as its distance tells."""
        if self.size is None:
            return None
        camera = view.camera
        _, depth = camera.project(self.points[self.positive])
        before = depth[depth > 0]
        if not len(before):
            return None
        return self.size * camera.fx * camera.fy / float(before.mean()) ** 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PromptShares:
    """What views say of some objects."""

    shares: Float[Tensor, "objects n"]
    """Share of each Gaussian, in [0, 1], see `MaskVotes`."""

    projected: tuple[int, ...]
    """How many views the points of each object were projected into."""

    masks: tuple[tuple[tuple[View, Rle], ...], ...]
    """Of each object, the views that had a mask of it, with the mask of the last round."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewPoints:
    """Points of an object in one view."""

    view: View
    pixels: Float[Tensor, "p 2"]
    """x and y."""

    positive: Bool[Tensor, "p"]
    """Whether each is on the object."""

    area: int | None = None
    """Pixels of the object in the view; None where nobody knows."""


def sampled_points(
    found: FoundObject, key: str, options: PromptOptions, *, seed: int
) -> list[ViewPoints]:
    """Points inside and around the masks of an object."""
    points: list[ViewPoints] = []
    for view, rle in found.masks:
        generator = torch.Generator().manual_seed(seed_of(seed, f"{key}:{view.name}"))
        mask = rle.decode()
        inside = points_inside(mask, POINTS, how=options.sampling, generator=generator)
        around = neighbouring_points(mask, NEGATIVES if options.sampling == "inside" else 0)
        signs = torch.arange(len(inside) + len(around)) < len(inside)
        pixels = torch.cat((inside, around))
        points.append(ViewPoints(view=view, pixels=pixels, positive=signs, area=rle.area))
    return points


def world_prompts(
    gaussians: Gaussians,
    given: Sequence[tuple[str, Sequence[ViewPoints]]],
    options: PromptOptions,
    *,
    backend: str,
) -> list[WorldPrompt]:
    """Points of views as points of the world, each view prepared once.

    Args:
        gaussians: The Gaussians of the scene.
        given: Objects by key, with their points.
        options: How points are lifted.
        backend: Name of the rendering backend.
    """
    views = {one.view.name: one.view for _, points in given for one in points}
    parts: list[list[tuple[Tensor, Tensor]]] = [[] for _ in given]
    sizes: list[list[float]] = [[] for _ in given]
    for name in sorted(views):
        here = [
            (at, one)
            for at, (_, points) in enumerate(given)
            for one in points
            if one.view.name == name and len(one.pixels)
        ]
        if not here:
            continue
        with prepare(gaussians, views[name].camera, backend=backend) as prepared:
            world, gaussian = lifted(
                views[name],
                prepared,
                gaussians,
                torch.cat([one.pixels for _, one in here]),
                how=options.lifting,
            )
        start = 0
        for at, one in here:
            part = slice(start, start + len(one.pixels))
            known = gaussian[part] >= 0
            parts[at].append((world[part][known], one.positive[known]))
            sizes[at] += _size(one, world[part][known & one.positive])
            start += len(one.pixels)
    nothing = (torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.bool))
    return [
        WorldPrompt(
            key=key,
            points=torch.cat([nothing[0], *(points for points, _ in parts[at])]),
            positive=torch.cat([nothing[1], *(signs for _, signs in parts[at])]),
            size=float(torch.tensor(sizes[at]).median()) if sizes[at] else None,
        )
        for at, (key, _) in enumerate(given)
    ]


def _size(points: ViewPoints, world: Tensor) -> list[float]:
    """Area at a depth of 1, where the area in the view and a depth are known."""
    if points.area is None or not len(world):
        return []
    camera = points.view.camera
    _, depth = camera.project(world)
    return [points.area * float(depth.mean()) ** 2 / (camera.fx * camera.fy)]


def vote_for(
    gaussians: Gaussians,
    views: Sequence[View],
    prompts: Sequence[WorldPrompt],
    makers: PromptedMasks,
    options: PromptOptions,
    *,
    seed: int,
    backend: str,
    progress: Callable[[int, int], None] | None = None,
) -> PromptShares:
    """Project points into views, have masks made of them, and let these vote.

    Args:
        gaussians: The Gaussians of the scene.
        views: All views that may be used.
        prompts: The objects.
        makers: Makes masks of points.
        options: How.
        seed: Of random choices.
        backend: Name of the rendering backend.
        progress: Called with the views done and all there are.
    """
    chosen = _views_of(views, prompts, options, seed)
    shares: Tensor | None = None
    masks: list[list[tuple[View, Rle]]] = [[] for _ in prompts]
    ordered = [view for view in views if any(view.name in names for names in chosen)]
    ordered.sort(key=lambda view: view.name)
    for turn in range(options.rounds):
        votes = MaskVotes(
            gaussians,
            len(prompts),
            rule=options.vote,
            render_options=options_for(gaussians, backend),
        )
        votes.add_views([len(one) for one in chosen])
        before, masks = masks, [[] for _ in prompts]
        inside = None if shares is None else (shares > options.tau).float().T.contiguous()
        for done, view in enumerate(ordered):
            objects = [at for at, names in enumerate(chosen) if view.name in names]
            with prepare(gaussians, view.camera, backend=backend) as prepared:
                if inside is None:
                    shown = _shown(view, prepared, gaussians, prompts, objects, options=options)
                else:
                    shown = _rendered(prepared, inside, objects)
                made = _made(view, shown, prompts, makers)
                votes.add(view, prepared, made)
            for at, mask in made:
                masks[at].append((view, mask))
            if progress is not None:
                progress(turn * len(ordered) + done + 1, options.rounds * len(ordered))
        found = votes.shares(options.tau)
        # What no mask overlaps by half keeps what the round before gave.
        lost = torch.tensor([not one for one in masks])
        masks = [one or old for one, old in zip(masks, before, strict=True)]
        shares = found if shares is None else torch.where(lost[:, None], shares, found)
    return PromptShares(
        shares=torch.zeros(len(prompts), len(gaussians)) if shares is None else shares,
        projected=tuple(len(one) for one in chosen),
        masks=tuple(tuple(one) for one in masks),
    )


def _views_of(
    views: Sequence[View], prompts: Sequence[WorldPrompt], options: PromptOptions, seed: int
) -> list[set[str]]:
    """Names of the views that each object is projected into."""
    chosen: list[set[str]] = []
    for prompt in prompts:
        of_object: tuple[View, ...] = ()
        if bool(prompt.positive.any()):
            of_object = projected_views(
                views,
                prompt.points[prompt.positive],
                share=options.view_share,
                how=options.sampling,
                seed=seed_of(seed, prompt.key),
            )
        chosen.append({view.name for view in of_object})
    return chosen


def _shown(
    view: View,
    prepared: PreparedView,
    gaussians: Gaussians,
    prompts: Sequence[WorldPrompt],
    objects: Sequence[int],
    *,
    options: PromptOptions,
) -> dict[int, Prompt]:
    """The points of each object that a view shows, of those with a positive one."""
    found: dict[int, Prompt] = {}
    size = torch.tensor([view.camera.width, view.camera.height])
    for at in objects:
        pixels, depth = view.camera.project(prompts[at].points)
        kept = (depth > 0) & ((pixels >= 0) & (pixels < size)).all(dim=1)
        if options.sampling == "inside" and bool(kept.any()):
            rows = torch.nonzero(kept).squeeze(1)
            surface = _median_depth(view, prepared, gaussians, pixels[rows])
            hidden = (surface > 0) & (depth[rows] > surface * (1 + DEPTH_TOLERANCE))
            kept[rows[hidden]] = False
        positive = prompts[at].positive[kept]
        if bool(positive.any()):
            found[at] = Prompt(points=pixels[kept].float(), positive=positive)
    return found


def _rendered(
    prepared: PreparedView, inside: Float[Tensor, "n objects"], objects: Sequence[int]
) -> dict[int, Prompt]:
    """What is selected of each object so far, as a mask of the view: most of the light."""
    with torch.no_grad():
        drawn = prepared.render(inside[:, list(objects)], warp="nearest").image.cpu() > _LIGHT
    return {
        at: Prompt(mask=drawn[..., place])
        for place, at in enumerate(objects)
        if int(drawn[..., place].sum()) >= _MIN_PIXELS
    }


def _median_depth(
    view: View, prepared: PreparedView, gaussians: Gaussians, pixels: Tensor
) -> Float[Tensor, "p"]:
    """Depth of the Gaussian at which half of the light is stopped; 0 where it never is."""
    median = prepared.contributors(pixels.floor().long(), 1).median.cpu().long()
    centres = gaussians.means.detach().cpu().double()[median.clamp_min(0)]
    _, depth = view.camera.project(centres)
    return torch.where(median >= 0, depth, 0.0)


def _made(
    view: View,
    shown: dict[int, Prompt],
    prompts: Sequence[WorldPrompt],
    makers: PromptedMasks,
) -> list[tuple[int, Rle]]:
    """The masks that were made in a view, by object."""
    objects = sorted(shown)
    areas = [prompts[at].area_in(view) for at in objects]
    masks = makers.masks(view, [shown[at] for at in objects], areas)
    return [(at, mask) for at, mask in zip(objects, masks, strict=True) if mask is not None]
