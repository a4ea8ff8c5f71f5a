"""Words voted into 3D: phrases of instances and names of classes, on test views (issue 16, item 1).

    python benchmarks/prompt.py SCENE ../shared/data/office [--rows default single random ...]
        [--limit N] [--check N] [--json FILE] [--work DIR]

Every phrase of `text_embeddings` whose instance at least three test views show is asked for, the
selection is rendered into the test views as `splatseg render --what SELECTION` does it, and scored
as `score.py binary` does it. `found`: phrases whose masks in the initial views show mostly the
instance that is meant. IoU is the mean over views (a view in which neither is anything counts 1),
`pooled` sums over views first. A phrase without an answer has a selection of nothing.

`oracle` is the ceiling: mean features of the true instances in train views, and the share of the
phrases whose own instance has the largest plain cosine. `classes` asks for names of classes, all
objects of each. `true` gives true masks of the initial views instead of words: what is lost after
words are found. `seen_often` are phrases whose instance more than 60 % of the train views show.
`boundaries` are phrases that were found, by pooled IoU: as selected (`usual`), without confidence
(`hard`), and split by `cut_masks`.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from click_targets import MIN_TEST_VIEWS
from numpy.typing import NDArray
from PIL import Image
from selected_views import TestViews

from splatseg.core import LabelMap, Rle, Scene, Selection, View
from splatseg.io.evidence import FeatureEvidence, load_text_embeddings, open_evidence
from splatseg.io.scene import load_scene
from splatseg.lift.boundaries.cut import cut_masks
from splatseg.lift.vocabulary import vocabulary_of
from splatseg.methods.prompt import (
    PUBLISHED,
    FoundObject,
    PromptOptions,
    PromptSession,
    PromptSources,
)

SEEN_OFTEN = 0.6
AT_ONCE = 32


@dataclass(frozen=True)
class Phrase:
    """Words, and what they mean."""

    words: str
    id: int

    @property
    def name(self) -> str:
        return self.words


@dataclass(frozen=True)
class Answered:
    """What came of a phrase."""

    right: bool
    selection: Selection


class Bench:
    """A scene, its truth and its phrases."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.scene: Scene = load_scene(args.scene)
        self.data: Path = args.data
        self.args = args
        self.level = "instance"
        self.words = load_text_embeddings(self.data)
        self.tests = TestViews(self.scene, self.data)
        self.phrases = self._phrases()
        self.results: dict[str, Any] = {}
        self.found: dict[tuple[str, str, int], tuple[list[list[FoundObject]], float]] = {}
        evidence = open_evidence(self.data / "features_text")
        if not isinstance(evidence, FeatureEvidence):
            raise SystemExit("features_text: expected features")
        self.sources = PromptSources(features=evidence, masks=open_evidence(self.data / args.masks))

    def truth(self, view: View, level: str = "instance") -> NDArray[np.int64]:
        return _map(self.data / level / f"{view.name}.png")

    def _phrases(self) -> list[Phrase]:
        shown: dict[int, int] = {}
        for view in self.scene.test_views:
            for id in np.unique(self.truth(view)).tolist():
                shown[id] = shown.get(id, 0) + 1
        rows = zip(self.words.labels, self.words.kinds, self.words.target_ids, strict=True)
        found = [
            Phrase(words, id)
            for words, kind, id in rows
            if kind == "instance" and shown.get(id, 0) >= MIN_TEST_VIEWS
        ]
        if self.args.limit is not None and self.args.limit < len(found):
            places = np.linspace(0, len(found) - 1, self.args.limit).round().astype(int)
            found = [found[place] for place in places]
        return found

    def session(self, options: PromptOptions) -> PromptSession:
        return PromptSession(
            self.scene.gaussians,
            self.scene.train_views,
            self.sources,
            options=options,
            seed=self.args.seed,
        )

    def right(self, found: FoundObject, id: int) -> bool:
        """Whether most pixels of its masks are of an instance."""
        inside, total = 0, 0
        for view, rle in found.masks:
            mask = rle.decode().numpy()
            inside += int((self.truth(view)[mask] == id).sum())
            total += int(mask.sum())
        return inside > 0.5 * total

    def asked(self, options: PromptOptions) -> tuple[list[Answered], dict[str, float]]:
        """All phrases, each by itself."""
        session = self.session(options)
        # What is found depends on these alone; it is kept from row to row.
        key = (options.region, options.initial, options.initial_views)
        if key not in self.found:
            began = time.perf_counter()
            found = [session.find(one.words)[:1] for one in self.phrases]
            self.found[key] = (found, time.perf_counter() - began)
        return self.voted(session, *self.found[key])

    def voted(
        self, session: PromptSession, found: Sequence[Sequence[FoundObject]], finding: float
    ) -> tuple[list[Answered], dict[str, float]]:
        none = torch.zeros(len(self.scene.gaussians), dtype=torch.bool)
        answers = [Answered(right=False, selection=Selection(mask=none)) for _ in found]
        began, calls, views = time.perf_counter(), 0, 0
        there = [place for place, objects in enumerate(found) if objects]
        for start in range(0, len(there), AT_ONCE):
            part = there[start : start + AT_ONCE]
            made = session.select([found[place][0] for place in part])
            calls += made.mask_calls
            for place, one in zip(part, made.objects, strict=True):
                views += one.projected
                answers[place] = Answered(
                    right=self.right(found[place][0], self.phrases[place].id),
                    selection=Selection.of_confidence(one.confidence),
                )
        voting = time.perf_counter() - began
        count = max(len(found), 1)
        return answers, {
            "seconds_find": finding / count,
            "seconds_vote": voting / count,
            "mask_calls": calls / count,
            "views": views / count,
        }

    def row(self, name: str, answers: Sequence[Answered], facts: dict[str, float]) -> None:
        """Score what came, print it and keep it."""
        selections = [one.selection for one in answers]
        scores = self.tests.scores(selections, [one.id for one in self.phrases])
        right = np.array([one.right for one in answers])
        said: dict[str, Any] = {"phrases": len(answers), "found": int(right.sum())}
        said["share"] = float(right.mean())
        for kind in ("iou", "pooled", "accuracy"):
            values = getattr(scores, kind)
            said[kind] = float(values.mean())
            said[f"{kind}_found"] = float(values[right].mean()) if right.any() else 0.0
        often = self.often()
        if often.any():
            said["seen_often"] = int(often.sum())
            said["iou_seen_often"] = float(scores.iou[often].mean())
            both = often & right
            said["iou_seen_often_found"] = float(scores.iou[both].mean()) if both.any() else 0.0
        said |= facts
        self.results[name] = said | {
            "by_phrase": [
                [one.words, bool(right[i]), round(float(scores.iou[i]), 4),
                 round(float(scores.pooled[i]), 4)]
                for i, one in enumerate(self.phrases)
            ]
        }  # fmt: skip
        print(name, {k: round(v, 4) for k, v in said.items()}, flush=True)
        if self.args.check:
            with tempfile.TemporaryDirectory() as folder:
                self.tests.check(
                    selections,
                    self.phrases,
                    Path(folder),
                    self.args.check,
                    scores,  # type: ignore[arg-type]
                )

    @lru_cache(maxsize=1)  # noqa: B019
    def often(self) -> NDArray[np.bool_]:
        """Phrases whose instance more than 60 % of the train views show."""
        maps = [set(np.unique(self.truth(view)).tolist()) for view in self.scene.train_views]
        share = [np.mean([one.id in ids for ids in maps]) for one in self.phrases]
        return np.array(share) > SEEN_OFTEN


