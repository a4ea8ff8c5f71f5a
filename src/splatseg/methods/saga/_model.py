"""What SAGA learns: features of Gaussians, a scale gate and a projector of 2D features."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import normalize

from splatseg.core import UNLABELLED
from splatseg.lift.affinity import project_features, projector_start
from splatseg.lift.training import Batch, Parameter, Values
from splatseg.methods._trained import linear_start
from splatseg.methods.saga._association import OBJECT_END, PART_END, divisions, level_cut
from splatseg.methods.saga._losses import (
    contrast_loss,
    correspondence_loss,
    guidance_loss,
    masked_means,
    members,
    norm_loss,
    pixel_weights,
    together_at,
)
from splatseg.methods.saga._mask_table import MaskTable
from splatseg.methods.saga._options import GateStart, SagaOptions
from splatseg.methods.saga._overlap import mean_overlap
from splatseg.methods.saga._smoothing import Smoother

PROJECTOR = "projector."
"""What names of the projector's arrays begin with among the shared parameters."""

_STEEPNESS = 10.0
"""How fast a channel of the gate closes at first, about its end, where each has one of its own."""

_LEVEL_STEEPNESS = 24.0
"""The same where ends lie between levels: 0.998 open and 0.002 at the scales of levels."""

_LAST_STEP = 1.5
"""The scale up to which the last channel is open at first."""

SELECTED = 0.85
"""Similarity from which on a pixel counts as found in scores."""

_ASKED = 4
"""Pixels of a mask that it is looked for by."""

_LARGE = 0.1
"""Share of a view from which on a mask's pixels count 1."""


