r"""Uplift: label maps of many views, carried onto the Gaussians by the adjoint of rendering.

A pixel votes for its id on every Gaussian that it shows, with the weight it shows it with:

.. math:: v_{ic} = \sum_{views} \sum_p w_{pi} \, [\mathrm{id}(p) = c], \qquad
          \mathrm{share}_{ic} = \frac{v_{ic}}{\sum_{c'} v_{ic'}}

which is :math:`W^\top` of the one-hot label map, normalised by how much of the Gaussian the
voting pixels saw. The strongest id is the Gaussian's label and its share the confidence. Light
that passes every Gaussian votes alike for the label of what none covers, such as the sky:

.. math:: b_c = \sum_{views} \sum_p \Bigl(1 - \sum_i w_{pi}\Bigr) [\mathrm{id}(p) = c]
              = \sum_{views} \sum_p [\mathrm{id}(p) = c] - \sum_i v_{ic}

References:
    Marrie et al., LUDVIG: Learning-free Uplifting of 2D Visual features to Gaussian Splatting
    scenes (2024), eq. 4: the same normalised adjoint, for features.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import UNLABELLED, Camera, ClassTable, Gaussians, LabelMap, Labels, View
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.render import RenderOptions, back_project, options_for

_CHANNELS = 32
"""Ids that one back-projection carries; bounds the memory of one-hot images."""

_ROWS = 65536
"""Gaussians ranked at a time."""


class LabelSource(Protocol):
    """Label maps by view name, read when asked for: recorded evidence, or a dictionary's."""

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have a label map."""
        ...

    def label_map(self, name: str) -> LabelMap:
        """The label map of one view."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class UpliftOptions:
    """How votes become labels."""

    candidates: int = 1
    """Ids kept for each Gaussian. 1 makes a hard layer; with more the layer keeps their shares
    and is drawn softly."""

    min_weight: float = 0.0
    """Blending weight, summed over voting pixels, that a Gaussian must exceed to be labelled.
    One fully visible pixel counts 1."""

    min_share: float = 0.0
    """Least share of the votes, in [0, 1], that the winner needs; below it there is no label."""

    min_background: float = 1e-3
    """Least share of the light of all voting pixels, in [0, 1], that must pass the Gaussians
    for there to be a background label. A closed room has none."""

    min_background_share: float = 0.5
    """Least share of that light, in [0, 1], that the background label needs."""

    memory: int = 1 << 30
    """Bytes of the table of votes. With more ids than fit, the views are gone through again for
    each part of the ids; the result is the same."""

    def __post_init__(self) -> None:
        if self.candidates < 1:
            raise RangeError(f"candidates: expected at least 1, got {self.candidates}.")
        if not (math.isfinite(self.min_weight) and self.min_weight >= 0):
            raise RangeError(f"min_weight: expected 0 or more, got {self.min_weight}.")
        check_range("min_share", self.min_share, 0.0, 1.0)
        check_range("min_background", self.min_background, 0.0, 1.0)
        check_range("min_background_share", self.min_background_share, 0.0, 1.0)
        if self.memory < 1:
            raise RangeError(f"memory: expected at least 1 byte, got {self.memory}.")