@lru_cache(maxsize=512)
def _map(path: Path) -> NDArray[np.int64]:
    return np.asarray(Image.open(path)).astype(np.int64)


def oracle(bench: Bench) -> None:
    """Mean features of true instances, plain cosines."""
    evidence = bench.sources.features
    if evidence is None:
        return
    vocabulary = vocabulary_of(evidence)
    sums: dict[int, NDArray[np.float64]] = {}
    for view in bench.scene.train_views:
        grid = evidence.features(view.name)
        rows, columns, channels = grid.features.shape
        ids = bench.truth(view)[: rows * grid.stride, : columns * grid.stride]
        cell = np.arange(rows * columns).reshape(rows, columns)
        cell = cell.repeat(grid.stride, 0).repeat(grid.stride, 1)
        values = grid.features.double().reshape(-1, channels).numpy()
        for id in np.unique(ids).tolist():
            count = np.bincount(cell[ids == id], minlength=len(values)).astype(np.float64)
            held = np.concatenate((count @ values, [count.sum()]))
            sums[id] = sums.get(id, 0) + held
    ids = sorted(id for id in sums if id > 0)
    means = torch.from_numpy(np.stack([sums[id][:-1] / sums[id][-1] for id in ids])).float()
    vectors = vocabulary.vectors([one.words for one in bench.phrases])
    best = vocabulary.space.cosines(means, vectors).argmax(dim=0).tolist()
    own = [ids[row] == one.id for row, one in zip(best, bench.phrases, strict=True)]
    said = {"phrases": len(own), "ceiling": float(np.mean(own))}
    bench.results["oracle"] = said
    print("oracle", said, flush=True)


def true_masks(bench: Bench) -> None:
    """Selections from the true masks of the initial views."""
    session = bench.session(PromptOptions())
    found: list[list[FoundObject]] = []
    for one in bench.phrases:
        masks: list[tuple[View, Rle]] = []
        for view in session.initial:
            mask = torch.from_numpy(bench.truth(view) == one.id)
            if int(mask.sum()) >= 16:
                masks.append((view, Rle.encode(mask)))
        found.append(
            [FoundObject(word=one.words, probability=1.0, masks=tuple(masks))] if masks else []
        )
    bench.row("true", *bench.voted(session, found, 0.0))


