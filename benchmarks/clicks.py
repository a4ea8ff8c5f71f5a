"""Selections by a click, a stroke, a box or a mask, scored on test views (issue 14, item 1).

    python benchmarks/clicks.py SCENE ../shared/data/office --source layer --layer masks_sam \
        [--evidence masks_sam] [--rows click clicks3 mask ...] [--seed 0] [--work DIR] [--json FILE]

For every thing instance that at least three test views show, one train view is drawn by the seed
among those in which it covers at least 400 pixels (or the one that shows most of it), and clicked
at the pixel of its largest region there that is farthest from the rim; nothing is tuned by eye.
What is selected is rendered into the test views, as `splatseg render --what SELECTION` does it, and
scored as `score.py binary` does it: IoU is the mean over views, of which those in which neither is
anything count 1; pooled sums intersections and unions over the views first. Rows:

- `click`: one click, object granularity; `auto`: granularity left at its default.
- `noisy`: one click up to 5 pixels from the rim, the first of five that are drawn, `noisy1` to
  `noisy4` the others; `scribble`: a stroke; `box`: its bounding box.
- `clicks3`: two more clicks where the selection itself asks for them, with the truth's answer.
- `mask`: the true mask of that view; `recorded`: the recorded mask there that fits it best; `sam`:
  of the recorded masks at the click the one that fits best, as a mask.
- `single`: the true mask of that view projected alone (SAGA's Table 2): each Gaussian of which the
  view shows most inside the mask.
- `per_view`: one recorded mask a view, chosen by what is selected so far (SAGA's Table 3), with
  its agreement with `click`, for `--limit` objects.
- `robot`: clicks at the middle of the largest error in ten train views: number of clicks to an IoU
  of 0.85 and 0.90 (NoC), at most ten.

`--level part` asks for parts of things instead, at the granularity of parts; its row `grouped` is
what the recorded masks of parts say, grouped by truth and lifted (`--grouped FOLDER` of what each
recorded mask is). `--pictures DIR` draws the ten worst clicks, and says why they are.

`--check N` has the first N objects of each row scored by ../shared/score/score.py too.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from click_targets import NOISY_CLICKS, ClickTarget, GroupedParts, Targets
from numpy.typing import NDArray
from per_view_masks import PerViewMasks
from selected_views import TestViews

from splatseg.core import Features, LabelMap, Selection, View
from splatseg.errors import InputError
from splatseg.io.evidence import open_evidence
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.lift import uplift
from splatseg.lift.voting.segment_masses import view_masses
from splatseg.prompting.feature_source import (
    FeatureMembership,
    FeatureMembershipOptions,
)
from splatseg.prompting.prompts import ViewPrompt
from splatseg.tasks import SelectOptions, open_selector
from splatseg.tasks.see import prompter_of
from splatseg.tasks.sources import SelectPostProcessing, SelectThreshold

MOST_CLICKS = 10
ROBOT_VIEWS = 10
LEVELS = (0.85, 0.90)


class Bench:
    """A scene, its truth, and a session that selects in it."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.scene = load_scene(args.scene)
        self.targets = Targets(
            self.scene, args.data, seed=args.seed, limit=args.limit, level=args.level
        )
        self.views = TestViews(self.scene, args.data, level=args.level)
        self.per_view = PerViewMasks(self.scene, args.data / args.evidence)
        self.args = args
        self.options = SelectOptions(
            source=args.source,
            from_layer=args.layer,
            granularity="part" if args.level == "part" else "object",
            threshold=args.rule,
            post_processing=args.after,
        )
        prompter = None if args.prompter is None else prompter_of(
            args.prompter, self.scene, report=print
        )  # fmt: skip
        self.session = open_selector(
            self.scene, options=self.options, source=self._source(), prompter=prompter
        )
        self.seconds: list[float] = []

    def _source(self) -> FeatureMembership | None:
        """Features with a threshold of their own, where one is asked for."""
        args = self.args
        if args.threshold is None:
            return None
        layer = load_scene_layer(args.scene, args.layer)
        if not isinstance(layer, Features):
            raise SystemExit(f"{args.layer}: thresholds are of features")
        options = FeatureMembershipOptions(threshold=args.threshold)
        return FeatureMembership(layer, self.scene.gaussians, options=options)

    def select(self, prompts: Sequence[ViewPrompt], **changes: Any) -> Any:
        """What prompts select; nothing where the source has no answer."""
        options = SelectOptions(**(_fields(self.options) | changes)) if changes else None
        began = time.perf_counter()
        try:
            found = self.session.select(prompts, options=options, advise=False)
        except InputError:
            return Selection(mask=torch.zeros(len(self.scene.gaussians), dtype=torch.bool))
        self.seconds.append(time.perf_counter() - began)
        return found.selection

    def click(self, target: ClickTarget, **changes: Any) -> Selection:
        """By one click in the middle."""
        return self.select([_point(target.view, target.point)], **changes)

    def noisy(self, target: ClickTarget, draw: int = 0) -> Selection:
        """By one click near the rim."""
        return self.select([_point(target.view, target.noisy[draw])])

    def scribble(self, target: ClickTarget) -> Selection:
        """By a stroke."""
        return self.select([ViewPrompt(view=target.view, scribble=torch.from_numpy(target.stroke))])

    def box(self, target: ClickTarget) -> Selection:
        """By the bounding box."""
        return self.select([ViewPrompt(view=target.view, box=torch.tensor(target.box))])

    def mask(self, target: ClickTarget) -> Selection:
        """By the true mask."""
        return self.select([ViewPrompt(view=target.view, mask=torch.from_numpy(target.mask))])

    def recorded(self, target: ClickTarget, *, at_click: bool = False) -> Selection:
        """By the recorded mask of that view that fits best."""
        masks = open_evidence(self.args.data / self.args.evidence).masks(target.view.name)
        best, chosen = -1.0, None
        column, row = int(target.point[0]), int(target.point[1])
        for index in range(len(masks)):
            mask = masks.dense(index).numpy()
            if at_click and not mask[row, column]:
                continue
            share = _iou(mask, target.mask)
            if share > best:
                best, chosen = share, mask
        if chosen is None:
            return self.click(target)
        return self.select([ViewPrompt(view=target.view, mask=torch.from_numpy(chosen))])

    def single(self, target: ClickTarget) -> Selection:
        """By what one view alone shows."""
        ids = torch.from_numpy(np.where(target.mask, 1, 0).astype(np.int32))
        found = view_masses(self.scene.gaussians, target.view.camera, LabelMap(ids=ids))
        inside = torch.zeros(len(self.scene.gaussians))
        own = found.segment == 1
        inside[found.gaussian[own]] = found.weight[own]
        return Selection(mask=(inside > 0.5 * found.visible) & (inside > 0))

    def slow(self, target: ClickTarget) -> Selection:
        """By one recorded mask a view."""
        began = time.perf_counter()
        found = self.per_view.select(target)
        self.seconds.append(time.perf_counter() - began)
        return found

    def grouped(self) -> Callable[[ClickTarget], Selection]:
        """By the recorded masks of parts that truth says are of one."""
        maps = GroupedParts(self.args.data / self.args.evidence, self.args.grouped)
        ids = uplift(self.scene.gaussians, self.scene.train_views, maps).ids
        return lambda target: Selection(mask=ids == target.id + 1)

    def asked(self, target: ClickTarget, clicks: int) -> Selection:
        """By clicks where the selection asks for them."""
        prompts = [_point(target.view, target.point)]
        for _ in range(clicks - 1):
            try:
                found = self.session.select(prompts, advise=True)
            except InputError:
                break
            hint = found.next_click
            if hint is None:
                break
            x, y = (float(v) for v in hint.point)
            sign = self.targets.truth(hint.view)[int(y), int(x)] == target.id
            more = [*prompts, _point(hint.view, (x, y), positive=bool(sign))]
            try:
                self.session.select(more, advise=False)
            except InputError:
                break
            prompts = more
        return self.select(prompts)

    def robot(self, target: ClickTarget) -> list[float]:
        """IoU on test views after each click of a robot that sees the truth of train views."""
        prompts = [_point(target.view, target.point)]
        shown = self.targets.best_views(target.id, ROBOT_VIEWS)
        scores: list[float] = []
        for _ in range(MOST_CLICKS):
            selection = self.select(prompts)
            scores.append(float(self.views.scores([selection], [target.id]).iou[0]))
            if scores[-1] >= LEVELS[-1]:
                break
            error = self.targets.largest_error(self.scene.gaussians, selection, target.id, shown)
            if error is None:
                break
            view, point, positive = error
            prompts.append(_point(view, point, positive=positive))
        return scores


