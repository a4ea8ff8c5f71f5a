"""What commands that go through views share: which views, which layer, and a progress bar."""

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from splatseg.core import Features, Labels, Scene, Selection, View
from splatseg.errors import InputError
from splatseg.evaluate.held_out import MaskUse
from splatseg.io.evidence import Evidence
from splatseg.io.scene import load_scene, load_scene_layer

SAME_IDS = ("uplift", "vote", "identity")
"""Methods whose layers have the ids of the evidence that they were made from."""


def check_new_scene(out: Path) -> None:
    """Refuse before the work a place that a new scene could not be written to after it."""
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(f"{out}: expected a new folder, got one that is there.")
    if not out.resolve().parent.is_dir():
        raise InputError(f"{out}: expected a place in a folder that is there, got none.")


def views_that_made(
    scene: Scene, metadata: Mapping[str, Any], evidence: Evidence
) -> tuple[View, ...]:
    """Views with evidence that made a layer, where it says which; else the training views."""
    known = set(evidence.view_names)
    used = metadata.get("views")
    names = set(cast("list[str]", used)) if isinstance(used, list) else None
    return tuple(
        view
        for view in scene.views
        if view.name in known and (view.split == "train" if names is None else view.name in names)
    )


@contextmanager
def progress(what: str) -> Generator[Callable[[int, int], None]]:
    """A bar on stderr with an estimate; gives a function of (done, total)."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(compact=True),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)

        def step(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        yield step


def open_scene(root: Path, data: Path | None) -> Scene:
    """The scene that a command works on."""
    return load_scene(root, data=data)


def mask_use(scene: Scene) -> MaskUse:
    """What the masks of the photographs meant when the scene was fitted."""
    options = scene.provenance.get("options")
    said = options.get("masks") if isinstance(options, Mapping) else None  # pyright: ignore[reportUnknownMemberType]
    return "alpha" if said == "alpha" else "ignore" if said == "ignore" else "off"


def views_of_split(scene: Scene, split: str) -> tuple[View, ...]:
    """The views of a split, or all of them.

    Raises:
        InputError: If the scene has no view of this split.
    """
    views = tuple(view for view in scene.views if split in ("all", view.split))
    if views:
        return views
    known = ", ".join(sorted({view.split for view in scene.views})) or "none: it has no views"
    raise InputError(f"--split: expected all or a split of the scene ({known}), got {split!r}.")


def layer_of(scene: Scene, name: str) -> Labels | Selection | Features:
    """A layer of a scene that was loaded from a folder."""
    if scene.root is None:
        raise InputError(f"layer {name!r}: the scene has no folder to read it from.")
    return load_scene_layer(scene.root, name)
