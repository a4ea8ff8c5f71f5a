"""What an edit changed, in pictures: the views that change most, before and after."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatseg.core import Scene, View
from splatseg.io.atomic import atomic_file
from splatseg.io.images import reduced_size, save_png
from splatseg.io.json_files import write_json
from splatseg.render import BackendName, render
from splatseg.report.html import Figure, Report, report_html
from splatseg.report.images import Gallery, GalleryImage, contact_sheet

_ASKED_VIEWS = 24
"""Views that are looked at, small, to find those that change most."""

_SMALL, _LARGE = 160, 960
"""Longest side in pixels of these and of those that are shown."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EditPictures:
    """Views that change most, the first most of all; pictures are 8-bit sRGB."""

    gallery: Gallery
    views: tuple[str, ...]


def draw_edit(
    before: Scene, after: Scene, *, views: int, backend: BackendName
) -> EditPictures | None:
    """Draw the views that an edit changes most, before and after it.

    Views are compared by name, each with the camera that it has in its scene: a scene that was
    moved as a whole shows the same.

    Returns:
        None where no view is wanted, or the scenes share none.
    """
    names = {view.name for view in after.views}
    shared = [view for view in before.train_views or before.views if view.name in names]
    if not views or not shared:
        return None
    asked = shared[:: math.ceil(len(shared) / _ASKED_VIEWS)]
    changes: list[float] = []
    for view in asked:
        first, second = (_image(s, view.name, _SMALL, backend) for s in (before, after))
        changes.append(float(((first - second) ** 2).mean()))
    order = sorted(range(len(asked)), key=lambda i: (-changes[i], i))[:views]
    chosen = [asked[i] for i in order]
    return EditPictures(
        gallery=Gallery(
            title="Before and after",
            columns=("before", "after"),
            rows=tuple(_row(before, after, view, backend) for view in chosen),
            note="The views that change most, the first most of all.",
        ),
        views=tuple(view.name for view in chosen),
    )


def _row(
    before: Scene, after: Scene, view: View, backend: BackendName
) -> tuple[str, tuple[GalleryImage, ...]]:
    pictures = (
        GalleryImage(
            image=(_image(scene, view.name, _LARGE, backend) * 255 + 0.5).to(torch.uint8),
            caption=f"{view.name}, {when}",
        )
        for scene, when in ((before, "before"), (after, "after"))
    )
    return view.name, tuple(pictures)


def _image(scene: Scene, name: str, longest: int, backend: BackendName) -> Tensor:
    camera = scene.view(name).camera
    size = reduced_size(camera.width, camera.height, longest)
    if size != (camera.width, camera.height):
        camera = camera.resized(*size)
    return render(scene.gaussians, camera, backend=backend).image.clamp(0, 1).cpu()


def write_edit_report(
    pictures: EditPictures,
    folder: Path,
    *,
    counts: tuple[int, int],
    operations: Sequence[Mapping[str, Any]],
) -> None:
    """Write edit.html, edit.png and edit.json in a folder of reports.

    Args:
        folder: The reports of the new scene; made where it is not there.
        pictures: What is shown.
        counts: Gaussians before and after.
        operations: What was done, one entry a step.
    """
    folder.mkdir(exist_ok=True)
    before, after = counts
    sentences = [edit_sentence(operation) for operation in operations]
    figures = (
        Figure(value=f"{before}", label="Gaussians before"),
        Figure(value=f"{after}", label="Gaussians after", note=f"{after - before:+}"),
    )
    page = report_html(
        Report(
            title="Edit",
            summary=" ".join(sentences),
            figures=figures,
            blocks=(pictures.gallery,),
        )
    )
    with atomic_file(folder / "edit.html") as path:
        path.write_text(page, encoding="utf-8", newline="\n")
    save_png(contact_sheet(pictures.gallery, cell_width=480), folder / "edit.png")
    content = {
        "before": before,
        "after": after,
        "operations": [dict(operation) for operation in operations],
        "views": list(pictures.views),
    }
    write_json(content, folder / "edit.json")


def edit_sentence(operation: Mapping[str, Any]) -> str:
    """What one step did, in words."""
    kind, selected = operation["kind"], operation.get("selected")
    if kind == "undo":
        return f"The last edit ({operation['undone']}) was undone."
    text = f"{kind}: " + ("everything" if selected is None else f"{selected} Gaussians selected")
    if operation.get("specks"):
        text += f", {operation['specks']} of them specks that it would have left behind"
    if operation.get("split"):
        text += (
            f"; {operation['split']} split at the boundary first, which adds {operation['added']}"
        )
    return text + "."
