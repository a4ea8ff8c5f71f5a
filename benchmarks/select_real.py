"""The object of a real capture by a click, clicks, a box, a stroke or a mask in one view.

    python benchmarks/select_real.py SCENE ../shared/data/real/dtu_scan37/masks --evidence masks

The scene is fitted without masks, and its masks are those of `splatseg see`, or any that were
recorded. For each of a few training views, drawn by the seed, the object is asked for in the ways
of `--rows`; what is selected is drawn into all other views as `splatseg render --what SELECTION`
does it, and scored by ../shared/score/score.py: mean IoU over these views, then over the views that
were asked in. Rows:

- `click`: one click at the pixel of the mask farthest from its rim; `group`, `part`: the same with
  that granularity; `clicksN`: N clicks, all but the first where the selection asks for the next
  one, answered by the mask there; `robotN`: clicks at the middle of the largest error in ten views.
- `mask`, `box`, `scribble`: the mask of the view, its box, a stroke through its middle.
- `background`: all but what one click on what the object is not selects.
- `lift`: the mask of the view, projected alone: each Gaussian of which it shows most inside.
- `ceiling`: the masks of all training views, lifted: what the fit lets any selection reach.

`--record NAME` keeps the masks of the training views as evidence NAME of the scene first: the
stand-in for a mask generator that finds the object, where no weights can be had. Only views that
are no training views are scored then.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
import torch
from numpy.typing import NDArray
from PIL import Image

from splatseg.core import LabelMap, MaskSet, Scene, Selection, View
from splatseg.errors import InputError
from splatseg.io.evidence import save_masks
from splatseg.io.scene import load_scene
from splatseg.lift import GaussianField, complete, uplift
from splatseg.lift.voting.segment_masses import view_masses
from splatseg.prompting.prompts import ViewPrompt
from splatseg.tasks import SelectOptions, open_selector
from splatseg.tasks.see import prompter_of

_SCORER = Path(__file__).resolve().parents[2] / "shared" / "score" / "score.py"
_ROBOT_VIEWS = 10

Mask = NDArray[np.bool_]


class Asker:
    """Asks for the object of a scene, and knows the answer.

    Args:
        scene: The scene.
        masks: A folder with a mask a view.
        options: What selections are made from.
    """

    def __init__(
        self, scene: Scene, masks: Path, options: SelectOptions, *, prompter: str | None = None
    ) -> None:
        self.scene = scene
        self._folder = masks
        self._options = options
        model = None if prompter is None else prompter_of(prompter, scene, report=print)
        self._session = open_selector(scene, options=options, prompter=model)

    def truth(self, view: View) -> Mask:
        """The mask of a view."""
        return np.asarray(Image.open(self._folder / f"{view.name}.png").convert("L")) > 127

    def answer(self, row: str, view: View) -> Selection:
        """What a row selects, asked in a view."""
        mask = self.truth(view)
        if row.startswith("clicks"):
            return self._asked(view, int(row.removeprefix("clicks")))
        if row.startswith("robot"):
            return self._corrected(view, int(row.removeprefix("robot")))
        match row:
            case "click":
                return self._select([_click(view, _middle(mask))])
            case "group" | "object" | "part":
                return self._select([_click(view, _middle(mask))], granularity=row)
            case "mask":
                return self._select([ViewPrompt(view=view, mask=torch.from_numpy(mask))])
            case "box":
                rows, columns = np.nonzero(mask)
                box = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
                return self._select([ViewPrompt(view=view, box=torch.tensor(box).float())])
            case "scribble":
                stroke = torch.from_numpy(_stroke(mask))
                return self._select([ViewPrompt(view=view, scribble=stroke)])
            case "background":
                return ~self._select([_click(view, _middle(~mask))])
            case "lift":
                return self._projected(view, mask)
            case "ceiling":
                return self._lifted()
            case _:
                raise SystemExit(f"there is no row {row!r}")

    def _select(self, prompts: Sequence[ViewPrompt], **changes: Any) -> Selection:
        own = {name: getattr(self._options, name) for name in SelectOptions.__dataclass_fields__}
        options = SelectOptions(**(own | changes))
        return self._session.select(prompts, options=options, advise=False).selection

    def _asked(self, view: View, count: int) -> Selection:
        """By clicks where the selection asks for them."""
        prompts = [_click(view, _middle(self.truth(view)))]
        for _ in range(count - 1):
            hint = self._session.select(prompts, advise=True).next_click
            if hint is None:
                break
            x, y = (float(v) for v in hint.point)
            more = [*prompts, _click(hint.view, (x, y), self.truth(hint.view)[int(y), int(x)])]
            if not self._answered(more):
                break
            prompts = more
        return self._select(prompts)

    def _corrected(self, view: View, count: int) -> Selection:
        """By clicks at the middle of the largest error that a few train views show."""
        views = self.scene.train_views
        shown = [views[len(views) * i // _ROBOT_VIEWS] for i in range(_ROBOT_VIEWS)]
        prompts = [_click(view, _middle(self.truth(view)))]
        for _ in range(count - 1):
            field = GaussianField(self.scene.gaussians, {"s": self._select(prompts)})
            worst: tuple[int, ViewPrompt] | None = None
            for other in shown:
                error = drawn(field, other) != self.truth(other)
                pieces, number = scipy.ndimage.label(error)
                if not number:
                    continue
                sizes = np.bincount(pieces.ravel())[1:]
                if worst is None or sizes.max() > worst[0]:
                    x, y = _middle(pieces == 1 + sizes.argmax())
                    inside = self.truth(other)[int(y), int(x)]
                    worst = int(sizes.max()), _click(other, (x, y), inside)
            if worst is None or not self._answered([*prompts, worst[1]]):
                break
            prompts.append(worst[1])
        return self._select(prompts)

    def _answered(self, prompts: Sequence[ViewPrompt]) -> bool:
        """Whether prompts have an answer: what a layer cannot tell apart has none."""
        try:
            self._select(prompts)
        except InputError as error:
            print(f"    {len(prompts)} clicks: {error}", flush=True)
            return False
        return True

    def _projected(self, view: View, mask: Mask) -> Selection:
        ids = torch.from_numpy(mask.astype(np.int32))
        found = view_masses(self.scene.gaussians, view.camera, LabelMap(ids=ids))
        inside = torch.zeros(len(self.scene.gaussians))
        own = found.segment == 1
        inside[found.gaussian[own]] = found.weight[own]
        return Selection(mask=(inside > 0.5 * found.visible) & (inside > 0))

    def _lifted(self) -> Selection:
        maps = {
            view.name: LabelMap(ids=torch.from_numpy(np.where(self.truth(view), 1, 2)).int())
            for view in self.scene.train_views
        }
        lifted = uplift(self.scene.gaussians, self.scene.train_views, _Masks(maps))
        return Selection(mask=complete(self.scene.gaussians, lifted).ids == 1)


class _Masks:
    """Label maps by view, as `uplift` reads them."""

    def __init__(self, maps: dict[str, LabelMap]) -> None:
        self._maps = maps

    @property
    def view_names(self) -> Sequence[str]:
        return tuple(self._maps)

    def label_map(self, name: str) -> LabelMap:
        return self._maps[name]


def drawn(field: GaussianField, view: View) -> Mask:
    """The selection of a field in a view."""
    with field.view(view.camera) as shown:
        return (shown.label_map("s").ids == 1).numpy()


def _click(view: View, point: tuple[float, float], positive: Any = True) -> ViewPrompt:
    return ViewPrompt(view=view, points=torch.tensor([point]), positive=torch.tensor([positive]))


def _middle(mask: Mask) -> tuple[float, float]:
    """x and y of the pixel farthest from the rim."""
    depth = scipy.ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(int(depth.argmax()), depth.shape)
    return float(column) + 0.5, float(row) + 0.5


def _stroke(mask: Mask) -> Mask:
    """A level line through the middle, within the mask, 3 pixels wide."""
    column, row = (int(v) for v in _middle(mask))
    line = np.zeros_like(mask)
    line[row] = mask[row]
    pieces, _ = scipy.ndimage.label(line)
    return scipy.ndimage.binary_dilation(pieces == pieces[row, column], np.ones((3, 3))) & mask


def _record(scene: Scene, masks: Path, name: str) -> None:
    """Keep the masks of training views as evidence."""
    if scene.root is None:
        raise SystemExit("the scene has no folder")
    for view in scene.train_views:
        with Image.open(masks / f"{view.name}.png") as image:
            mask = torch.from_numpy(np.asarray(image.convert("L")) > 127)
        one = MaskSet.from_dense(mask[None])
        save_masks(one, scene.root / "evidence" / name, view.name)


def _scores(
    asker: Asker, selection: Selection, views: Sequence[View], masks: Path, work: Path
) -> Any:
    """What score.py says of some views."""
    field = GaussianField(asker.scene.gaussians, {"s": selection})
    with tempfile.TemporaryDirectory(dir=work) as made:
        for kind in ("pred", "truth"):
            (Path(made) / kind).mkdir()
        for view in views:
            picture = Image.fromarray(drawn(field, view).astype(np.uint8) * 255)
            picture.save(Path(made) / "pred" / f"{view.name}.png")
            (Path(made) / "truth" / f"{view.name}.png").symlink_to(
                (masks / f"{view.name}.png").resolve()
            )
        words = [sys.executable, str(_SCORER), "binary", "--pred", f"{made}/pred"]
        words += ["--truth", f"{made}/truth"]
        return json.loads(subprocess.run(words, check=True, capture_output=True).stdout)


def main() -> None:
    """Ask in a few views, in all ways."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("scene", type=Path)
    parser.add_argument("masks", type=Path)
    parser.add_argument("--source", default="masks")
    parser.add_argument("--layer")
    parser.add_argument("--prompter", help="model of source propagate; recorded masks by name")
    parser.add_argument("--evidence")
    parser.add_argument("--record", help="name under which true masks become evidence")
    parser.add_argument("--rows", nargs="+", default=["click", "group", "clicks3", "mask", "box"])
    parser.add_argument("--views", type=int, default=3, help="training views that are asked in")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()))
    args = parser.parse_args()
    if args.record:
        _record(load_scene(args.scene), args.masks, args.record)
    evidence = args.evidence or args.record
    options = SelectOptions(source=args.source, from_layer=args.layer, evidence=evidence)
    asker = Asker(load_scene(args.scene), args.masks, options, prompter=args.prompter)
    train = asker.scene.train_views
    order = np.random.default_rng(args.seed).permutation(len(train))[: args.views]
    for row in args.rows:
        found: list[float] = []
        for index in order:
            view = train[index]
            try:
                scored = [
                    other
                    for other in asker.scene.views
                    if other.name != view.name and (not args.record or other.split != "train")
                ]
                said = _scores(asker, asker.answer(row, view), scored, args.masks, args.work)
            except InputError as error:
                print(f"    {row} in {view.name}: {error}", flush=True)
                found.append(0.0)
                continue
            found.append(said["IoU_mean_over_views"])
            print(f"    {row} in {view.name}: {found[-1]:.4f} ({said['views']} views)", flush=True)
        print(f"{row:10s} IoU {np.mean(found):.4f}, least {min(found):.4f}", flush=True)


if __name__ == "__main__":
    main()