class SagaModel:
    """Affinity features, see `methods.saga`.

    Args:
        features: What features start as.
        masks: What is known of the masks, whose numbers the targets have.
        options: Losses, rates and smoothing.
        smoother: Means over neighbours; None where features are free.
        guidance: Channels of the 2D features, 0 without.
        rng: Draws what the gate and the projector start as.
    """

    def __init__(
        self,
        features: Float[Tensor, "n channels"],
        masks: MaskTable,
        options: SagaOptions,
        *,
        smoother: Smoother | None,
        guidance: int,
        rng: np.random.Generator,
    ) -> None:
        self._masks = masks
        self._options = options
        self._smoother = smoother
        self._guided = guidance > 0 and options.guidance_weight > 0
        self._gated = options.correspondence == "scale"
        self._rows = {"features": Parameter(start=features, rate=options.rate)}
        self._shared: dict[str, Parameter] = {}
        if self._gated:
            weight, bias = gate_start(features.shape[1], options.gate, rng)
            for name, start in (("gate_weight", weight), ("gate_bias", bias)):
                self._shared[name] = Parameter(start=start, rate=options.gate_rate)
        if self._guided:
            for name, start in projector_start(guidance, features.shape[1], rng).items():
                self._shared[PROJECTOR + name] = Parameter(start=start, rate=options.projector_rate)

    @property
    def row_parameters(self) -> Mapping[str, Parameter]:
        """``features``."""
        return self._rows

    @property
    def shared_parameters(self) -> Mapping[str, Parameter]:
        """``gate_weight`` and ``gate_bias`` where there is a gate, and the projector's arrays."""
        return self._shared

    def loss(self, batch: Batch, values: Values) -> Float[Tensor, ""]:
        """The sum of the chosen losses, the mean over the views of the batch."""
        rendered = self._rendered(batch, values, train=True)
        scales = self._scales(values.rng) if self._gated else []
        losses, prototypes = [], []
        for pixels, inside, numbers in _by_view(batch):
            seen = rendered[pixels]
            losses.append(self._pair_loss(seen, inside, numbers, scales, values))
            if self._options.guidance_weight > 0 and len(numbers):
                found = masked_means(
                    self._queries(batch, pixels, seen, values), inside, batch.stands_for[pixels]
                )
                prototypes.append(found)
                losses[-1] = losses[-1] + self._options.guidance_weight * guidance_loss(
                    found, seen, inside
                )
        loss = torch.stack(losses).mean()
        if self._options.norm_weight > 0 and self._options.unit:
            loss = loss + self._options.norm_weight * norm_loss(rendered)
        if self._options.sparsity_weight > 0 and prototypes:
            loss = loss + self._options.sparsity_weight * self._sparsity(prototypes, values)
        return loss

    def score(self, batches: Sequence[Batch], values: Values) -> float:
        """How well masks of held-out views are found by single pixels of theirs: the mean overlap.

        For each mask, the intersection over union of its pixels with those whose cosine with one
        of them exceeds `SELECTED`, behind the gate of the mask's own scale; the mean over a few of
        its pixels, evenly through them. Where scales are levels, masks that are nodes count.
        """
        overlaps: list[float] = []
        nodes = self._masks.nodes
        for seen, inside, numbers, stands_for in self._whole_views(batches, values):
            for column, number in enumerate(numbers.tolist()):
                if nodes is not None and int(nodes.nodes[0, number]) == UNLABELLED:
                    continue
                gated = seen * self._gate(float(self._masks.ranks[number]), values)
                own = inside[:, column]
                directions = normalize(gated, dim=1)
                pixels = torch.nonzero(own).squeeze(1)
                asked = pixels[(torch.arange(_ASKED) * 2 + 1) * len(pixels) // (2 * _ASKED)]
                found = directions @ directions[asked].T > SELECTED
                overlaps.append(mean_overlap(found, own, stands_for))
        return float(np.mean(overlaps)) if overlaps else 0.0

    def _rendered(
        self, batch: Batch, values: Values, *, train: bool
    ) -> Float[Tensor, "pixels channels"]:
        touched = batch.weights.touched
        if self._smoother is None:
            features = values.rows("features", touched)
            own = normalize(features, dim=1) if self._options.unit else features
            return batch.weights.product(own)
        drop = self._options.smoothing_drop if train else 0.0
        rows = self._smoother.rows(touched, drop=drop, rng=values.rng if train else None)
        near = normalize(values.rows("features", rows.touched), dim=1)
        return batch.weights.product(rows.product(near))

    def _scales(self, rng: np.random.Generator) -> list[float]:
        """The scales of a step: the smallest, the largest, and some between."""
        return [0.0, *sorted(rng.random(self._options.scales).tolist()), 1.0]

    def _gate(self, scale: float, values: Values) -> Float[Tensor, "channels"] | float:
        if not self._gated:
            return 1.0
        return torch.sigmoid(values.shared["gate_weight"] * scale + values.shared["gate_bias"])

    def _pair_loss(
        self,
        seen: Float[Tensor, "pixels channels"],
        inside: Bool[Tensor, "pixels masks"],
        numbers: Int64[Tensor, "masks"],
        scales: Sequence[float],
        values: Values,
    ) -> Float[Tensor, ""]:
        options = self._options
        if options.correspondence == "none" or options.correspondence_weight == 0:
            return seen.new_zeros(())
        if options.correspondence == "overlap":
            return options.correspondence_weight * correspondence_loss(seen, inside)
        ranks = self._masks.ranks[numbers]
        weights = None
        if options.max_pixel_weight > 1:
            weights = pixel_weights(
                inside,
                self._masks.areas[numbers],
                reference=_LARGE,
                max_weight=options.max_pixel_weight,
            )
        total = seen.new_zeros(())
        for scale in scales:
            if self._masks.nodes is None:
                together, apart = together_at(inside, ranks, scale)
            else:
                shown, levels, known = self._masks.nodes.at(inside, numbers, scale)
                together, apart = together_at(shown, levels, level_cut(scale), known=known)
            directions = normalize(seen * self._gate(scale, values), dim=1)
            total = total + contrast_loss(directions, together, apart, weights)
        return options.correspondence_weight * total / len(scales)

    def _queries(
        self, batch: Batch, pixels: Int64[Tensor, "some"], seen: Tensor, values: Values
    ) -> Float[Tensor, "some channels"]:
        """What queries are means of: projected 2D features, or without these what is rendered."""
        if not self._guided:
            return seen
        arrays = {
            name.removeprefix(PROJECTOR): value
            for name, value in values.shared.items()
            if name.startswith(PROJECTOR)
        }
        return project_features(arrays, batch.target("guidance")[pixels].float())

    def _sparsity(self, prototypes: Sequence[Tensor], values: Values) -> Float[Tensor, ""]:
        """The mean positive product of queries with some Gaussians, wherever they are."""
        count = len(self._rows["features"].start)
        some = max(1, round(self._options.sparsity_share * count))
        drawn = np.sort(values.rng.choice(count, some, replace=False))
        features = values.rows("features", torch.from_numpy(drawn))
        if self._options.unit:
            features = normalize(features, dim=1)
        return torch.relu(features @ torch.cat(list(prototypes)).T).mean()

    def _whole_views(
        self, batches: Sequence[Batch], values: Values
    ) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """What each view shows, put together again from the batches that its pixels are in."""
        parts: dict[int, list[tuple[Tensor, Tensor, Tensor, Tensor]]] = {}
        for batch in batches:
            rendered = self._rendered(batch, values, train=False)
            masks = batch.ragged_target("masks")
            row = torch.repeat_interleave(torch.arange(len(batch)), torch.diff(masks.starts))
            for view in torch.unique(batch.views).tolist():
                pixels = torch.nonzero(batch.views == view).squeeze(1)
                mine = batch.views[row] == view
                local = torch.searchsorted(pixels, row[mine])
                part = (rendered[pixels], local, masks.values[mine], batch.stands_for[pixels])
                parts.setdefault(view, []).append(part)
        for view in sorted(parts):
            found = parts[view]
            sizes = np.cumsum([0, *(len(part[0]) for part in found)])
            row = torch.cat([part[1] + int(n) for part, n in zip(found, sizes, strict=False)])
            inside, numbers = members(row, torch.cat([p[2] for p in found]), int(sizes[-1]))
            yield (
                torch.cat([part[0] for part in found]),
                inside,
                numbers,
                torch.cat([part[3] for part in found]),
            )


def gate_start(
    channels: int, kind: GateStart, rng: np.random.Generator
) -> tuple[Float[Tensor, "channels"], Float[Tensor, "channels"]]:
    r"""What the gate's weight and bias start as.

    Channel c is open up to a scale of its own and closed beyond,
    :math:`\sigma(\kappa (t_c - s))`. Steps: :math:`t_c` goes evenly from 0 to 1.5, so that a third
    of the channels is open at all scales. Levels: it lies between the scales of parts and objects
    for the first third, between those of objects and groups for the second, beyond 1 for the third.
    """
    if kind == "random":
        weight, bias = linear_start(1, channels, rng)
        return weight[:, 0].contiguous(), bias
    ends, steepness = torch.linspace(0.0, _LAST_STEP, channels), _STEEPNESS
    if kind == "levels":
        steepness = _LEVEL_STEEPNESS
        for where, end in zip(divisions(channels), (PART_END, OBJECT_END, _LAST_STEP), strict=True):
            ends[where] = end
    return torch.full((channels,), -steepness), steepness * ends


def _by_view(
    batch: Batch,
) -> Iterator[tuple[Int64[Tensor, "some"], Bool[Tensor, "some masks"], Int64[Tensor, "masks"]]]:
    """The pixels of each view of a batch, which masks contain them, and these masks' numbers."""
    masks = batch.ragged_target("masks")
    row = torch.repeat_interleave(torch.arange(len(batch)), torch.diff(masks.starts))
    for view in torch.unique(batch.views).tolist():
        pixels = torch.nonzero(batch.views == view).squeeze(1)
        mine = batch.views[row] == view
        local = torch.searchsorted(pixels, row[mine])
        yield pixels, *members(local, masks.values[mine], len(pixels))
