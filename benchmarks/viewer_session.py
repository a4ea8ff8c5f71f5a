"""A long session of three people in the viewer: does memory stay level, and is anything lost?

    python benchmarks/viewer_session.py SCENE [--length 1] [--json FILE]

Three pages of one server, in a real Chromium: 500 clicks at random places from random photographs'
cameras, every fifth selection kept as an object, 200 times undo and 40 times redo, 20 exports, 5
reloads, in an order that the seed draws; `--length 0.1` does a tenth of it. Each action waits for
its answer. Memory of the server (resident) and of the pages (JavaScript's heap after a collection)
is printed as time goes by.

At the end the server is stopped, and the scene is opened in Python: what is there has to be what
the pages showed last. Then all that the journal says is done again in Python in a scene without a
journal, clicks as prompts and not as their masks, and the layers of both have to be equal.
"""

import argparse
import json
import os
import random
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from viewer_browser import Server, Viewer, chromium, served

from splatseg.core import Camera, View
from splatseg.errors import InputError
from splatseg.io.scene import load_scene
from splatseg.prompting.prompts import ViewPrompt
from splatseg.viewer import Session, open_session
from splatseg.viewer._journal import JOURNAL_FILE, command_from_json

CLICKS, UNDO, REDO, EXPORTS, RELOADS, CLIENTS = 500, 200, 40, 20, 5, 3
KINDS = ("table", "points", "objects", "splat")


