"""Words to masks in the initial views: by recorded features and masks, or by a grounding model.

`MaskMatches` asks every recorded mask. Its feature is told apart from its neighbours', those of one
thing in several views are averaged, and words are compared with them in their span, each held
against what else a thing could be (`lift.words`).

`CellMatches` is the plain way. In each view alone, the relevancy of a word in the cells of the
feature map (`lift.relevancy`) has its maximum at some cell; the region is what hangs together with
it above the middle between the maximum and the median. The recorded mask with the best IoU with the
region is taken.

`GroundedMatches` asks a model, such as LangSAM (Grounding DINO and SAM), as published: of its masks
the surest of each view.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import FeatureSource, Gaussians, MaskSet, Rle, View
from splatseg.core.models import GroundedMasks, Image
from splatseg.errors import InputError
from splatseg.lift.phrases import match_phrases
from splatseg.lift.vocabulary import Vocabulary, relevancy
from splatseg.lift.voting.features import checked_grid
from splatseg.lift.voting.segment_masses import view_masses
from splatseg.lift.words import TEMPERATURE, WordMatches, context_of, match_words, word_span
from splatseg.methods.prompt.masks import MaskTable, image_of, mask_overlaps
from splatseg.methods.prompt.options import PromptOptions

SAME = 0.2
"""IoU from which on masks of two views are of one thing."""


def linked(
    views: Sequence[int], iou: Float[Tensor, "m m"], scores: Sequence[float]
) -> list[list[int]]:
    """Masks joined to objects: those of two views that are of one thing, of each view one.

    Args:
        views: The view of each mask.
        iou: Of all pairs.
        scores: How sure each is; objects come in the order of their surest mask.
    """
    free = set(range(len(views)))
    objects: list[list[int]] = []
    for seed in sorted(range(len(views)), key=lambda one: (-scores[one], one)):
        if seed not in free:
            continue
        free.discard(seed)
        members = [seed]
        for view in sorted(set(views) - {views[seed]}):
            rivals = [one for one in sorted(free) if views[one] == view]
            best = max(rivals, key=lambda one: (float(iou[seed, one]), -one), default=None)
            if best is not None and float(iou[seed, best]) >= SAME:
                members.append(best)
                free.discard(best)
        objects.append(sorted(members, key=lambda one: views[one]))
    return objects


_FULL_CELLS = 50.0
"""Cells from which on a mask counts fully in the mean over views."""

_AS_GOOD = 0.02
"""How much less the cosine of a whole may be than that of its part, for the whole to be meant. The
feature of a part is that of the thing, often a little purer, as cells at the rim hold other things;
what only stands around it differs by far more."""

_INSIDE = 0.5
"""Share of a mask in another from which on it is not another object."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoundObject:
    """What answers to a word: masks in some of the initial views."""

    word: str
    probability: float
    """That the word means it, in [0, 1]."""

    masks: tuple[tuple[View, Rle], ...]
    """At least one; at most one of each view."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaskGroups:
    """One group a mask: it, and its match in every other view that has one."""

    members: Int64[Tensor, "m views"]
    """Rows of the table, -1 where a view has no match."""

    values: Float[Tensor, "m channels"]
    """Mean feature of the members."""

    weights: Float[Tensor, "m"]
    """Cells of the members, each counted to a limit."""


def mask_groups(table: MaskTable) -> MaskGroups:
    """The groups of all masks."""
    count = len(table)
    members = torch.full((count, len(table.views)), -1, dtype=torch.int64)
    for at in range(len(table.views)):
        of_view = torch.nonzero(table.view == at).squeeze(1)
        if not len(of_view):
            continue
        best, column = table.iou[:, of_view].max(dim=1)
        members[:, at] = torch.where(best >= SAME, of_view[column], -1)
    members[torch.arange(count), table.view] = torch.arange(count)
    counted = table.cells.clamp_max(_FULL_CELLS).double()
    weights = torch.where(members >= 0, counted[members.clamp_min(0)], 0.0)
    values = (weights[:, :, None] * table.values.double()[members.clamp_min(0)]).sum(dim=1)
    total = weights.sum(dim=1)
    return MaskGroups(
        members=members, values=(values / total[:, None]).float(), weights=total.float()
    )


def answering(
    table: MaskTable,
    groups: MaskGroups,
    answers: WordMatches,
    *,
    several: bool,
    least: float,
) -> list[FoundObject]:
    """The groups that answer to a word, the surest first, none inside another.

    One object is the group of the largest cosine: a phrase says which of several alike things is
    meant, and the names of their class, which probabilities hold against it, say nothing of that.
    Where that lies in others that answer as well it is the largest of them: a thing, not its part.

    Args:
        table: The masks.
        groups: One a mask.
        answers: What each answers to one word.
        several: Whether all that answer are wanted; else one.
        least: Probability from which on one answers.
    """
    probabilities, word = answers.probabilities[:, 0], answers.words[0]
    order = torch.argsort(
        probabilities if several else answers.cosines[:, 0], descending=True, stable=True
    )
    if not several and len(order):
        whole = _whole(table, answers, int(order[0]), least)
        order = torch.cat([torch.tensor([whole]), order])
    found: list[FoundObject] = []
    taken = torch.zeros(len(table), dtype=torch.bool)
    for row in order.tolist():
        if float(probabilities[row]) < least or (found and not several):
            break
        if bool(taken[row]):
            continue
        members = [int(one) for one in groups.members[row].tolist() if one >= 0]
        taken |= _of_same(table, members)
        found.append(
            FoundObject(
                word=word,
                probability=float(probabilities[row]),
                masks=tuple((table.views[int(table.view[one])], table.rle(one)) for one in members),
            )
        )
    return found


def _whole(table: MaskTable, answers: WordMatches, best: int, least: float) -> int:
    """The row of the largest mask that holds one, and answers as well."""
    cosines, probabilities = answers.cosines[:, 0], answers.probabilities[:, 0]
    near = (cosines >= cosines[best] - _AS_GOOD) & (probabilities >= least)
    near &= table.contained[best] >= _INSIDE
    near[best] = True
    return int(torch.where(near, table.cells, -1.0).argmax())


def _of_same(table: MaskTable, members: Sequence[int]) -> Bool[Tensor, "m"]:
    """Masks that lie in one of some masks, or around it, or are members."""
    rows = torch.tensor(members)
    inside = (table.contained[:, rows] >= _INSIDE).any(dim=1)
    around = (table.contained[rows] >= _INSIDE).any(dim=0)
    inside[rows] = True
    return inside | around


_BETTER = 0.5
"""Relevancy above which a word fits better than every negative."""


class WordAnswering(Protocol):
    """Finds what words mean in the initial views."""

    @property
    def calls(self) -> int:
        """How often a model was asked so far."""
        ...

    def find(self, word: str) -> list[FoundObject]:
        """Objects that answer to a word, the surest first; none where nothing does."""
        ...


class MaskMatches:
    """Words asked of every mask.

    Args:
        table: The masks of the initial views.
        vocabulary: Vectors of words.
        options: How many objects are wanted, and how sure is sure.
    """

    calls = 0

    def __init__(self, table: MaskTable, vocabulary: Vocabulary, options: PromptOptions) -> None:
        self._table, self._vocabulary, self._options = table, vocabulary, options
        self._groups: MaskGroups = mask_groups(table)
        self._span = word_span(self._groups.values, self._groups.weights, vocabulary.space)

    def find(self, word: str) -> list[FoundObject]:
        """Objects that answer to a word."""
        answers = self._asked(word)
        looks = self._table.looks
        if self._options.phrases == "parts" and looks is not None:
            scores, probabilities = match_phrases(
                answers,
                lambda: looks,
                self._vocabulary,
                lambda part: self._asked(part).probabilities[:, 0],
            )
            answers = replace(answers, cosines=scores / TEMPERATURE, probabilities=probabilities)
        return answering(
            self._table,
            self._groups,
            answers,
            several=self._options.objects == "all",
            least=self._options.probability_limit,
        )

    def _asked(self, word: str) -> WordMatches:
        """What each group answers to a word, or a phrase as a whole."""
        return match_words(
            self._groups.values,
            [word],
            self._vocabulary,
            self._span,
        )


class CellMatches:
    """Words asked of the cells of the feature maps, in each view alone.

    Args:
        table: The masks of the initial views.
        features: Their feature maps.
        vocabulary: Vectors of words.
        options: How many objects are wanted, and how sure is sure.
    """

    calls = 0

    def __init__(
        self,
        table: MaskTable,
        features: FeatureSource,
        vocabulary: Vocabulary,
        options: PromptOptions,
    ) -> None:
        self._table, self._vocabulary, self._options = table, vocabulary, options
        self._grids = [checked_grid(view, features.features(view.name)) for view in table.views]
        self._negatives = vocabulary.vectors(vocabulary.negatives or context_of(vocabulary))

    def find(self, word: str) -> list[FoundObject]:
        """Objects that answer to a word: of one all views' masks, of several those that match."""
        several = self._options.objects == "all"
        rows: list[int] = []
        scores: list[float] = []
        for at in range(len(self._table.views)):
            regions = self._regions(word, at)
            for score, region in regions if several else regions[:1]:
                row = self._covering(at, region)
                if row is not None and row not in rows:
                    rows.append(row)
                    scores.append(score)
        if not rows:
            return []
        of_view = [int(self._table.view[row]) for row in rows]
        chosen = torch.tensor(rows)
        objects = [list(range(len(rows)))]
        if several:
            objects = linked(of_view, self._table.iou[chosen][:, chosen], scores)
        return [
            FoundObject(
                word=word,
                probability=max(scores[one] for one in members),
                masks=tuple(
                    (self._table.views[of_view[one]], self._table.rle(rows[one])) for one in members
                ),
            )
            for members in objects
        ]

    def _regions(self, word: str, at: int) -> list[tuple[float, Bool[Tensor, "h w"]]]:
        """Connected regions of a view that answer, in its pixels, with their maxima."""
        import cv2

        grid = self._grids[at]
        space = self._vocabulary.space
        values = grid.features.float()
        found = relevancy(
            space.cosines(values, self._vocabulary.vectors([word])),
            space.cosines(values, self._negatives),
        )[..., 0]
        limit = max(float((found.max() + found.median()) / 2), _BETTER)
        least = max(self._options.probability_limit, _BETTER)
        count, pieces = cv2.connectedComponents((found >= limit).numpy().astype(np.uint8))
        peaks = [
            (float(found[torch.from_numpy(pieces == one)].max()), one) for one in range(1, count)
        ]
        camera = self._table.views[at].camera
        regions: list[tuple[float, Tensor]] = []
        for peak, one in sorted(peaks, key=lambda pair: (-pair[0], pair[1])):
            if peak <= least:
                break
            cells = torch.from_numpy(pieces == one)
            pixels = cells.repeat_interleave(grid.stride, 0).repeat_interleave(grid.stride, 1)
            whole = torch.zeros(camera.height, camera.width, dtype=torch.bool)
            part = pixels[: camera.height, : camera.width]
            whole[: part.shape[0], : part.shape[1]] = part
            regions.append((peak, whole))
        return regions

    def _covering(self, at: int, region: Bool[Tensor, "h w"]) -> int | None:
        """The row of the mask with the best IoU with a region; None where no mask meets it."""
        best, found = 0.0, None
        for row in torch.nonzero(self._table.view == at).squeeze(1).tolist():
            mask = self._table.rle(row).decode()
            overlap = int((mask & region).sum()) / max(int((mask | region).sum()), 1)
            if overlap > best:
                best, found = overlap, int(row)
        return found


