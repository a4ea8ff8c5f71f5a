"""The readable reference of retrieval: every feature against every query, in torch."""

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from splatseg.prompting.retrieval import Similarity


def scores(
    features: Float[Tensor, "n d"],
    queries: Float[Tensor, "q d"],
    *,
    similarity: Similarity = "cosine",
    gate: Float[Tensor, "d"] | None = None,
) -> Float64[Tensor, "n"]:
    """What `retrieval.scores` computes, in float64 and of features as they were given."""
    rows, asked = features.double(), queries.double()
    if gate is not None:
        rows, asked = rows * gate.double(), asked * gate.double()
    if similarity == "cosine":
        rows, asked = _unit(rows), _unit(asked)
    return (rows @ asked.T).amax(dim=1)


def retrieve(
    features: Float[Tensor, "n d"],
    positive: Float[Tensor, "q d"],
    negative: Float[Tensor, "r d"] | None = None,
    *,
    threshold: float,
    similarity: Similarity = "cosine",
    gate: Float[Tensor, "d"] | None = None,
) -> Bool[Tensor, "n"]:
    """Which Gaussians `retrieval.retrieve` finds."""
    above = scores(features, positive, similarity=similarity, gate=gate)
    found = above > threshold
    if negative is not None and len(negative):
        found &= above > scores(features, negative, similarity=similarity, gate=gate)
    return found


def _unit(rows: Tensor) -> Tensor:
    lengths = torch.linalg.vector_norm(rows, dim=1, keepdim=True)
    return rows / lengths.masked_fill(lengths == 0, 1.0)