def _fields(options: SelectOptions) -> dict[str, Any]:
    return {name: getattr(options, name) for name in SelectOptions.__dataclass_fields__}


def _point(view: View, point: Sequence[float], *, positive: bool = True) -> ViewPrompt:
    return ViewPrompt(
        view=view, points=torch.tensor([list(point)]), positive=torch.tensor([positive])
    )


def _iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else 0.0


def rows_of(bench: Bench) -> dict[str, Callable[[ClickTarget], Selection]]:
    """How each row selects."""
    return {
        "click": bench.click,
        "auto": lambda target: bench.click(target, granularity="auto"),
        "raw": lambda target: bench.click(target, post_processing="none"),
        "noisy": bench.noisy,
        **{f"noisy{draw}": partial(bench.noisy, draw=draw) for draw in range(1, NOISY_CLICKS)},
        "scribble": bench.scribble,
        "box": bench.box,
        "clicks3": lambda target: bench.asked(target, 3),
        "mask": bench.mask,
        "recorded": bench.recorded,
        "sam": lambda target: bench.recorded(target, at_click=True),
        "single": bench.single,
        "per_view": bench.slow,
    }


def run_row(bench: Bench, name: str, select: Callable[[ClickTarget], Selection]) -> dict[str, Any]:
    """Select every object, and score all of them."""
    bench.seconds.clear()
    targets = bench.targets.objects
    selections = [select(target) for target in targets]
    seconds = list(bench.seconds)
    scores = bench.views.scores(selections, [target.id for target in targets])
    ious = scores.pooled
    print(
        f"{name:10s} IoU {scores.iou.mean():.4f}  pooled {ious.mean():.4f}  "
        f"accuracy {scores.accuracy.mean():.4f}  "
        f"median {np.median(ious):.3f}  below 0.5: {(ious < 0.5).sum()} of {len(ious)}  "
        f"{1000 * float(np.median(seconds or [0])):.0f} ms",
        flush=True,
    )
    causes: dict[int, str] = {}
    for place, index in enumerate(np.argsort(ious)[: bench.args.worst]):
        words = ""
        if bench.args.pictures:
            file = bench.args.pictures / name / f"{place:02d}.png"
            cause = bench.views.picture(selections[index], targets[index], file)
            words = causes[targets[index].id] = cause.words
        print(f"    {ious[index]:.3f} {targets[index].name}: {words}")
    if name == "per_view":
        fast = [bench.click(target) for target in targets]
        print(f"    agreement with click {bench.views.agreement(selections, fast).mean():.4f}")
    if bench.args.work and bench.args.check:
        bench.views.check(selections, targets, bench.args.work / name, bench.args.check, scores)
    return {
        "row": name,
        "iou": float(scores.iou.mean()),
        "pooled": float(ious.mean()),
        "accuracy": float(scores.accuracy.mean()),
        "milliseconds": 1000 * float(np.median(seconds or [0])),
        "causes": causes,
        "objects": {t.id: float(v) for t, v in zip(targets, ious, strict=True)},
    }


