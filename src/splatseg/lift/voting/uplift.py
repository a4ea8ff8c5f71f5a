r"""Uplift: label maps of many views, carried onto the Gaussians by the adjoint of rendering.

A pixel votes for its id on every Gaussian that it shows, with the weight it shows it with:

.. math:: v_{ic} = \sum_{views} \sum_p w_{pi} \, [\mathrm{id}(p) = c], \qquad
          \mathrm{share}_{ic} = \frac{v_{ic}}{\sum_{c'} v_{ic'}}

which is :math:`W^\top` of the one-hot label map, normalised by how much of the Gaussian the
voting pixels saw. The strongest id is the Gaussian's label and its share the confidence; other
rules are in `lift.voting.votes`. The transmittance behind all Gaussians votes alike for the label
of what none covers, such as the sky:

.. math:: b_c = \sum_{views} \sum_p \Bigl(1 - \sum_i w_{pi}\Bigr) [\mathrm{id}(p) = c]
              = \sum_{views} \sum_p [\mathrm{id}(p) = c] - \sum_i v_{ic}

References:
    Marrie et al., LUDVIG: Learning-free Uplifting of 2D Visual features to Gaussian Splatting
    scenes (2024), eq. 4: the same normalised adjoint, for features.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from typing import Annotated

import torch
from jaxtyping import Float, Int64
from msgspec import Meta
from torch import Tensor

from splatseg.core import (
    LOCAL,
    UNLABELLED,
    Camera,
    ClassTable,
    Executor,
    Gaussians,
    LabelMap,
    Labels,
    LabelSource,
    LayerInfo,
    View,
    ViewNames,
    camera_of_map,
)
from splatseg.core.boundary import boundary
from splatseg.core.options import Count, NonNegative, Share, options
from splatseg.errors import InputError
from splatseg.lift.voting.confusion import ViewVotes
from splatseg.lift.voting.votes import SLOTS, LabelRule, Ranking, VoteTable, decide
from splatseg.render import (
    PreparedView,
    RenderOptions,
    SparseBackProjected,
    SparseImage,
    options_for,
    prepare,
)


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


_MIN_UNCOVERED = 1e-3
"""Share of the weight of all voting pixels that must pass the Gaussians for there to be a
background label. A closed room has none."""

_MIN_BACKGROUND_SHARE = 0.5
"""Share of that weight that the background label needs."""


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

    def votes(self, camera: Camera, label_map: LabelMap) -> "LabelVotes":
        """A view's votes for the ids of its map, in one pass whatever their number."""
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
            return LabelVotes(ids=ids, pixels=votes, projected=view.back_project_sparse(image))

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelVotes:
    """What one view says."""

    ids: Int64[Tensor, "ids"]
    """Of its label map, ascending."""

    pixels: Float[Tensor, "ids"]
    """Pixels of each, or their confidences, summed; float64."""

    projected: SparseBackProjected
    """Votes of each id, a channel, on Gaussians; and how much of each Gaussian the view shows."""

    def add_to(
        self, table: VoteTable, label_mass: LabelMass, by_view: ViewVotes | None = None
    ) -> None:
        """Add them to those of other views; `by_view` keeps a sample of them view by view."""
        projected = self.projected
        for votes_of in (table, by_view):
            if votes_of is not None:
                votes_of.add_sparse(
                    self.ids[projected.channels], projected.gaussians, projected.sums
                )
        on_gaussians = torch.bincount(
            projected.channels, weights=projected.sums.double(), minlength=len(self.ids)
        )
        label_mass.add(self.ids.tolist(), self.pixels, on_gaussians)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Voting:
    """What votes of all views need."""

    adjoint: RenderAdjoint
    evidence: LabelSource


def _votes_of(voting: _Voting, view: View) -> Iterator[LabelVotes]:
    """The votes of a view."""
    label_map = voting.evidence.label_map(view.name)
    camera = camera_of_map(view, label_map.height, label_map.width)
    yield voting.adjoint.votes(camera, label_map)


@options(
    removed={
        "count_void": "label the pixels outside an object with an id of their own",
        "equal_views": "every pixel has the same weight",
        "edge_pixels": "every labelled pixel votes",
        "edge_vote": "every labelled pixel votes",
        "min_background": "a thousandth of the light must pass the Gaussians",
        "min_background_share": "the background label needs half of that light",
        "memory": "it is called `table_memory`",
        "slots": "32 ids are remembered of each Gaussian, or as many as `candidates`",
    }
)
class UpliftOptions:
    """How votes become labels."""

    candidates: Count = 1
    """Ids kept for each Gaussian. 1 makes a hard layer; with more the layer keeps their shares
    and is rendered softly."""

    min_weight: NonNegative = 0.0
    """Blending weight, summed over voting pixels, that a Gaussian must exceed to be labelled.
    One fully visible pixel counts 1."""

    min_share: Share = 0.0
    """Minimum share of the votes, in [0, 1], that the winner needs; below it there is no label."""

    label_rule: LabelRule = "share"
    """Which id wins. share: the id with most votes. flashsplat: an id with more votes than all
    others together and the slackness, compared after L2 normalisation. flashsplat_multi: the
    same after L1 normalisation; with a negative slackness several ids may win."""

    slackness: Annotated[float, Meta(ge=-1, le=1)] = 0.0
    """FlashSplat's gamma, in [-1, 1], added to the votes against an id: above 0 labels are
    cut tight around what was seen, below 0 generously."""

    table_memory: Count = 1 << 30
    """Bytes of an exact table of votes, 4 for each id and Gaussian. With more ids than fit,
    each Gaussian remembers its strongest."""

    def with_candidates(self, count: int) -> "UpliftOptions":
        """The same votes for a soft layer with at least so many candidates."""
        return replace(self, candidates=max(self.candidates, count))


