r"""Uplift: label maps of many views, carried onto the Gaussians by the adjoint of rendering.

A pixel votes for its id on every Gaussian that it shows, with the weight it shows it with:

.. math:: v_{ic} = \sum_{views} \sum_p w_{pi} \, [\mathrm{id}(p) = c], \qquad
          \mathrm{share}_{ic} = \frac{v_{ic}}{\sum_{c'} v_{ic'}}

which is :math:`W^\top` of the one-hot label map, normalised by how much of the Gaussian the
voting pixels saw. The strongest id is the Gaussian's label and its share the confidence; other
rules are in `lift.mass.decision`. The transmittance behind all Gaussians votes alike for the label
of what none covers, such as the sky:

.. math:: b_c = \sum_{views} \sum_p \Bigl(1 - \sum_i w_{pi}\Bigr) [\mathrm{id}(p) = c]
              = \sum_{views} \sum_p [\mathrm{id}(p) = c] - \sum_i v_{ic}

References:
    Marrie et al., LUDVIG: Learning-free Uplifting of 2D Visual features to Gaussian Splatting
    scenes (2024), eq. 4: the same normalised adjoint, for features.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from splatseg._check import check_choice, check_range
from splatseg.core import (
    UNLABELLED,
    ClassTable,
    Gaussians,
    LabelMap,
    Labels,
    LabelSource,
    LayerInfo,
    View,
    camera_of_map,
)
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError
from splatseg.lift.mass.adjoint import LabelMass, RenderAdjoint, near_an_edge, voting_views
from splatseg.lift.mass.decision import LabelRule, decide
from splatseg.lift.mass.view_votes import ViewVotes
from splatseg.lift.mass.vote_table import Ranking, VoteTable
from splatseg.render import RenderOptions, options_for


@dataclass(frozen=True, slots=True, kw_only=True)
class UpliftOptions:
    """How votes become labels."""

    candidates: int = 1
    """Ids kept for each Gaussian. 1 makes a hard layer; with more the layer keeps their shares
    and is rendered softly."""

    min_weight: float = 0.0
    """Blending weight, summed over voting pixels, that a Gaussian must exceed to be labelled.
    One fully visible pixel counts 1."""

    min_share: float = 0.0
    """Minimum share of the votes, in [0, 1], that the winner needs; below it there is no label."""

    label_rule: LabelRule = "share"
    """Who wins. share: the id with most votes. flashsplat: an id with more votes than all
    others together and the slackness, compared after L2 normalisation. flashsplat_multi: the
    same after L1 normalisation; with a negative slackness several ids may win."""

    slackness: float = 0.0
    """FlashSplat's gamma, in [-1, 1], added to the votes against an id: above 0 labels are
    cut tight around what was seen, below 0 generously."""

    count_void: bool = False
    """Mass on unlabelled pixels counts against every id: for masks of single objects, whose
    outside has no label."""

    equal_views: float = 0.0
    """How far views are made equal, in [0, 1]: a view's votes on a Gaussian are divided by how
    much the view shows of it, to this power. At 0 every pixel has the same weight, at 1 every view,
    however far away."""

    edge_pixels: int = 0
    """Pixels this near to another id, along rows and columns, vote with `edge_vote`."""

    edge_vote: float = 0.0
    """Weight of a pixel near an edge, in [0, 1]."""

    min_background: float = 1e-3
    """Minimum share of the weight of all voting pixels, in [0, 1], that must pass the Gaussians
    for there to be a background label. A closed room has none."""

    min_background_share: float = 0.5
    """Minimum share of that weight, in [0, 1], that the background label needs."""

    memory: int = 1 << 30
    """Bytes of an exact table of votes, 4 for each id and Gaussian. With more ids than fit,
    each Gaussian remembers its strongest."""

    slots: int = 32
    """Ids remembered of each Gaussian then, 8 bytes each; more than 1. Exact for Gaussians that
    have votes for no more ids; of others an id with more than 1 / (slots + 1) of the votes is never
    lost."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.candidates < 1:
            raise RangeError(f"candidates: expected at least 1, got {self.candidates}.")
        if not (math.isfinite(self.min_weight) and self.min_weight >= 0):
            raise RangeError(f"min_weight: expected 0 or more, got {self.min_weight}.")
        check_range("min_share", self.min_share, 0.0, 1.0)
        check_choice("label_rule", self.label_rule, ("share", "flashsplat", "flashsplat_multi"))
        check_range("slackness", self.slackness, -1.0, 1.0)
        check_range("equal_views", self.equal_views, 0.0, 1.0)
        if self.edge_pixels < 0:
            raise RangeError(f"edge_pixels: expected 0 or more, got {self.edge_pixels}.")
        check_range("edge_vote", self.edge_vote, 0.0, 1.0)
        check_range("min_background", self.min_background, 0.0, 1.0)
        check_range("min_background_share", self.min_background_share, 0.0, 1.0)
        if self.memory < 1:
            raise RangeError(f"memory: expected at least 1 byte, got {self.memory}.")
        if self.slots < max(2, self.candidates):
            raise RangeError(
                f"slots: expected at least 2 and no fewer than the {self.candidates} candidates, "
                f"got {self.slots}."
            )


