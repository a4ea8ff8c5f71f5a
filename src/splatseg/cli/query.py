"""``splatseg query``: words become the things that they mean, and how surely."""

import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from splatseg.cli._types import Backend, Data, Frames, Json, Quiet, SceneFolder
from splatseg.cli._work import ConsoleObserver, open_scene, print_result, typed
from splatseg.core import Scene, View
from splatseg.core.models import TextFeatures
from splatseg.errors import InputError
from splatseg.io.scene import check_name, save_scene_layer
from splatseg.io.scene_folder import work_on_scene
from splatseg.tasks import (
    Answers,
    QueryOptions,
    QuerySession,
    draw_answers,
    draw_heat,
    write_query_report,
)
from splatseg.tasks.named_models import model_of
from splatseg.tasks.scene_parts import views_asked

_LISTED = 5
_HEAT_VIEWS = ("train",)


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Ask a scene for words: which things they mean, and how surely.

    Features in the space of words answer (`splatseg see --model clip --what text`, or recorded
    ones), of objects where there are masks: these are associated, and their features are told
    apart where they share cells, once; the layer `objects` of the scene keeps them, and every
    query after that takes milliseconds. A word that nothing in the scene answers to is unknown.

    Each word is a word of its own: a phrase goes in quotes. One word becomes a selection with
    --layer, several become labels with an id each.

    For example:

    splatseg query room mug "desk lamp" keyboard

    splatseg query room mug --layer mugs --picture found

    splatseg query room wall floor ceiling chair --every --layer classes

    splatseg query room sofa --model clip --features clip --report --heat maps --views path --video
    """

    scene: SceneFolder

    words: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="WORDS")]
    """Words or phrases."""

    layer: str | None = None
    """Also write what answers as this layer of the scene: a selection of one word, labels of
    several."""

    picture: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also write DIR/WORD_RANK.png: each thing in the view that shows most of it."""

    heat: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also write DIR/WORD/VIEW.png: the probability of each word over the views."""

    views: Annotated[tuple[str, ...], tyro.conf.arg(metavar="VIEWS")] = _HEAT_VIEWS
    """Views of the heat maps: train, all, path (a smooth path near the cameras), or names by comma
    or by space."""

    frames: Frames = 360

    video: bool = False
    """Also write a film of each word's heat maps, DIR/WORD.mp4. Needs splatseg[video]."""

    fps: float = 24.0
    """Frames a second of --video."""

    report: bool = False
    """Also write SCENE/reports/query.html and query.json: what answers, with pictures."""

    top: int = _LISTED
    """Things of a word that are listed and drawn, at most."""

    model: Annotated[str | None, tyro.conf.arg(metavar="MODEL")] = None
    """Who encodes the words: the model that the features were made with, as
    NAME[=WEIGHTS][,OPTION=VALUE...], such as clip. None takes the vectors of words that were
    recorded with the features. To features from before its last layers (`see --model lseg --what
    features`) it applies these, once for each voxel or Gaussian."""

    download: bool = False
    """Fetch weights that are not on this machine; what and how much is said before."""

    device: str = "auto"
    """Where the model runs: cpu, cuda, cuda:1. auto takes cuda where there is one."""

    options: tyro.conf.OmitArgPrefixes[QueryOptions] = field(default_factory=QueryOptions)
    """Who answers, and how sure is sure."""

    backend: Backend = "auto"
    data: Data = None
    json: Json = False
    quiet: Quiet = False


def run(command: Command) -> None:
    """Query a scene."""
    started = time.monotonic()
    observer = ConsoleObserver(quiet=command.quiet, json=command.json)
    if not command.words:
        raise InputError("words: expected words or phrases, got none.")
    if command.top < 1:
        raise InputError(f"top: expected at least 1, got {command.top}.")
    if command.layer is not None:
        check_name("layer", command.layer)
    scene = open_scene(command.scene, command.data)
    views = _views(command, scene)
    encoder = None if command.model is None else _encoder(command, observer)
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
            made = answers.labels() if _several(command, answers) else answers.selection()
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


def _several(command: Command, answers: Answers) -> bool:
    return len(answers.words) > 1 or command.options.every


def _views(command: Command, scene: Scene) -> tuple[View, ...]:
    """Those of the heat maps."""
    if command.heat is None:
        if command.video:
            raise InputError("video: expected --heat, whose maps the film is of, with it.")
        if command.views != _HEAT_VIEWS:
            raise InputError("views: expected --heat, whose maps are of these views, with it.")
        return ()
    return views_asked(scene, _names(command.views), frames=command.frames)


def _names(views: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name for word in views for name in word.split(",") if name)


def _encoder(command: Command, observer: ConsoleObserver) -> TextFeatures:
    if command.model is None:
        raise InputError("model: expected the name of one, got none.")
    model = model_of(
        command.model, download=command.download, device=command.device, report=observer.note
    )
    if not isinstance(model, TextFeatures):
        raise InputError(f"model: expected one that encodes words, such as clip, got {model.name}.")
    return model


def _answered(answers: Answers, top: int) -> tuple[dict[str, Any], list[str]]:
    facts: dict[str, Any] = {
        "source": answers.layer,
        "words": {},
        "unknown": answers.unknown,
        "surest": dict(answers.surest),
    }
    lines: list[str] = []
    for word in answers.words:
        found = answers.found[word]
        facts["words"][word] = [asdict(one) for one in found[:top]]
        if not found:
            lines.append(f"{word}: unknown here ({answers.surest[word]:.1%} at most)")
            continue
        more = f", the surest {top} of them" if len(found) > top else ""
        count = "1 thing" if len(found) == 1 else f"{len(found)} things"
        lines.append(f"{word}: {count}{more}")
        for one in found[:top]:
            x, y, z = one.centre
            lines.append(
                f"  {one.probability:6.1%}  thing {one.thing}, {one.gaussians} Gaussians at "
                f"{x:.2f} {y:.2f} {z:.2f}"
            )
    return facts, lines


def _drawn(
    command: Command, scene: Scene, answers: Answers, views: tuple[View, ...]
) -> Iterator[tuple[str, Path, tuple[Path, ...]]]:
    """What is drawn, by its name: the folder and the files."""
    if command.picture is not None:
        files = draw_answers(
            answers, scene, command.picture, top=command.top, backend=command.backend
        )
        yield "pictures", command.picture, files
    if command.heat is not None:
        files = draw_heat(
            answers, scene, views, command.heat,
            video=command.video, fps=command.fps, backend=command.backend,
        )  # fmt: skip
        yield "heat_maps", command.heat, files
