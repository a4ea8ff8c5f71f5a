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
deviation. *code* compares as adaptive does, with the published code's threshold
(`retrieval.published_threshold`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

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
    published_threshold,
    scores,
)
from splatseg.prompting.seen import SeenPrompt
from splatseg.render import SparseWeights

ThresholdRule = Literal["fixed", "adaptive", "code"]
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
    prompts mean and one standard deviation, as in the paper. code: as in its published code."""

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
        self, prompts: Sequence[SeenPrompt], *, granularity: float | None = None
    ) -> Float[Tensor, "n"]:
        """How likely each Gaussian belongs to what is shown, see `MembershipSource`.

        Raises:
            InputError: If the prompts show nothing that has a feature.
        """
        queries = self._queries(prompts)
        if not queries:
            raise InputError("features: expected features where the prompts are, got none.")
        gate = self._gate(granularity)
        confidence = torch.stack([self._confidence(one, gate) for one in queries]).amax(dim=0)
        negative = torch.cat([self._values[:0], *map(self._negative, prompts)])
        if len(negative):
            # Equally like what is meant and what is not is the border as well.
            positive = torch.cat([one.queries for one in queries])
            found = scores(self._stored("cosine"), positive, gate=gate)
            against = scores(self._stored("cosine"), negative, gate=gate)
            confidence = torch.minimum(confidence, (0.5 + (found - against)).clamp(0, 1))
        return confidence if self._seen is None else confidence.where(self._seen, 0.0)

    def _queries(self, prompts: Sequence[SeenPrompt]) -> list["_Queries"]:
        """Positive queries of all prompts, those of one similarity together."""
        found: dict[Similarity, list[_Queries]] = {"cosine": [], "dot": []}
        for prompt in prompts:
            shown = self._shown(prompt.positive_rows)
            queries = None
            if prompt.dense and prompt.inside is not None and not prompt.guessed:
                queries = self._mask_queries(prompt)
            by_product = queries is not None and self._options.rule != "fixed"
            if queries is None:
                queries = self._thinned(prompt, shown)
            similarity: Similarity = "dot" if by_product else "cosine"
            if len(queries):
                inside = shown if prompt.dense else shown[:0]
                found[similarity].append(_Queries(similarity, queries, inside))
        return [_Queries.together(some) for some in found.values() if some]

    def _confidence(self, query: "_Queries", gate: Tensor | None) -> Float[Tensor, "n"]:
        """In [0, 1], 0.5 at the threshold of the rule."""
        found = scores(self._stored(query.similarity), query.queries, gate=gate)
        if query.similarity == "cosine":
            return _around(found, self._limit(found, query, gate), low=-1.0, high=1.0)
        ends = float(found.min()), float(found.max())
        return _around(found, self._limit(found, query, gate), low=ends[0], high=ends[1])

    def _limit(self, found: Tensor, query: "_Queries", gate: Tensor | None) -> float:
        match self._options.rule:
            case "fixed":
                return self._options.threshold
            case "adaptive":
                by_product = query.similarity == "dot"
                return deviation_threshold(found) if by_product else mean_threshold(found)
            case "code":
                if not len(query.inside):
                    return published_threshold(found, found[:0])
                inside = StoredFeatures.of(
                    query.inside, precision="float32", similarity=query.similarity
                )
                return published_threshold(found, scores(inside, query.queries, gate=gate))

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

    def _negative(self, prompt: SeenPrompt) -> Float[Tensor, "q d"]:
        """Queries of what is not meant."""
        return self._thinned(prompt, self._shown(prompt.negative_rows))

    def _thinned(self, prompt: SeenPrompt, shown: Float[Tensor, "p d"]) -> Float[Tensor, "q d"]:
        """What pixels show, of strokes, masks and boxes the centres of k-means."""
        many = prompt.dense and len(shown) > _CLUSTERS
        return self._centres(shown) if many else shown

    def _shown(self, rows: SparseWeights) -> Float[Tensor, "p d"]:
        """Features that pixels show; pixels that show none are left out."""
        shown = rows.to("cpu").product(self._values)
        return shown[torch.linalg.vector_norm(shown, dim=1) > 0]

    def _mask_queries(self, prompt: SeenPrompt) -> Float[Tensor, "q d"] | None:
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
        from sklearn.cluster import KMeans

        count = min(_CLUSTERS, len(np.unique(values.numpy(), axis=0)))
        made = KMeans(n_clusters=count, random_state=self._options.seed)
        made.fit(values.double().numpy())
        return torch.from_numpy(made.cluster_centers_).float()


@dataclass(frozen=True, slots=True, eq=False)
class _Queries:
    """Queries that scores are made with in one way."""

    similarity: Similarity
    queries: Float[Tensor, "q d"]
    inside: Float[Tensor, "p d"]
    """What pixels of masks and strokes show; a point alone would be as alike as can be."""

    @classmethod
    def together(cls, some: Sequence["_Queries"]) -> "_Queries":
        """Those of several prompts."""
        return cls(
            some[0].similarity,
            torch.cat([one.queries for one in some]),
            torch.cat([one.inside for one in some]),
        )


def _around(found: Tensor, limit: float, *, low: float, high: float) -> Tensor:
    """Confidences in [0, 1], 0.5 at the limit, linear from the least to the largest similarity."""
    above = 0.5 + 0.5 * (found - limit) / max(high - limit, 1e-6)
    below = 0.5 - 0.5 * (limit - found) / max(limit - low, 1e-6)
    return torch.where(found > limit, above, below).clamp(0, 1)
