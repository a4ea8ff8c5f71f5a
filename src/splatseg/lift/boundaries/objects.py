r"""Objects learnt with the geometry: label maps as a second loss of a fit, and splits at borders.

From a point of the fit on (`fit._objects`) every Gaussian has a label, decided by `uplift`, and a
step also asks for the light of each pixel to be that of Gaussians of the pixel's id, the loss of
`lift.boundaries.sharpen`. What one Gaussian alone cannot do, be on both sides of a border, two
can: a Gaussian whose evidence is divided between two ids is split in the direction that separates
the pixels of the two (Fisher's discriminant of `lift.boundaries.cut`, here between the two
strongest ids of each Gaussian at once), and each half begins with the id of its side. From there
on both halves move, shrink and turn opaque under the photographs and the label maps together.

References:
    Zhang et al., COB-GS: Clear Object Boundaries in 3DGS Segmentation Based on Boundary-Adaptive
    Gaussian Splitting, CVPR 2025: Gaussians that two masks pull at are split.
    Shen et al., Trace3D: Consistent Segmentation Lifting via Gaussian Instance Tracing, ICCV 2025:
    Gaussians of several instances are found by their blending weights, and split while fitting.
"""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    Edited,
    Gaussians,
    Labels,
    LabelSource,
    Selection,
    View,
    camera_of_map,
)
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.fit import ExtraLoss
from splatseg.lift.boundaries.cut import (
    BORDER_WEIGHT,
    MIN_VIEW_WEIGHT,
    on_border,
    plane_of_pixels,
    view_direction,
)
from splatseg.lift.boundaries.sharpen import (
    CachedLabelMaps,
    LabelLoss,
    SharpenOptions,
    TrustedLabelMaps,
)
from splatseg.lift.boundaries.split import axes_of, line_extent, split_along, unit_or_main
from splatseg.lift.voting.uplift import UpliftOptions, pixel_votes, uplift, voting_views
from splatseg.render import SparseImage, options_for, prepare

_MIN_SIDE = 0.2
"""Share of its evidence that a Gaussian's second id must have for it to be split."""

_MIN_PIXELS = 0.5
"""Standard deviation across the border, pixels, that it must have in some view."""

_MIN_WEIGHT = 0.5
"""Evidence of the second id that it must have, in pixels that show it fully."""


