r"""A click carried from view to view: what it means without masks of all views beforehand.

**What is meant.** The Gaussians of the clicked pixel are found in a few more views that show them,
each from another side, and a promptable model is asked at their brightest pixel there. Masks of
different views that are alike become one meaning, and one of them is the object (`meanings`).

**What it covers.** Of the masks :math:`m_v` of a meaning in the views V, each Gaussian is a member
with the share of its light that is inside,

.. math:: p_i = \frac{\sum_{v \in V} (W_v^T m_v)_i}{\lambda + \sum_{v \in V} (W_v^T 1)_i},

which is drawn into the next view, :math:`W_v p / W_v k` with k = 1 for Gaussians that were seen
before. What is more than a half there is a rough mask, by which, and by the pixel farthest from its
rim, the model is prompted. Its mask counts where it agrees with what is known; what nobody saw
before may be in it or not. The next view is one that shows much of what belongs or is unsure, from
another side but not so far around that nothing known is visible. It ends when members stay the
same, or after eight views. At last the border is put where neighbours are least alike, by a
minimum cut (`graph_cut`), as GaussianCut does.

The loop is that of iSegMan (Zhao et al. 2025) and SAGD (Hu et al. 2024), the cut that of
GaussianCut (Jain et al. 2024); meanings, choice of views and agreement are ours.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core import MaskSet, PromptableMasks, View
from splatseg.core.models import Image, Prompt
from splatseg.errors import InputError
from splatseg.prompting.graph import graph_cut
from splatseg.prompting.meanings import Candidate, chosen_meaning, meanings_of
from splatseg.prompting.next_click import in_image, largest_region
from splatseg.prompting.pipeline import POINTED_AT, SceneIndex
from splatseg.prompting.seen import ViewCache, VisiblePrompt

MAX_VIEWS = 8
"""Most views that the model is asked in, those of the prompts included."""

_VOTING_VIEWS = 6
"""Of these, views that the clicked Gaussians are looked up in."""

_UNSEEN = 0.1
"""Lambda, in pixels: a Gaussian of which less was seen than this is none that is known."""

_MIN_KNOWN = 0.5
"""Share of a pixel's light from Gaussians that were seen before, with which it is known."""

_MIN_SEED = 0.3
"""Share of a pixel's light from Gaussians of the click, with which it shows them."""

_MIN_AGREEMENT = 0.5
"""Least IoU of the model's mask with what is known of the thing, over the pixels that are known."""

_MIN_PIXELS = 32
"""Fewer pixels of the thing in a view, and it is not asked there."""

_FULL_TURN, _MOST_TURN = 40.0, 75.0
"""Degrees about the thing from the nearest view that was looked at: more than the first is not
worth more, and from the second on little of what is visible is known."""

_FAR_WORTH = 0.25
"""What such a view is worth against one within."""

_STABLE = 0.02
"""Share of the members that a view changes at most where they stay the same."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LookedAt:
    """A view in which the model was asked."""

    view: str
    agreement: float
    """IoU of its mask with what was known; 1 in views that told what is meant."""

    accepted: bool
    """Whether a mask of it counted."""


@dataclass(slots=True, kw_only=True, eq=False)
class _Known:
    """What the masks so far say of each Gaussian."""

    inside: Float[Tensor, "n"]
    total: Float[Tensor, "n"]
    views: list[View] = field(default_factory=list[View])

    def add(self, view: View, inside: Float[Tensor, "n"], total: Float[Tensor, "n"]) -> None:
        """Count a view."""
        self.inside += inside
        self.total += total
        self.views.append(view)

    def shares(self) -> Float[Tensor, "n"]:
        """The share of each Gaussian's light that is inside."""
        return self.inside / (_UNSEEN + self.total)


