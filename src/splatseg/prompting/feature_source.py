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

What is similar, and the threshold, by `FeatureSourceOptions.rule`: *fixed* compares by cosine with
one number, SAM-based prompts too. *adaptive* is the paper's: cosines with the mean of all scores as
the threshold; of SAM-based prompts products (eq. 12), with the mean and one standard deviation.
*code* compares as adaptive does, with the published code's threshold
(`retrieval.published_threshold`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg._check import check_choice, check_range
from splatseg.core import FeatureMap, Features, Gaussians, View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError, ShapeError
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
_COVERED = 0.9
_OBJECT = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureSourceOptions:
    """How features answer prompts."""

    precision: Literal["float32", "float16", "int8"] = "float16"
    """What features are held in: int8 takes half of the memory and flips a few of a hundred
    Gaussians near the threshold."""

    clusters: int = 5
    """Queries that strokes and masks are reduced to by k-means."""

    rule: ThresholdRule = "fixed"
    """What a score must exceed. fixed: `threshold`. adaptive: the mean of the scores, of SAM-based
    prompts mean and one standard deviation, as in the paper. code: as in its published code."""

    threshold: float = 0.85
    """Similarity in [-1, 1] of the fixed rule. The published code has 0.75; decision 0030."""

    seed: int = 0
    """Of k-means."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("precision", self.precision, ("float32", "float16", "int8"))
        check_choice("rule", self.rule, get_args(ThresholdRule))
        check_range("threshold", self.threshold, -1.0, 1.0)
        if self.clusters < 1:
            raise RangeError(f"clusters: expected at least 1, got {self.clusters}.")


class FeatureSource:
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
        options: FeatureSourceOptions | None = None,
        guidance: Callable[[View], FeatureMap | None] | None = None,
    ) -> None:
        if len(features) != len(gaussians):
            raise ShapeError(
                f"features: expected {len(gaussians)} rows, one a Gaussian of the scene, got "
                f"{len(features)}; they are of another scene."
            )
        self._options = options or FeatureSourceOptions()
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
        """How likely each Gaussian belongs to what is shown, see `sources.MembershipSource`.

        Raises:
            InputError: If the prompts show nothing that has a feature.
        """
        asked = self._asked(prompts)
        if not asked:
            raise InputError("features: expected features where the prompts are, got none.")
        gate = self._gate(granularity)
        confidence = torch.stack([self._confidence(one, gate) for one in asked]).amax(dim=0)
        negative = torch.cat([self._values[:0], *map(self._negative, prompts)])
        if len(negative):
            # Equally like what is meant and what is not is the border as well.
            positive = torch.cat([one.queries for one in asked])
            found = scores(self._stored("cosine"), positive, gate=gate)
            against = scores(self._stored("cosine"), negative, gate=gate)
            confidence = torch.minimum(confidence, (0.5 + (found - against)).clamp(0, 1))
        return confidence if self._seen is None else confidence.where(self._seen, 0.0)

    def _asked(self, prompts: Sequence[SeenPrompt]) -> list["_Asked"]:
        """Positive queries of all prompts, those of one similarity together."""
        found: dict[Similarity, list[_Asked]] = {"cosine": [], "dot": []}
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
                found[similarity].append(_Asked(similarity, queries, inside))
        return [_Asked.together(some) for some in found.values() if some]

    def _confidence(self, asked: "_Asked", gate: Tensor | None) -> Float[Tensor, "n"]:
        """In [0, 1], 0.5 at the threshold of the rule."""
        found = scores(self._stored(asked.similarity), asked.queries, gate=gate)
        if asked.similarity == "cosine":
            return _around(found, self._limit(found, asked, gate), low=-1.0, high=1.0)
        ends = float(found.min()), float(found.max())
        return _around(found, self._limit(found, asked, gate), low=ends[0], high=ends[1])

    def _limit(self, found: Tensor, asked: "_Asked", gate: Tensor | None) -> float:
        match self._options.rule:
            case "fixed":
                return self._options.threshold
            case "adaptive":
                by_product = asked.similarity == "dot"
                return deviation_threshold(found) if by_product else mean_threshold(found)
            case "code":
                if not len(asked.inside):
                    return published_threshold(found, found[:0])
                inside = StoredFeatures.of(
                    asked.inside, precision="float32", similarity=asked.similarity
                )
                return published_threshold(found, scores(inside, asked.queries, gate=gate))

    def _stored(self, similarity: Similarity) -> StoredFeatures:
        """The features as they are compared, made when they are first asked for."""
        if similarity not in self._made:
            self._made[similarity] = StoredFeatures.of(
                self._values, precision=self._options.precision, similarity=similarity
            )
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
        many = prompt.dense and len(shown) > self._options.clusters
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
        if covered >= _COVERED or len(projected) <= self._options.clusters:
            return query
        return self._centres(projected)

    def _centres(self, values: Float[Tensor, "p d"]) -> Float[Tensor, "q d"]:
        """Centres of k-means."""
        from sklearn.cluster import KMeans

        count = min(self._options.clusters, len(np.unique(values.numpy(), axis=0)))
        made = KMeans(n_clusters=count, random_state=self._options.seed)
        made.fit(values.double().numpy())
        return torch.from_numpy(made.cluster_centers_).float()


@dataclass(frozen=True, slots=True, eq=False)
class _Asked:
    """Queries that scores are made with in one way."""

    similarity: Similarity
    queries: Float[Tensor, "q d"]
    inside: Float[Tensor, "p d"]
    """What pixels of masks and strokes show; a point alone would be as alike as can be."""

    @classmethod
    def together(cls, some: Sequence["_Asked"]) -> "_Asked":
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