def uplift(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    options: UpliftOptions | None = None,
    classes: ClassTable | None = None,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Labels:
    """Label Gaussians by the votes of label maps.

    A pixel at -1 casts no vote; a pixel whose label map has a confidence votes with it. Views
    with lens distortion vote through the nearest warp's transpose, each pixel on the Gaussians
    of the pinhole pixel that its centre falls into. Equal votes go to the smaller id.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those that vote: a method that is to be measured uses train views only.
        evidence: Their label maps, as large as the photographs or reduced in proportion.
        options: How votes become labels.
        classes: Names of the ids, for the metadata.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.
        progress: Called with the views done and all there are to do, over all passes.

    Returns:
        The layer. Gaussians that no voting pixel saw have the id -1 and confidence 0. The
        metadata holds the method, its options, the views and what the background rests on.

    Raises:
        InputError: If there are no views, if one has no label map, or no pixel has a label.
        ShapeError: If a label map does not have its photograph's proportions.
    """
    options = options or UpliftOptions()
    ballots = _read_ballots(views, evidence)
    ids = sorted({i for ballot in ballots for i in ballot.votes})
    if not ids:
        raise InputError(f"evidence: expected a labelled pixel in {len(views)} views, found none.")
    width = min(len(ids), max(1, options.memory // (4 * max(len(gaussians), 1))))
    parts = [ids[start : start + width] for start in range(0, len(ids), width)]
    engine = _Engine(gaussians, render_options or options_for(gaussians, backend), backend)
    ranking = _Ranking(len(gaussians), options.candidates)
    cast_by_id = torch.tensor(
        [sum(ballot.votes.get(i, 0.0) for ballot in ballots) for i in ids], dtype=torch.float64
    )
    caught_by_id: list[Tensor] = []
    done, total = 0, len(parts) * len(ballots)
    for part in parts:
        votes = torch.zeros(len(gaussians), len(part))
        for ballot in ballots:
            mine = [i for i in part if i in ballot.votes]
            if mine:
                paper = evidence.label_map(ballot.view.name)
                engine.cast(votes, part, mine, ballot.camera, paper)
            done += 1
            if progress is not None:
                progress(done, total)
        caught_by_id.append(votes.sum(dim=0, dtype=torch.float64))
        ranking.add(votes, part)
    # Rounding may leave a hair less than nothing.
    light = (cast_by_id - torch.cat(caught_by_id)).clamp_min(0)
    voting = float(cast_by_id.sum())
    background, share = _background(light, voting, ids, options)
    labels_ids, confidence, shares = ranking.result(options)
    soft = options.candidates > 1
    return Labels(
        ids=labels_ids,
        confidence=confidence,
        background=background,
        candidates=ranking.ids if soft else None,
        shares=shares if soft else None,
        metadata=_metadata(options, views, ids, classes, share),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Ballot:
    """A view that votes, with the camera of its label map's pixels and the votes for each id."""

    view: View
    camera: Camera
    votes: Mapping[int, float]


def _read_ballots(views: Sequence[View], evidence: LabelSource) -> list[_Ballot]:
    if not views:
        raise InputError("views: expected at least one view that votes, got none.")
    known = set(evidence.view_names)
    missing = [view.name for view in views if view.name not in known]
    if missing:
        raise InputError(
            f"evidence: expected a label map of every view that votes, {len(missing)} of "
            f"{len(views)} have none, the first is {missing[0]}."
        )
    ballots: list[_Ballot] = []
    for view in views:
        paper = evidence.label_map(view.name)
        ballots.append(
            _Ballot(
                view=view,
                camera=camera_of_map(view, paper.height, paper.width),
                votes=_votes_cast(paper),
            )
        )
    return ballots


def _votes_cast(paper: LabelMap) -> dict[int, float]:
    """How many pixels vote for each id, each with its confidence."""
    ids, place = torch.unique(paper.ids, return_inverse=True)
    weights = None if paper.confidence is None else paper.confidence.double().reshape(-1)
    counts = torch.bincount(place.reshape(-1), weights=weights, minlength=len(ids))
    pairs = zip(ids.tolist(), counts.tolist(), strict=True)
    return {int(id): float(count) for id, count in pairs if id != UNLABELLED}


def camera_of_map(view: View, height: int, width: int) -> Camera:
    """The camera of a map's pixels: the view's own, or reduced in proportion.

    Raises:
        ShapeError: If the map does not have the photograph's proportions.
    """
    camera = view.camera
    if (height, width) == (camera.height, camera.width):
        return camera
    # A reduced side may be off by the rounding of one pixel.
    across, down = width / camera.width, height / camera.height
    if abs(across - down) * max(camera.width, camera.height) > 1.0 + 1e-9:
        raise ShapeError(
            f"{view.name}: expected a map of {camera.width}x{camera.height} pixels or reduced in "
            f"proportion, got {width}x{height}."
        )
    return camera.resized(width, height)


class _Engine:
    """The adjoint of rendering, a few ids at a time."""

    def __init__(self, gaussians: Gaussians, options: RenderOptions, backend: str) -> None:
        self._gaussians = gaussians
        self._options = options
        self._backend = backend

    def cast(
        self,
        votes: Float[Tensor, "n ids"],
        ids: Sequence[int],
        mine: Sequence[int],
        camera: Camera,
        paper: LabelMap,
    ) -> None:
        """Add one view's votes for the ids in `mine` to the table, whose columns are `ids`."""
        for start in range(0, len(mine), _CHANNELS):
            part = list(mine[start : start + _CHANNELS])
            image = (paper.ids.unsqueeze(-1) == torch.tensor(part, dtype=torch.int32)).float()
            if paper.confidence is not None:
                image = image * paper.confidence.float().unsqueeze(-1)
            with torch.no_grad():
                sums = back_project(
                    self._gaussians,
                    camera,
                    image.to(self._gaussians.means),
                    options=self._options,
                    backend=self._backend,
                    warp="nearest",
                ).sums
            columns = torch.tensor([ids.index(i) for i in part])
            votes.index_add_(1, columns, sums.to(votes))


class _Ranking:
    """The strongest ids of each Gaussian so far, and the sum of all votes."""

    def __init__(self, count: int, candidates: int) -> None:
        self.ids: Int[Tensor, "n k"] = torch.full((count, candidates), UNLABELLED).int()
        self._votes = torch.zeros(count, candidates)
        self._total = torch.zeros(count)

    def add(self, votes: Float[Tensor, "n ids"], ids: Sequence[int]) -> None:
        """Take in the votes for further ids, larger than those before."""
        names = torch.tensor(ids, dtype=torch.int32)
        for rows in _row_blocks(len(votes)):
            block = votes[rows]
            self._total[rows] += block.sum(dim=1)
            # `max` takes the first of equals: what was ranked before, then the smaller id. So an
            # id without votes never wins: an empty slot without votes stands before it.
            table = torch.cat((self._votes[rows], block), dim=1)
            labels = torch.cat((self.ids[rows], names.expand(len(block), -1)), dim=1)
            for rank in range(self.ids.shape[1]):
                value, column = table.max(dim=1, keepdim=True)
                self._votes[rows, rank] = value.squeeze(1)
                self.ids[rows, rank] = labels.gather(1, column).squeeze(1)
                table.scatter_(1, column, -1.0)

    def result(self, options: UpliftOptions) -> tuple[Tensor, Tensor, Tensor]:
        """Ids (n,), confidence (n,) and shares (n, k)."""
        seen = self._total > options.min_weight
        shares = self._votes / torch.where(self._total > 0, self._total, 1.0).unsqueeze(1)
        # Sums in float32 may leave a lone id's share a hair above 1.
        shares = torch.where(seen.unsqueeze(1), shares, 0.0).clamp_max(1.0)
        sure = seen & (shares[:, 0] >= options.min_share) & (self.ids[:, 0] != UNLABELLED)
        self.ids[~seen] = UNLABELLED
        ids = torch.where(sure, self.ids[:, 0], UNLABELLED)
        return ids, torch.where(sure, shares[:, 0], 0.0), shares


def _row_blocks(count: int) -> Iterator[slice]:
    for start in range(0, count, _ROWS):
        yield slice(start, start + _ROWS)


def _background(
    light: Tensor, voting: float, ids: Sequence[int], options: UpliftOptions
) -> tuple[int, dict[str, float]]:
    """The label of what no Gaussian covers, or -1, and what that rests on."""
    passed = float(light.sum())
    place = int(light.argmax())
    facts = {
        "light": passed / voting if voting > 0 else 0.0,
        "share": float(light[place]) / passed if passed > 0 else 0.0,
    }
    enough = passed > 0 and facts["light"] >= options.min_background
    sure = facts["share"] >= options.min_background_share
    return (ids[place] if enough and sure else UNLABELLED), facts


def _metadata(
    options: UpliftOptions,
    views: Sequence[View],
    ids: Sequence[int],
    classes: ClassTable | None,
    background: dict[str, float],
) -> dict[str, Any]:
    known = () if classes is None else classes.rows
    return {
        "method": "uplift",
        "options": asdict(options),
        "views": [view.name for view in views],
        "names": {str(row.id): row.name for row in known if row.id in ids},
        "background_votes": background,
    }