class PropagatedMasks:
    """A source that asks a promptable model in a few views.

    Args:
        views: Views that it may look at.
        model: Gives masks at points, of what it is shown.
        cache: Prepared views of the Gaussians.
        neighbours: Their neighbours, for the border.
        image_of: The picture of a view, uint8 (H, W, 3).
        report: Is told of each view.
    """

    def __init__(
        self,
        views: Sequence[View],
        model: PromptableMasks,
        *,
        cache: ViewCache,
        neighbours: SceneIndex,
        image_of: Callable[[View], Image],
        report: Callable[[str], None] | None = None,
    ) -> None:
        self._views = tuple(views)
        self._model = model
        self._cache = cache
        self._means = cache.gaussians.means.detach().cpu().double()
        self._neighbours = neighbours
        self._image_of = image_of
        self._report = report
        self.unseen: torch.Tensor | None = None
        """(n,): Gaussians that no view of the last selection showed."""
        self.looked_at: tuple[LookedAt, ...] = ()
        """Views of the last selection, in order."""

    def membership(
        self, prompts: Sequence[VisiblePrompt], *, granularity: float | None
    ) -> Float[Tensor, "n"]:
        """See `MembershipSource`.

        Raises:
            InputError: If the model finds nothing at the prompts.
        """
        looked_at: list[LookedAt] = []
        known = self._given(prompts)
        if known is None:
            known = self._meant(prompts, granularity, looked_at)
        else:
            looked_at += [
                LookedAt(view=view.name, agreement=1.0, accepted=True) for view in known.views
            ]
        self._propagate(known, looked_at)
        self.unseen = known.total < _UNSEEN
        self.looked_at = tuple(looked_at)
        return self._with_border(known.shares(), prompts)

    def _empty(self) -> _Known:
        inside, total = torch.zeros(2, len(self._cache.gaussians))
        return _Known(inside=inside, total=total)

    def _given(self, prompts: Sequence[VisiblePrompt]) -> _Known | None:
        """What masks of prompts say; None where there is none."""
        known = self._empty()
        for one in prompts:
            if one.inside is not None and one.masked and one.view not in known.views:
                self._count(known, one.view, one.inside)
        return known if known.views else None

    def _meant(
        self,
        prompts: Sequence[VisiblePrompt],
        granularity: float | None,
        looked_at: list[LookedAt],
    ) -> _Known:
        """What points or boxes mean, by the model's masks in several views."""
        found: list[Candidate] = []
        asked: list[View] = []
        seed = self._seed(prompts)
        for one in prompts:
            if one.view not in asked:
                asked.append(one.view)
                here = [other for other in prompts if other.view is one.view]
                found += self._candidates(one.view, _prompt_of(here))
        left = [view for view in self._views if view not in asked]
        known = self._empty()
        known.add(asked[0], seed, torch.ones_like(seed))
        known.views[:] = asked
        while left and len(asked) < _VOTING_VIEWS:
            view = self._next(left, known.views, seed)
            if view is None:
                break
            left.remove(view)
            pixel = self._brightest(view, seed)
            if pixel is not None:
                asked.append(view)
                known.views.append(view)
                found += self._candidates(view, Prompt(points=torch.tensor([pixel])))
        if not found:
            raise InputError(
                f"prompter: expected a mask at the prompts in view {asked[0].name}, "
                f"{self._model.name} found none there, nor at the same place in "
                f"{len(asked) - 1} other views."
            )
        chosen = chosen_meaning(meanings_of(found), granularity, len(asked))
        known = self._empty()
        for one in chosen:
            known.add(one.view, one.inside, one.total)
        told = {one.view.name for one in chosen}
        looked_at += [
            LookedAt(view=view.name, agreement=1.0, accepted=view.name in told) for view in asked
        ]
        self._note(f"{len(told)} of {len(asked)} views show what is meant")
        return known

    def _candidates(self, view: View, prompt: Prompt) -> list[Candidate]:
        """The model's masks on the Gaussians."""
        found = self._model.prompted_masks(self._model.embed(self._image_of(view)), prompt)
        scores: list[float] = found.scores.tolist()
        if not scores:
            return []
        every, total = self._cache.mask_masses(view, found)
        return [
            Candidate(view=view, inside=inside, total=total, score=score)
            for inside, score in zip(every, scores, strict=True)
        ]

    def _count(self, known: _Known, view: View, mask: Bool[Tensor, "height width"]) -> None:
        """Add what a mask says."""
        (inside,), total = self._cache.mask_masses(view, MaskSet.from_dense(mask[None]))
        known.add(view, inside, total)

    def _seed(self, prompts: Sequence[VisiblePrompt]) -> Float[Tensor, "n"]:
        """Blending weights of the positive pixels."""
        seed = torch.zeros(len(self._cache.gaussians))
        for one in prompts:
            rows = one.positive_rows
            seed.index_add_(0, rows.ids.long().cpu(), rows.weights.float().cpu())
        return (seed / seed.max().clamp_min(1e-9)).clamp_max(1)

    def _brightest(self, view: View, seed: Tensor) -> tuple[float, float] | None:
        """The pixel that shows most of the clicked Gaussians; None where they are hidden."""
        drawn = self._drawn(view, seed[:, None])[..., 0]
        row, column = divmod(int(drawn.argmax()), drawn.shape[1])
        if float(drawn[row, column]) < _MIN_SEED:
            return None
        return (column + 0.5, row + 0.5)

    def _propagate(self, known: _Known, looked_at: list[LookedAt]) -> None:
        """Ask where masks are lacking, first in views that were looked at, then in further ones."""
        told = {view.name for view in known.views}
        again = [one.view for one in looked_at if one.view not in told]
        left = [view for view in self._views if view.name not in told]
        seen = {one.view: i for i, one in enumerate(looked_at)}
        unchanged = 0
        while left and unchanged < 2:
            repeated = [view for view in left if view.name in again]
            candidates = repeated or left
            if not repeated and len(looked_at) >= MAX_VIEWS:
                return
            shares = known.shares()
            weights = torch.where(shares > 0.1, shares + 4 * shares * (1 - shares), 0.0)
            view = self._next(candidates, known.views, weights)
            if view is None:
                return
            left.remove(view)
            rough = self._rough(view, known)
            if rough is None:
                continue
            mask, agreement = self._asked(view, *rough)
            accepted = mask is not None and agreement >= _MIN_AGREEMENT
            record = LookedAt(view=view.name, agreement=agreement, accepted=accepted)
            if view.name in seen:
                looked_at[seen[view.name]] = record
            else:
                looked_at.append(record)
            word = "counts" if accepted else "does not count"
            self._note(f"view {view.name}: IoU {agreement:.2f} with what is known, {word}")
            if not accepted or mask is None:
                continue
            before = shares > 0.5
            self._count(known, view, mask)
            after = known.shares() > 0.5
            same = int((before ^ after).sum()) <= _STABLE * int(after.sum())
            unchanged = unchanged + 1 if same else 0

    def _note(self, sentence: str) -> None:
        if self._report is not None:
            self._report(sentence)

    def _with_border(
        self, shares: Float[Tensor, "n"], prompts: Sequence[VisiblePrompt]
    ) -> Float[Tensor, "n"]:
        """The border where neighbours are least alike; what negative points show is out."""
        outside = torch.zeros(len(shares), dtype=torch.bool)
        for prompt in prompts:
            rows = prompt.negative_rows
            outside[rows.ids[rows.weights >= POINTED_AT].long().cpu()] = True
        none = torch.zeros(0, dtype=torch.int64)
        rows = torch.nonzero(outside).squeeze(1)
        return graph_cut(self._neighbours.graph, shares, inside=none, outside=rows)

    def _next(
        self, left: Sequence[View], used: Sequence[View], weights: Float[Tensor, "n"]
    ) -> View | None:
        """The view with most of the weight in its image, from another side."""
        means = self._means
        centre = (means * weights[:, None]).sum(0) / weights.sum().clamp_min(1e-9)
        seen = torch.stack([_towards(view, centre) for view in used])
        full = _pixels_a_unit(used[0], centre)
        best, best_worth = None, 0.0
        for view, share in zip(left, in_image(means, left, weights), strict=True):
            cosine = float((seen @ _towards(view, centre)).max().clamp(-1, 1))
            angle = float(np.degrees(np.arccos(cosine)))
            turn = min(angle, _FULL_TURN) if angle <= _MOST_TURN else _FAR_WORTH * _FULL_TURN
            size = min(1.0, _pixels_a_unit(view, centre) / full)
            worth = share * turn * size**2
            if worth > best_worth:
                best, best_worth = view, worth
        return best

    def _drawn(self, view: View, signal: Tensor) -> Float[Tensor, "height width channels"]:
        """``W @ signal`` of a view, signals of the Gaussians as they are without an edit."""
        shown = self._cache.shown(view)
        signal = signal[shown.rows.cpu()].to(self._cache.gaussians.device)
        with torch.no_grad():
            return self._cache.prepared(view).render(signal).image.cpu()

    def _rough(
        self, view: View, known: _Known
    ) -> tuple[Bool[Tensor, "height width"], Bool[Tensor, "height width"]] | None:
        """What is known of the thing in a view, and which pixels are known."""
        is_known = (known.total >= _UNSEEN).float()
        drawn = self._drawn(view, torch.stack((known.shares() * is_known, is_known), dim=1))
        covered = drawn[..., 1] >= _MIN_KNOWN
        inside = covered & (drawn[..., 0] > 0.5 * drawn[..., 1])
        return (inside, covered) if int(inside.sum()) >= _MIN_PIXELS else None

    def _asked(
        self, view: View, rough: Tensor, covered: Tensor
    ) -> tuple[Bool[Tensor, "height width"] | None, float]:
        """The model's mask that agrees best with what is known, and how well."""
        region = largest_region(rough.numpy(), np.ones(rough.shape))
        if region is None:
            return None, 0.0
        row, column = region.pixel
        prompt = Prompt(points=torch.tensor([[column + 0.5, row + 0.5]]), mask=rough)
        found = self._model.prompted_masks(self._model.embed(self._image_of(view)), prompt)
        return _closest(found, rough, covered)


