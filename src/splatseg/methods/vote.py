r"""Vote: each view votes on a Gaussian by the id at the pixel that its centre falls into.

The simplest way to lift labels, and the one of SA-GS and its followers; a baseline beside
`uplift`, where all pixels that show a Gaussian vote. With :math:`P_j` the projection of view j
and :math:`L_j` its label map,

.. math:: v_{ic} = \sum_j u_{ij} \, [L_j(P_j \mu_i) = c], \qquad
          \mathrm{share}_{ic} = v_{ic} / N_i

where :math:`u_{ij}` is 1, or the blending weight of the Gaussian at that pixel, and :math:`N_i`
what all ids got from the views that see the Gaussian (``visible``) or the number of all views
(``published``). Published, a view that does not see a Gaussian, or sees it on an unlabelled
pixel, votes against every id, so that an object in less than 70 % of the views is lost.

A centre is seen through whatever hides it, unless the occlusion test is asked for.

References:
    Hu et al., Semantic Anything in 3D Gaussians (SA-GS / SAGD, 2024), section 4.3: more than
    0.7 of all views. Prompt SA-GS (2024), eq. 7 and 8: more than 0.6 of them.
    Yan et al., Street Gaussians (2024), as read into points by the mesh-based street field:
    regions around centres vote.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import torch
from torch import Tensor

from splatseg._check import check_choice, check_range
from splatseg.core import (
    UNLABELLED,
    Camera,
    ClassTable,
    Gaussians,
    LabelMap,
    Labels,
    LabelSource,
    LayerInfo,
    View,
    camera_of_map,
)
from splatseg.errors import InputError, RangeError
from splatseg.lift.mass.adjoint import voting_views
from splatseg.lift.mass.centres import Centres, centre_weights, centres_in, majority_map, unoccluded
from splatseg.lift.mass.vote_table import VoteTable
from splatseg.methods._method import Method, MethodInputs
from splatseg.render import PreparedView, RenderOptions, options_for, prepare

VoteRule = Literal["visible", "published"]
VoteOcclusion = Literal["none", "depth", "weight"]
VoteWeight = Literal["one", "transmittance"]

_PUBLISHED_SHARE = 0.7
_SLOTS = 32


@dataclass(frozen=True, slots=True, kw_only=True)
class VoteOptions:
    """How views vote."""

    rule: VoteRule = "visible"
    """visible: shares are of the votes of views that see a Gaussian. published: they are of all
    views, as in SA-GS; views that do not see it vote against it."""

    share: float | None = None
    """Share in [0, 1] that the winner must exceed. None is 0 for visible and SA-GS's 0.7 for
    published; Prompt SA-GS takes 0.6."""

    occlusion: VoteOcclusion = "none"
    """Which views see a centre. none: all with a pixel for it, whatever hides it. depth: those
    where it is not behind the rendered median depth. weight: those where the Gaussian has
    blending weight at that pixel."""

    depth_tolerance: float = 0.05
    """How far behind the median depth a centre may lie, as a part of that depth."""

    min_weight: float = 0.01
    """Blending weight in [0, 1] at the pixel of its centre that a Gaussian needs to be seen, for
    the occlusion test by weight."""

    weight: VoteWeight = "one"
    """What a view's vote counts. transmittance: the Gaussian's blending weight at the pixel of
    its centre, its opacity there times the transmittance before it."""

    region: int = 0
    """Pixels on each side of the centre's pixel that decide with it: the vote is for the
    commonest id of the square. 0 is the pixel alone."""

    count_void: bool = False
    """Views that see a centre on an unlabelled pixel count against every id, as they do when
    published: for masks of single objects, whose outside has no label."""

    candidates: int = 1
    """Ids kept for each Gaussian. 1 makes a hard layer; with more the layer keeps their shares
    and is rendered softly."""

    memory: int = 1 << 30
    """Bytes of an exact table of votes, 4 for each id and Gaussian. With more ids than fit, each
    Gaussian remembers its strongest 32."""

    def __post_init__(self) -> None:
        check_choice("rule", self.rule, ("visible", "published"))
        check_choice("occlusion", self.occlusion, ("none", "depth", "weight"))
        check_choice("weight", self.weight, ("one", "transmittance"))
        if self.share is not None:
            check_range("share", self.share, 0.0, 1.0)
        check_range("min_weight", self.min_weight, 0.0, 1.0)
        tolerance = self.depth_tolerance
        if not (math.isfinite(tolerance) and tolerance >= 0):
            raise RangeError(f"depth_tolerance: expected 0 or more, got {tolerance}.")
        if self.region < 0:
            raise RangeError(f"region: expected 0 or more, got {self.region}.")
        for name in ("candidates", "memory"):
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")

    @property
    def needed_share(self) -> float:
        """`share`, or what None stands for."""
        if self.share is not None:
            return self.share
        return _PUBLISHED_SHARE if self.rule == "published" else 0.0


def vote(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    options: VoteOptions | None = None,
    classes: ClassTable | None = None,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Labels:
    """Label Gaussians by what the views show where their centres are.

    A pixel whose label map has a confidence votes with it. Equal votes go to the smaller id.
    Views are gone through once, in the order of their names, so the order they are given in does
    not matter.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those that vote: a method that is to be measured uses train views only.
        evidence: Their label maps, as large as the photographs or reduced in proportion.
        options: How views vote.
        classes: Names of the ids, for the info.
        render_options: Switches of the blending model, for occlusion and transmittance.
        backend: Name of the rendering backend.
        progress: Called with the views done and all there are to do.

    Returns:
        The layer, with the sum of a Gaussian's votes as its evidence: views, not pixels. There is
        no background label, because what no Gaussian covers has no centre.

    Raises:
        InputError: If there are no views, if one has no label map, or no centre falls on a
            labelled pixel.
        ShapeError: If a label map does not have its photograph's proportions.
    """
    options = options or VoteOptions()
    ordered = voting_views(views, evidence, "a label map")
    gaussians.check_values()
    voter = _CentreVoter(
        gaussians=gaussians,
        options=options,
        render_options=render_options or options_for(gaussians, backend),
        backend=backend,
    )
    table, against, ids = _collected(voter, ordered, evidence, progress)
    return _decide(table, against, options, views=ordered, names=_names(classes, ids))


def _collected(
    voter: "_CentreVoter",
    ordered: Sequence[View],
    evidence: LabelSource,
    progress: Callable[[int, int], None] | None,
) -> tuple[VoteTable, Tensor, set[int]]:
    """Votes for ids, votes of unlabelled pixels (n,), and the ids, of all views."""
    count = len(voter.gaussians)
    slots = max(_SLOTS, voter.options.candidates)
    table = VoteTable(count, memory=voter.options.memory, slots=slots)
    against = torch.zeros(count)
    ids: set[int] = set()
    for done, view in enumerate(ordered):
        label_map = evidence.label_map(view.name)
        camera = camera_of_map(view, label_map.height, label_map.width)
        votes = voter.view_votes(camera, label_map)
        labelled = votes.ids != UNLABELLED
        table.add_sparse(votes.ids[labelled], votes.gaussians[labelled], votes.weights[labelled])
        against.index_add_(0, votes.gaussians[~labelled], votes.weights[~labelled])
        ids.update(torch.unique(votes.ids[labelled]).tolist())
        if progress is not None:
            progress(done + 1, len(ordered))
    if not ids and count:
        raise InputError(
            f"evidence: expected a labelled pixel at a Gaussian's centre in {len(ordered)} views, "
            "found none."
        )
    return table, against, ids


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _ViewVotes:
    """Votes of one view: at most one id a Gaussian, -1 for an unlabelled pixel."""

    gaussians: Tensor
    ids: Tensor
    weights: Tensor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _CentreVoter:
    """Reads label maps at the pixels of the centres of Gaussians."""

    gaussians: Gaussians
    options: VoteOptions
    render_options: RenderOptions
    backend: str

    def view_votes(self, camera: Camera, label_map: LabelMap) -> _ViewVotes:
        centres = centres_in(self.gaussians.means, camera, near=self.render_options.near)
        with prepare(
            self.gaussians, camera, options=self.render_options, backend=self.backend
        ) as view:
            centres, weight = self._seen(centres, view)
        column, row = centres.pixels.unbind(dim=1)
        vote_weight = torch.ones(len(weight))
        if self.options.weight == "transmittance":
            vote_weight = weight
        if label_map.confidence is not None:
            vote_weight = vote_weight * label_map.confidence.cpu().float()[row, column]
        ids = majority_map(label_map.ids.cpu(), self.options.region)
        return _ViewVotes(
            gaussians=centres.gaussians, ids=ids[row, column].long(), weights=vote_weight
        )

    def _seen(self, centres: Centres, view: PreparedView) -> tuple[Centres, Tensor]:
        """The centres that pass the occlusion test, and their weights where they are needed."""
        test = self.options.occlusion
        if test == "depth":
            visible = unoccluded(
                centres, self.gaussians, view, tolerance=self.options.depth_tolerance
            )
            centres = centres[visible]
        weight = torch.ones(len(centres.gaussians))
        if test == "weight" or self.options.weight == "transmittance":
            weight = centre_weights(centres, self.gaussians, view)
            min_weight = self.options.min_weight if test == "weight" else 0.0
            seen = (weight > 0) & (weight >= min_weight)
            centres, weight = centres[seen], weight[seen]
        return centres, weight


def _decide(
    table: VoteTable,
    against: Tensor,
    options: VoteOptions,
    *,
    views: Sequence[View],
    names: dict[int, str],
) -> Labels:
    ranking = table.rank(options.candidates)
    total = ranking.total + against if options.count_void else ranking.total
    if options.rule == "published":
        total = torch.full_like(ranking.total, float(len(views)))
    shares = ranking.votes / torch.where(total > 0, total, 1.0).unsqueeze(1)
    # Sums in float32 may leave a lone id's share a hair above 1.
    shares = shares.clamp(0, 1)
    has_label = (ranking.ids[:, 0] != UNLABELLED) & (shares[:, 0] > options.needed_share)
    soft = options.candidates > 1
    return Labels(
        ids=torch.where(has_label, ranking.ids[:, 0], UNLABELLED),
        confidence=torch.where(has_label, shares[:, 0], 0.0),
        candidates=ranking.ids if soft else None,
        shares=shares if soft else None,
        evidence=ranking.total,
        info=LayerInfo(
            method="vote",
            options=asdict(options),
            views=tuple(view.name for view in views),
            names=names,
        ),
    )


def _names(classes: ClassTable | None, ids: set[int]) -> dict[int, str]:
    known = () if classes is None else classes.rows
    return {row.id: row.name for row in known if row.id in ids}


def run(inputs: MethodInputs, options: VoteOptions) -> Labels:
    """Let views vote by the pixels of centres, see `vote`."""
    return vote(
        inputs.gaussians,
        inputs.views,
        inputs.evidence,
        options=options,
        classes=inputs.label_names,
        backend=inputs.backend,
        progress=inputs.progress,
    )


METHOD = Method(
    name="vote",
    summary="views vote for Gaussians by the pixel of their centre, with or without occlusion test",
    reference="SA-GS (Hu et al. 2024), section 4.3; Prompt SA-GS (2024), eq. 7 and 8",
    evidence=("labels", "tracked"),
    options=VoteOptions,
    run=run,
    keeps_ids=True,
    published=VoteOptions(rule="published"),
)
