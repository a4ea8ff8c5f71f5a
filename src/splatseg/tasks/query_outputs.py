"""Pictures of what answers to words: each thing where it is seen best, and heat maps of views."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatseg.core import Scene, Selection, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.images import save_png
from splatseg.io.paths import path_inside
from splatseg.lift.field import selection_labels
from splatseg.lift.label_maps import view_label_map
from splatseg.render import BackendName, PreparedView, prepare
from splatseg.report.selection_picture import selection_picture
from splatseg.tasks._film import check_film, write_film
from splatseg.tasks._view_images import shown_image
from splatseg.tasks.query import Answers

_SELECTED = 1
_CANDIDATES = 6
"""Views in which a thing is looked for: those that have most of its centres, and it near."""

_HEAT = 0.65
"""Share of the colour of heat in a picture; the rest is the photograph."""


@boundary
def draw_answers(
    answers: Answers,
    scene: Scene,
    folder: Path,
    *,
    top: int = 5,
    backend: BackendName = "auto",
) -> tuple[Path, ...]:
    """Write a picture of each thing that answers, in the view that shows most of it.

    Args:
        answers: What was asked and found.
        scene: Its scene.
        folder: Where WORD_RANK.png goes; it is made.
        top: Things of a word, at most.
        backend: Who renders.

    Raises:
        InputError: If the scene has no view.
    """
    views = scene.train_views or scene.views
    if not views:
        raise InputError("scene: expected a view to draw, it has none.")
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    for word in answers.words:
        for rank, thing in enumerate(answers.found[word][:top], start=1):
            shown = best_view(scene, views, answers.of_thing(word, thing.thing), backend=backend)
            path = path_inside(folder, f"{file_name(word)}_{rank}.png")
            save_png(selection_picture(shown.image, shown.mask), path)
            files.append(path)
    return tuple(files)


@boundary
def draw_heat(
    answers: Answers,
    scene: Scene,
    views: Sequence[View],
    folder: Path,
    *,
    video: bool = False,
    fps: float = 24.0,
    backend: BackendName = "auto",
) -> tuple[Path, ...]:
    """Write the probability of each word over views, blue for 0 to red for 1.

    Args:
        answers: What was asked and found.
        scene: Its scene.
        views: Those to draw.
        folder: Where WORD/VIEW.png goes; it is made.
        video: Whether WORD.mp4 is made of the pictures of each word; it comes after them.
        fps: Its frames a second.
        backend: Who renders.

    Raises:
        InputError: If there is to be a film of views that differ in size, or of none.
        MissingPackageError: If there is to be a film, and no encoder.
    """
    if video:
        check_film(views, fps=fps)
    files: list[Path] = []
    for view in views:
        with prepare(scene.gaussians, view.camera, backend=backend) as prepared:
            image = shown_image(view, prepared)
            heat = heat_of(answers, prepared)
        for column, word in enumerate(answers.words):
            path = path_inside(folder, f"{file_name(word)}/{view.name}.png")
            path.parent.mkdir(parents=True, exist_ok=True)
            save_png(heat_picture(image, heat[..., column]), path)
            files.append(path)
    for word in answers.words if video else ():
        pictures = folder / file_name(word)
        write_film(views, pictures, fps=fps, is_label_map=False, classes=None)
        files.append(pictures.with_name(f"{pictures.name}.mp4"))
    return tuple(files)


def heat_of(answers: Answers, prepared: PreparedView) -> Float[Tensor, "height width words"]:
    """The probability of each word over a view, rendered through the Gaussians."""
    with torch.no_grad():
        return prepared.render(answers.probabilities.contiguous()).image.cpu()


def heat_picture(
    image: UInt8[Tensor, "height width 3"], heat: Float[Tensor, "height width"]
) -> UInt8[Tensor, "height width 3"]:
    """An image under its heat.

    Args:
        image: The view.
        heat: In [0, 1].
    """
    grey = cv2.cvtColor(image.numpy(), cv2.COLOR_RGB2GRAY)[..., None]
    values = (heat.clamp(0, 1).numpy() * 255 + 0.5).astype("uint8")
    colour = cv2.cvtColor(cv2.applyColorMap(values, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    mixed = _HEAT * colour + (1 - _HEAT) * grey
    return torch.from_numpy((mixed + 0.5).astype("uint8"))


def file_name(word: str) -> str:
    """A word as a name of a file: letters, digits, and _ for the rest."""
    return "".join(one if one.isalnum() else "_" for one in word)[:60]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenThing:
    """A thing in a view."""

    view: View
    mask: Bool[Tensor, "height width"]
    image: UInt8[Tensor, "height width 3"]


def best_view(
    scene: Scene, views: Sequence[View], chosen: Selection, *, backend: BackendName
) -> SeenThing:
    """A thing in the view that shows most of it.

    Args:
        scene: The scene.
        views: Where it is looked for; there must be one.
        chosen: The thing.
        backend: Who renders.
    """
    labels = selection_labels(chosen)
    seen: list[tuple[View, Tensor]] = []
    for view in views_near(scene, views, chosen):
        with prepare(scene.gaussians, view.camera, backend=backend) as prepared:
            seen.append((view, view_label_map(prepared, labels).ids.cpu() == _SELECTED))
    view, mask = max(seen, key=lambda one: int(one[1].sum()))
    with prepare(scene.gaussians, view.camera, backend=backend) as prepared:
        image = shown_image(view, prepared)
    return SeenThing(view=view, mask=mask, image=image)


def views_near(scene: Scene, views: Sequence[View], chosen: Selection) -> tuple[View, ...]:
    """The few views that have most of a thing's centres in their pictures, and it near."""
    means = scene.gaussians.means.detach().cpu()[chosen.ids]
    order = sorted(range(len(views)), key=lambda index: (-_shown(views[index], means), index))
    return tuple(views[index] for index in order[:_CANDIDATES])


def _shown(view: View, means: Tensor) -> float:
    """Share of centres inside the picture, over their squared depth: how large it is there."""
    camera = view.camera
    pose = camera.cam_from_world.cpu().float()
    local = means @ pose[:3, :3].T + pose[:3, 3]
    depth = local[:, 2].clamp_min(1e-6)
    x = local[:, 0] / depth * camera.fx + camera.cx
    y = local[:, 1] / depth * camera.fy + camera.cy
    inside = (local[:, 2] > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    near = depth[inside].median() if bool(inside.any()) else torch.tensor(1.0)
    return float(inside.float().mean() / near**2)
