"""A person's task in the viewer: five named objects of a scene as files, and how good they are.

    python benchmarks/viewer_task.py SCENE ../shared/data/toys [--pictures DIR] [--json FILE]
    python benchmarks/viewer_task.py guitar.compressed.ply --pictures DIR \\
        --places head=0.5,0.1 neck=0.5,0.3+0.5,0.5 stand=0.5,0.9@1 ...

`splatseg view` and a real Chromium, clicks counted. The photograph in which most things are large
enough is opened by its thumbnail (one click); the five largest things there that cover at most 15 %
of it are clicked in the middle, and kept by Enter; two get a name that is typed, the others keep
the name that they are given. Where the selection, as it is drawn in that view, has an IoU under
0.85 with the true mask of it, one more click is spent in the middle of its largest error, for or
against, while clicks are left: what a person would see and do. Then all objects are exported as a
file each (three clicks: the button, the kind, the last button).

IoU is that of `clicks.py`: the mean over all test views.

A splat file has neither photographs nor truth: the person presses "Make masks", waits, and clicks
what the picture shows in the view that the page opens with. `--places` says where, as shares of its
width and height from the upper left, and what it is; a further place of a thing is clicked with
Shift, and `@` says the size of the thing, 0 part, 0.5 object, 1 group, which keys set. Without it
the largest five things of the tree that are seen there are clicked in the middle. What came into
each file is drawn from two sides, to be judged by eye.
"""

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
import torch
from click_targets import MIN_PIXELS, Targets
from jaxtyping import UInt8
from numpy.typing import NDArray
from selected_views import TestViews
from torch import Tensor
from viewer_browser import HEIGHT, WIDTH, Viewer, chromium, served

from splatseg.core import InstanceTree, Scene, Selection, View
from splatseg.io.images import write_png
from splatseg.io.scene import load_scene
from splatseg.io.splats import read_splats
from splatseg.lift.field import selection_labels
from splatseg.lift.label_maps import label_map
from splatseg.render import prepare
from splatseg.viewer import open_session

THINGS, CLICKS, TEXTS = 5, 12, 2
EXPORTING = 3
LARGEST = 0.15
GOOD = 0.85
MASKS_SECONDS = 900
SIDE = 240


class Person:
    """Clicks in a page, and counts."""

    def __init__(self, viewer: Viewer) -> None:
        self.viewer = viewer
        self.clicks = 0
        self.texts = 0
        self._camera: dict[str, float] = {}
        self._level = 0.5

    def open_photograph(self, index: int) -> None:
        """By its thumbnail."""
        self.viewer.forget()
        self.viewer.page.locator(".thumb").nth(index).click()
        self.clicks += 1
        self.viewer.settle(1.0)
        self._camera = [one for one in self.viewer.seen("sent") if one["type"] == "camera"][-1]

    def click(self, x: float, y: float, *, modifiers: tuple[str, ...] = ()) -> dict[str, Any]:
        """At shares of the picture; gives the answer."""
        page = self.viewer.page
        self.viewer.forget()
        for key in modifiers:
            page.keyboard.down(key)
        page.mouse.click(*self.viewer.at(x, y))
        for key in modifiers:
            page.keyboard.up(key)
        self.clicks += 1
        answer = self.viewer.await_one(
            lambda one: one["type"] == "error" or one.get("stage") == "final", seconds=20
        )
        self.viewer.settle()
        return answer

    def at(self, view: View, pixel: tuple[float, float]) -> tuple[float, float]:
        """Where a pixel of the photograph is in the picture, as shares of it."""
        lens, shown = view.camera, self._camera
        return (
            (pixel[0] - lens.cx) / lens.fx * shown["focal"] / shown["width"] + 0.5,
            (pixel[1] - lens.cy) / lens.fy * shown["focal"] / shown["height"] + 0.5,
        )

    def keep(self, name: str) -> None:
        """By Enter; with a name, if one is typed."""
        page = self.viewer.page
        self.viewer.forget()
        if name:
            page.locator("#overlay").focus()
            page.keyboard.press("Shift+Enter")
            page.keyboard.press("Control+a")
            page.keyboard.type(name)
            self.texts += 1
        else:
            page.locator("#overlay").focus()
        page.keyboard.press("Enter")
        self.viewer.await_type("patch", seconds=20)
        self.viewer.settle()

    def set_level(self, level: float) -> None:
        """The size of what a click selects, by the keys for it."""
        steps = round(10 * (level - self._level))
        for _ in range(abs(steps)):
            self.viewer.page.keyboard.press("." if steps > 0 else ",")
        self._level = level

    def make_masks(self) -> float:
        """By the button; gives the seconds until their objects are suggested."""
        page = self.viewer.page
        self.viewer.forget()
        began = time.perf_counter()
        page.locator("#suggestions button:has-text('Make masks')").click()
        self.clicks += 1
        page.locator("#suggestions .row").first.wait_for(timeout=1e3 * MASKS_SECONDS)
        seconds = time.perf_counter() - began
        self.viewer.settle()
        return seconds

    def export(self) -> str:
        """All objects, a file each; gives the name of what came."""
        page = self.viewer.page
        self.viewer.forget()
        for one in ("#actions button:has-text('Export')", "label[for=kind-objects]"):
            page.locator(one).first.click()
        page.locator(".export-form button[type=submit]").click()
        self.clicks += EXPORTING
        ended = self.viewer.await_one(lambda one: one["type"] in ("finished", "error"))
        return str(ended.get("result") or ended.get("text"))


