"""Training of how regions are merged and chosen (`splatseg.models._region_masks`)."""

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from splatseg.models._region_graph import (
    Array,
    Floats,
    Hierarchy,
    Perceptron,
    Regions,
    merge,
)
from splatseg.models._region_masks import SMALLEST, Candidates, candidates
from splatseg_bench.region_training import dense

Ids = NDArray[np.int32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Example:
    """Regions of a picture, and its true parts and things."""

    regions: Regions
    basins: NDArray[np.int32]
    """(h, w): the regions' pixels."""

    part: Ids
    thing: Ids


def as_rendered(depth: Array, image: NDArray[np.uint8], rng: np.random.Generator) -> Array:
    """True depth with the errors of fitted Gaussians: rims are soft, textures stand out."""
    light = image.astype(np.float32).mean(2) / 255
    texture = light - cv2.GaussianBlur(light, (0, 0), 4.0)
    grain = cv2.GaussianBlur(
        rng.normal(size=light.shape).astype(np.float32), (0, 0), float(rng.uniform(0.6, 2.5))
    )
    wrong = float(rng.normal(0, 0.06)) * texture
    wrong = wrong + float(rng.uniform(0, 0.012)) * grain / max(float(grain.std()), 1e-6)
    inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0).astype(np.float32)
    inverse = cv2.GaussianBlur(inverse, (0, 0), float(rng.uniform(0.4, 1.6))) * (1 + wrong)
    return np.where(inverse > 1e-6, 1 / np.maximum(inverse, 1e-6), 0).astype(np.float32)


