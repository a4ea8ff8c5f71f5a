r"""Gaussians whose features match queries (Cen et al., SAGA, section 3.4).

The positive score of a Gaussian with feature f is its largest similarity with a positive query,
the negative score that with a negative one,

.. math:: S^p = \max_{Q \in \mathcal{Q}^p} \langle f, Q \rangle, \quad
          S^n = \max_{Q \in \mathcal{Q}^n} \langle f, Q \rangle,

and it belongs to the target if :math:`S^p > S^n` and :math:`S^p > \tau`. The rules that the
threshold is made by are functions below. A readable twin of the kernel is in the tests.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Float32
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg._native import match_features
from splatseg.core.boundary import boundary
from splatseg.errors import RangeError, ShapeError

Precision = Literal["float32", "float16", "int8"]
Similarity = Literal["cosine", "dot"]

PANEL_ROWS = 16
MAX_CHANNELS = 1024
_DTYPES = {"float32": torch.float32, "float16": torch.float16, "int8": torch.int8}
_HALF_MAX = 65504.0
_INT8_MAX = 127.0


@dataclass(frozen=True, slots=True, eq=False)
class StoredFeatures:
    r"""Features of all Gaussians, as the kernel reads them.

    Made by `StoredFeatures.of`. Rows lie in panels of 16, channel after channel, so that a vector
    instruction works on 16 Gaussians at once; it is a copy, the only one that retrieval needs.
    With int8 every row has a scale of its own: its largest component becomes 127. Against a scale
    for every channel that halves the error, and it is exact about the length of a row.
    """

    panels: Tensor
    """(ceil(n / 16), d, 16) of the precision; rows behind the last are zero."""

    scales: Float32[Tensor, "n"] | None
    """What products with a row are multiplied by; None where that is 1."""

    rows: int
    """How many Gaussians there are."""

    similarity: Similarity
    """What a score is: the cosine of the angle to the query, or the dot product."""

    @staticmethod
    @boundary
    def of(
        values: Float[Tensor, "n d"],
        *,
        precision: Precision = "float16",
        similarity: Similarity = "cosine",
    ) -> "StoredFeatures":
        """Features stored in a precision.

        Args:
            values: A feature for each Gaussian, 1 to 1024 channels.
            precision: float16 takes 2 bytes a channel, int8 one and 4 bytes a Gaussian.
            similarity: With "cosine" rows are normalised when they are stored; a row of zeros has
                score 0. With "dot" they are kept as they are.

        Raises:
            ShapeError: If there are no channels or more than 1024.
            RangeError: If a value is not finite, or beyond 65504 and kept in float16 as it is.
        """
        if values.ndim != 2 or not 1 <= values.shape[1] <= MAX_CHANNELS:
            raise ShapeError(
                f"values: expected shape (any, 1 to {MAX_CHANNELS}), got {tuple(values.shape)}."
            )
        check_finite("values", values)
        table = values.detach().cpu().float()
        if similarity == "cosine":
            table = _normalised(table)
        elif precision == "float16" and float(table.abs().amax() if len(table) else 0) > _HALF_MAX:
            raise RangeError(
                f"values: expected magnitudes of at most {_HALF_MAX:g} for float16, got "
                f"{float(table.abs().amax()):g}; normalise them or take float32."
            )
        scales = None
        if precision == "int8":
            table, scales = _as_bytes(table)
            if similarity == "cosine":
                scales = 1.0 / torch.linalg.vector_norm(table, dim=1).clamp_min(1.0)
        return StoredFeatures(
            panels=_in_panels(table, _DTYPES[precision]),
            scales=scales,
            rows=len(values),
            similarity=similarity,
        )

    def __len__(self) -> int:
        return self.rows

    @property
    def channels(self) -> int:
        """Components of a feature."""
        return self.panels.shape[1]

    @property
    def nbytes(self) -> int:
        """Memory that the features take, bytes."""
        scales = 0 if self.scales is None else self.scales.nbytes
        return self.panels.nbytes + scales


@boundary
def scores(
    features: StoredFeatures,
    queries: Float[Tensor, "q d"],
    *,
    gate: Float[Tensor, "d"] | None = None,
) -> Float32[Tensor, "n"]:
    r"""Largest similarity of each Gaussian with one of the queries.

    Args:
        features: The features of the Gaussians.
        queries: At least one query. With cosine similarity their lengths do not matter.
        gate: Factors of the channels, of features and queries alike (the scale gate of SAGA's
            second version). It is folded into the queries; with cosine similarity the lengths of
            the gated features are taken along: :math:`\max_Q \langle f g, Q g \rangle / (|f g|
            |Q g|)`.

    Returns:
        (n,) similarities; 0 for a feature of which nothing is left, whatever the queries.

    Raises:
        ShapeError: If queries or gate do not fit the features, or there is no query.
        RangeError: If a value is not finite.
    """
    folded = _folded(features, queries, gate)
    if not len(folded):
        raise ShapeError("queries: expected at least one query, got none.")
    result = torch.empty(features.rows)
    gated = gate is not None and features.similarity == "cosine"
    squared = gate.detach().cpu().float().square() if gate is not None and gated else None
    half = features.panels.dtype == torch.float16
    panels = features.panels.view(torch.int16) if half else features.panels
    rows, scales, nobody = features.rows, features.scales, folded[:0]
    match_features(panels, rows, scales, folded, nobody, squared, math.inf, result, None, None)
    return result


def mean_threshold(positive: Float[Tensor, "n"]) -> float:
    """The mean of the positive scores: section 3.4, prompts of points, scribbles and masks."""
    return float(positive.double().mean()) if len(positive) else 0.0


def deviation_threshold(positive: Float[Tensor, "n"]) -> float:
    """Mean and standard deviation of the positive scores: section 3.4, SAM-based prompts."""
    if not len(positive):
        return 0.0
    wide = positive.double()
    return float(wide.mean() + wide.std(correction=0))


def _folded(
    features: StoredFeatures, queries: Tensor, gate: Tensor | None
) -> Float32[Tensor, "q d"]:
    """Queries as the kernel takes them: with the gate of the features, normalised."""
    check_shape("queries", queries, (None, features.channels))
    check_finite("queries", queries)
    asked = queries.detach().cpu().float()
    if gate is None:
        return (_normalised(asked) if features.similarity == "cosine" else asked).contiguous()
    check_shape("gate", gate, (features.channels,))
    check_finite("gate", gate)
    factors = gate.detach().cpu().float()
    gated = asked * factors
    if features.similarity == "cosine":
        gated = _normalised(gated)
    return (gated * factors).contiguous()


def _normalised(rows: Tensor) -> Tensor:
    # The largest component first, so that squares neither overflow nor vanish.
    largest = rows.abs().amax(dim=1, keepdim=True)
    scaled = rows / largest.masked_fill(largest == 0, 1.0)
    lengths = torch.linalg.vector_norm(scaled, dim=1, keepdim=True)
    return scaled / lengths.masked_fill(lengths == 0, 1.0)


def _as_bytes(table: Tensor) -> tuple[Tensor, Float32[Tensor, "n"]]:
    """Rows with a largest component of 127, rounded, and what they are to be multiplied by."""
    largest = table.abs().amax(dim=1)
    steps = torch.where(largest == 0, 1.0, largest / _INT8_MAX)
    return (table / steps.unsqueeze(1)).round_(), steps


def _in_panels(table: Tensor, dtype: torch.dtype) -> Tensor:
    count, channels = table.shape
    panels = (count + PANEL_ROWS - 1) // PANEL_ROWS
    padded = torch.zeros(panels * PANEL_ROWS, channels, dtype=dtype)
    padded[:count] = table.to(dtype)
    return padded.view(panels, PANEL_ROWS, channels).transpose(1, 2).contiguous()