class ObjectLabels:
    """Label maps of a fit's views, and labels of its Gaussians: an `ObjectSupervision` of `fit`.

    Args:
        views: The training views, at the poses of the fit. Those without evidence do not count.
        evidence: Their label maps, with ids that mean the same in all views; with `matched` only
            the names of the views count.
        matched: For segments with ids of each view's own: makes such label maps for the Gaussians
            as they are at the first decision.
        options: How much labels count, and which pixels do; the number of steps is the fit's.
        digest: Of the evidence's files: a fit is resumed with the same evidence only.
        backend: Name of the rendering backend.

    Raises:
        InputError: If there is no view with evidence.
    """

    @boundary
    def __init__(
        self,
        views: Sequence[View],
        evidence: LabelSource,
        *,
        matched: Callable[[Gaussians], LabelSource] | None = None,
        options: SharpenOptions | None = None,
        digest: str = "",
        backend: str = "auto",
    ) -> None:
        known = set(evidence.view_names)
        shown = [view for view in views if view.name in known]
        if not shown:
            raise InputError(
                f"evidence: expected some of the {len(views)} training views, got none of them."
            )
        self._views = voting_views(shown, evidence, "a label map")
        self._names = [view.name for view in self._views]
        self._evidence = evidence
        self._matched = matched
        self._options = options or SharpenOptions()
        self._digest = digest
        self._backend = backend
        self._maps = CachedLabelMaps(evidence)
        self._labels = torch.zeros(0, dtype=torch.int32)

    @property
    def digest(self) -> str:
        """Of the evidence and of how it counts."""
        return f"{self._digest} {self._options.label_weight} {self._options.trust_pixels}"

    @property
    def labels(self) -> Int[Tensor, "n"]:
        """Ids of the Gaussians as decided last, -1 where no pixel shows one; none before."""
        return self._labels

    def decide(self, gaussians: Gaussians, *, room: int) -> Edited:
        """Decide the labels anew, and split at most `room` Gaussians that straddle a border.

        Args:
            gaussians: Those of the fit, on the CPU.
            room: Gaussians that there may be more of.

        Returns:
            The Gaussians that stay, in order, and behind them two parts of each that was split.
        """
        if not len(self._labels):
            self._maps = self._trusted(gaussians)
        votes = self._votes(gaussians, self._maps)
        edited, self._labels = _split_straddling(
            gaussians, self._views, self._maps, votes, room=room, backend=self._backend
        )
        return edited

    def loss(self, generator: torch.Generator) -> ExtraLoss:
        """The loss of a step, see `lift.boundaries.sharpen`; zero in views without evidence."""
        of_labels = LabelLoss(self._maps, self._labels, self._options, generator, self._backend)
        known = frozenset(self._names)

        def loss(view: View, gaussians: Gaussians, rows: Int64[Tensor, "m"]) -> Tensor:
            return of_labels(view, gaussians, rows) if view.name in known else torch.zeros(())

        return loss

    def state(self) -> dict[str, Tensor]:
        """Labels and, once they are decided, the label maps in use."""
        maps = {"maps": torch.zeros(0, dtype=torch.uint8), "sizes": torch.zeros(0, 4).long()}
        return {
            "labels": self._labels,
            **(self._maps.state(self._names) if len(self._labels) else maps),
        }

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._labels = tensors["labels"]
        if len(self._labels):
            self._maps = CachedLabelMaps(self._evidence)
            self._maps.restore(self._names, tensors)

    def _votes(self, gaussians: Gaussians, maps: LabelSource) -> Labels:
        options = UpliftOptions(candidates=2)
        return uplift(gaussians, self._views, maps, options=options, backend=self._backend)

    def _trusted(self, gaussians: Gaussians) -> CachedLabelMaps:
        """The label maps to learn from, all of them read."""
        source = self._evidence if self._matched is None else self._matched(gaussians)
        maps = CachedLabelMaps(source)
        if self._options.trust_pixels >= 0:
            votes = self._votes(gaussians, maps)
            hard = Labels(ids=votes.ids, confidence=votes.confidence, background=votes.background)
            by_name = {view.name: view for view in self._views}
            maps = CachedLabelMaps(
                TrustedLabelMaps(
                    maps, gaussians, by_name, hard, self._options.trust_pixels, self._backend
                )
            )
        # Codes are drawn for the ids of all maps that were read: all, before the first step.
        for name in self._names:
            maps.label_map(name)
        return maps


