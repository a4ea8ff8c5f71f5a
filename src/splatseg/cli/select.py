"""``splatseg select``: clicks, boxes, strokes, masks and places become a selection."""

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from splatseg.cli._prompt_words import PromptWords
from splatseg.cli._select_text import selected_by_text, word_facts, word_lines
from splatseg.cli._types import Backend, Data, Json, Quiet, SceneFolder, Seed, SelectLevel
from splatseg.cli._work import ConsoleObserver, open_scene, print_result
from splatseg.core import PromptableMasks, Scene, Selection
from splatseg.core.instance_tree import layer_kind
from splatseg.errors import InputError
from splatseg.io.scene import save_scene_layer
from splatseg.io.scene_folder import work_on_scene
from splatseg.prompting.prompts import AxisBox, Ball, SelectionPrompt, Similar
from splatseg.tasks import (
    Selected,
    SelectionSession,
    SelectMode,
    SelectOptions,
    check_selection_file,
    draw_selection,
    save_selected_splats,
    text_prompts,
)
from splatseg.tasks.named_models import prompter_of
from splatseg.tasks.scene_parts import whole_layer

_BASES: dict[str, SelectMode] = {
    "add_to": "add",
    "subtract_from": "subtract",
    "intersect": "intersect",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Options(SelectOptions):
    granularity: SelectLevel = "auto"
    mode: Annotated[SelectMode, tyro.conf.Suppress] = "new"
    seed: Seed = 0


_Repeated = tyro.conf.UseAppendAction


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Select a thing by what you show of it: the Gaussians that belong to it become a layer.

    What is shown in views is answered from what the scene has: masks that `splatseg see` made,
    features, or a layer of `splatseg segment`. Pixels have x to the right and y down from the top
    left corner. Places (--box-3d, --sphere, --lasso) bound the answer, and alone select all
    inside.

    In the scene the selection becomes SCENE/layers/NAME.npz; an older layer of the name is
    replaced. `splatseg render --what NAME`, `edit --layer NAME` and `export --layer NAME` take it.

    For example:

    splatseg select room --view front --point 200,150 --layer mug

    splatseg select room --point front:200,150 --negative left:40,90 --granularity part --layer lid

    splatseg select room --view front --box 120,80,260,210 --save mug.ply --picture clicks

    splatseg select room --sphere 0.4 0 1.2 0.3 --add-to mug --layer mug

    splatseg select room --text "red mug" --layer mug --picture found
    """

    scene: SceneFolder

    layer: str = "selection"
    """Name of the layer that is written."""

    view: str | None = None
    """View of all prompts that name none. VIEW:X,Y is a point in another."""

    point: Annotated[tuple[str, ...], _Repeated, tyro.conf.arg(metavar="[VIEW:]X,Y")] = ()
    """A pixel on the thing. May be given again and again, as all prompts below."""

    negative: Annotated[tuple[str, ...], _Repeated, tyro.conf.arg(metavar="[VIEW:]X,Y")] = ()
    """A pixel on what it is not."""

    box: Annotated[tuple[str, ...], _Repeated, tyro.conf.arg(metavar="[VIEW:]X0,Y0,X1,Y1")] = ()
    """A box that the thing lies inside."""

    mask: Annotated[tuple[str, ...], _Repeated, tyro.conf.arg(metavar="[VIEW:]PNG")] = ()
    """An image of the view's size, black where the thing is not."""

    scribble: Annotated[tuple[str, ...], _Repeated, tyro.conf.arg(metavar="[VIEW:]PNG")] = ()
    """An image of the view's size with strokes on the thing, on black or transparent."""

    negative_scribble: Annotated[
        tuple[str, ...], _Repeated, tyro.conf.arg(metavar="[VIEW:]PNG")
    ] = ()
    """The same with strokes on what it is not."""

    lasso: Annotated[tuple[str, ...], _Repeated, tyro.conf.arg(metavar="[VIEW:]X,Y,X,Y,...")] = ()
    """A polygon in a view: what lies behind it, near and far."""

    box_3d: tuple[float, float, float, float, float, float] | None = None
    """Least x, y, z, then largest x, y, z, world, scene units."""

    sphere: tuple[float, float, float, float] | None = None
    """Centre x, y, z and radius, world, scene units."""

    text: Annotated[tuple[str, ...], _Repeated, tyro.conf.arg(metavar="WORDS")] = ()
    """Words or a phrase that the thing answers to, instead of clicks: found by recorded features
    and masks of the views, or by models. `splatseg segment --method prompt` has more options."""

    objects: Literal["one", "all"] = "one"
    """With --text: the surest object, or all that answer."""

    features: str | None = None
    """With --text: evidence of features in the space of words. None takes the only one."""

    grounder: Annotated[str | None, tyro.conf.arg(metavar="MODEL")] = None
    """With --text: a model that finds words in photographs, such as langsam."""

    encoder: Annotated[str | None, tyro.conf.arg(metavar="MODEL")] = None
    """With --text: the model that made the features, for words that were not recorded."""

    like: Annotated[tuple[str, ...], _Repeated, tyro.conf.arg(metavar="LAYER")] = ()
    """A layer that is a selection: all things like it."""

    add_to: Annotated[str | None, tyro.conf.arg(metavar="LAYER")] = None
    """A selection that this one is added to."""

    subtract_from: Annotated[str | None, tyro.conf.arg(metavar="LAYER")] = None
    """A selection that this one is taken away from."""

    intersect: Annotated[str | None, tyro.conf.arg(metavar="LAYER")] = None
    """A selection of which only what is in this one, too, stays."""

    prompter: Annotated[str | None, tyro.conf.arg(metavar="MODEL")] = None
    """Who turns points and boxes into masks of their views first: a model that answers points as
    NAME[=WEIGHTS][,OPTION=VALUE...], such as sam, or recorded masks, by name or folder."""

    download: bool = False
    """Fetch weights that are not on this machine; what and how much is said before."""

    device: str = "auto"
    """Where the prompter runs: cpu, cuda, cuda:1. auto takes cuda where there is one."""

    save: Path | None = None
    """Also write the selected Gaussians alone: a splat file such as mug.ply, or a folder, in which
    it becomes NAME.ply."""

    picture: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also write DIR/VIEW.png for each view of a prompt: the selection outlined, points marked."""

    options: tyro.conf.OmitArgPrefixes[_Options] = field(default_factory=_Options)
    """How."""

    backend: Backend = "auto"
    data: Data = None
    json: Json = False
    quiet: Quiet = False


def run(command: Command) -> None:
    """Select in a scene."""
    started = time.monotonic()
    observer = ConsoleObserver(quiet=command.quiet, json=command.json)
    scene = open_scene(command.scene, command.data)
    _check_text(command)
    prompts = _prompts(command, scene)
    base, mode = _base(command, scene)
    prompter = None
    if command.prompter is not None:
        prompter = prompter_of(
            command.prompter,
            scene,
            download=command.download,
            device=command.device,
            report=observer.note,
        )
    saved = None if command.save is None else check_selection_file(command.save, command.layer)
    with work_on_scene(command.scene, "select", writes=["layers"]):
        options = replace(command.options, mode=mode)
        if command.text:
            made = selected_by_text(
                command,
                scene,
                prompts,
                options,
                prompter=prompter,
                base=base,
                observer=observer,
                report=observer.note,
            )
            prompts += text_prompts(made.selection, scene)
        else:
            made = _clicked(
                command, scene, prompts, options, prompter=prompter, base=base, observer=observer
            )
        path = save_scene_layer(made.selection, command.scene, command.layer)
    facts = _facts(made, command.layer, path)
    lines = [*_lines(made), str(path)]
    if saved is not None:
        save_selected_splats(made.selection, scene, saved)
        facts["splats"] = saved
        lines.append(f"splats of the selection alone in {saved}")
    if command.picture is not None:
        files = draw_selection(
            made.selection, scene, prompts, command.picture, backend=command.backend
        )
        facts["pictures"] = list(files)
        lines.append(f"{len(files)} pictures in {command.picture}")
    facts["seconds"] = round(time.monotonic() - started, 3)
    print_result(facts, lines, json=command.json)


def _check_text(command: Command) -> None:
    """Refuse flags that go with words where there are none."""
    if command.text:
        return
    for name in ("features", "grounder", "encoder"):
        if getattr(command, name) is not None:
            raise InputError(f"{name}: goes with --text, got none.")
    if command.objects != "one":
        raise InputError("objects: goes with --text, got none.")


def _clicked(
    command: Command,
    scene: Scene,
    prompts: list[SelectionPrompt],
    options: SelectOptions,
    *,
    prompter: PromptableMasks | None,
    base: Selection | None,
    observer: ConsoleObserver,
) -> Selected:
    session = SelectionSession(
        scene, options=options, prompter=prompter, backend=command.backend, observer=observer
    )
    try:
        with session:
            return session.select(prompts, base=base)
    finally:
        # Masks take a while to associate: their tree is kept, even where it has no answer.
        for name, layer in session.made_layers.items():
            save_scene_layer(layer, command.scene, name)


def _prompts(command: Command, scene: Scene) -> list[SelectionPrompt]:
    """All prompts of the command line."""
    words = PromptWords(scene, command.view)
    words.add_points("--point", command.point, positive=True)
    words.add_points("--negative", command.negative, positive=False)
    words.add_boxes("--box", command.box)
    for name in ("mask", "scribble", "negative_scribble"):
        words.add_images(f"--{name.replace('_', '-')}", name, getattr(command, name))
    prompts: list[SelectionPrompt] = [*words.prompts(), *words.lassos("--lasso", command.lasso)]
    if command.box_3d is not None:
        prompts.append(AxisBox(low=command.box_3d[:3], high=command.box_3d[3:]))
    if command.sphere is not None:
        x, y, z, radius = command.sphere
        prompts.append(Ball(centre=(x, y, z), radius=radius))
    prompts += [Similar(selection=_selection("--like", scene, name)) for name in command.like]
    if not prompts and not command.text:
        raise InputError(
            "prompts: expected --point, --box, --mask, --scribble, --lasso, --box-3d, --sphere, "
            "--like or --text, got none."
        )
    return prompts


def _base(command: Command, scene: Scene) -> tuple[Selection | None, SelectMode]:
    """The selection that this one changes, and how."""
    given = [name for name in _BASES if getattr(command, name) is not None]
    if len(given) > 1:
        raise InputError(
            f"add_to, subtract_from, intersect: expected one of them, got {' and '.join(given)}."
        )
    if not given:
        return None, "new"
    flag = f"--{given[0].replace('_', '-')}"
    return _selection(flag, scene, getattr(command, given[0])), _BASES[given[0]]


def _selection(flag: str, scene: Scene, name: str) -> Selection:
    layer = whole_layer(scene, name, option=flag)
    if not isinstance(layer, Selection):
        kind = layer_kind(layer)
        raise InputError(f"{flag}: expected a layer that is a selection, {name!r} is of {kind}.")
    return layer


def _facts(made: Selected, name: str, path: Path) -> dict[str, Any]:
    """What was made, for programs."""
    mean = made.selection.mean_confidence
    hint = made.next_click
    return {
        "layer": name,
        "file": path,
        "gaussians": len(made.selection),
        "selected": made.selection.count,
        "confidence": None if mean is None else round(mean, 4),
        "source": made.source,
        "words": word_facts(made),
        "next_click": None
        if hint is None
        else {
            "view": hint.view.name,
            "point": [float(v) for v in hint.point],
            "probability": round(float(hint.probability), 4),
        },
        "warnings": list(made.warnings),
        "stage_seconds": {name: round(value, 4) for name, value in made.seconds.items()},
    }


def _lines(made: Selected) -> list[str]:
    """What was made, for people."""
    mean = made.selection.mean_confidence
    by = f" by {made.source}" if made.source else ""
    sure = "" if mean is None else f", confidence {mean:.2f}"
    lines = [
        f"{made.selection.count} of {len(made.selection)} Gaussians{by}{sure}; "
        f"{sum(made.seconds.values()):.2f} s"
    ]
    lines += word_lines(made)
    lines += [f"note: {warning}" for warning in made.warnings]
    if (hint := made.next_click) is not None:
        x, y = (float(v) for v in hint.point)
        lines.append(
            f"the next click helps most at --point {hint.view.name}:{x:.0f},{y:.0f}, or "
            f"--negative where it is something else (now {100 * float(hint.probability):.0f} % in)"
        )
    return lines
