r"""What SAGA learns: features of Gaussians, a scale gate and a projector of 2D features.

Losses of pairs of pixels are linear in the similarities S once it is known which pairs count, with
constant coefficients K. As a sum of :math:`K_{pq} \langle d_p, d_q \rangle` over directions d it
costs two products and keeps nothing of the size of the pairs for its gradient:

.. math:: \sum_{pq} K_{pq} \langle d_p, d_q \rangle = \sum_p \langle d_p, (K d)_p \rangle .
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, normalize

from splatseg.core import UNLABELLED
from splatseg.lift.affinity import project_features, projector_start
from splatseg.lift.training import Batch, Parameter, Values
from splatseg.methods.saga.masks import OBJECT_END, PART_END, LevelMasks, divisions, level_cut
from splatseg.methods.saga.options import PUBLISHED_RATE, SagaOptions

_BLOCK = 512
"""Pixels whose pairs with all others are held at a time."""

HARD_POSITIVE = 0.75
"""Pixels that belong together are pulled while their similarity is below this."""

HARD_NEGATIVE = 0.5
"""Pixels that do not are pushed while it is above this."""


def guidance_loss(
    prototypes: Float[Tensor, "masks channels"],
    rendered: Float[Tensor, "pixels channels"],
    inside: Bool[Tensor, "pixels masks"],
) -> Float[Tensor, ""]:
    r"""SAM-guidance loss, eq. 6 and 7: the binary cross-entropy of masks and what queries find.

    .. math:: -\mathrm{mean}_{M, p} \bigl[ M_p \log \sigma(T_M \cdot F_p)
              + (1 - M_p) \log (1 - \sigma(T_M \cdot F_p)) \bigr]

    The text sums where the code, and this, take the mean.
    """
    return binary_cross_entropy_with_logits(rendered @ prototypes.T, inside.to(rendered))


def masked_means(
    values: Float[Tensor, "pixels channels"],
    inside: Bool[Tensor, "pixels masks"],
    sample_weight: Float[Tensor, "pixels"],
) -> Float[Tensor, "masks channels"]:
    """Masked average pooling, eq. 5: the mean over the pixels of each mask.

    Over drawn pixels it is an estimate, each counting as many as it was drawn for.
    """
    share = inside.to(values) * sample_weight[:, None]
    return (share.T @ values) / share.sum(dim=0).clamp_min(1e-12)[:, None]


def correspondence_loss(
    rendered: Float[Tensor, "pixels channels"], inside: Bool[Tensor, "pixels masks"]
) -> Float[Tensor, ""]:
    r"""Correspondence loss, eq. 8 to 10: pixels are as alike as their masks are the same.

    .. math:: -\mathrm{mean}_{p, q} K(p, q) \, \max(0, \cos(F_p, F_q)), \qquad
              K(p, q) = \frac{|M^p \cap M^q|}{|M^p \cup M^q|}, \; -1 \text{ where that is } 0 .

    The text has the cosine itself and a sum; the published code, and this, cut it off below 0, so
    that unlike pixels need not become opposite, and take the mean.
    """
    directions = normalize(rendered, dim=1)
    fixed = directions.detach()
    with torch.no_grad():
        # Few sets of masks occur in a view, and K is the same for all pixels of two of them.
        sets, which = _distinct(inside)
        overlap = set_overlaps(sets).to(rendered)[:, which]
        pulled = torch.zeros_like(fixed)
        for begin in range(0, len(fixed), _BLOCK):
            block, rest = fixed[begin : begin + _BLOCK], fixed[begin:]
            kept = (block @ rest.T).gt_(0)
            kept.mul_(overlap[:, begin:].index_select(0, which[begin : begin + _BLOCK]))
            pulled[begin : begin + _BLOCK] += kept @ rest
            pulled[begin + _BLOCK :] += kept[:, len(block) :].T @ block
        value = (fixed * pulled).sum()
    # With pulled = K d the sum is <d, K d> and its gradient 2 K d, as K is symmetric.
    return -(2 * (directions * pulled).sum() - value) / max(len(rendered) ** 2, 1)


def _distinct(
    inside: Bool[Tensor, "pixels masks"],
) -> tuple[Bool[Tensor, "sets masks"], Int64[Tensor, "pixels"]]:
    """The sets of masks that occur, and which of them each pixel has."""
    packed: NDArray[np.uint8] = np.packbits(inside.numpy(), axis=1)
    # Equal bytes are equal sets, and sort a hundred times as fast as rows of booleans.
    rows = np.ascontiguousarray(packed).view(f"V{packed.shape[1]}").reshape(-1)
    first, which = np.unique(rows, return_index=True, return_inverse=True)[1:]
    return inside[torch.from_numpy(first)], torch.from_numpy(which.astype(np.int64))


def set_overlaps(sets: Bool[Tensor, "sets masks"]) -> Float[Tensor, "sets sets"]:
    """K of eq. 8 for pairs of sets of masks: intersection over union, -1 where that is 0."""
    member = sets.float()
    shared = member @ member.T
    sizes = member.sum(dim=1)
    union = sizes[:, None] + sizes[None, :] - shared
    return torch.where(shared == 0, -1.0, shared / union.clamp_min(1))


def together_at(
    inside: Bool[Tensor, "pixels masks"],
    ranks: Float[Tensor, "masks"],
    scale: float,
    *,
    known: Bool[Tensor, "pixels"] | None = None,
) -> tuple[Bool[Tensor, "pixels pixels"], Bool[Tensor, "pixels pixels"]]:
    """Which pairs of pixels belong together at a scale, and which do not.

    At a scale a pixel belongs to the masks up to it, and to larger ones only where none of those
    covers it. Pixels that share one belong together; pixels of which one belongs to a mask and
    that share none do not; of two pixels outside all masks nothing is known.

    Args:
        inside: Which pixels each mask contains.
        ranks: The scales of the masks, in [0, 1].
        scale: The scale that is asked about.
        known: Pixels of which something is known; None for all.
    """
    small = ranks <= scale
    covered = (inside & small).any(dim=1)
    member = inside & (small[None, :] | ~covered[:, None])
    one = member.float()
    together = (one @ one.T) > 0
    masked = member.any(dim=1)
    apart = ~together & (masked[:, None] | masked[None, :])
    return together, apart if known is None else apart & known[:, None] & known[None, :]


def contrast_loss(
    directions: Float[Tensor, "pixels channels"],
    together: Bool[Tensor, "pixels pixels"],
    apart: Bool[Tensor, "pixels pixels"],
) -> Float[Tensor, ""]:
    r"""Hard pairs pulled together and pushed apart: the scale-gated loss.

    .. math:: \mathrm{mean}_{P}(1 - S_{pq}) + \mathrm{mean}_{N} S_{pq}

    with P the pairs that belong together with :math:`S < 0.75` and N those that do not with
    :math:`S > 0.5`.
    """
    with torch.no_grad():
        similarity = directions @ directions.T
        pulled = (together & (similarity < HARD_POSITIVE)).float()
        pushed = (apart & (similarity > HARD_NEGATIVE)).float()
        pulls = pulled.sum()
        coefficients = pushed.div_(pushed.sum().clamp_min(1e-12))
        coefficients.sub_(pulled.div_(pulls.clamp_min(1e-12)))
    # K is symmetric.
    return (pulls > 0).float() + (directions * (coefficients @ directions)).sum()


def norm_loss(rendered: Float[Tensor, "pixels channels"]) -> Float[Tensor, ""]:
    """The mean of (1 - |F_p|)^2: Gaussians of a pixel agree, so that their mean keeps its length.

    Directions that differ within a pixel cancel, and then the pixel shows a shorter feature than
    each of its Gaussians has.
    """
    return (1 - torch.linalg.vector_norm(rendered, dim=1)).square().mean()


def members(
    pixel: Int64[Tensor, "entries"], mask: Int64[Tensor, "entries"], pixels: int
) -> tuple[Bool[Tensor, "pixels masks"], Int64[Tensor, "masks"]]:
    """Which pixels each mask contains, and the numbers of the masks that occur, ascending."""
    numbers, column = torch.unique(mask, return_inverse=True)
    inside = torch.zeros(pixels, len(numbers), dtype=torch.bool)
    inside[pixel, column] = True
    return inside, numbers


def mean_overlap(
    found: Bool[Tensor, "pixels queries"],
    inside: Bool[Tensor, "pixels"],
    weights: Float[Tensor, "pixels"],
) -> float:
    """The mean intersection over union of what queries found with a mask.

    Args:
        found: Which pixels each query finds.
        inside: Which pixels the mask contains.
        weights: What each pixel counts.
    """
    if not bool(inside.any()) or not found.shape[1]:
        return 0.0
    weight = weights.double()[:, None]
    both = (weight * (found & inside[:, None])).sum(dim=0)
    either = (weight * (found | inside[:, None])).sum(dim=0)
    return float((both / either).mean())


PROJECTOR = "projector."
"""What names of the projector's arrays begin with among the shared parameters."""