def classes(bench: Bench) -> None:
    """Names of the classes that are there, all objects of each."""
    table = json.loads((bench.data / "metadata.json").read_text())["classes"]
    names = [(row["name"], row["id"]) for row in table if row["present"] and row["isthing"]]
    views = TestViews(bench.scene, bench.data, level="semantic")  # type: ignore[arg-type]
    for many in ("one", "all"):
        session = bench.session(
            replace(PromptOptions(), objects=many, min_probability=0.3 if many == "all" else 0.05)
        )
        none = torch.zeros(len(bench.scene.gaussians), dtype=torch.bool)
        selections: list[Selection] = []
        objects = 0
        for name, _ in names:
            found = session.find(name)
            objects += len(found)
            selections.append(
                Selection.of_confidence(session.select(found).confidence)
                if found
                else Selection(mask=none)
            )
        scores = views.scores(selections, [id for _, id in names])
        said = {
            "classes": len(names),
            "objects": objects,
            "iou": float(scores.iou.mean()),
            "pooled": float(scores.pooled.mean()),
        }
        bench.results[f"classes {many}"] = said
        print(f"classes {many}", {k: round(v, 4) for k, v in said.items()}, flush=True)


@dataclass(frozen=True)
class _ObjectMaps:
    """Masks of an object as label maps: 1 inside, 2 outside."""

    masks: dict[str, torch.Tensor]

    @property
    def view_names(self) -> Sequence[str]:
        return tuple(self.masks)

    def label_map(self, name: str) -> LabelMap:
        return LabelMap(ids=torch.where(self.masks[name], 1, 2).int())


def boundaries(bench: Bench) -> None:
    """Gaussians at rims of phrases that were found: as they are, and split."""
    session = bench.session(PromptOptions())
    rows: list[list[float]] = []
    for one in bench.phrases:
        found = session.find(one.words)[:1]
        if not found or not bench.right(found[0], one.id):
            continue
        (made,) = session.select(found).objects
        masks = [(view, rle.decode()) for view, rle in made.masks]
        usual = Selection.of_confidence(made.confidence)
        hard = Selection(mask=usual.mask)
        cut = cut_masks(
            bench.scene.gaussians,
            [view for view, _ in masks],
            _ObjectMaps({view.name: mask for view, mask in masks}),
            [1],
        )
        scenes = (
            (bench.scene.gaussians, usual),
            (bench.scene.gaussians, hard),
            (cut.edited.gaussians, cut.inside),
        )
        rows.append([])
        for gaussians, selection in scenes:
            views = TestViews(replace(bench.scene, gaussians=gaussians), bench.data)
            rows[-1].append(float(views.scores([selection], [one.id]).pooled[0]))
        print(one.words, [round(value, 4) for value in rows[-1]], flush=True)
    names = ("usual", "hard", "cut")
    said = {name: float(value) for name, value in zip(names, np.mean(rows, axis=0), strict=True)}
    bench.results["boundaries"] = said | {"phrases": len(rows)}
    print("boundaries", len(rows), {k: round(v, 4) for k, v in said.items()}, flush=True)


DEFAULT = PromptOptions()
OPTIONS: dict[str, PromptOptions] = {
    "default": DEFAULT,
    "single": replace(DEFAULT, initial="single"),
    "kmeans4": replace(DEFAULT, initial_views=4),
    "random4": replace(DEFAULT, initial="random", initial_views=4),
    "random24": replace(DEFAULT, initial="random"),
    "rounds1": replace(DEFAULT, rounds=1),
    "cells": replace(DEFAULT, region="cells"),
    "views10": replace(DEFAULT, view_share=0.1),
    "views50": replace(DEFAULT, view_share=0.5),
    "views10random": replace(DEFAULT, view_share=0.1, view_choice="random"),
    "views50random": replace(DEFAULT, view_share=0.5, view_choice="random"),
    "visible": replace(DEFAULT, vote="visible"),
    "visible06": replace(DEFAULT, vote="visible", threshold=0.6),
    "transposed06": replace(DEFAULT, threshold=0.6),
    "eq8": replace(DEFAULT, vote="published"),
    "no-negatives": replace(DEFAULT, negatives=0),
    "random-points": replace(DEFAULT, sampling="random"),
    "centre": replace(DEFAULT, lifting="centre"),
    "no-occlusion": replace(DEFAULT, occlusion="none"),
    "published": PUBLISHED,
    "published100": replace(PUBLISHED, view_share=1.0),
    "published-single": replace(PUBLISHED, initial="single"),
    "published-random": replace(PUBLISHED, initial="random"),
    "published10": replace(PUBLISHED, view_share=0.1),
}


def _row_of(name: str) -> Callable[[Bench], None]:
    def row(bench: Bench) -> None:
        bench.row(name, *bench.asked(OPTIONS[name]))

    return row


ROWS: dict[str, Callable[[Bench], None]] = {
    "oracle": oracle,
    **{name: _row_of(name) for name in OPTIONS},
    "true": true_masks,
    "classes": classes,
    "boundaries": boundaries,
}


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS))
    parser.add_argument("--masks", default="masks_sam")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=int, help="so many phrases, evenly through all")
    parser.add_argument("--check", type=int, default=0, help="so many of each row by score.py")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    bench = Bench(args)
    for name in args.rows:
        ROWS[name](bench)
        if args.json is not None:
            args.json.write_text(json.dumps(bench.results, indent=1))


if __name__ == "__main__":
    main()