def middle(mask: NDArray[np.bool_]) -> tuple[float, float]:
    """The pixel of the largest region that is farthest from its rim, column and row."""
    regions, count = scipy.ndimage.label(mask)
    sizes = np.bincount(regions.ravel(), minlength=count + 1)[1:]
    inner = scipy.ndimage.distance_transform_edt(np.pad(regions == sizes.argmax() + 1, 1))[
        1:-1, 1:-1
    ]
    row, column = np.unravel_index(int(inner.argmax()), inner.shape)
    return float(column) + 0.5, float(row) + 0.5


def chosen(targets: Targets, views: list[View]) -> tuple[int, list[Any]]:
    """The photograph that shows most things large enough, and the five largest in it."""
    best: tuple[int, int, list[Any]] | None = None
    for index, view in enumerate(views):
        truth = targets.truth(view)
        areas = [(int((truth == one.id).sum()), one) for one in targets.objects]
        fitting = [(area, one) for area, one in areas if MIN_PIXELS <= area <= LARGEST * truth.size]
        if best is None or len(fitting) > best[0]:
            fitting.sort(key=lambda pair: -pair[0])
            best = len(fitting), index, [one for _, one in fitting[:THINGS]]
    assert best is not None
    return best[1], best[2]


def task(scene: Path, data: Path, pictures: Path | None) -> dict[str, Any]:
    """Do it, and score it."""
    loaded = load_scene(scene)
    targets = Targets(loaded, data)
    # The strip of photographs has all views, in their order.
    index, things = chosen(targets, list(loaded.views))
    view = loaded.views[index]
    truth = targets.truth(view)
    with served(scene) as server, chromium() as browser:
        viewer = Viewer(browser, server.url)
        viewer.ready()
        person = Person(viewer)
        person.open_photograph(index)
        for number, thing in enumerate(things):
            true = truth == thing.id
            person.click(*person.at(view, middle(true)))
            while person.clicks < CLICKS - EXPORTING - (THINGS - 1 - number):
                drawn = _drawn(scene, view)
                if (drawn & true).sum() >= GOOD * (drawn | true).sum():
                    break
                missing, more = true & ~drawn, drawn & ~true
                good = missing.sum() >= more.sum()
                keys = ("Alt", "Shift") if good else ("Alt",)
                where = middle(missing if good else more)
                if person.click(*person.at(view, where), modifiers=keys)["type"] == "error":
                    break
            person.keep(thing.name if number < TEXTS else "")
            _picture(viewer, pictures, f"{number + 1}-{thing.name}")
        exported = person.export()
        _picture(viewer, pictures, "exported")
    with open_session(scene) as session:
        labels, objects = session.labels(), session.document.objects
        selections = [Selection(mask=labels.ids == one.id) for one in objects]
    files = sorted(str(path.relative_to(scene)) for path in (scene / "exports").rglob("*.ply"))
    scores = TestViews(loaded, data).scores(selections, [one.id for one in things])
    return {
        "view": view.name, "clicks": person.clicks, "texts": person.texts, "exported": exported,
        "files": files,
        "things": [
            {"thing": thing.name, "name": one.name, "gaussians": one.mask.count, "iou": float(iou)}
            for thing, one, iou in zip(things, objects, scores.iou, strict=True)
        ],
    }  # fmt: skip


