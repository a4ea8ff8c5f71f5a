r"""The rendered probability of each pixel's own label, without those of all others.

.. math:: \sum_i w_{pi} \exp(z_{i, c_p} - \log \sum_c e^{z_{ic}})

needs one logit for each entry of W and one log-sum-exp for each Gaussian. A matrix of all touched
Gaussians and all classes is never made where logits come from a linear classifier.
"""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import embedding

from splatseg.lift.training import Batch

_ROWS = 2048
"""Gaussians classified at a time: their logits stay in the cache."""


def linear_own_probability(
    batch: Batch,
    label: Int64[Tensor, "pixels"],
    features: Float[Tensor, "t channels"],
    weight: Float[Tensor, "classes channels"],
    bias: Float[Tensor, "classes"],
) -> Float[Tensor, "pixels"]:
    """Of touched Gaussians' features and a linear classifier; differentiable towards all three."""
    gaussian, own = _entries(batch, label)
    # The gradient of `embedding` is a sum in the order of entries, in one pass.
    logit = (embedding(gaussian, features) * embedding(own, weight)).sum(dim=1)
    logit = logit + embedding(own, bias[:, None]).squeeze(1)
    normaliser = _LinearLogSumExp.apply(features, weight, bias)
    return _rendered(batch, gaussian, logit, normaliser)


def own_probability(
    batch: Batch, label: Int64[Tensor, "pixels"], logits: Float[Tensor, "t classes"]
) -> Float[Tensor, "pixels"]:
    """Of touched Gaussians' logits; differentiable towards them."""
    gaussian, own = _entries(batch, label)
    logit = embedding(gaussian * logits.shape[1] + own, logits.reshape(-1, 1)).squeeze(1)
    return _rendered(batch, gaussian, logit, torch.logsumexp(logits, dim=1))


def _entries(batch: Batch, label: Tensor) -> tuple[Tensor, Tensor]:
    """Touched Gaussian and pixel's label of each entry of W."""
    rows = batch.weights.rows
    return rows.ids.long(), torch.repeat_interleave(label, rows.indptr.diff())


def _rendered(batch: Batch, gaussian: Tensor, logit: Tensor, normaliser: Tensor) -> Tensor:
    rows = batch.weights.rows
    each = torch.exp(logit - embedding(gaussian, normaliser[:, None]).squeeze(1))
    # Rows whose entries are columns of their own: sums of each pixel's entries.
    entries = torch.arange(len(gaussian), dtype=torch.int32)
    own = replace(rows, ids=entries, gaussians=len(entries))
    return own.product(each[:, None]).squeeze(1)


class _LinearLogSumExp(torch.autograd.Function):
    r"""``logsumexp(features @ weight.T + bias, dim=1)``, a block of rows at a time.

    With :math:`q = \mathrm{softmax}(A f + b)` and g the gradient towards the result, gradients
    are :math:`g A^\top q` towards f, and sums of :math:`g q f^\top` and :math:`g q` towards A, b.
    """

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, bias: Tensor) -> Tensor:  # type: ignore[override]
        result = features.new_empty(len(features))
        for begin in range(0, len(features), _ROWS):
            block = slice(begin, begin + _ROWS)
            logits = torch.addmm(bias, features[block], weight.T)
            result[block] = torch.logsumexp(logits, dim=1)
        ctx.save_for_backward(features, weight, bias, result)
        return result

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        features, weight, bias, result = ctx.saved_tensors
        gradient = gradients[0]
        towards = (
            torch.empty_like(features),
            torch.zeros_like(weight),
            torch.zeros_like(bias),
        )
        for begin in range(0, len(features), _ROWS):
            block = slice(begin, begin + _ROWS)
            each = torch.addmm(bias, features[block], weight.T)
            each.sub_(result[block, None]).exp_().mul_(gradient[block, None])
            torch.mm(each, weight, out=towards[0][block])
            towards[1].addmm_(each.T, features[block])
            towards[2].add_(each.sum(dim=0))
        return towards