def _prompt_of(prompts: Sequence[VisiblePrompt]) -> Prompt:
    """Points and box of a view, as a model takes them."""
    pixels = torch.cat([one.pixels for one in prompts if not one.dense] or [torch.zeros(0, 2)])
    signs = torch.cat(
        [one.positive.cpu() for one in prompts if not one.dense]
        or [torch.zeros(0, dtype=torch.bool)]
    )
    box = None
    for one in prompts:
        if one.inside is not None:
            rows, columns = one.inside.any(1).nonzero(), one.inside.any(0).nonzero()
            corners = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
            box = torch.tensor([float(corner) for corner in corners])
    return Prompt(points=pixels.float() + 0.5, positive=signs, box=box)


def _towards(view: View, centre: Tensor) -> Float[Tensor, "3"]:
    """The direction from a thing to a camera."""
    found = view.camera.centre.double().cpu() - centre
    return found / torch.linalg.vector_norm(found).clamp_min(1e-9)


def _pixels_a_unit(view: View, centre: Tensor) -> float:
    """How large a view shows a thing: pixels a unit of the scene."""
    camera = view.camera
    distance = float(torch.linalg.vector_norm(camera.centre.double().cpu() - centre))
    return max(camera.fx, camera.fy) / max(distance, 1e-9)


def _closest(
    found: MaskSet, rough: Tensor, covered: Tensor
) -> tuple[Bool[Tensor, "height width"] | None, float]:
    """The mask with the largest IoU with a rough one over the pixels that are covered."""
    best, best_iou = None, 0.0
    for i in range(len(found)):
        mask = found.dense(i)
        either = int(((mask & covered) | rough).sum())
        iou = int((mask & rough).sum()) / max(either, 1)
        if iou > best_iou:
            best, best_iou = mask, iou
    return best, best_iou
