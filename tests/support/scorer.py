"""Scores of maps in files, by loops over pixels and segments: a second reading of the measures.

Nothing of splatseg is in it. Figures have the names of the shared score.py, which the same tests
are held to where it is there. Sums over classes and images come from scikit-learn and
scikit-image, matching and ranking are spelt out.
"""

import fnmatch
import itertools
import json
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from sklearn.metrics import confusion_matrix

from support.shared import SharedData

Score = dict[str, Any]
Segment = tuple[int, int]


def _maps(pred: Path, truth: Path, views: str) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    for path in sorted(truth.iterdir()):
        if fnmatch.fnmatch(path.stem, views):
            (other,) = pred.glob(f"{path.stem}.*")
            yield path.stem, _pixels(other), _pixels(path)


def _pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        array = np.asarray(image)
    return array if array.ndim == 3 else array.astype(np.int64)


def semantic_scores(predicted: np.ndarray, truth: np.ndarray) -> Score:
    """Over classes that the truth has; 0 of the truth is not scored."""
    known = truth != 0
    ids = np.union1d(predicted[known], truth[known])
    counts = confusion_matrix(truth[known], predicted[known], labels=ids)
    per_class, share, recall = {}, {}, {}
    for k, id in enumerate(ids.tolist()):
        true, said, both = counts[k].sum(), counts[:, k].sum(), counts[k, k]
        if true:
            per_class[id] = both / (true + said - both)
            share[id] = true / counts.sum()
            recall[id] = both / true
    return {
        "mIoU": fmean(per_class.values()),
        "fwIoU": sum(per_class[id] * share[id] for id in per_class),
        "accuracy": np.trace(counts) / counts.sum(),
        "mAcc": fmean(recall.values()),
        "classes": len(per_class),
        "per_class": {str(id): round(float(v), 4) for id, v in per_class.items()},
    }


def semantic(*, pred: Path, truth: Path, views: str = "*") -> Score:
    maps = list(_maps(pred, truth, views))
    predicted, true = (np.concatenate([m[i].ravel() for m in maps]) for i in (1, 2))
    return semantic_scores(predicted, true) | {"views": len(maps)}


def points(*, pred: Path, truth: Path) -> Score:
    with np.load(pred) as found, np.load(truth) as true:
        predicted, known = (f["semantic"].astype(np.int64) for f in (found, true))
    predicted = np.maximum(predicted, 0)
    unlabelled = np.count_nonzero(predicted == 0) / len(known)
    return semantic_scores(predicted, known) | {"points": len(known), "unlabelled": unlabelled}


def binary(*, pred: Path, truth: Path, views: str = "*") -> Score:
    ious, right, both, either = [], [], 0, 0
    for _, p, t in _maps(pred, truth, views):
        said, true = {*np.flatnonzero(p > 127).tolist()}, {*np.flatnonzero(t > 0).tolist()}
        ious.append(len(said & true) / len(said | true) if said | true else 1.0)
        right.append(1 - len(said ^ true) / t.size)
        both, either = both + len(said & true), either + len(said | true)
    return {
        "IoU_mean_over_views": fmean(ious),
        "IoU_pooled": both / either,
        "accuracy": fmean(right),
        "views": len(ious),
    }


def image(*, pred: Path, truth: Path, views: str = "*") -> Score:
    decibels, likeness = [], []
    for _, p, t in _maps(pred, truth, views):
        a, b = p / 255, t / 255
        same = np.array_equal(a, b)
        decibels.append(120.0 if same else peak_signal_noise_ratio(b, a, data_range=1))
        _, window = structural_similarity(
            a, b, data_range=1, channel_axis=-1, gaussian_weights=True, sigma=1.5,
            use_sample_covariance=False, full=True,
        )  # fmt: skip
        likeness.append(window[5:-5, 5:-5].mean())
    return {
        "PSNR": fmean(decibels),
        "PSNR_min": min(decibels),
        "SSIM": fmean(likeness),
        "views": len(decibels),
    }


def _overlap(p: list, t: list, keep: list[bool]) -> tuple[Counter, Counter, Counter]:
    """Pixels of each true segment, each predicted one (None: no segment), and each pair."""
    true, said, both = Counter(), Counter(), Counter()
    for a, b, known in zip(p, t, keep, strict=True):
        if known:
            true[b] += 1
            if a is not None:
                said[a] += 1
                both[b, a] += 1
    return true, said, both


def instances(*, pred: Path, truth: Path, views: str = "*") -> Score:
    true, said, both = Counter(), Counter(), Counter()
    count = 0
    for _, p, t in _maps(pred, truth, views):
        found = _overlap(
            [i or None for i in p.ravel().tolist()],
            t.ravel().tolist(),
            (t > 0).ravel().tolist(),
        )
        true, said, both = true + found[0], said + found[1], both + found[2]
        count += 1
    ious = _best_sum({k: n / (true[k[0]] + said[k[1]] - n) for k, n in both.items()}, list(true))
    hits = sum(iou > 0.5 for iou in ious)
    return {
        "mIoU": sum(ious) / len(true),
        "recall50": hits / len(true),
        "precision50": hits / max(len(said), 1),
        "truth_instances": len(true),
        "predicted_instances": len(said),
        "views": count,
    }