class Script:
    """What the three people do.

    Args:
        pages: Their pages.
        seed: Draws the order.
        length: Share of the whole.
    """

    def __init__(self, pages: list[Viewer], *, seed: int, length: float) -> None:
        self._pages = pages
        self._draw = random.Random(seed)
        self.missed = 0
        self.done: dict[str, int] = {}
        actions: list[str] = []
        for name, count in (
            ("click", CLICKS), ("undo", UNDO), ("redo", REDO), ("export", EXPORTS),
            ("reload", RELOADS), ("keep", CLICKS // 5), ("view", CLICKS // 10),
        ):  # fmt: skip
            actions += [name] * max(1, round(count * length))
        self._draw.shuffle(actions)
        self.actions = ["click", "keep", "click", "keep", *actions]

    def act(self, action: str) -> None:
        """One of them does something, and waits for the answer."""
        viewer = self._draw.choice(self._pages)
        viewer.forget()
        getattr(self, f"_{action}")(viewer)
        self.done[action] = self.done.get(action, 0) + 1

    def _click(self, viewer: Viewer) -> None:
        for _ in range(20):
            x, y = self._draw.uniform(0.05, 0.95), self._draw.uniform(0.1, 0.9)
            if viewer.is_picture(x, y):
                break
        viewer.page.mouse.click(*viewer.at(x, y))
        self._await(viewer, lambda one: one["type"] == "error" or one.get("stage") == "final")

    def _view(self, viewer: Viewer) -> None:
        viewer.page.locator(".thumb").nth(self._draw.randrange(6)).click()
        viewer.settle(0.2)

    def _keep(self, viewer: Viewer) -> None:
        viewer.page.locator("#overlay").focus()
        viewer.page.keyboard.press("Enter")
        self._changed(viewer)

    def _undo(self, viewer: Viewer) -> None:
        viewer.page.locator("#overlay").focus()
        viewer.page.keyboard.press("Control+z")
        self._changed(viewer)

    def _redo(self, viewer: Viewer) -> None:
        viewer.page.locator("#overlay").focus()
        viewer.page.keyboard.press("Control+Shift+Z")
        self._changed(viewer)

    def _reload(self, viewer: Viewer) -> None:
        viewer.page.reload()
        viewer.await_type("F")

    def _export(self, viewer: Viewer) -> None:
        kind = KINDS[self.done.get("export", 0) % len(KINDS)]
        page = viewer.page
        page.locator("#overlay").focus()
        page.keyboard.press("Control+e")
        page.locator(f"label[for=kind-{kind}]").click()
        page.locator(".export-form button[type=submit]").click()
        self._await(viewer, lambda one: one["type"] in ("finished", "error"), seconds=60)
        if page.locator("dialog[open]").count():
            page.keyboard.press("Escape")

    def _changed(self, viewer: Viewer) -> None:
        # Nothing to undo, or to keep: the page says nothing to the server.
        if viewer.page.evaluate(
            "seen.sent.some((one) => ['command','undo','redo'].includes(one.type))"
        ):
            self._await(viewer, lambda one: one["type"] in ("patch", "error"))

    def _await(self, viewer: Viewer, fits: Any, *, seconds: float = 20) -> None:
        try:
            viewer.await_one(fits, seconds=seconds)
        except SystemExit:
            self.missed += 1


def replayed(scene: Path, journal: Path) -> Session:
    """A session in which all that a journal says was done again, clicks as prompts."""
    session = open_session(load_scene(scene))
    first = open_session(journal.parent.parent)
    with first:
        for line in journal.read_text().splitlines()[1:]:
            again(session, json.loads(line), first)
    return session


def again(session: Session, line: dict[str, Any], first: Session) -> None:
    """Do what a line of a journal says."""
    if line["do"] in ("undo", "redo"):
        getattr(session, line["do"])()
        return
    command = command_from_json(line["do"], line["arguments"])
    prompts = (line["arguments"].get("prompt") or {}).get("prompts", [])
    if line["do"] == "select" and len(prompts) == 1 and "camera" in prompts[0]:
        one = prompts[0]
        record = one["camera"] | {
            "cam_from_world": torch.tensor(one["camera"]["cam_from_world"], dtype=torch.float64)
        }
        view = View(name=one["view"], camera=Camera(**record))
        try:
            session.select(
                ViewPrompt(view=view, points=torch.tensor(one["points"])), level=one["level"]
            )
        except InputError as error:
            raise SystemExit(f"a click that was answered is not now: {error}") from error
        return
    for mask in (getattr(command, "mask", None), *getattr(command, "masks", ())):
        if mask is not None:
            session.masks.put(first.confidence(mask))
    session.do(command)


def run(scene: Path, *, length: float, seed: int) -> dict[str, Any]:
    """The session, and what became of it."""
    memory: list[tuple[float, float, list[float]]] = []
    with served(scene) as server, chromium() as browser:
        pages = [Viewer(browser, server.url) for _ in range(CLIENTS)]
        pages[0].ready()
        script = Script(pages, seed=seed, length=length)
        began = time.perf_counter()

        def note() -> None:
            memory.append(measured(server, pages, time.perf_counter() - began))
            at, resident, heaps = memory[-1]
            shown = ", ".join(f"{heap:.1f}" for heap in heaps)
            print(f"{at:5.0f} s  server {resident:.0f} MB, pages {shown} MB", flush=True)

        every = max(1, len(script.actions) // 20)
        for count, action in enumerate(script.actions):
            if count % every == 0:
                note()
            script.act(action)
        note()
        pages[0].settle()
        shown = [viewer.page.locator("#objects .count").first.inner_text() for viewer in pages]
        errors = [error for viewer in pages for error in viewer.errors]
    return {
        "memory": memory, "done": script.done, "missed": script.missed, "shown": shown,
        "errors": errors, "load": os.getloadavg()[0],
    }  # fmt: skip


def measured(
    server: Server, pages: list[Viewer], seconds: float
) -> tuple[float, float, list[float]]:
    """Memory now."""
    return seconds, server.resident_mb, [viewer.heap_mb for viewer in pages]


def main() -> None:
    """Run, print and compare."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--length", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        scene, bare = Path(folder) / "scene", Path(folder) / "bare"
        for place in (scene, bare):
            shutil.copytree(args.scene, place, ignore=shutil.ignore_patterns("view", "exports"))
        made = run(scene, length=args.length, seed=args.seed)
        print(f"did {made['done']}; without an answer {made['missed']}; errors {made['errors']}")
        level = [one for one in made["memory"] if one[0] >= min(60, made["memory"][-1][0] / 4)]
        first, last = level[0], level[-1]
        print(
            f"server from {first[1]:.0f} to {last[1]:.0f} MB, highest "
            f"{max(one[1] for one in level):.0f}"
        )
        with open_session(scene) as restored:
            ours, count = restored.labels(), len(restored.document.objects)
            print(
                f"objects: pages showed {made['shown']}, restored {count}; {list(restored.notes)}"
            )
        with replayed(bare, scene / "view" / JOURNAL_FILE) as python:
            theirs = python.labels()
        equal = torch.equal(ours.ids, theirs.ids) and torch.equal(
            ours.confidence, theirs.confidence
        )
        names = ours.info.names == theirs.info.names
        print(f"layer equals that of the same commands in Python: {equal and names}")
        if args.json is not None:
            args.json.write_text(json.dumps(made | {"equal": equal and names}))


if __name__ == "__main__":
    main()
