r"""Words to masks in the initial views: by recorded features and masks, or by a grounding model.

`MaskAnswers` asks every recorded mask. Its feature is told apart from its neighbours', those of one
thing in several views are averaged, and words are compared with them in their span, each held
against what else a thing could be (`lift.words`).

`CellAnswers` is the plain way. In each view alone, the relevancy of a word in the cells of the
feature map (`lift.relevancy`) has its maximum at some cell; the region is what hangs together with
it above the middle between the maximum and the median. The recorded mask with the best IoU with the
region is taken.

`GroundedAnswers` asks a model, such as LangSAM (Grounding DINO and SAM), as published: of its masks
the surest of each view.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from splatseg.core import FeatureSource, Gaussians, MaskSet, View
from splatseg.core.models import GroundedMasks, Image
from splatseg.errors import InputError
from splatseg.lift.vocabulary import Vocabulary, relevancy
from splatseg.lift.voting.features import checked_grid
from splatseg.lift.voting.segment_masses import view_masses
from splatseg.lift.words import (
    WordAnswers,
    answer_phrases,
    answer_words,
    context_of,
    word_span,
)
from splatseg.methods.prompt._groups import (
    FoundObject,
    MaskGroups,
    answering,
    mask_groups,
)
from splatseg.methods.prompt._linked import linked
from splatseg.methods.prompt._options import PromptOptions
from splatseg.methods.prompt._table import MaskTable, mask_overlaps
from splatseg.render import prepare

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


class MaskAnswers:
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
            tau = self._options.answers.temperature
            scores, probabilities = answer_phrases(
                answers,
                lambda: looks,
                self._vocabulary,
                lambda part: self._asked(part).probabilities[:, 0],
                temperature=tau,
            )
            answers = replace(answers, cosines=scores / tau, probabilities=probabilities)
        return answering(
            self._table,
            self._groups,
            answers,
            several=self._options.objects == "all",
            least=self._options.least_probability,
        )

    def _asked(self, word: str) -> WordAnswers:
        """What each group answers to a word, or a phrase as a whole."""
        return answer_words(
            self._groups.values,
            [word],
            self._vocabulary,
            self._span,
            options=self._options.answers,
        )


class CellAnswers:
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
        least = max(self._options.least_probability, _BETTER)
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


class GroundedAnswers:
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
        least = self._options.least_probability
        sure = [i for i in range(len(found)) if float(found.scores[i]) >= least]
        sure.sort(key=lambda i: (-float(found.scores[i]), i))
        if self._options.objects == "one":
            sure = sure[:1]
        return MaskSet(
            height=view.camera.height,
            width=view.camera.width,
            masks=tuple(found.masks[i] for i in sure),
            scores=found.scores[sure],
            levels=found.levels[sure],
        )


def image_of(gaussians: Gaussians, view: View, backend: str) -> Image:
    """The photograph of a view, or its render where it has none."""
    if view.image is not None:
        return view.read_image()
    with prepare(gaussians, view.camera, backend=backend) as prepared, torch.no_grad():
        colour = prepared.render().image
    return (colour.cpu().clamp(0, 1) * 255 + 0.5).to(torch.uint8)