@boundary
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
    of the pinhole pixel that its centre falls into. Equal votes go to the smaller id. Views are
    gone through once, in the order of their names, so the order they are given in does not
    matter.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those that vote: a method that is to be measured uses train views only.
        evidence: Their label maps, as large as the photographs or reduced in proportion.
        options: How votes become labels.
        classes: Names of the ids, for the info.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.
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
    votes = _collected(
        gaussians,
        ordered,
        evidence,
        options=options,
        render_options=render_options or options_for(gaussians, backend),
        backend=backend,
        progress=progress,
    )
    return _labels(votes, ordered, options, _names(classes, votes.label_mass))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Votes:
    """Votes of all views."""

    table: VoteTable
    label_mass: LabelMass
    visibility: Tensor
    """(n,): how much of each Gaussian the views show."""

    squared_visibility: Tensor
    """(n,): the squares of what each view shows, summed."""

    by_view: ViewVotes | None
    """Only of soft layers."""


def _collected(
    gaussians: Gaussians,
    ordered: Sequence[View],
    evidence: LabelSource,
    *,
    options: UpliftOptions,
    render_options: RenderOptions,
    backend: str,
    progress: Callable[[int, int], None] | None,
) -> _Votes:
    """Go through the views once and add up their votes."""
    by_view = ViewVotes(gaussians.means) if options.candidates > 1 else None
    adjoint = RenderAdjoint(
        gaussians=gaussians,
        options=render_options,
        backend=backend,
        equal_views=options.equal_views,
        by_view=by_view,
    )
    table = VoteTable(len(gaussians), memory=options.memory, slots=options.slots)
    label_mass = LabelMass()
    visibility, squared_visibility = torch.zeros(len(gaussians)), torch.zeros(len(gaussians))
    for done, view in enumerate(ordered):
        label_map = evidence.label_map(view.name)
        camera = camera_of_map(view, label_map.height, label_map.width)
        weighted = _without_edges(label_map, options)
        view_visibility = adjoint.add_view(table, label_mass, camera, weighted)
        visibility += view_visibility
        squared_visibility += view_visibility**2
        if by_view is not None:
            by_view.end_view(view.camera)
        if progress is not None:
            progress(done + 1, len(ordered))
    if not label_mass.total:
        raise InputError(
            f"evidence: expected a labelled pixel in {len(ordered)} views, found none."
        )
    return _Votes(
        table=table,
        label_mass=label_mass,
        visibility=visibility,
        squared_visibility=squared_visibility,
        by_view=by_view,
    )


def _labels(
    votes: _Votes, ordered: Sequence[View], options: UpliftOptions, names: dict[int, str]
) -> Labels:
    """The layer that the votes decide."""
    ranking = votes.table.rank(options.candidates)
    decision = decide(
        ranking,
        rule=options.label_rule,
        slackness=options.slackness,
        min_weight=options.min_weight,
        min_share=options.min_share,
        against=votes.visibility - ranking.total if options.count_void else None,
    )
    background, record = _background(votes.label_mass, options)
    soft = options.candidates > 1
    squares = votes.squared_visibility
    return Labels(
        ids=decision.ids,
        confidence=decision.confidence,
        background=background,
        candidates=decision.candidates if soft else None,
        shares=decision.shares if soft else None,
        evidence=ranking.total,
        # Kish's effective sample size: a view that shows hardly anything counts hardly anything.
        effective_views=torch.where(squares > 0, votes.visibility**2 / squares, 0.0),
        info=LayerInfo(
            method="uplift",
            options=asdict(options),
            views=tuple(view.name for view in ordered),
            names=names,
            view_correlation=_correlation(votes.by_view, ranking),
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


def _without_edges(label_map: LabelMap, options: UpliftOptions) -> LabelMap:
    """The same ids, in which pixels near an edge have less weight."""
    if not options.edge_pixels or options.edge_vote == 1:
        return label_map
    weight = torch.where(near_an_edge(label_map, options.edge_pixels), options.edge_vote, 1.0)
    if label_map.confidence is not None:
        weight = weight * label_map.confidence.cpu().float()
    return LabelMap(ids=label_map.ids, confidence=weight)


def _background(label_mass: LabelMass, options: UpliftOptions) -> tuple[int, dict[str, float]]:
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
        "light": total_uncovered / total_mass if total_mass > 0 else 0.0,
        "share": uncovered[strongest] / total_uncovered if total_uncovered > 0 else 0.0,
    }
    enough = total_uncovered > 0 and record["light"] >= options.min_background
    clear = record["share"] >= options.min_background_share
    return (strongest if enough and clear else UNLABELLED), record


def _names(classes: ClassTable | None, label_mass: LabelMass) -> dict[int, str]:
    known = () if classes is None else classes.rows
    return {row.id: row.name for row in known if row.id in label_mass.total}


def _largest_share(part: Tensor, whole: Tensor) -> float:
    if not len(part):
        return 0.0
    return float((part / torch.where(whole > 0, whole, 1.0)).max())
