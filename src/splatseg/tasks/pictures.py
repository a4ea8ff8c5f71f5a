"""Pictures and files of selections and of answers to words, and the page of a query."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatseg.core import UNLABELLED, Labels, Scene, Selection, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, MissingFileError
from splatseg.io.atomic import path_inside
from splatseg.io.images import save_png
from splatseg.io.scene_folder import scene_path
from splatseg.io.splats import write_splats
from splatseg.lift import GaussianField
from splatseg.lift.field import selection_labels
from splatseg.lift.label_maps import view_label_map
from splatseg.prompting.prompts import Lasso, SelectionPrompt, ViewPrompt
from splatseg.render import BackendName, PreparedView, prepare
from splatseg.report.colours import colour_of
from splatseg.report.html import Block, Figure, Report, Table
from splatseg.report.images import (
    Gallery,
    GalleryImage,
    ObjectCard,
    ObjectGallery,
    selection_picture,
)
from splatseg.report.objects import sightings
from splatseg.report.words import counted
from splatseg.tasks.query import Found, QueryResult, query_record
from splatseg.tasks.render import check_film, write_film
from splatseg.tasks.see import shown_image
from splatseg.tasks.work import REPORTS_FOLDER, write_page


@boundary
def check_selection_file(path: Path, name: str) -> Path:
    """The file that the splats of a selection are written to; before long work.

    Args:
        path: A file by its suffix, or a folder, in which it becomes NAME.ply.
        name: Name of the layer.

    Raises:
        MissingFileError: If the folder of a file does not exist.
        InputError: If a folder is to be where a file is.
    """
    if path.suffix and not path.is_dir():
        if not path.parent.is_dir():
            raise MissingFileError(f"{path}: expected a folder that exists, got {path.parent}.")
        return path
    if path.is_file():
        raise InputError(f"{path}: expected a folder or a name with a suffix, got a file.")
    return path / f"{name}.ply"


@boundary
def save_selected_splats(selection: Selection, scene: Scene, path: Path) -> None:
    """Write the selected Gaussians alone; the format is that of the suffix.

    Args:
        selection: What is selected, at least one.
        scene: Its scene.
        path: The file; its folder is made.

    Raises:
        InputError: If nothing is selected, or the suffix is of no format that is written.
    """
    if not selection.count:
        raise InputError("selection: expected Gaussians to write, got none.")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_splats(scene.gaussians[selection.ids], path)


@boundary
def draw_selection(
    selection: Selection,
    scene: Scene,
    prompts: Sequence[SelectionPrompt],
    folder: Path,
    *,
    backend: BackendName = "auto",
) -> tuple[Path, ...]:
    """Write a picture of each view in which something was shown, and give the files.

    The selection is bright and outlined in the photograph, or in the render of a view that has
    none, with the prompts on top.

    Args:
        selection: What was selected.
        scene: Its scene.
        prompts: What it was selected by.
        folder: Where FOLDER/VIEW.png goes; it is made.
        backend: Rendering backend.
    """
    shown = [prompt for prompt in prompts if isinstance(prompt, ViewPrompt | Lasso)]
    views = {prompt.view.name: prompt.view for prompt in shown}
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    for name, view in views.items():
        with prepare(scene.gaussians, view.camera, backend=backend) as prepared:
            mask = view_label_map(prepared, selection_labels(selection)).ids.cpu() == _SELECTED
            image = shown_image(view, prepared)
        picture = _picture(image, mask, [p for p in shown if p.view.name == name])
        path = path_inside(folder, f"{name}.png")
        save_png(picture, path)
        files.append(path)
    return tuple(files)


def _picture(
    image: Tensor, mask: Tensor, prompts: Sequence[ViewPrompt | Lasso]
) -> UInt8[Tensor, "height width 3"]:
    """All prompts of one view on its picture."""
    polygons = [prompt.polygon for prompt in prompts if isinstance(prompt, Lasso)]
    in_view = [prompt for prompt in prompts if isinstance(prompt, ViewPrompt)]
    for prompt in in_view:
        if prompt.box is not None:
            x0, y0, x1, y1 = prompt.box.tolist()
            polygons.append(torch.tensor([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))
    return selection_picture(
        image,
        mask,
        points=torch.cat([torch.zeros(0, 2), *(prompt.points for prompt in in_view)]),
        positive=torch.cat([torch.zeros(0).bool(), *(prompt.signs for prompt in in_view)]),
        polygons=tuple(polygons),
        strokes=_together([prompt.scribble for prompt in in_view]),
        negative_strokes=_together([prompt.negative_scribble for prompt in in_view]),
    )


def _together(strokes: Sequence[Tensor | None]) -> Tensor | None:
    given = [pixels for pixels in strokes if pixels is not None]
    return torch.stack(given).any(dim=0) if given else None


_SELECTED = 1
_CANDIDATES = 6
"""Views in which a thing is looked for: those that have most of its centres, and it near."""

_HEAT = 0.65
"""Share of the colour of heat in a picture; the rest is the photograph."""


@boundary
def draw_query_result(
    answers: QueryResult,
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
        backend: Rendering backend.

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
            _, image, mask = best_view(scene, views, chosen, backend=backend)
            path = path_inside(folder, f"{file_name(word)}_{rank}.png")
            save_png(selection_picture(image, mask), path)
            files.append(path)
    return tuple(files)


@boundary
def draw_heat(
    answers: QueryResult,
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
        backend: Rendering backend.

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


def heat_of(answers: QueryResult, prepared: PreparedView) -> Float[Tensor, "height width words"]:
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


def best_view(
    scene: Scene, views: Sequence[View], chosen: Selection, *, backend: BackendName
) -> tuple[View, UInt8[Tensor, "height width 3"], Bool[Tensor, "height width"]]:
    """The view that shows most of a thing, its image, and the mask of the thing there.

    Args:
        scene: The scene.
        views: Where it is looked for; there must be one.
        chosen: The thing.
        backend: Rendering backend.
    """
    labels = selection_labels(chosen)
    seen: list[tuple[View, Tensor]] = []
    for view in views_near(scene, views, chosen):
        with prepare(scene.gaussians, view.camera, backend=backend) as prepared:
            seen.append((view, view_label_map(prepared, labels).ids.cpu() == _SELECTED))
    view, mask = max(seen, key=lambda one: int(one[1].sum()))
    with prepare(scene.gaussians, view.camera, backend=backend) as prepared:
        return view, shown_image(view, prepared), mask


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


@boundary
def write_query_report(
    answers: QueryResult,
    scene: Scene,
    root: Path,
    *,
    top: int = 5,
    command: str = "",
    backend: BackendName = "auto",
) -> Path:
    """Write ROOT/reports/query.html, and query.json beside it; gives the path of the page.

    It shows each thing that answers, cut out of the view that shows it best, and for each word
    the surest thing in its view beside the probability there. The one of an earlier query is
    replaced.

    Args:
        answers: What was asked and found.
        scene: Its scene.
        root: The scene's folder.
        top: Things of a word that are shown, at most.
        command: The words that started it; may be empty.
        backend: Rendering backend.

    Raises:
        InputError: If the scene has no view.
    """
    views = scene.train_views or scene.views
    if not views:
        raise InputError("scene: expected a view to draw, it has none.")
    blocks: list[Block] = [_words(answers)]
    if shown := [word for word in answers.words if answers.found[word]]:
        blocks.append(_where(answers, scene, views, shown, backend))
    blocks += [_things(answers, scene, views, word, top=top, backend=backend) for word in shown]
    page = Report(
        title="Query",
        summary=_summary(answers),
        command=command,
        figures=(
            Figure(value=f"{len(shown)} of {len(answers.words)}", label="words that are here"),
            Figure(
                value=str(sum(len(answers.found[word]) for word in shown)),
                label="things that answer",
            ),
        ),
        blocks=tuple(blocks),
        facts={
            "layer that answered": answers.layer,
            "least probability": answers.options.min_probability,
        },
    )
    path = scene_path(root, REPORTS_FOLDER, "query.html")
    return write_page(page, path, record=query_record(answers))


def _summary(answers: QueryResult) -> str:
    """What was found, in a sentence."""
    here = [
        f"{word}: {counted(len(found), 'thing')}"
        for word in answers.words
        if (found := answers.found[word])
    ]
    unknown = ", ".join(answers.unknown)
    said = [f"{reference.explanation}." for reference in answers.references.values()]
    return " ".join(
        sentence
        for sentence in (
            f"{', '.join(here)}." if here else "",
            unknown and f"Unknown: {unknown}.",
            *said,
        )
        if sentence
    )


def _words(answers: QueryResult) -> Table:
    """Every word, also those that nothing answers to."""
    return Table(
        title="Words",
        columns=("word", "things", "surest", "Gaussians"),
        rows=tuple(
            (
                word,
                len(answers.found[word]),
                f"{answers.surest[word]:.1%}",
                sum(one.gaussians for one in answers.found[word]),
            )
            for word in answers.words
        ),
        note="Surest is the largest probability of anything, also where it is too small to answer.",
    )


def _where(
    answers: QueryResult,
    scene: Scene,
    views: Sequence[View],
    words: Sequence[str],
    backend: BackendName,
) -> Gallery:
    """The surest thing of each word in the view that shows it best, and the probability there."""
    rows: list[tuple[str, tuple[GalleryImage, ...]]] = []
    for word in words:
        thing = answers.of_thing(word, answers.found[word][0].thing)
        view, image, mask = best_view(scene, views, thing, backend=backend)
        with prepare(scene.gaussians, view.camera, backend=backend) as prepared:
            heat = heat_of(answers, prepared)[..., answers.words.index(word)]
        pictures = (selection_picture(image, mask), heat_picture(image, heat))
        rows.append((word, tuple(GalleryImage(image=one, caption=view.name) for one in pictures)))
    return Gallery(
        title="Where they are",
        columns=("the surest thing", "probability"),
        rows=tuple(rows),
        note="Probability from blue, 0, to red, 1.",
    )


def _things(
    answers: QueryResult,
    scene: Scene,
    views: Sequence[View],
    word: str,
    *,
    top: int,
    backend: BackendName,
) -> ObjectGallery:
    """The things of a word, the surest first, each cut out of the view that shows it best."""
    things = answers.found[word][:top]
    ids = torch.full((len(scene.gaussians),), UNLABELLED, dtype=torch.int32)
    near: dict[str, View] = {}
    for rank, thing in enumerate(things, start=1):
        chosen = answers.of_thing(word, thing.thing)
        ids[chosen.mask] = rank
        near |= {view.name: view for view in views_near(scene, views, chosen)}
    labels = Labels(ids=ids, confidence=(ids != UNLABELLED).float())
    colours = {rank: colour_of(rank, None) for rank in range(1, len(things) + 1)}
    field = GaussianField(scene.gaussians, {word: labels}, backend=backend)
    seen = sightings(field, word, list(near.values()), colours)
    return ObjectGallery(
        title=word,
        cards=tuple(
            ObjectCard(
                id=rank,
                name=f"thing {thing.thing}",
                colour=colours[rank],
                image=seen[rank].image if rank in seen else None,
                facts=_facts(thing),
            )
            for rank, thing in enumerate(things, start=1)
        ),
        note="" if len(answers.found[word]) <= top else f"The surest {top} of them.",
    )


def _facts(thing: Found) -> tuple[tuple[str, str], ...]:
    return (
        ("probability", f"{thing.probability:.1%}"),
        ("Gaussians", str(thing.gaussians)),
        ("centre", " ".join(f"{value:.2f}" for value in thing.centre)),
        ("size", " ".join(f"{value:.2f}" for value in thing.size)),
    )
