"""Pictures of what answers to words: each thing where it is seen best, and heat maps of views."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from splatseg.core import Scene, Selection, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.images import load_image, save_png
from splatseg.io.paths import path_inside
from splatseg.lift.field_layers import selection_labels
from splatseg.lift.label_maps import view_label_map
from splatseg.render import BackendName, PreparedView, prepare
from splatseg.report.selection_picture import selection_picture
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
            chosen = answers.of_thing(word, thing.thing)
            mask, image = _best_view(scene, views, chosen, backend)
            path = path_inside(folder, f"{file_name(word)}_{rank}.png")
            save_png(selection_picture(image, mask), path)
            files.append(path)
    return tuple(files)


@boundary
def draw_heat(
    answers: Answers,
    scene: Scene,
    views: Sequence[View],
    folder: Path,
    *,
    backend: BackendName = "auto",
) -> tuple[Path, ...]:
    """Write the probability of each word over views, blue for 0 to red for 1.

    Args:
        answers: What was asked and found.
        scene: Its scene.
        views: Those to draw.
        folder: Where WORD/VIEW.png goes; it is made.
        backend: Who renders.
    """
    files: list[Path] = []
    for view in views:
        with prepare(scene.gaussians, view.camera, backend=backend) as prepared:
            image = _image(view, prepared)
            with torch.no_grad():
                heat = prepared.render(answers.probabilities.contiguous()).image.cpu()
        for column, word in enumerate(answers.words):
            path = path_inside(folder, f"{file_name(word)}/{view.name}.png")
            path.parent.mkdir(parents=True, exist_ok=True)
            save_png(heat_picture(image, heat[..., column]), path)
            files.append(path)
    return tuple(files)


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


def _best_view(
    scene: Scene, views: Sequence[View], chosen: Selection, backend: BackendName
) -> tuple[Tensor, Tensor]:
    """The mask of a thing, and the picture, in the view that shows most of it."""
    means = scene.gaussians.means.detach().cpu()[chosen.ids]
    order = sorted(range(len(views)), key=lambda index: (-_shown(views[index], means), index))
    best: tuple[int, Tensor, Tensor] | None = None
    for index in order[:_CANDIDATES]:
        view = views[index]
        with prepare(scene.gaussians, view.camera, backend=backend) as prepared:
            mask = view_label_map(prepared, selection_labels(chosen)).ids.cpu() == _SELECTED
            if best is None or int(mask.sum()) > best[0]:
                best = (int(mask.sum()), mask, _image(view, prepared))
    if best is None:
        raise InputError("scene: expected a view to draw, it has none.")
    return best[1], best[2]


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


def _image(view: View, prepared: PreparedView) -> UInt8[Tensor, "height width 3"]:
    """The photograph, or the render."""
    if view.image is not None:
        return load_image(view)
    with torch.no_grad():
        colour = prepared.render().image
    return (colour.cpu().clamp(0, 1) * 255 + 0.5).to(torch.uint8)
