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
- `paper`: `voxels`, `published` and `objects` asked for the classes of the voxel paper's table
  alone, pixels of others left out.
- `unknown`: how well the probabilities tell which of all classes are there: the area under the
  ROC, and the shares found at 0.5 of those that are there and of those that are not.
- `phrases`: share of the phrases of instances for which their own object is the likeliest, of those
  whose instance is mostly one object's, asked whole and by their parts.
- `speed`: milliseconds of a query of one word, and of ten: of the vectors, of the things, and of
  the probability of each Gaussian.
"""

import time
from collections.abc import Callable, Sequence

import numpy as np
from scored import run_rows
from word_scene import PAPER_CLASSES, WordScene

from splatseg.core import Features
from splatseg.methods.voxels.words import VoxelWords


def _calibrated(
    bench: WordScene, row: str, name: str, words: Sequence[str], *, others: bool = True
) -> None:
    """By `query --every` from a layer."""
    layer = bench.voxels(name) if "voxels" in name else bench.features(name)
    found = bench.session(layer).ask(words).cosines
    bench.scored(row, found, found.abs().amax(dim=1) > 0, words, others=others)


def _plain(bench: WordScene, row: str, features: Features, words: Sequence[str]) -> None:
    """The word of the largest plain cosine."""
    vocabulary = bench.vocabulary
    found = vocabulary.space.cosines(features.values, vocabulary.vectors(words))
    bench.scored(row, found, features.values.abs().amax(dim=1) > 0, words)


def objects(bench: WordScene) -> None:
    _calibrated(bench, "objects", "objects", bench.names)


def gaussians(bench: WordScene) -> None:
    _plain(bench, "gaussians", bench.features("features_text"), bench.names)


def means(bench: WordScene) -> None:
    rows = bench.session(bench.features("objects")).index.rows
    _plain(bench, "means", bench.means(bench.features("features_text"), rows), bench.names)


def _voxels(bench: WordScene, name: str, words: Sequence[str], *, others: bool = True) -> None:
    row = name if others else f"paper {name}"
    _calibrated(bench, f"{row}, span", name, words, others=others)
    layer = bench.voxels(name)
    asked = VoxelWords(layer, bench.session(layer).index.vocabulary, components=None)
    cosines = asked.of_gaussians(asked.cosines(asked.vocabulary.vectors(words)))
    known = cosines.abs().amax(dim=1) > 0
    bench.scored(f"{row}, cosines", cosines, known, words, others=others)


def voxels(bench: WordScene) -> None:
    _voxels(bench, "voxels", bench.names)


def published(bench: WordScene) -> None:
    _voxels(bench, "voxels_published", bench.names)


def paper(bench: WordScene) -> None:
    words = [name for name in PAPER_CLASSES if name in bench.names]
    for name in ("voxels_published", "voxels"):
        _voxels(bench, name, words, others=False)
    _calibrated(bench, "paper objects", "objects", words, others=False)


def unknown(bench: WordScene) -> None:
    index = bench.session(bench.features("objects")).index
    found = index.ask([row["name"] for row in bench.classes]).probabilities
    best = found[index.weights > 5].amax(dim=0).numpy()
    there = np.array([bool(row["present"]) for row in bench.classes])
    area = (best[there][:, None] > best[~there][None]).mean()
    shares = {str(at): [float((best[one] > at).mean().round(3)) for one in (there, ~there)]
              for at in (0.1, 0.2, 0.3, 0.5, 0.7)}  # fmt: skip
    print("unknown", {"area": round(float(area), 4), "there, not there, above": shares}, flush=True)


def phrases(bench: WordScene) -> None:
    words = bench.vocabulary.recorded
    session = bench.session(bench.features("objects"))
    own = bench.instances(session.index)
    rows = zip(words.labels, words.kinds, words.target_ids, strict=True) if words else ()
    asked = [(label, id) for label, kind, id in rows if kind == "instance" and id in own]
    for how in ("whole", "parts"):
        session = bench.session(bench.features("objects"), phrases=how)
        answers = session.ask([label for label, _ in asked])
        best = answers.vectors.probabilities.argmax(dim=0).tolist()
        first = np.mean([own[row] == id for row, (_, id) in zip(best, asked, strict=True)])
        things = np.mean([len(answers.found[label]) for label, _ in asked])
        said = {"phrases": len(asked), "own first": round(float(first), 4),
                "things that answer": round(float(things), 2)}  # fmt: skip
        print("phrases", how, said, flush=True)


def speed(bench: WordScene) -> None:
    session = bench.session(bench.features("objects"))
    names = bench.names
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
        WordScene,
        {
            "objects": objects,
            "means": means,
            "gaussians": gaussians,
            "voxels": voxels,
            "published": published,
            "paper": paper,
            "unknown": unknown,
            "phrases": phrases,
            "speed": speed,
        },
    )