@boundary
def uplift(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    options: UpliftOptions | None = None,
    classes: ClassTable | None = None,
    backend: str = "auto",
    executor: Executor = LOCAL,
    progress: Callable[[int, int], None] | None = None,
) -> Labels:
    """Label Gaussians by the votes of label maps.

    A pixel at -1 casts no vote; a pixel whose label map has a confidence votes with it. Views
    with lens distortion vote through the nearest warp's transpose, each pixel on the Gaussians
    of the pinhole pixel that its centre falls into. Equal votes go to the smaller id. Views are
    gone through once, in the order of their names, so the order they are given in does not
    matter.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those that vote: a method that is to be measured uses train views only.
        evidence: Their label maps, as large as the photographs or reduced in proportion.
        options: How votes become labels.
        classes: Names of the ids, for the info.
        backend: Name of the rendering backend.
        executor: Where the views are worked on; the layer does not depend on it.
        progress: Called with the views done and all there are to do.

    Returns:
        The layer, with the votes of each Gaussian as its evidence. Gaussians that no voting
        pixel saw have the id -1 and confidence 0. The info holds the method, its options,
        the views, what the background rests on, and the largest error bound of a count, as a share
        of the Gaussian's votes (0 where the table was exact).

    Raises:
        InputError: If there are no views, if one has no label map, or no pixel has a label.
        ShapeError: If a label map does not have its photograph's proportions.
    """
    options = options or UpliftOptions()
    ordered = voting_views(views, evidence, "a label map")
    soft = options.candidates > 1
    by_view = ViewVotes(gaussians.means) if soft else None
    adjoint = RenderAdjoint(
        gaussians=gaussians,
        options=options_for(gaussians, backend),
        backend=backend,
    )
    slots = max(SLOTS, options.candidates)
    table = VoteTable(len(gaussians), memory=options.table_memory, slots=slots)
    label_mass = LabelMass()
    visibility, squares = torch.zeros(len(gaussians)), torch.zeros(len(gaussians))
    voting = _Voting(adjoint=adjoint, evidence=evidence)
    with closing(executor.map(_votes_of, ordered, shared=voting)) as found:
        for done, (view, votes) in enumerate(zip(ordered, found, strict=True)):
            votes.add_to(table, label_mass, by_view)
            visibility += votes.projected.weights
            squares += votes.projected.weights**2
            if by_view is not None:
                by_view.end_view(view.camera)
            if progress is not None:
                progress(done + 1, len(ordered))
    if not label_mass.total:
        raise InputError(
            f"evidence: expected a labelled pixel in {len(ordered)} views, found none."
        )
    ranking = table.rank(options.candidates)
    decision = decide(
        ranking,
        rule=options.label_rule,
        slackness=options.slackness,
        min_weight=options.min_weight,
        min_share=options.min_share,
    )
    background, record = _background(label_mass)
    return Labels(
        ids=decision.ids,
        confidence=decision.confidence,
        background=background,
        candidates=decision.candidates if soft else None,
        shares=decision.shares if soft else None,
        evidence=ranking.total,
        # Kish's effective sample size: a view that shows hardly anything counts hardly anything.
        effective_views=torch.where(squares > 0, visibility**2 / squares, 0.0),
        info=LayerInfo(
            method="uplift",
            options=asdict(options),
            views=tuple(view.name for view in ordered),
            names=names_of(classes, label_mass.total),
            view_correlation=_correlation(by_view, ranking),
            details={
                "background_votes": record,
                "largest_error_bound": _largest_share(ranking.error_bound, ranking.total),
            },
        ),
    )


def _correlation(by_view: ViewVotes | None, ranking: Ranking) -> float | None:
    """How alike neighbouring views err, where the layer is soft."""
    if by_view is None:
        return None
    shares = ranking.votes / ranking.total.clamp_min(1e-30).unsqueeze(1)
    return by_view.correlation(ranking.ids, shares)


def _background(label_mass: LabelMass) -> tuple[int, dict[str, float]]:
    """The label of what no Gaussian covers, or -1, and what that rests on."""
    total_mass = sum(label_mass.total[id] for id in sorted(label_mass.total))
    # Rounding may leave a hair less than nothing.
    uncovered = {
        id: max(0.0, label_mass.total[id] - label_mass.on_gaussians[id])
        for id in sorted(label_mass.total)
    }
    total_uncovered = sum(uncovered.values())
    # `max` takes the first of equals, the smallest id.
    strongest = max(uncovered, key=lambda id: uncovered[id])
    record = {
        "uncovered_share": total_uncovered / total_mass if total_mass > 0 else 0.0,
        "share": uncovered[strongest] / total_uncovered if total_uncovered > 0 else 0.0,
    }
    enough = total_uncovered > 0 and record["uncovered_share"] >= _MIN_UNCOVERED
    clear = record["share"] >= _MIN_BACKGROUND_SHARE
    return (strongest if enough and clear else UNLABELLED), record


def names_of(classes: ClassTable | None, ids: Collection[int]) -> dict[int, str]:
    """Names of the classes that are among some ids."""
    return {row.id: row.name for row in (classes.rows if classes else ()) if row.id in ids}


def _largest_share(part: Tensor, whole: Tensor) -> float:
    if not len(part):
        return 0.0
    return float((part / torch.where(whole > 0, whole, 1.0)).max())