def run_robot(bench: Bench) -> dict[str, Any]:
    """The interactive curve."""
    curves = [bench.robot(target) for target in bench.targets.objects]
    full = np.array([curve + [max(curve)] * (MOST_CLICKS - len(curve)) for curve in curves])
    means = full.mean(axis=0)
    needed: dict[str, float] = {}
    for level in LEVELS:
        reached = full >= level
        first = np.where(reached.any(axis=1), reached.argmax(axis=1) + 1, MOST_CLICKS)
        needed[f"NoC@{round(100 * level)}"] = float(first.mean())
    words = "  ".join(f"{key} {value:.2f}" for key, value in needed.items())
    print("robot      IoU by clicks", means.round(3).tolist(), words, flush=True)
    return {"row": "robot", "curve": means.tolist(), **needed}


def main() -> None:
    """Run the rows asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--source", default="auto")
    parser.add_argument("--layer")
    parser.add_argument("--prompter", help="model of source propagate; recorded masks by name")
    parser.add_argument("--threshold", type=float, help="of features, instead of the usual one")
    parser.add_argument("--rule", choices=get_args(SelectThreshold), default="auto")
    parser.add_argument("--after", choices=get_args(SelectPostProcessing), default="auto")
    parser.add_argument("--evidence", default="masks_sam")
    parser.add_argument("--rows", nargs="+", default=["click", "auto", "noisy", "mask"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=int, help="so many objects, evenly through all")
    parser.add_argument("--level", choices=("instance", "part"), default="instance")
    parser.add_argument("--grouped", type=Path, help="truth of recorded masks, for that row")
    parser.add_argument("--worst", type=int, default=0)
    parser.add_argument("--pictures", type=Path, help="where the worst are drawn")
    parser.add_argument("--work", type=Path)
    parser.add_argument("--check", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    bench = Bench(args)
    known = rows_of(bench)
    if "grouped" in args.rows:
        known["grouped"] = bench.grouped()
    said = [
        run_robot(bench) if name == "robot" else run_row(bench, name, known[name])
        for name in args.rows
    ]
    if args.json:
        args.json.write_text(json.dumps(said, indent=1))


if __name__ == "__main__":
    main()
