r"""Which categories objects are of, where only those of the tracks over them are known.

A track covers several objects: what it moved on to, what it bled into. Of track t it is known how
many of its pixels were taken for category c, :math:`m_{tc}`, and how many are of object k,
:math:`n_{kt}` (its votes), but not which of them. If pixels of an object are of category c with
probability :math:`r_{kc}` under every track, expectation maximization of their likelihood gives

.. math:: r_{kc} \leftarrow \frac{1}{n_k} \sum_t n_{kt} m_{tc} \,
          \frac{r_{kc}}{\sum_{k'} n_{k't} r_{k'c}} \Big/ \text{(sum over c)}, \qquad
          \textstyle\sum_c m_{tc} = \sum_k n_{kt}

from :math:`r_{kc}` all alike. The first round lets each track vote for all it was taken for, of
every object alike. Those after it tell the objects of a track apart, by the other tracks over them.
It is stopped early: the data are few, and the limit explains its noise.

References:
    Dempster, Laird and Rubin, JRSS B 39 (1977). The iteration is that of Richardson (1972) and
    Lucy (1974) for a mixture by known shares; the question is King's, A Solution to the Ecological
    Inference Problem (1997).
"""

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.core.threads import one_torch_thread
from splatseg.errors import RangeError
from splatseg.lift.object_classes.pooling import PooledObjects

_LEAST = 1e-12
"""Below this what a track is expected to be taken for is none."""


@boundary
def with_categories(
    pooled: PooledObjects, categories: Mapping[int, Mapping[int, float]], *, rounds: int = 10
) -> PooledObjects:
    """Objects with votes for categories, where those for ids are votes for what these are.

    Args:
        pooled: Objects with votes for ids, such as tracks.
        categories: m: of each id how much speaks for which category, in any unit; one that is not
            known, or of which nothing is known, votes for none.
        rounds: Of expectation maximization, at least 1.

    Returns:
        The objects, each with as many votes as it has for ids whose categories are known.

    Raises:
        RangeError: If a number is negative or not finite, or there are no rounds.
    """
    if rounds < 1:
        raise RangeError(f"rounds: expected at least 1, got {rounds}.")
    for id, shares in categories.items():
        for number in shares.values():
            if not 0 <= number < float("inf"):
                raise RangeError(f"categories: expected 0 or more of id {id}, got {number}.")
    classes = sorted({kind for shares in categories.values() for kind in shares})
    taken = torch.zeros(len(pooled.classes), len(classes), dtype=torch.float64)
    for row, id in enumerate(pooled.classes.tolist()):
        for kind, number in categories.get(id, {}).items():
            taken[row, classes.index(kind)] = number
    sums = taken.sum(dim=1, keepdim=True)
    taken /= torch.where(sums > 0, sums, 1.0)
    votes = pooled.votes * (sums > 0).T
    with one_torch_thread():
        answers = _answers(votes, taken * votes.sum(dim=0)[:, None], rounds)
    return replace(
        pooled,
        classes=torch.tensor(classes, dtype=torch.int64),
        votes=answers * votes.sum(dim=1, keepdim=True),
    )


def _answers(
    votes: Float[Tensor, "objects tracks"], taken: Float[Tensor, "tracks classes"], rounds: int
) -> Float[Tensor, "objects classes"]:
    """R; rows of zeros for objects without votes."""
    shape = (len(votes), taken.shape[1])
    answers = torch.full(shape, 1 / max(shape[1], 1), dtype=torch.float64)
    for _ in range(rounds):
        expected = votes.T @ answers
        ratio = torch.where(expected > _LEAST, taken / expected.clamp_min(_LEAST), 0.0)
        answers = answers * (votes @ ratio)
        scale = answers.sum(dim=1, keepdim=True)
        answers = answers / torch.where(scale > 0, scale, 1.0)
    return answers
