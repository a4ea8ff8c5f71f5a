"""How well features of Gaussians tell one instance from another: AUC of the cosine of pairs.

    python benchmarks/affinity.py SCENE ../shared/data/toys --layer L [--pairs 60000] [--seed 0]

L is a layer of features, such as `segment --method saga` makes. A Gaussian's true instance is that
of most of its pixels in the training views of the capture's `instance` maps; those without one,
and those that no view showed to the layer, are left out. The area under the ROC curve of the
cosine, same against other instance, is 0.5 for features that know nothing. It is printed for pairs
of Gaussians drawn alike, in which large things and walls have the say, and for pairs of instances
drawn alike.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from scipy.stats import rankdata

from splatseg.core import Features
from splatseg.io.evidence import open_evidence
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.lift import uplift

LEAST = 20
"""Gaussians of an instance that is drawn."""


def auc(same: np.ndarray, scores: np.ndarray) -> float:
    """Share of pairs of a true and a false row in which the true one scores higher (ties half)."""
    ranks = rankdata(scores)
    true, false = int(same.sum()), int((~same).sum())
    return float((ranks[same].sum() - true * (true + 1) / 2) / (true * false))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--layer", required=True)
    parser.add_argument("--pairs", type=int, default=60_000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    scene, layer = load_scene(args.scene), load_scene_layer(args.scene, args.layer)
    if not isinstance(layer, Features):
        raise SystemExit(f"{args.layer}: expected features, got {type(layer).__name__}.")
    maps = open_evidence(args.data / "instance")
    named = set(maps.view_names)
    ids = uplift(scene.gaussians, [v for v in scene.train_views if v.name in named], maps).ids
    shown = ids > 0 if layer.weights is None else (ids > 0) & (layer.weights > 0)
    directions = torch.nn.functional.normalize(layer.values.float(), dim=1).numpy()
    rng, ids = np.random.default_rng(args.seed), ids.numpy()
    rows = np.flatnonzero(shown.numpy())

    def scored(one: np.ndarray, other: np.ndarray) -> float:
        return auc(
            ids[one] == ids[other], np.einsum("pc,pc->p", directions[one], directions[other])
        )

    of = {i: rows[ids[rows] == i] for i in np.unique(ids[rows])}
    some = [members for members in of.values() if len(members) >= LEAST]
    first = rng.integers(len(some), size=args.pairs)
    second = np.where(np.arange(args.pairs) % 2, first, rng.integers(len(some), size=args.pairs))
    pairs = [[rng.choice(some[i]), rng.choice(some[j])] for i, j in zip(first, second, strict=True)]
    found = {
        "gaussians": scored(rng.choice(rows, args.pairs), rng.choice(rows, args.pairs)),
        "instances": scored(*np.array(pairs).T),
        "rows": len(rows),
        "trained": layer.info.details.get("trained"),
    }
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
