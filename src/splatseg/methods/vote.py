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
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float, Int64
from torch import Tensor

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
from splatseg.core.options import Share, options
from splatseg.errors import InputError
from splatseg.lift.voting.uplift import names_of, voting_views
from splatseg.lift.voting.votes import SLOTS, VoteTable
from splatseg.methods._method import Method, MethodInputs
from splatseg.render import PreparedView, RenderOptions, options_for, prepare

_FOLD_TOLERANCE = 1e-2
"""A point whose pixel straightens to elsewhere, in pixels, lies beyond the fold of the lens."""

_PIXELS = 32768
"""Rows of W held at a time; bounds memory."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Centres:
    """The Gaussians whose centres a view has a pixel for."""

    gaussians: Int64[Tensor, "m"]
    """Which, ascending."""

    pixels: Int64[Tensor, "m 2"]
    """Column and row of each."""

    depth: Float[Tensor, "m"]
    """z-depth of each centre, scene units."""

    def __getitem__(self, index: Tensor) -> "Centres":
        """Some of them."""
        return Centres(
            gaussians=self.gaussians[index], pixels=self.pixels[index], depth=self.depth[index]
        )


def centres_in(means: Float[Tensor, "n 3"], camera: Camera, *, near: float) -> Centres:
    """Project centres into the pixels of any camera, distortion included.

    What lies nearer than `near`, outside the image or beyond the fold of the lens, where the
    polynomial leads back into the image, is left out.
    """
    points = means.detach().cpu().double()
    projected, depth = camera.project(points)
    size = projected.new_tensor([camera.width, camera.height])
    inside = (depth > near) & ((projected >= 0) & (projected < size)).all(dim=-1)
    rows = torch.nonzero(inside).squeeze(1)
    if not camera.is_pinhole:
        pinhole_pixels = replace(camera, model="pinhole", distortion=()).project(points[rows])[0]
        undistorted = camera.undistort_pixels(projected[rows])
        rows = rows[
            torch.linalg.vector_norm(undistorted - pinhole_pixels, dim=-1) < _FOLD_TOLERANCE
        ]
    return Centres(gaussians=rows, pixels=projected[rows].floor().long(), depth=depth[rows])


def unoccluded(
    centres: Centres, gaussians: Gaussians, view: PreparedView, *, tolerance: float
) -> Tensor:
    """Which centres are not behind the surface that the view shows, bool (m,).

    A pixel's surface is at its median depth (`Rendered.median_depth`), where transmittance falls
    to one half; a pixel without one occludes nothing.
    """
    with torch.no_grad():
        signal = gaussians.means.new_zeros(len(gaussians), 1)
        rendered = view.render(signal, warp="nearest")
    surface = rendered.median_depth.cpu().double()[centres.pixels[:, 1], centres.pixels[:, 0]]
    return (surface <= 0) | (centres.depth <= surface * (1 + tolerance))


def centre_weights(
    centres: Centres, gaussians: Gaussians, view: PreparedView
) -> Float[Tensor, "m"]:
    """Blending weight of each Gaussian at the pixel of its centre, float32."""
    width = view.camera.width
    flat = centres.pixels[:, 1] * width + centres.pixels[:, 0]
    centre_pixels = torch.unique(flat)
    centre_pixel = torch.full((len(gaussians),), -1, dtype=torch.int64)
    centre_pixel[centres.gaussians] = flat
    centre_weight = torch.zeros(len(gaussians))
    for part in torch.split(centre_pixels, _PIXELS):
        requested = torch.stack((part % width, part // width), dim=-1)
        rows = view.weights(requested)
        ids = rows.ids.cpu().long()
        pixel = torch.repeat_interleave(part, torch.diff(rows.indptr.cpu()))
        own = centre_pixel[ids] == pixel
        centre_weight[ids[own]] = rows.weights.cpu().float()[own]
    return centre_weight[centres.gaussians]


VoteRule = Literal["visible", "published"]
VoteOcclusion = Literal["none", "depth", "weight"]
VoteWeight = Literal["one", "transmittance"]

_PUBLISHED_SHARE = 0.7

_DEPTH_TOLERANCE = 0.05
"""How far behind the median depth a centre may lie, as a part of that depth."""

_MIN_WEIGHT = 0.01
"""Blending weight at the pixel of its centre that a Gaussian needs to be seen."""

_MEMORY = 1 << 30
"""Bytes of an exact table of votes."""


@options(
    removed={
        "depth_tolerance": "a centre may lie a twentieth behind the median depth",
        "min_weight": "a Gaussian is seen where its blending weight is 0.01 or more",
        "count_void": "label the pixels outside an object with an id of their own",
        "candidates": "method uplift makes soft layers",
        "region": "the pixel of the centre decides alone",
        "memory": "the table of votes is exact up to 1 GiB",
    }
)
class VoteOptions:
    """How views vote."""

    rule: VoteRule = "visible"
    """visible: shares are of the votes of views that see a Gaussian. published: they are of all
    views, as in SA-GS; views that do not see it vote against it."""

    share: Share | None = None
    """Share in [0, 1] that the winner must exceed. None is 0 for visible and SA-GS's 0.7 for
    published; Prompt SA-GS takes 0.6."""

    occlusion: VoteOcclusion = "none"
    """Which views see a centre. none: all with a pixel for it, whatever hides it. depth: those
    where it is not behind the rendered median depth. weight: those where the Gaussian has
    blending weight at that pixel."""

    weight: VoteWeight = "one"
    """What a view's vote counts. transmittance: the Gaussian's blending weight at the pixel of
    its centre, its opacity there times the transmittance before it."""

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
        render_options=options_for(gaussians, backend),
        backend=backend,
    )
    table, ids = _collected(voter, ordered, evidence, progress)
    return _decide(table, options, views=ordered, names=names_of(classes, ids))


def _collected(
    voter: "_CentreVoter",
    ordered: Sequence[View],
    evidence: LabelSource,
    progress: Callable[[int, int], None] | None,
) -> tuple[VoteTable, set[int]]:
    """Votes for ids, and the ids, of all views."""
    count = len(voter.gaussians)
    table = VoteTable(count, memory=_MEMORY, slots=SLOTS)
    ids: set[int] = set()
    for done, view in enumerate(ordered):
        label_map = evidence.label_map(view.name)
        camera = camera_of_map(view, label_map.height, label_map.width)
        found, gaussians, weights = voter.view_votes(camera, label_map)
        table.add_sparse(found, gaussians, weights)
        ids.update(torch.unique(found).tolist())
        if progress is not None:
            progress(done + 1, len(ordered))
    if not ids and count:
        raise InputError(
            f"evidence: expected a labelled pixel at a Gaussian's centre in {len(ordered)} views, "
            "found none."
        )
    return table, ids


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _CentreVoter:
    """Reads label maps at the pixels of the centres of Gaussians."""

    gaussians: Gaussians
    options: VoteOptions
    render_options: RenderOptions
    backend: str

    def view_votes(self, camera: Camera, label_map: LabelMap) -> tuple[Tensor, Tensor, Tensor]:
        """Ids, Gaussians and weights of the votes of a view; unlabelled pixels have none."""
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
        ids = label_map.ids.cpu()[row, column].long()
        labelled = ids != UNLABELLED
        return ids[labelled], centres.gaussians[labelled], vote_weight[labelled]

    def _seen(self, centres: Centres, view: PreparedView) -> tuple[Centres, Tensor]:
        """The centres that pass the occlusion test, and their weights where they are needed."""
        test = self.options.occlusion
        if test == "depth":
            visible = unoccluded(centres, self.gaussians, view, tolerance=_DEPTH_TOLERANCE)
            centres = centres[visible]
        weight = torch.ones(len(centres.gaussians))
        if test == "weight" or self.options.weight == "transmittance":
            weight = centre_weights(centres, self.gaussians, view)
            min_weight = _MIN_WEIGHT if test == "weight" else 0.0
            seen = (weight > 0) & (weight >= min_weight)
            centres, weight = centres[seen], weight[seen]
        return centres, weight


def _decide(
    table: VoteTable, options: VoteOptions, *, views: Sequence[View], names: dict[int, str]
) -> Labels:
    ranking = table.rank(1)
    total = ranking.total
    if options.rule == "published":
        total = torch.full_like(ranking.total, float(len(views)))
    # Sums in float32 may leave a lone id's share a hair above 1.
    shares = (ranking.votes[:, 0] / torch.where(total > 0, total, 1.0)).clamp(0, 1)
    has_label = (ranking.ids[:, 0] != UNLABELLED) & (shares > options.needed_share)
    return Labels(
        ids=torch.where(has_label, ranking.ids[:, 0], UNLABELLED),
        confidence=torch.where(has_label, shares, 0.0),
        evidence=ranking.total,
        info=LayerInfo(
            method="vote",
            options=asdict(options),
            views=tuple(view.name for view in views),
            names=names,
        ),
    )


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
