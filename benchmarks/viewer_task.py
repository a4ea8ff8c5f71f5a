"""A person's task in the viewer: five named objects of a scene as files, and how good they are.

    python benchmarks/viewer_task.py SCENE ../shared/data/toys [--pictures DIR] [--json FILE]
    python benchmarks/viewer_task.py guitar.compressed.ply --pictures DIR

`splatseg view` and a real Chromium, clicks counted. The photograph in which most things are large
enough is opened by its thumbnail (one click); the five largest things there that cover at most 15 %
of it are clicked in the middle, and kept by Enter; two get a name that is typed, the others keep
the name that they are given. Where the selection, as it is drawn in that view, has an IoU under
0.85 with the true mask of it, one more click is spent in the middle of its largest error, for or
against, while clicks are left: what a person would see and do. Then all objects are exported as a
file each (three clicks: the button, the kind, the last button).

IoU is that of `clicks.py`: the mean over all test views. A splat file has no truth: five places
are clicked, and pictures are all that is reported.
"""

import argparse
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
from click_targets import MIN_PIXELS, Targets
from numpy.typing import NDArray
from selected_views import TestViews
from viewer_browser import Viewer, chromium, served

from splatseg.core import Selection, View
from splatseg.io.scene import load_scene
from splatseg.lift.field import selection_labels
from splatseg.lift.label_maps import label_map
from splatseg.viewer import open_session

THINGS, CLICKS, TEXTS = 5, 12, 2
EXPORTING = 3
LARGEST = 0.15
GOOD = 0.85


class Person:
    """Clicks in a page, and counts."""

    def __init__(self, viewer: Viewer) -> None:
        self.viewer = viewer
        self.clicks = 0
        self.texts = 0
        self._camera: dict[str, float] = {}

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


def pictured(splats: Path, pictures: Path | None) -> dict[str, Any]:
    """Five places of a splat file without photographs."""
    with served(splats) as server, chromium() as browser:
        viewer = Viewer(browser, server.url)
        viewer.ready()
        person = Person(viewer)
        found: list[Any] = []
        for number, (x, y) in enumerate(
            ((0.5, 0.5), (0.4, 0.4), (0.6, 0.6), (0.5, 0.3), (0.5, 0.7))
        ):
            answer = person.click(x, y)
            found.append(answer.get("count") or answer.get("text"))
            if answer["type"] != "error":
                person.keep(f"part {number + 1}" if number < TEXTS else "")
            _picture(viewer, pictures, f"place-{number + 1}")
        exported = person.export()
        _picture(viewer, pictures, "exported")
    return {"clicks": person.clicks, "texts": person.texts, "found": found, "exported": exported}


def _picture(viewer: Viewer, pictures: Path | None, name: str) -> None:
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        viewer.page.screenshot(path=pictures / f"{name.replace(' ', '-')}.png")


def main() -> None:
    """Do the task, and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path, nargs="?")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if args.scene.is_file():
            made = pictured(args.scene, args.pictures)
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
