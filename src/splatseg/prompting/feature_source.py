r"""Features as a source of selections: SAGA's section 3.4.

The query of a point is the feature that its pixel shows, that of strokes, masks and boxes are five
centres of k-means over the features of their pixels. A Gaussian's score is its largest similarity
with a positive query; it belongs to the target if that exceeds the one with negative queries, and a
threshold. Features with a scale gate (`lift.AffinityHead`) are compared at the scale of what is
asked for. The confidence is 0.5 at the threshold and at equal scores, and 1 at the largest
similarity that there can be.

With the projector of features that were trained under guidance, a mask is asked in the space of 2D
features (SAM-based prompts): the mean of its projected features is the query if the pixels that it
finds in the view cover 90 % of the mask, centres of k-means over them otherwise.

What is similar, and the threshold, by `FeatureMembershipOptions.rule`: *fixed* compares by cosine
with one number, SAM-based prompts too. *adaptive* is the paper's: cosines with the mean of all
scores as the threshold; of SAM-based prompts products (eq. 12), with the mean and one standard
deviation.
"""

from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from msgspec import Meta
from torch import Tensor

from splatseg.core import FeatureMap, Features, Gaussians, View
from splatseg.core.boundary import boundary
from splatseg.core.options import options
from splatseg.errors import InputError, ShapeError
from splatseg.lift.affinity import AffinityHead
from splatseg.prompting.retrieval import (
    Similarity,
    StoredFeatures,
    deviation_threshold,
    mean_threshold,
    scores,
)
from splatseg.prompting.seen import VisiblePrompt
from splatseg.render import SparseWeights

ThresholdRule = Literal["fixed", "adaptive"]
_CLUSTERS = 5
"""Queries that strokes and masks are reduced to by k-means, as published."""

_COVERED = 0.9
_OBJECT = 0.5


@options(
    removed={
        "precision": "features are held in float16",
        "clusters": f"strokes and masks are reduced to {_CLUSTERS} queries, as published",
    }
)
class FeatureMembershipOptions:
    """How features answer prompts."""

    rule: ThresholdRule = "fixed"
    """What a score must exceed. fixed: `threshold`. adaptive: the mean of the scores, of SAM-based
    prompts mean and one standard deviation, as in the paper."""

    threshold: Annotated[float, Meta(ge=-1, le=1)] = 0.85
    """Similarity in [-1, 1] of the fixed rule. The published code has 0.75;
    docs/decisions/features.md."""

    seed: int = 0
    """Seed of k-means."""