def _best_sum(iou: dict[tuple[Any, Any], float], true: list) -> list[float]:
    """IoUs of the matching one to one with the largest sum: best sums over sets of used ids."""
    best: dict[frozenset, tuple[float, tuple[float, ...]]] = {frozenset(): (0.0, ())}
    for t in true:
        options = [(None, 0.0), *((p, v) for (own, p), v in iou.items() if own == t)]
        following: dict[frozenset, tuple[float, tuple[float, ...]]] = {}
        for (used, (total, chosen)), (p, v) in itertools.product(best.items(), options):
            if p in used:
                continue
            key = used if p is None else used | {p}
            candidate = (total + v, (*chosen, v))
            following[key] = max(following.get(key, candidate), candidate)
        best = following
    return list(max(best.values())[1])


def panoptic(
    *, pred_instance: Path, pred_semantic: Path, truth_instance: Path, truth_semantic: Path,
    metadata: Path, scores: Path | None = None, views: str = "*",
) -> Score:  # fmt: skip
    rows = json.loads(metadata.read_text())["classes"]
    things = {row["id"] for row in rows if row["isthing"]}
    ranks = {int(k): v for k, v in json.loads(scores.read_text()).items()} if scores else {}
    true, said, both = Counter(), Counter(), Counter()
    detections, wanted = defaultdict(list), Counter()
    classes = list(_maps(pred_semantic, truth_semantic, views))
    for (name, pc, tc), (_, pi, ti) in zip(
        classes, _maps(pred_instance, truth_instance, views), strict=True
    ):
        p = [_segment(c, i, things) for c, i in zip(*map(_flat, (pc, pi)), strict=True)]
        t = [_segment(c, i, things) for c, i in zip(*map(_flat, (tc, ti)), strict=True)]
        one = _overlap(p, t, [s is not None for s in t])
        true, said, both = true + one[0], said + one[1], both + one[2]
        for segment in one[0]:
            wanted[segment[0]] += segment[0] in things
        for segment in sorted(one[1]):
            if segment[0] in things:
                best = max(
                    ((one[2][t, segment] / (one[0][t] + one[1][segment] - one[2][t, segment]), t)
                     for t in sorted(one[0]) if t[0] == segment[0]),
                    key=lambda pair: pair[0], default=(0.0, None),
                )  # fmt: skip
                rank = ranks.get(segment[1], 1.0)
                detections[segment[0]].append((rank, best[0], (name, best[1])))
    quality = _panoptic_quality(true, said, both)
    precision = [_average_precision(detections[c], n) for c, n in wanted.items() if n]
    predicted, known = (np.concatenate([m[i].ravel() for m in classes]) for i in (1, 2))

    def mean_pq(chosen: Callable[[int], bool]) -> float:
        return fmean([q[0] for c, q in quality.items() if chosen(c)] or [0.0])

    return {
        "PQ_scene": mean_pq(lambda c: True),
        "PQ_things": mean_pq(lambda c: c in things),
        "PQ_stuff": mean_pq(lambda c: c not in things),
        "mAP50": fmean(precision or [0.0]),
        "mIoU": semantic_scores(predicted, known)["mIoU"],
        "views": len(classes),
        "tp": sum(q[1] for q in quality.values()),
        "fp": sum(q[2] for q in quality.values()),
        "fn": sum(q[3] for q in quality.values()),
    }


def _flat(array: np.ndarray) -> list[int]:
    return array.ravel().tolist()


def _segment(class_id: int, instance: int, things: set[int]) -> Segment | None:
    """What a pixel belongs to: the instance of a thing, all of a class of stuff, or nothing."""
    return (class_id, instance if class_id in things else 0) if class_id else None


def _panoptic_quality(true: Counter, said: Counter, both: Counter) -> dict[int, tuple]:
    """PQ, hits, false ones and missed ones of each class."""
    quality = {}
    for c in {segment[0] for segment in (*true, *said)}:
        hits = []
        for (t, p), n in both.items():
            iou = n / (true[t] + said[p] - n)
            if t[0] == p[0] == c and iou > 0.5:
                hits.append(iou)
        missed = sum(t[0] == c for t in true) - len(hits)
        false = sum(p[0] == c for p in said) - len(hits)
        total = sum(hits) / (len(hits) + false / 2 + missed / 2)
        quality[c] = (total, len(hits), false, missed)
    return quality


def _average_precision(found: list[tuple[float, float, tuple]], wanted: int) -> float:
    """Area under the curve of the best precision at each recall or beyond."""
    hits, curve, used = 0, [], set()
    ranked = sorted(found, key=lambda row: -row[0])
    for seen, (_, iou, target) in enumerate(ranked, start=1):
        if iou >= 0.5 and target not in used:
            used.add(target)
            hits += 1
            curve.append([hits / wanted, hits / seen])
    for k in range(len(curve) - 2, -1, -1):
        curve[k][1] = max(curve[k][1], curve[k + 1][1])
    area, before = 0.0, 0.0
    for recall, precision in curve:
        area, before = area + (recall - before) * precision, recall
    return area


COMMANDS = {f.__name__: f for f in (semantic, points, binary, image, instances, panoptic)}


def reference(_: SharedData) -> Callable[..., Score]:
    """The functions above, called with score.py's words."""

    def run(command: str, *words: object) -> Score:
        pairs = zip(words[::2], words[1::2], strict=True)
        options = {str(k).removeprefix("--").replace("-", "_"): v for k, v in pairs}
        return COMMANDS[command](**options)

    return run


def shared_scorer(shared: SharedData) -> Callable[..., Score]:
    """score.py, in a process of its own."""

    def run(*words: object) -> Score:
        command = [sys.executable, str(shared.scorer), *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


SCORERS = {"reference": reference, "score.py": shared_scorer}