def counts(basins: NDArray[np.int32], ids: Ids) -> Array:
    """(basins, ids): pixels of each basin with each of the ids there are."""
    labels, count = dense(ids)
    codes = basins.astype(np.int64) * count + labels
    size = int(basins.max()) + 1, count
    return (
        np.bincount(codes.reshape(-1), minlength=size[0] * size[1]).reshape(size).astype(np.float32)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class PairRows:
    """Pairs of regions that merging asked about."""

    features: Array
    """(n, f)"""

    answers: NDArray[np.bool_]
    """(n, 2): whether both are mostly of one part, and of one thing."""

    weights: Array
    """(n, 2): how much an answer counts."""


def record_pairs(
    examples: Sequence[Example],
    pair: Perceptron | None,
    *,
    seed: int,
    share: float = 0.1,
    over: Callable[[Callable[[int], Any], range], Iterable[Any]] = map,
) -> PairRows:
    """Merge by what was learned so far, by contours alone at first, and keep what was asked.

    What a policy meets is what it must learn, so each round follows the last one's (Ross et al.
    2011; of regions, GALA of Nunez-Iglesias et al. 2013). Each picture is merged in an order of
    parts, of things, or between. Regions that are of several count little.

    Args:
        examples: Pictures.
        pair: What was learned so far.
        seed: Of the orders, and of what is kept.
        share: Of questions that are kept.
        over: Applies a function to numbers of examples, in order; by several processes, say.
    """

    def one(number: int) -> tuple[Array, NDArray[np.bool_], Array]:
        return _recorded(examples[number], pair, np.random.default_rng([seed, number]), share)

    rows = list(over(one, range(len(examples))))
    features, answers, weights_of_all = (np.concatenate(part) for part in zip(*rows, strict=True))
    return PairRows(features=features, answers=answers, weights=weights_of_all)


def _recorded(
    example: Example, pair: Perceptron | None, rng: np.random.Generator, share: float
) -> tuple[Array, NDArray[np.bool_], Array]:
    """Features, answers and weights of one picture, as of `PairRows`."""
    thing = float(rng.choice([0.0, 0.5, 1.0]))
    tree = merge(example.regions, pair, (1 - thing, thing), record=True)
    if tree.questions is None:
        raise RuntimeError("merging recorded nothing.")
    pairs, features = tree.questions
    kept = rng.random(len(pairs)) < share
    a, b = pairs[kept].T
    least = np.minimum(np.minimum(tree.area[a], tree.area[b]), 4000) ** 0.5
    same: list[NDArray[np.bool_]] = []
    weights: list[Floats] = []
    for ids in (example.part, example.thing):
        totals = _with_unions(counts(example.basins, ids), tree)
        main, most = totals.argmax(1), totals.max(1) / tree.area
        same.append(main[a] == main[b])
        weights.append(least * (2 * np.minimum(most[a], most[b]) - 1).clip(0))
    return features[kept], np.stack(same, 1), np.stack(weights, 1).astype(np.float32)


def _with_unions(of_basins: Array, tree: Hierarchy) -> Array:
    """Counts of basins, and of the nodes that they were merged into."""
    found = np.concatenate(
        (of_basins, np.zeros((len(tree.merges), of_basins.shape[1]), np.float32))
    )
    for node, (a, b) in enumerate(tree.merges.tolist(), tree.leaves):
        found[node] = found[a] + found[b]
    return found


def node_rows(
    examples: Sequence[Example],
    pair: Perceptron,
    *,
    over: Callable[[Callable[[int], Any], range], Iterable[Any]] = map,
) -> tuple[Array, Array]:
    """Features (n, f) of candidates, and what their perceptron is to say (n, 4).

    The IoU with the best part and the best thing, and twice what each is above a half.
    """

    def one(number: int) -> tuple[Array, Array]:
        example = examples[number]
        nodes = candidates(example.regions, pair)
        best = [
            best_ious(nodes, example.basins, ids).max(1) for ids in (example.part, example.thing)
        ]
        return nodes.features, np.stack(best, axis=1)

    features, ious = (
        np.concatenate(part) for part in zip(*over(one, range(len(examples))), strict=True)
    )
    return features, np.concatenate((ious, (2 * ious - 1).clip(0)), axis=1)


def best_ious(nodes: Candidates, basins: NDArray[np.int32], ids: Ids) -> Array:
    """(k, ids) IoU of candidates with what is true; 0 where that is smaller than any candidate."""
    of_ids = counts(basins, ids)
    totals = of_ids.sum(0)
    inside = np.arange(len(nodes.areas))
    shared = np.concatenate(
        [nodes.members(rows).astype(np.float32) @ of_ids for rows in np.array_split(inside, 16)]
    )
    ious = shared / (nodes.areas[:, None] + totals - shared)
    return np.where(totals >= SMALLEST * ids.size, ious, 0).astype(np.float32)


def fit(
    features: Array,
    targets: NDArray[Any],
    weights: Array | None,
    *,
    hidden: Sequence[int],
    steps: int,
    seed: int,
    report: Callable[[str], None],
    batch: int = 2048,
    noise: float = 0.04,
) -> Perceptron:
    """Train a perceptron by cross entropy, AdamW and one cycle of the rate up to 4e-3."""
    torch.manual_seed(seed)
    mean = features.mean(0)
    spread = features.std(0) + np.float32(1e-4)
    inputs = torch.from_numpy(((features - mean) / spread).clip(-8, 8))
    wanted = torch.from_numpy(targets.astype(np.float32))
    counted = None if weights is None else torch.from_numpy(weights / weights.mean())
    sizes = (features.shape[1], *hidden, targets.shape[1])
    layers = [nn.Linear(a, b) for a, b in itertools.pairwise(sizes)]
    parts: list[nn.Module] = [layers[0]]
    for layer in layers[1:]:
        parts += [nn.ReLU(), layer]
    network = nn.Sequential(*parts)
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=1e-2)
    cycle = torch.optim.lr_scheduler.OneCycleLR(optimiser, 4e-3, total_steps=steps)
    mean_loss = 0.0
    for step in range(steps):
        rows = torch.randint(len(inputs), (batch,))
        noisy = inputs[rows] + noise * torch.randn(batch, sizes[0])
        loss: Tensor = functional.binary_cross_entropy_with_logits(
            network(noisy), wanted[rows], reduction="none"
        )
        loss = (loss if counted is None else loss * counted[rows]).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        cycle.step()
        mean_loss += (float(loss.detach()) - mean_loss) / min(step + 1, 200)
    report(f"{len(features)} rows, {steps} steps: loss {mean_loss:.4f}")
    return Perceptron(
        scaling=np.stack((mean, spread)),
        layers=tuple(
            (layer.weight.detach().numpy().T.copy(), layer.bias.detach().numpy())
            for layer in layers
        ),
    )