_STEEPNESS = 24.0
"""How fast a channel of the gate closes at first: 0.998 open and 0.002 at the scales of levels."""

_GROUP_END = 1.5
"""The scale up to which channels of groups are open at first."""

_GATE_RATE = 0.01
"""Adam's rate for the gate."""

_SCALES = 4
"""Scales drawn by chance in a step, besides the smallest and the largest."""

_SPARSITY_WEIGHT, _SPARSITY_SHARE = 0.1, 0.1
"""The published code's weight of the sparsity, and share of all Gaussians that it is of."""

SELECTED = 0.85
"""Similarity from which on a pixel counts as found in scores."""

_ASKED = 4
"""Pixels of a mask that it is looked for by."""


class SagaModel:
    """Affinity features, see `methods.saga`.

    Args:
        features: What features start as.
        levels: The nodes of the masks, whose numbers the targets have; None without a gate.
        options: Losses and rates.
        guidance: Channels of the 2D features, 0 without.
        rng: Draws what the projector starts as.
    """

    def __init__(
        self,
        features: Float[Tensor, "n channels"],
        levels: LevelMasks | None,
        options: SagaOptions,
        *,
        guidance: int,
        rng: np.random.Generator,
    ) -> None:
        self._levels = levels
        self._options = options
        self._unit = not options.is_published
        self._guided = guidance > 0 and options.guidance_weight > 0
        self.row_parameters: Mapping[str, Parameter] = {
            "features": Parameter(start=features, rate=options.rate)
        }
        """``features``."""
        self.shared_parameters: dict[str, Parameter] = {}
        """``gate_weight`` and ``gate_bias`` where there is a gate, and the projector's arrays."""
        if options.gated:
            weight, bias = gate_start(features.shape[1])
            for name, start in (("gate_weight", weight), ("gate_bias", bias)):
                self.shared_parameters[name] = Parameter(start=start, rate=_GATE_RATE)
        if self._guided:
            for name, start in projector_start(guidance, features.shape[1], rng).items():
                self.shared_parameters[PROJECTOR + name] = Parameter(
                    start=start, rate=PUBLISHED_RATE
                )

    def loss(self, batch: Batch, values: Values) -> Float[Tensor, ""]:
        """The sum of the chosen losses, the mean over the views of the batch."""
        rendered = self._rendered(batch, values)
        scales = list[float]()
        if self._options.gated:  # the smallest, the largest, and some between
            scales = [0.0, *sorted(values.rng.random(_SCALES).tolist()), 1.0]
        weight = self._options.guidance_weight
        losses, prototypes = [], []
        for _, pixels, row, mask in _entries_by_view(batch):
            inside, numbers = members(row, mask, len(pixels))
            seen = rendered[pixels]
            losses.append(self._pair_loss(seen, inside, numbers, scales, values))
            if weight > 0 and len(numbers):
                found = masked_means(
                    self._queries(batch, pixels, seen, values), inside, batch.stands_for[pixels]
                )
                prototypes.append(found)
                losses[-1] = losses[-1] + weight * guidance_loss(found, seen, inside)
        loss = torch.stack(losses).mean()
        if self._unit:
            return loss + norm_loss(rendered)
        if prototypes:
            loss = loss + _SPARSITY_WEIGHT * self._sparsity(prototypes, values)
        return loss

    def score(self, batches: Sequence[Batch], values: Values) -> float:
        """How well masks of held-out views are found by single pixels of theirs: the mean overlap.

        For each mask, the intersection over union of its pixels with those whose cosine with one
        of them exceeds `SELECTED`, behind the gate of the mask's own scale; the mean over a few of
        its pixels, evenly through them. Where scales are levels, masks that are nodes count.
        """
        overlaps: list[float] = []
        for seen, inside, numbers, weight in self._whole_views(batches, values):
            for column, number in enumerate(numbers.tolist()):
                scale = 0.0
                if self._levels is not None:
                    if int(self._levels.nodes[0, number]) == UNLABELLED:
                        continue
                    scale = float(self._levels.scales[0, number])
                gated = seen * self._gate(scale, values)
                own = inside[:, column]
                directions = normalize(gated, dim=1)
                pixels = torch.nonzero(own).squeeze(1)
                asked = pixels[(torch.arange(_ASKED) * 2 + 1) * len(pixels) // (2 * _ASKED)]
                found = directions @ directions[asked].T > SELECTED
                overlaps.append(mean_overlap(found, own, weight))
        return float(np.mean(overlaps)) if overlaps else 0.0

    def _rendered(self, batch: Batch, values: Values) -> Float[Tensor, "pixels channels"]:
        features = values.rows("features", batch.weights.touched)
        return batch.weights.product(normalize(features, dim=1) if self._unit else features)

    def _gate(self, scale: float, values: Values) -> Float[Tensor, "channels"] | float:
        if not self._options.gated:
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
        total = seen.new_zeros(())
        if self._options.correspondence == "overlap":
            return correspondence_loss(seen, inside)
        if self._levels is None:
            return total
        for scale in scales:
            shown, levels, known = self._levels.at(inside, numbers, scale)
            together, apart = together_at(shown, levels, level_cut(scale), known=known)
            directions = normalize(seen * self._gate(scale, values), dim=1)
            total = total + contrast_loss(directions, together, apart)
        return total / len(scales)

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
        count = len(self.row_parameters["features"].start)
        some = max(1, round(_SPARSITY_SHARE * count))
        drawn = np.sort(values.rng.choice(count, some, replace=False))
        features = values.rows("features", torch.from_numpy(drawn))
        return torch.relu(features @ torch.cat(list(prototypes)).T).mean()

    def _whole_views(
        self, batches: Sequence[Batch], values: Values
    ) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """What each view shows, put together again from the batches that its pixels are in."""
        parts: dict[int, list[tuple[Tensor, Tensor, Tensor, Tensor]]] = {}
        for batch in batches:
            rendered = self._rendered(batch, values)
            for view, pixels, local, mask in _entries_by_view(batch):
                part = (rendered[pixels], local, mask, batch.stands_for[pixels])
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


def gate_start(channels: int) -> tuple[Float[Tensor, "channels"], Float[Tensor, "channels"]]:
    r"""What the gate's weight and bias start as.

    Channel c is open up to a scale of its own and closed beyond, :math:`\sigma(\kappa (t_c - s))`,
    with :math:`t_c` between the scales of parts and objects for the first third, between those of
    objects and groups for the second, beyond 1 for the third.
    """
    ends = torch.empty(channels)
    for where, end in zip(divisions(channels), (PART_END, OBJECT_END, _GROUP_END), strict=True):
        ends[where] = end
    return torch.full((channels,), -_STEEPNESS), _STEEPNESS * ends


def _entries_by_view(batch: Batch) -> Iterator[tuple[int, Tensor, Tensor, Tensor]]:
    """Each view of a batch, its pixels, and the masks that contain them.

    The latter as pairs: the place among these pixels, and the number of the mask.
    """
    masks = batch.ragged_target("masks")
    row = torch.repeat_interleave(torch.arange(len(batch)), torch.diff(masks.starts))
    for view in torch.unique(batch.views).tolist():
        pixels = torch.nonzero(batch.views == view).squeeze(1)
        mine = batch.views[row] == view
        local = torch.searchsorted(pixels, row[mine])
        yield view, pixels, local, masks.values[mine]
