"""What no view sees takes the labels of what is shaped like it: extremely randomised trees.

The labels that views give to points are all that the trees learn from; no label of any other
drive, and none of the points themselves.

References:
    Geurts et al., Extremely randomized trees (Machine Learning 2006).
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

_MIN_LEAF = 5
_ROWS = 65536


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShapeSamples:
    """Points with labels to learn from: at most so many of each, and how many each stands for."""

    features: Float[Tensor, "m f"]
    labels: Int[Tensor, "m"]
    """Columns of the table of votes, int64."""

    weights: Float[Tensor, "m"]
    """How sure its label is, in [0, 1]."""

    hashes: Int[Tensor, "m"]
    totals: Float[Tensor, "c"]
    """Points of each label before the sample was drawn."""

    def __len__(self) -> int:
        return len(self.labels)


def drawn(samples: Sequence[ShapeSamples], per_label: int) -> ShapeSamples:
    """Several samples as one: of each label those with the smallest hashes.

    Samples of samples are the sample of all: how a drive is divided does not matter.
    """
    features = torch.cat([sample.features for sample in samples])
    labels = torch.cat([sample.labels for sample in samples])
    weights = torch.cat([sample.weights for sample in samples])
    hashes = torch.cat([sample.hashes for sample in samples])
    order = np.lexsort((hashes.numpy(), labels.numpy()))
    grouped = labels.numpy()[order]
    starts = np.searchsorted(grouped, grouped, side="left")
    kept = torch.from_numpy(order[np.arange(len(order)) - starts < per_label])
    totals = torch.stack([sample.totals for sample in samples]).sum(dim=0)
    return ShapeSamples(
        features=features[kept],
        labels=labels[kept],
        weights=weights[kept],
        hashes=hashes[kept],
        totals=totals,
    )


class ShapeForest:
    """Trees that tell from a shape what it is called.

    Args:
        samples: What to learn from, at least one point.
        trees: How many.
        seed: Of the trees.
    """

    def __init__(self, samples: ShapeSamples, *, trees: int, seed: int) -> None:
        from sklearn.ensemble import ExtraTreesClassifier

        labels = samples.labels.numpy()
        present = np.bincount(labels, minlength=len(samples.totals))
        # Each label counts as often as it came, though only some of its points were kept.
        share = samples.totals.numpy() / np.maximum(present, 1)
        self._labels = len(samples.totals)
        self._forest = ExtraTreesClassifier(
            n_estimators=trees,
            min_samples_leaf=_MIN_LEAF,
            random_state=seed,
            n_jobs=torch.get_num_threads(),
        )
        self._forest.fit(
            samples.features.numpy(), labels, sample_weight=samples.weights.numpy() * share[labels]
        )
        # Trees add their answers up in the order in which their threads end: one at a time.
        self._forest.n_jobs = 1

    def shares(self, features: Float[Tensor, "n f"]) -> Float[Tensor, "n c"]:
        """How sure each label is of each shape; rows add up to 1."""
        out = torch.zeros(len(features), self._labels)
        columns = torch.from_numpy(np.asarray(self._forest.classes_, dtype=np.int64))
        blocks = features.split(_ROWS)
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            told = pool.map(self._told, blocks)
            for start, shares in zip(range(0, len(out), _ROWS), told, strict=True):
                out[start : start + _ROWS, columns] = torch.from_numpy(shares).float()
        return out

    def _told(self, features: Float[Tensor, "m f"]) -> NDArray[np.float64]:
        return np.asarray(self._forest.predict_proba(features.numpy()))