class GroundedMatches:
    """Words asked of a model that sees the photographs of the initial views.

    Args:
        gaussians: The Gaussians, which tell what is one thing in two views.
        views: The initial views; those without a photograph are rendered.
        model: Who finds words.
        options: How many objects are wanted, and how sure is sure.
        backend: Name of the rendering backend.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        model: GroundedMasks,
        options: PromptOptions,
        *,
        backend: str = "auto",
    ) -> None:
        self._gaussians, self._views, self._model = gaussians, tuple(views), model
        self._options, self._backend = options, backend
        self._images: dict[str, Image] = {}
        self.calls = 0

    def find(self, word: str) -> list[FoundObject]:
        """Objects that answer to a word: of one the surest mask of each view."""
        sets = [self._asked(word, view) for view in self._views]
        rows = [(at, index) for at, found in enumerate(sets) for index in range(len(found))]
        if not rows:
            return []
        scores = [float(sets[at].scores[index]) for at, index in rows]
        objects = [list(range(len(rows)))]
        if self._options.objects == "all":
            held = [
                view_masses(self._gaussians, view.camera, found, backend=self._backend)
                for view, found in zip(self._views, sets, strict=True)
            ]
            iou, _ = mask_overlaps(held, rows, len(self._gaussians))
            objects = linked([at for at, _ in rows], iou, scores)
        return [
            FoundObject(
                word=word,
                probability=max(scores[one] for one in members),
                masks=tuple(
                    (self._views[rows[one][0]], sets[rows[one][0]].masks[rows[one][1]])
                    for one in members
                ),
            )
            for members in objects
        ]

    def _asked(self, word: str, view: View) -> MaskSet:
        """The masks of a view that are sure enough, the surest first; of one object that alone."""
        if view.name not in self._images:
            self._images[view.name] = image_of(self._gaussians, view, self._backend)
        self.calls += 1
        found = self._model.grounded_masks(self._images[view.name], [word]).masks
        if len(found) and (found.height, found.width) != (view.camera.height, view.camera.width):
            raise InputError(
                f"grounder: expected masks of {view.camera.width}x{view.camera.height} pixels, "
                f"got {found.width}x{found.height}."
            )
        least = self._options.probability_limit
        sure = [i for i in range(len(found)) if float(found.scores[i]) >= least]
        sure.sort(key=lambda i: (-float(found.scores[i]), i))
        if self._options.objects == "one":
            sure = sure[:1]
        return found.subset(sure)
