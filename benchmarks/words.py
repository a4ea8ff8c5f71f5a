"""Words asked of a scene: names of classes on test views, words that it lacks, milliseconds.

    python benchmarks/words.py SCENE ../shared/data/office

SCENE has the layer `objects` (`splatseg query SCENE wall --masks masks_sam` makes it) and, for the
row `gaussians`, one of `segment --method features --evidence features_text` called
`features_text`. Rows:

- `objects`: the likeliest of the classes that are there, by `query --every`.
- `means`: plain cosines of means over the same objects; `gaussians`: of each Gaussian's own.
- `voxels`: by voxels, the layer `voxels` (`segment --method voxels --evidence features_text --layer
  voxels`), in the span as `query --every --from-layer voxels` asks, and by plain cosines, as the
  paper asks; `published` the same of the layer `voxels_published`, made with `--published`.
- `unknown`: how well the probabilities tell which of all classes are there: the area under the
  ROC, and the shares found at 0.5 of those that are there and of those that are not.
- `speed`: milliseconds of a query of one word, and of ten: of the vectors, of the things, and of
  the probability of each Gaussian.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scored import ScoredScene, run_rows

from splatseg.core import UNLABELLED, Features, Labels, VoxelFeatures
from splatseg.io.scene import load_scene_layer
from splatseg.lift import complete
from splatseg.lift.voxels import VoxelWords
from splatseg.tasks import QueryOptions, QuerySession


def _features(bench: ScoredScene, name: str) -> Features:
    layer = load_scene_layer(bench.scene.root, name)
    if not isinstance(layer, Features):
        raise TypeError(f"{name}: expected features.")
    return layer


def _classes(bench: ScoredScene) -> list[dict[str, Any]]:
    return json.loads((bench.data / "metadata.json").read_text())["classes"]


def _session(bench: ScoredScene, layer: Features | VoxelFeatures) -> QuerySession:
    options = QueryOptions(from_layer="asked", every=True, features="features_text")
    return QuerySession(bench.scene, options=options, layers={"asked": layer})


def _scored(bench: ScoredScene, row: str, labels: Labels) -> None:
    """With Gaussians of no object labelled by their neighbours."""
    present = torch.tensor([UNLABELLED, *(c["id"] for c in _classes(bench) if c["present"])])
    named = replace(labels, ids=present[labels.ids.long().clamp_min(0)].int())
    whole = complete(bench.scene.gaussians, named)
    said = bench.score("semantic", [bench.draw(whole, row)], "semantic")
    print(row, {k: round(v, 4) for k, v in said.items() if isinstance(v, float)}, flush=True)


def _names(bench: ScoredScene) -> list[str]:
    return [row["name"] for row in _classes(bench) if row["present"]]


def objects(bench: ScoredScene) -> None:
    answers = _session(bench, _features(bench, "objects")).ask(_names(bench))
    _scored(bench, "objects", answers.labels())


def _plain(bench: ScoredScene, features: Features) -> Labels:
    """The word of the largest plain cosine."""
    session = _session(bench, features)
    vocabulary = session.index.vocabulary
    cosines = vocabulary.space.cosines(features.values, vocabulary.vectors(_names(bench)))
    known = features.values.abs().amax(dim=1) > 0
    best = torch.where(known, cosines.argmax(dim=1) + 1, UNLABELLED)
    return Labels(ids=best.int(), confidence=known.float())


def gaussians(bench: ScoredScene) -> None:
    _scored(bench, "gaussians", _plain(bench, _features(bench, "features_text")))


def means(bench: ScoredScene) -> None:
    own, layer = _features(bench, "features_text"), _features(bench, "objects")
    index = _session(bench, layer).index
    rows, weights = index.rows, own.weights
    if weights is None:
        raise TypeError("features_text: expected weights.")
    there = torch.nonzero(rows >= 0).squeeze(1)
    sums = torch.zeros(len(index), own.values.shape[1] + 1, dtype=torch.float64)
    weighted = torch.cat((own.values * weights[:, None], weights[:, None]), dim=1).double()
    sums.index_add_(0, rows[there], weighted[there])
    mean = (sums[:, :-1] / sums[:, -1:].clamp_min(1e-12)).float()
    _scored(bench, "means", _plain(bench, replace(own, values=index.of_gaussians(mean))))


def _voxels(bench: ScoredScene, name: str) -> None:
    layer = load_scene_layer(bench.scene.root or Path(), name)
    if not isinstance(layer, VoxelFeatures):
        raise TypeError(f"{name}: expected voxels.")
    session = _session(bench, layer)
    _scored(bench, f"{name}, span", session.ask(_names(bench)).labels())
    asked = VoxelWords(layer, session.index.vocabulary, components=None)
    cosines = asked.of_gaussians(asked.cosines(asked.vocabulary.vectors(_names(bench))))
    known = cosines.abs().amax(dim=1) > 0
    best = torch.where(known, cosines.argmax(dim=1) + 1, UNLABELLED)
    plain = Labels(ids=best.int(), confidence=known.float())
    _scored(bench, f"{name}, cosines", plain)


def voxels(bench: ScoredScene) -> None:
    _voxels(bench, "voxels")


def published(bench: ScoredScene) -> None:
    _voxels(bench, "voxels_published")


def unknown(bench: ScoredScene) -> None:
    session = _session(bench, _features(bench, "objects"))
    found = session.index.ask([row["name"] for row in _classes(bench)]).probabilities
    best = found[session.index.weights > 5].amax(dim=0).numpy()
    there = np.array([bool(row["present"]) for row in _classes(bench)])
    area = (best[there][:, None] > best[~there][None]).mean()
    shares = {str(at): [float((best[one] > at).mean().round(3)) for one in (there, ~there)]
              for at in (0.1, 0.2, 0.3, 0.5, 0.7)}  # fmt: skip
    print("unknown", {"area": round(float(area), 4), "there, not there, above": shares}, flush=True)


def speed(bench: ScoredScene) -> None:
    session = _session(bench, _features(bench, "objects"))
    names = _names(bench)
    for count in (1, 10):
        calls: list[Callable[[Sequence[str]], object]] = [
            session.index.ask,
            session.ask,
            lambda words: session.ask(words).probabilities,
        ]
        seconds: list[list[float]] = [[] for _ in calls]
        for turn in range(9):
            words = [names[(turn + step) % len(names)] for step in range(count)]
            for place, ask in enumerate(calls):
                began = time.perf_counter()
                ask(words)
                seconds[place].append(1000 * (time.perf_counter() - began))
        medians = [round(float(np.median(one)), 2) for one in seconds]
        said = dict(zip(("vectors ms", "things ms", "Gaussians ms"), medians, strict=True))
        print("speed", {"words": count, **said}, flush=True)


if __name__ == "__main__":
    run_rows(
        __doc__,
        ScoredScene,
        {
            "objects": objects,
            "means": means,
            "gaussians": gaussians,
            "voxels": voxels,
            "published": published,
            "unknown": unknown,
            "speed": speed,
        },
    )