def _drawn(scene: Path, view: View) -> NDArray[np.bool_]:
    """The selection as it is now, drawn in a view; read from the journal of the server."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "view"
        shutil.copytree(scene / "view", copy, ignore=shutil.ignore_patterns("*lock*"))
        loaded = load_scene(scene)
        with open_session(loaded, folder=copy) as session:
            selection = session.selected
    if selection is None:
        return np.zeros((view.camera.height, view.camera.width), bool)
    return label_map(loaded.gaussians, view.camera, selection_labels(selection)).ids.numpy() == 1


@dataclass(frozen=True)
class Place:
    """Where a thing is clicked, as shares of the picture, and its size."""

    points: tuple[tuple[float, float], ...]
    level: float = 0.5


Places = dict[str, Place]


def places_of(words: Sequence[str]) -> Places:
    """``NAME=X,Y[+X,Y][@LEVEL]`` each."""
    found: Places = {}
    for word in words:
        name, _, rest = word.partition("=")
        where, _, level = rest.partition("@")
        pairs = [one.partition(",") for one in where.split("+")]
        points = tuple((float(x), float(y)) for x, _, y in pairs)
        found[name] = Place(points, float(level or 0.5))
    return found


def pictured(splats: Path, scene: Path, places: Places, pictures: Path | None) -> dict[str, Any]:
    """Five things of a splat file without photographs."""
    with served(splats, "--output", str(scene)) as server, chromium() as browser:
        viewer = Viewer(browser, server.url)
        viewer.ready()
        person = Person(viewer)
        seconds = person.make_masks()
        viewer.ready()
        _picture(viewer, pictures, "masks")
        found: list[Any] = []
        for number, (name, place) in enumerate((places or largest(scene)).items()):
            person.set_level(place.level)
            for at, point in enumerate(place.points):
                answer = person.click(*point, modifiers=("Shift",) if at else ())
            found.append(answer.get("count") or answer.get("text"))
            _picture(viewer, pictures, f"{number + 1}-{name}")
            if answer["type"] != "error":
                person.keep(name if number < TEXTS else "")
        exported = person.export()
        _picture(viewer, pictures, "exported")
    files = sorted((scene / "exports").rglob("*.ply"))
    if pictures is not None:
        write_png(sheet(load_scene(scene), files), pictures / "files.png")
    return {
        "clicks": person.clicks, "texts": person.texts, "seconds of masks": round(seconds, 1),
        "found": found, "exported": exported, "files": [path.name for path in files],
    }  # fmt: skip


def largest(scene: Path) -> Places:
    """The middles of the largest things of the tree in the first view that are no background."""
    loaded = load_scene(scene)
    (tree,) = (one for one in loaded.layers.values() if isinstance(one, InstanceTree))
    # The page shows as much of the view's height, and begins with this view.
    camera = loaded.train_views[0].camera
    ids = label_map(loaded.gaussians, camera, tree.cut()).ids.numpy()
    known, areas = np.unique(ids[ids >= 0], return_counts=True)
    largest = known[np.argsort(-areas, kind="stable")][:THINGS]
    scale = min(WIDTH / camera.width, HEIGHT / camera.height)
    found: Places = {}
    for number, id in enumerate(largest.tolist()):
        x, y = middle(ids == id)
        shares = (
            (x - camera.cx) * scale / WIDTH + 0.5,
            (y - camera.cy) * scale / HEIGHT + 0.5,
        )
        found[f"thing {number + 1}"] = Place((shares,))
    return found


def sheet(scene: Scene, files: list[Path]) -> UInt8[Tensor, "height width 3"]:
    """What is in splat files, a column each, from where the first view is and from behind."""
    columns: list[Tensor] = []
    first = scene.train_views[0].camera
    ahead = first.cam_from_world[2, :3]
    behind = min(scene.views, key=lambda view: float(view.camera.cam_from_world[2, :3] @ ahead))
    for path in files:
        gaussians = read_splats(path)
        drawn: list[Tensor] = []
        for camera in (first, behind.camera):
            # A lens so long that the thing fills most of the picture.
            pixels, _ = camera.project(gaussians.means.double())
            low, high = (pixels.quantile(q, dim=0) for q in (0.02, 0.98))
            side = 1.3 * float((high - low).max())
            centre = (low + high) / 2
            near = replace(
                camera.resized(SIDE, SIDE),
                fx=camera.fx * SIDE / side,
                fy=camera.fy * SIDE / side,
                cx=(camera.cx - float(centre[0])) * SIDE / side + SIDE / 2,
                cy=(camera.cy - float(centre[1])) * SIDE / side + SIDE / 2,
            )
            with prepare(gaussians, near) as view:
                drawn.append(view.picture())
        columns.append(torch.cat(drawn))
    return torch.cat(columns, dim=1)


def _picture(viewer: Viewer, pictures: Path | None, name: str) -> None:
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        viewer.page.screenshot(path=pictures / f"{name.replace(' ', '-')}.png")


def main() -> None:
    """Do the task, and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path, nargs="?")
    parser.add_argument("--places", nargs="+", default=[], metavar="NAME=X,Y[+X,Y][@LEVEL]")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if args.scene.is_file():
            places = places_of(args.places)
            made = pictured(args.scene, Path(folder) / "scene", places, args.pictures)
        else:
            if args.data is None:
                parser.error("a scene needs its capture, for the truth")
            scene = Path(folder) / "scene"
            shutil.copytree(args.scene, scene, ignore=shutil.ignore_patterns("view", "exports"))
            made = task(scene, args.data, args.pictures)
    print(json.dumps(made, indent=1))
    if args.json is not None:
        args.json.write_text(json.dumps(made))


if __name__ == "__main__":
    main()
