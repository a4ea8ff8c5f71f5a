"""``splatseg query``: words become the things that they mean, and how surely."""

import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from splatseg.cli._shared import (
    Device,
    Downloads,
    Frames,
    OnScene,
    named_model,
    print_result,
    typed,
)
from splatseg.core import Scene, View
from splatseg.core.models import TextFeatures
from splatseg.errors import InputError
from splatseg.io.scene import check_name, save_scene_layer
from splatseg.io.scene_folder import work_on_scene
from splatseg.tasks import (
    QueryOptions,
    QueryResult,
    QuerySession,
    draw_heat,
    draw_query_result,
    write_query_report,
)
from splatseg.tasks.query import reference_record
from splatseg.tasks.work import Work

_LISTED = 5
_HEAT_VIEWS = ("train",)


@dataclass(frozen=True, kw_only=True)
class Command(OnScene):
    """Find the objects of a scene that answer words, with probabilities.

    Features in the space of words are compared (`splatseg see --model clip --what text`, or
    recorded ones), of objects where there are masks: these are associated, and their features
    separated where they share cells, once; the layer `objects` of the scene keeps them, and every
    later query takes milliseconds. A word that nothing in the scene answers is unknown.

    Each word is searched by itself: a phrase needs quotes. One word becomes a selection with
    --layer, several become labels with one id each.

    Phrases may refer to objects by relations (left of, behind, on, under, near, between, with),
    orders (largest, nearest the door, second from the left), counts (two mugs, how many mugs) and
    negation (not on the desk, not red). The answer says why; of an ambiguous phrase it lists all
    candidates and chooses none. Left and right are those of --view.

    For example:

    splatseg query room mug "desk lamp" keyboard

    splatseg query room mug --layer mugs --picture found

    splatseg query room "the mug left of the laptop" "how many books on the shelf" --view front

    splatseg query room wall floor ceiling chair --every --layer classes

    splatseg query room sofa --model clip --features clip --report --heat maps --views path --video
    """

    words: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="WORDS")]
    """Words or phrases."""

    layer: str | None = None
    """Also write the answer as this layer of the scene: a selection of one word, labels of several
    words."""

    picture: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also write DIR/WORD_RANK.png: each object in the view that shows most of it."""

    heat: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also write DIR/WORD/VIEW.png: the probability of each word in the views."""

    views: Annotated[tuple[str, ...], tyro.conf.arg(metavar="VIEWS")] = _HEAT_VIEWS
    """Views of the heat maps: train, all, path (a smooth path near the cameras), or names,
    separated by commas or spaces."""

    frames: Frames = 360

    video: bool = False
    """Also write a film of each word's heat maps, DIR/WORD.mp4. Needs splatseg[video]."""

    fps: float = 24.0
    """Frames per second of --video."""

    report: bool = False
    """Also write SCENE/reports/query.html and query.json: the answers, with pictures."""

    top: int = _LISTED
    """Largest number of objects per word that are listed and drawn."""

    model: Annotated[str | None, tyro.conf.arg(metavar="MODEL")] = None
    """Model that encodes the words, the one that made the features:
    NAME[=WEIGHTS][,OPTION=VALUE...], such as clip. None takes the vectors of words that were
    recorded with the features. Features from before its last layers (`see --model lseg --what
    features`) pass these once per voxel or Gaussian."""

    download: Downloads = False
    device: Device = "auto"

    options: tyro.conf.OmitArgPrefixes[QueryOptions] = field(default_factory=QueryOptions)
    """What answers, and from which probability."""


def run(command: Command) -> None:
    """Query a scene."""
    started = time.monotonic()
    observer = command.observer
    if not command.words:
        raise InputError("words: expected words or phrases, got none.")
    if command.top < 1:
        raise InputError(f"top: expected at least 1, got {command.top}.")
    if command.layer is not None:
        check_name("layer", command.layer)
    scene = command.open()
    views = _views(command, scene)
    encoder = named_model(command, "model", TextFeatures, "encodes words, such as clip")
    writes = ["layers", *(["reports"] if command.report else [])]
    with work_on_scene(command.scene, "query", writes=writes):
        session = QuerySession(
            scene,
            options=command.options,
            encoder=encoder,
            backend=command.backend,
            observer=observer,
        )
        for name, layer in session.made_layers.items():
            save_scene_layer(layer, command.scene, name)
        asked = time.monotonic()
        answers = session.ask(command.words)
        milliseconds = 1000 * (time.monotonic() - asked)
        facts, lines = _answered(answers, command.top)
        if command.layer is not None:
            several = len(answers.words) > 1 or command.options.every
            made = answers.labels() if several else answers.selection()
            facts["layer"] = save_scene_layer(made, command.scene, command.layer)
            lines.append(str(facts["layer"]))
        if command.report:
            facts["report"] = write_query_report(
                answers, scene, command.scene,
                top=command.top, command=typed(sys.argv), backend=command.backend,
            )  # fmt: skip
            lines.append(f"report: {facts['report']}")
    for key, folder, files in _drawn(command, scene, answers, views):
        facts[key] = list(files)
        lines.append(f"{len(files)} {key.replace('_', ' ')} in {folder}")
    facts["query_milliseconds"] = round(milliseconds, 3)
    facts["seconds"] = round(time.monotonic() - started, 3)
    print_result(facts, lines, json=command.json)


def _views(command: Command, scene: Scene) -> tuple[View, ...]:
    """Those of the heat maps."""
    if command.heat is None:
        if command.video:
            raise InputError("video: expected --heat, whose maps the film is of, with it.")
        if command.views != _HEAT_VIEWS:
            raise InputError("views: expected --heat, whose maps are of these views, with it.")
        return ()
    return Work(scene=scene).views(command.views, frames=command.frames)


def _answered(answers: QueryResult, top: int) -> tuple[dict[str, Any], list[str]]:
    facts: dict[str, Any] = {
        "source": answers.layer,
        "words": {},
        "unknown": answers.unknown,
        "surest": dict(answers.surest),
    }
    lines: list[str] = []
    if answers.references:
        facts["references"] = {
            word: reference_record(reference) for word, reference in answers.references.items()
        }
    for word in answers.words:
        found = answers.found[word]
        facts["words"][word] = [asdict(one) for one in found[:top]]
        reference = answers.references.get(word)
        if reference is not None:
            lines.append(reference.explanation)
            if not found:
                continue
        elif not found:
            lines.append(f"{word}: unknown here ({answers.surest[word]:.1%} at most)")
            continue
        more = f", the surest {top} of them" if len(found) > top else ""
        count = "1 thing" if len(found) == 1 else f"{len(found)} things"
        if reference is None:
            lines.append(f"{word}: {count}{more}")
        for one in found[:top]:
            x, y, z = one.centre
            lines.append(
                f"  {one.probability:6.1%}  thing {one.thing}, {one.gaussians} Gaussians at "
                f"{x:.2f} {y:.2f} {z:.2f}"
            )
    return facts, lines


def _drawn(
    command: Command, scene: Scene, answers: QueryResult, views: tuple[View, ...]
) -> Iterator[tuple[str, Path, tuple[Path, ...]]]:
    """What is drawn, by its name: the folder and the files."""
    if command.picture is not None:
        files = draw_query_result(
            answers, scene, command.picture, top=command.top, backend=command.backend
        )
        yield "pictures", command.picture, files
    if command.heat is not None:
        files = draw_heat(
            answers, scene, views, command.heat,
            video=command.video, fps=command.fps, backend=command.backend,
        )  # fmt: skip
        yield "heat_maps", command.heat, files
