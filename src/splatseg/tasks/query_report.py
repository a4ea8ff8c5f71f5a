"""The page of a query: which things answer to words, a picture of each, and where they are."""

from collections.abc import Sequence
from pathlib import Path

import torch

from splatseg.core import UNLABELLED, Labels, Scene, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.atomic import atomic_file
from splatseg.io.json_files import write_json
from splatseg.io.scene_folder import scene_path
from splatseg.lift import GaussianField
from splatseg.render import BackendName, prepare
from splatseg.report.colours import colour_of
from splatseg.report.html import Block, Figure, Report, Table, report_html
from splatseg.report.images import (
    Gallery,
    GalleryImage,
    ObjectCard,
    ObjectGallery,
    selection_picture,
)
from splatseg.report.objects import sightings
from splatseg.report.words import counted
from splatseg.tasks.outputs import REPORTS_FOLDER
from splatseg.tasks.query import Answers, Found, answers_record
from splatseg.tasks.query_outputs import best_view, heat_of, heat_picture, views_near

_NAME = "query"


@boundary
def write_query_report(
    answers: Answers,
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
        backend: Who renders.

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
    path = scene_path(root, REPORTS_FOLDER, f"{_NAME}.html")
    with atomic_file(path) as temporary:
        temporary.write_text(report_html(page), encoding="utf-8", newline="\n")
    write_json(answers_record(answers), path.with_suffix(".json"))
    return path


def _summary(answers: Answers) -> str:
    """What was found, in a sentence."""
    here = [
        f"{word}: {counted(len(found), 'thing')}"
        for word in answers.words
        if (found := answers.found[word])
    ]
    unknown = ", ".join(answers.unknown)
    return " ".join(
        sentence
        for sentence in (f"{', '.join(here)}." if here else "", unknown and f"Unknown: {unknown}.")
        if sentence
    )


def _words(answers: Answers) -> Table:
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
    answers: Answers,
    scene: Scene,
    views: Sequence[View],
    words: Sequence[str],
    backend: BackendName,
) -> Gallery:
    """The surest thing of each word in the view that shows it best, and the probability there."""
    rows: list[tuple[str, tuple[GalleryImage, ...]]] = []
    for word in words:
        thing = answers.of_thing(word, answers.found[word][0].thing)
        seen = best_view(scene, views, thing, backend=backend)
        with prepare(scene.gaussians, seen.view.camera, backend=backend) as prepared:
            heat = heat_of(answers, prepared)[..., answers.words.index(word)]
        pictures = (selection_picture(seen.image, seen.mask), heat_picture(seen.image, heat))
        rows.append(
            (word, tuple(GalleryImage(image=one, caption=seen.view.name) for one in pictures))
        )
    return Gallery(
        title="Where they are",
        columns=("the surest thing", "probability"),
        rows=tuple(rows),
        note="Probability from blue, 0, to red, 1.",
    )


def _things(
    answers: Answers,
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
