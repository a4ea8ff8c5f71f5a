"""Words voted into 3D: phrases of instances and names of classes, on test views (issue 16, item 1).

    python benchmarks/prompt.py SCENE ../shared/data/office [--rows default published+true ...]
        [--seeds 0 1 2] [--limit N] [--check N] [--json FILE]

Every phrase of `text_embeddings` whose instance at least three test views show is asked for, the
selection is rendered into the test views as `splatseg render --what SELECTION` does it, and scored
as `score.py binary` does it. `found`: phrases whose masks in the initial views show mostly the
instance that is meant. IoU is the mean over views (a view in which neither is anything counts 1),
`pooled` sums over views first. A phrase without an answer has a selection of nothing.

With several seeds numbers are means over them; `spread` is the standard deviation of the IoU over
seeds, and `interval` holds 95 % of the means of phrases drawn anew (bootstrap).

A row of options is followed by what is true in it: `+words` gives true masks of the initial views
instead of what words find, `+masks` lets an oracle segmenter answer points (`TrueMasks`: the
smallest true part or thing that holds them, ragged, 8 % missing) instead of recorded masks. So
`published`, `published+words`, `published+masks` and `published+words+masks` tell what words and
masks cost, `published-weight` and `published-visible` beside them what eq. 6 and eq. 8 do.

`oracle` is the ceiling: mean features of the true instances in train views, and the share of the
phrases whose own instance has the largest plain cosine. `classes` asks for names of classes, all
objects of each. `seen_often` are phrases whose instance more than 60 % of the train views show.
`boundaries` are phrases that were found, by pooled IoU: as selected (`usual`), without confidence
(`hard`), and split by `cut_masks`.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from click_targets import MIN_TEST_VIEWS
from numpy.typing import NDArray
from selected_views import Scores, TestViews
from true_masks import TrueMasks, id_map

from splatseg.core import LabelMap, Rle, Scene, Selection, View
from splatseg.errors import InputError
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
LEAST_PIXELS = 16
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
        self.found: dict[
            tuple[str, str, str, int, int, bool], tuple[list[list[FoundObject]], float]
        ] = {}
        evidence = open_evidence(self.args.features or self.data / "features_text")
        if not isinstance(evidence, FeatureEvidence):
            raise SystemExit("features_text: expected features")
        self.sources = PromptSources(features=evidence, masks=open_evidence(self.data / args.masks))

    def truth(self, view: View, level: str = "instance") -> NDArray[np.int64]:
        return id_map(self.data / level / f"{view.name}.png")

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

    def session(self, options: PromptOptions, seed: int, *, masks: bool = False) -> PromptSession:
        """A session; with `masks` true ones answer points."""
        prompter = TrueMasks(self.scene, self.data, seed) if masks else None
        return PromptSession(
            self.scene.gaussians,
            self.scene.train_views,
            replace(self.sources, prompter=prompter),
            options=options,
            seed=seed,
            up=self.scene.up,
        )

    def right(self, found: FoundObject, id: int) -> bool:
        """Whether most pixels of its masks are of an instance."""
        inside, total = 0, 0
        for view, rle in found.masks:
            mask = rle.decode().numpy()
            inside += int((self.truth(view)[mask] == id).sum())
            total += int(mask.sum())
        return inside > 0.5 * total

    def asked(
        self, options: PromptOptions, seed: int, *, words: bool, masks: bool
    ) -> tuple[list[Answered], dict[str, float]]:
        """All phrases, each by itself; with `words` and `masks` those are true."""
        session = self.session(options, seed, masks=masks)
        # What is found depends on these alone; it is kept from row to row.
        key = (
            options.region, options.phrases, options.initial, options.initial_views, seed, words,
        )  # fmt: skip
        if key not in self.found:
            began = time.perf_counter()
            if words:
                found = [self.true_object(session.initial, one) for one in self.phrases]
            else:
                found = [session.find(one.words)[:1] for one in self.phrases]
            self.found[key] = (found, time.perf_counter() - began)
        return self.voted(session, *self.found[key])

    def true_object(self, views: Sequence[View], phrase: Phrase) -> list[FoundObject]:
        """What a phrase means, by its true masks."""
        masks: list[tuple[View, Rle]] = []
        for view in views:
            mask = torch.from_numpy(self.truth(view) == phrase.id)
            if int(mask.sum()) >= LEAST_PIXELS:
                masks.append((view, Rle.encode(mask)))
        found = FoundObject(word=phrase.words, probability=1.0, masks=tuple(masks))
        return [found] if masks else []

    def voted(
        self, session: PromptSession, found: Sequence[Sequence[FoundObject]], finding: float
    ) -> tuple[list[Answered], dict[str, float]]:
        none = torch.zeros(len(self.scene.gaussians), dtype=torch.bool)
        answers = [Answered(right=False, selection=Selection(mask=none)) for _ in found]
        began, calls, views = time.perf_counter(), 0, 0
        there = [place for place, objects in enumerate(found) if objects]
        for start in range(0, len(there), AT_ONCE):
            part = there[start : start + AT_ONCE]
            try:
                made = session.select([found[place][0] for place in part])
            except InputError as error:  # no view has a mask of any of them
                if "masks: expected" not in str(error):
                    raise
                continue
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

    def row(self, name: str, options: PromptOptions, *, words: bool, masks: bool) -> None:
        """Ask with each seed, score what came, print it and keep it."""
        ids = [one.id for one in self.phrases]
        ious, pooled, rights = [], [], []
        facts: list[dict[str, float]] = []
        for seed in self.args.seeds:
            answers, said = self.asked(options, seed, words=words, masks=masks)
            selections = [one.selection for one in answers]
            scores = self.tests.scores(selections, ids)
            ious.append(scores.iou)
            pooled.append(scores.pooled)
            rights.append(np.array([one.right for one in answers]))
            facts.append(said | {"accuracy": float(scores.accuracy.mean())})
            if self.args.check:
                self.check(selections, scores)
        iou, right = np.stack(ious), np.stack(rights)
        said: dict[str, Any] = {
            "phrases": len(ids),
            "found": float(right.sum(axis=1).mean()),
            "share": float(right.mean()),
            "iou": float(iou.mean()),
            "spread": float(iou.mean(axis=1).std(ddof=1)) if len(iou) > 1 else 0.0,
            "interval": [round(float(end), 4) for end in interval(iou.mean(axis=0))],
            "pooled": float(np.mean(pooled)),
            "iou_found": float(iou[right].mean()) if right.any() else 0.0,
            "pooled_found": float(np.stack(pooled)[right].mean()) if right.any() else 0.0,
        }
        often = self.often
        if often.any():
            said["seen_often"] = int(often.sum())
            said["iou_seen_often"] = float(iou[:, often].mean())
        said |= {key: float(np.mean([one[key] for one in facts])) for key in facts[0]}
        self.results[name] = said | {
            "by_phrase": [
                [one.words, float(right[:, at].mean()), *iou[:, at].round(4).tolist()]
                for at, one in enumerate(self.phrases)
            ]
        }
        shown = {k: round(v, 4) if isinstance(v, float) else v for k, v in said.items()}
        print(name, shown, flush=True)

    def check(self, selections: Sequence[Selection], scores: Scores) -> None:
        """Hold some phrases to `score.py`."""
        with tempfile.TemporaryDirectory() as folder:
            self.tests.check(
                selections,
                self.phrases,  # type: ignore[arg-type]
                Path(folder),
                self.args.check,
                scores,
            )

    @cached_property
    def often(self) -> NDArray[np.bool_]:
        """Phrases whose instance more than 60 % of the train views show."""
        maps = [set(np.unique(self.truth(view)).tolist()) for view in self.scene.train_views]
        share = [np.mean([one.id in ids for ids in maps]) for one in self.phrases]
        return np.array(share) > SEEN_OFTEN


def interval(values: NDArray[np.float64], draws: int = 2000) -> tuple[float, float]:
    """Between which 95 % of the means of values drawn anew lie."""
    rng = np.random.default_rng(0)
    means = values[rng.integers(0, len(values), (draws, len(values)))].mean(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    return float(low), float(high)


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


def classes(bench: Bench) -> None:
    """Names of the classes that are there, all objects of each."""
    table = json.loads((bench.data / "metadata.json").read_text())["classes"]
    names = [(row["name"], row["id"]) for row in table if row["present"] and row["isthing"]]
    views = TestViews(bench.scene, bench.data, level="semantic")  # type: ignore[arg-type]
    for many in ("one", "all"):
        session = bench.session(
            replace(DEFAULT, objects=many, min_probability=0.3 if many == "all" else 0.05),
            bench.args.seeds[0],
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
    session = bench.session(DEFAULT, bench.args.seeds[0])
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
    "whole": replace(DEFAULT, phrases="whole"),
    "rounds1": replace(DEFAULT, rounds=1),
    "cells": replace(DEFAULT, region="cells"),
    "views10": replace(DEFAULT, view_share=0.1),
    "views50": replace(DEFAULT, view_share=0.5),
    "visible": replace(DEFAULT, vote="visible"),
    "visible06": replace(DEFAULT, vote="visible", threshold=0.6),
    "transposed06": replace(DEFAULT, threshold=0.6),
    "eq8": replace(DEFAULT, vote="published"),
    "random-points": replace(DEFAULT, sampling="random"),
    "centre": replace(DEFAULT, lifting="centre"),
    "published": PUBLISHED,
    "published100": replace(PUBLISHED, view_share=1.0),
    "published-single": replace(PUBLISHED, initial="single"),
    "published-random": replace(PUBLISHED, initial="random"),
    "published10": replace(PUBLISHED, view_share=0.1),
    "published-weight": replace(PUBLISHED, lifting="weight"),
    "published-visible": replace(PUBLISHED, vote="visible"),
    "published-weight-visible": replace(PUBLISHED, lifting="weight", vote="visible"),
}


ROWS: dict[str, Callable[[Bench], None]] = {
    "oracle": oracle,
    "classes": classes,
    "boundaries": boundaries,
}


def ask(bench: Bench, row: str) -> None:
    """A row of options, and what is true in it."""
    name, *true = row.split("+")
    if name not in OPTIONS or not set(true) <= {"words", "masks"}:
        raise SystemExit(f"rows: expected {', '.join((*ROWS, *OPTIONS))}, got {row!r}.")
    bench.row(row, OPTIONS[name], words="words" in true, masks="masks" in true)


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--rows", nargs="+", default=[*ROWS, *OPTIONS])
    parser.add_argument("--masks", default="masks_sam")
    parser.add_argument("--features", type=Path, help="in place of DATA/features_text")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--limit", type=int, help="so many phrases, evenly through all")
    parser.add_argument("--check", type=int, default=0, help="so many of each row by score.py")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    bench = Bench(args)
    for name in args.rows:
        if name in ROWS:
            ROWS[name](bench)
        else:
            ask(bench, name)
        if args.json is not None:
            args.json.write_text(json.dumps(bench.results, indent=1))


if __name__ == "__main__":
    main()