def _split_straddling(
    gaussians: Gaussians,
    views: Sequence[View],
    maps: LabelSource,
    votes: Labels,
    *,
    room: int,
    backend: str,
) -> tuple[Edited, Int[Tensor, "n"]]:
    """The Gaussians with those of two ids split, those with most evidence of a second id first.

    Args:
        gaussians: The Gaussians.
        views: The views that the votes are of.
        maps: Their label maps.
        votes: The two strongest ids of each Gaussian, with their shares and evidence.
        room: Largest number of splits.
        backend: Name of the rendering backend.

    Returns:
        The Gaussians, and the id of each.
    """
    unchanged = Edited.unchanged(gaussians), votes.ids
    if votes.candidates is None or votes.shares is None or votes.evidence is None or not room:
        return unchanged
    pairs, share = votes.candidates.long(), votes.shares[:, 1]
    lesser = share * votes.evidence
    straddles = (share >= _MIN_SIDE) & (lesser >= _MIN_WEIGHT) & (pairs[:, 1] != UNLABELLED)
    straddles &= gaussians.scales.amax(dim=1) > 0
    if not bool(straddles.any()):
        return unchanged
    directions = pair_directions(gaussians, views, maps, pairs, backend=backend)
    straddles &= (directions != 0).any(dim=1)
    rows = torch.nonzero(straddles).squeeze(1)
    cameras = [view.camera for view in views]
    chosen = gaussians[rows]
    extent = line_extent(chosen, unit_or_main(chosen, directions[rows]), cameras)
    rows = rows[extent.pixels >= _MIN_PIXELS]
    rows = rows[lesser[rows].argsort(descending=True, stable=True)[:room]].sort().values
    if not len(rows):
        return unchanged
    mask = torch.zeros(len(gaussians), dtype=torch.bool)
    mask[rows] = True
    edited = split_along(
        gaussians, Selection(mask=mask), directions[rows], parts=2, cameras=cameras
    )
    labels = votes.ids[edited.rows]
    # The direction points to the pixels of the first id: the second part of each lies there.
    labels[-2 * len(rows) :] = pairs[rows].flip(1).reshape(-1).to(labels.dtype)
    return edited, labels


def pair_directions(
    gaussians: Gaussians,
    views: Sequence[View],
    maps: LabelSource,
    pairs: Int64[Tensor, "n 2"],
    *,
    backend: str = "auto",
) -> Float[Tensor, "n 3"]:
    r"""The direction that separates the pixels of two ids best, other ids for each Gaussian.

    That of `cut.sides_of`, with the pixels of the first id inside and those of the second outside,
    for all Gaussians in one pass: the masses :math:`A_i` and positions :math:`c^A_i` of every id
    are one sparse image of three channels an id.

    Args:
        gaussians: The Gaussians.
        views: Those that vote.
        maps: Label maps of them; pixels at -1 do not count.
        pairs: Two ids of each Gaussian.
        backend: Name of the rendering backend.

    Returns:
        :math:`g_i` in each Gaussian's own frame; it points to the first id's pixels, its length
        has no meaning. Zero where no view shows both.
    """
    options = options_for(gaussians, backend)
    direction = torch.zeros(len(gaussians), 3, dtype=torch.float64)
    axes = axes_of(gaussians)
    for view in views:
        label_map = maps.label_map(view.name)
        camera = camera_of_map(view, label_map.height, label_map.width)
        ids, index, _ = pixel_votes(label_map)
        index = index.reshape(-1)
        labelled = index >= 0
        weights = torch.where(on_border(label_map.ids), BORDER_WEIGHT, 1.0)
        if label_map.confidence is not None:
            weights *= label_map.confidence.cpu().float()
        values = plane_of_pixels(camera).reshape(-1, 3) * weights.reshape(-1, 1)
        channels = 3 * index[labelled].unsqueeze(1) + torch.arange(3)
        image = SparseImage(
            indptr=torch.cat((torch.zeros(1, dtype=torch.int64), (3 * labelled).cumsum(0))),
            channels=channels.reshape(-1).to(torch.int32),
            values=values[labelled].reshape(-1),
            count=3 * len(ids),
        )
        with (
            torch.no_grad(),
            prepare(gaussians, camera, options=options, backend=backend) as prepared,
        ):
            found = prepared.back_project_sparse(image)
        channels = found.channels.long()
        own = pairs[found.gaussians] == ids[channels // 3].unsqueeze(1)
        moments = torch.zeros(len(gaussians), 6)
        for side in range(2):
            mine = own[:, side]
            moments[found.gaussians[mine], 3 * side + channels[mine] % 3] = found.sums[mine]
        on_both = (moments[:, 0] > MIN_VIEW_WEIGHT) & (moments[:, 3] > MIN_VIEW_WEIGHT)
        rows = torch.nonzero(on_both).squeeze(1)
        if len(rows):
            direction[rows] += view_direction(
                gaussians[rows], axes[rows], camera, moments[rows], options
            )
    return direction