class FeatureMembership:
    """Answers prompts by the features of Gaussians.

    Args:
        features: One feature a Gaussian: affinity features with their head, or any others.
        gaussians: The Gaussians that they are of.
        options: How they answer.
        guidance: Feature maps that affinity features were trained with, by view; None asks masks
            as strokes are asked.

    Raises:
        ShapeError: If the features are of another scene.
    """

    @boundary
    def __init__(
        self,
        features: Features,
        gaussians: Gaussians,
        *,
        options: FeatureMembershipOptions | None = None,
        guidance: Callable[[View], FeatureMap | None] | None = None,
    ) -> None:
        if len(features) != len(gaussians):
            raise ShapeError(
                f"features: expected {len(gaussians)} rows, one a Gaussian of the scene, got "
                f"{len(features)}; they are of another scene."
            )
        self._options = options or FeatureMembershipOptions()
        self._values = features.values.detach().cpu().float()
        self._seen = None if features.weights is None else features.weights.cpu() > 0
        self._head = AffinityHead.of(features) if features.info.head is not None else None
        self._made: dict[Similarity, StoredFeatures] = {}
        self._guidance = guidance

    @property
    def unseen(self) -> Bool[Tensor, "n"] | None:
        """Gaussians that no view showed when the features were made; None where that is unknown."""
        return None if self._seen is None else ~self._seen

    @boundary
    def membership(
        self, prompts: Sequence[VisiblePrompt], *, granularity: float | None = None
    ) -> Float[Tensor, "n"]:
        """How likely each Gaussian belongs to what is shown, see `MembershipSource`.

        Raises:
            InputError: If the prompts show nothing that has a feature.
        """
        queries = self._queries(prompts)
        if not queries:
            raise InputError("features: expected features where the prompts are, got none.")
        gate = self._gate(granularity)
        found = [self._confidence(similarity, some, gate) for similarity, some in queries.items()]
        confidence = torch.stack(found).amax(dim=0)
        negative = torch.cat([self._values[:0], *map(self._negative, prompts)])
        if len(negative):
            # Equally like what is meant and what is not is the border as well.
            positive = torch.cat(list(queries.values()))
            found = scores(self._stored("cosine"), positive, gate=gate)
            against = scores(self._stored("cosine"), negative, gate=gate)
            confidence = torch.minimum(confidence, (0.5 + (found - against)).clamp(0, 1))
        return confidence if self._seen is None else confidence.where(self._seen, 0.0)

    def _queries(self, prompts: Sequence[VisiblePrompt]) -> dict[Similarity, Float[Tensor, "q d"]]:
        """Positive queries of all prompts, those of one similarity together."""
        found: dict[Similarity, list[Tensor]] = {"cosine": [], "dot": []}
        for prompt in prompts:
            queries = None
            if prompt.dense and prompt.inside is not None and not prompt.guessed:
                queries = self._mask_queries(prompt)
            by_product = queries is not None and self._options.rule != "fixed"
            if queries is None:
                queries = self._thinned(prompt, self._shown(prompt.positive_rows))
            if len(queries):
                found["dot" if by_product else "cosine"].append(queries)
        return {similarity: torch.cat(some) for similarity, some in found.items() if some}

    def _confidence(
        self, similarity: Similarity, queries: Float[Tensor, "q d"], gate: Tensor | None
    ) -> Float[Tensor, "n"]:
        """In [0, 1], 0.5 at the threshold of the rule."""
        found = scores(self._stored(similarity), queries, gate=gate)
        by_cosine = similarity == "cosine"
        limit = self._options.threshold
        if self._options.rule == "adaptive":
            limit = mean_threshold(found) if by_cosine else deviation_threshold(found)
        low, high = (-1.0, 1.0) if by_cosine else (float(found.min()), float(found.max()))
        return _around(found, limit, low=low, high=high)

    def _stored(self, similarity: Similarity) -> StoredFeatures:
        """The features as they are compared, made when they are first asked for."""
        if similarity not in self._made:
            self._made[similarity] = StoredFeatures.of(self._values, similarity=similarity)
        return self._made[similarity]

    def _gate(self, granularity: float | None) -> Tensor | None:
        head = self._head
        if head is None or not head.gated:
            return None
        return head.gate(head.scale(_OBJECT if granularity is None else granularity))

    def _negative(self, prompt: VisiblePrompt) -> Float[Tensor, "q d"]:
        """Queries of what is not meant."""
        return self._thinned(prompt, self._shown(prompt.negative_rows))

    def _thinned(self, prompt: VisiblePrompt, shown: Float[Tensor, "p d"]) -> Float[Tensor, "q d"]:
        """What pixels show, of strokes, masks and boxes the centres of k-means."""
        many = prompt.dense and len(shown) > _CLUSTERS
        return self._centres(shown) if many else shown

    def _shown(self, rows: SparseWeights) -> Float[Tensor, "p d"]:
        """Features that pixels show; pixels that show none are left out."""
        shown = rows.to("cpu").product(self._values)
        return shown[torch.linalg.vector_norm(shown, dim=1) > 0]

    def _mask_queries(self, prompt: VisiblePrompt) -> Float[Tensor, "q d"] | None:
        """Queries of a mask by 2D features; None where there are none."""
        head = self._head
        if head is None or not head.projector or self._guidance is None or prompt.inside is None:
            return None
        given = self._guidance(prompt.view)
        if given is None:
            return None
        cells = prompt.pixels.cpu() // given.stride
        projected = head.project(given.features[cells[:, 1], cells[:, 0]])
        query = projected.mean(dim=0, keepdim=True)
        shown = prompt.rows.to("cpu").product(self._values)
        covered = float(((shown @ query.T) > 0).float().mean())
        if covered >= _COVERED or len(projected) <= _CLUSTERS:
            return query
        return self._centres(projected)

    def _centres(self, values: Float[Tensor, "p d"]) -> Float[Tensor, "q d"]:
        """Centres of k-means."""
        from scipy.cluster import vq

        count = min(_CLUSTERS, len(np.unique(values.numpy(), axis=0)))
        rng = np.random.default_rng(self._options.seed)
        kmeans: Any = vq.kmeans2  # `seed` of old releases is hidden in new ones
        centres, _ = kmeans(values.double().numpy(), count, minit="++", seed=rng)
        return torch.from_numpy(centres).float()


def _around(found: Tensor, limit: float, *, low: float, high: float) -> Tensor:
    """Confidences in [0, 1], 0.5 at the limit, linear from the least to the largest similarity."""
    above = 0.5 + 0.5 * (found - limit) / max(high - limit, 1e-6)
    below = 0.5 - 0.5 * (limit - found) / max(limit - low, 1e-6)
    return torch.where(found > limit, above, below).clamp(0, 1)
