"""``splatseg select``: clicks, boxes, strokes, masks, words and places become a selection."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import torch
import tyro
from torch import Tensor

from splatseg.cli._shared import Device, Downloads, Memory, OnScene, named_model, print_result
from splatseg.core import PromptableMasks, Scene, Selection, View
from splatseg.core.instance_tree import layer_kind
from splatseg.core.models import GroundedMasks, TextFeatures
from splatseg.errors import InputError
from splatseg.io.foreign import reading
from splatseg.io.images import open_image
from splatseg.io.scene import save_scene_layer
from splatseg.io.scene_folder import work_on_scene
from splatseg.methods.prompt import PromptOptions
from splatseg.prompting.prompts import (
    AxisBox,
    Ball,
    Lasso,
    SelectionPrompt,
    Similar,
    Solid,
    ViewPrompt,
)
from splatseg.tasks import (
    Selected,
    SelectionSession,
    SelectMode,
    SelectOptions,
    TextModels,
    TextOptions,
    check_selection_file,
    draw_selection,
    save_selected_splats,
    select_text,
    text_prompts,
)
from splatseg.tasks.see import prompter_of
from splatseg.tasks.work import Work, check_streams

_T = TypeVar("_T")

_BASES: dict[str, SelectMode] = {
    "add_to": "add",
    "subtract_from": "subtract",
    "intersect": "intersect",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Options(SelectOptions):
    granularity: Annotated[str, tyro.conf.arg(metavar="LEVEL")] = "auto"
    """Size of what a click selects: group, object, part, or a number from 0 (groups) by 0.5
    (objects) to 1 (the finest parts). auto: chosen by the source."""

    mode: Annotated[SelectMode, tyro.conf.Suppress] = "new"


_Repeated = tyro.conf.UseAppendAction


_Pixel = Annotated[tuple[str, ...], _Repeated, tyro.conf.arg(metavar="[VIEW:]X,Y")]
_Image = Annotated[tuple[str, ...], _Repeated, tyro.conf.arg(metavar="[VIEW:]PNG")]
_Model = Annotated[str | None, tyro.conf.arg(metavar="MODEL")]
_Layer = Annotated[str | None, tyro.conf.arg(metavar="LAYER")]


@dataclass(frozen=True, kw_only=True)
class Command(OnScene):
    """Select an object by prompts: the Gaussians that belong to it become a layer.

    Prompts in views are answered from what the scene has: masks that `splatseg see` made,
    features, or a layer of `splatseg segment`; or, with --source propagate, by a model that is
    asked in a few views (--prompter), without anything prepared. Pixels have x to the right and y
    down from the top left corner. Places (--box-3d, --sphere, --lasso) bound the answer, and alone
    select all inside.

    The selection becomes SCENE/layers/NAME.npz and replaces an older layer of the name. `splatseg
    render --what NAME`, `edit --layer NAME` and `export --layer NAME` take it.

    For example:

    splatseg select room --view front --point 200,150 --layer mug

    splatseg select room --point front:200,150 --negative left:40,90 --granularity part --layer lid

    splatseg select room --view front --box 120,80,260,210 --save mug.ply --picture clicks

    splatseg select room --view front --point 200,150 --source propagate --prompter regions

    splatseg select room --sphere 0.4 0 1.2 0.3 --add-to mug --layer mug

    splatseg select room --text "red mug" --layer mug --picture found

    splatseg select room --text "the mug left of the laptop" --view front --layer mug
    """

    layer: str = "selection"
    """Name of the layer to write."""

    view: str | None = None
    """View of all prompts that name none, and from which left and right in --text are said.
    VIEW:X,Y is a point in another."""

    point: _Pixel = ()
    """Pixel on the object. May be repeated, as all prompts below."""

    negative: _Pixel = ()
    """Pixel that is not on the object."""

    box: Annotated[tuple[str, ...], _Repeated, tyro.conf.arg(metavar="[VIEW:]X0,Y0,X1,Y1")] = ()
    """Box around the object."""

    mask: _Image = ()
    """Image of the view's size, black outside the object."""

    scribble: _Image = ()
    """Image of the view's size with strokes on the object, on black or transparent."""

    negative_scribble: _Image = ()
    """The same with strokes outside the object."""

    lasso: Annotated[tuple[str, ...], _Repeated, tyro.conf.arg(metavar="[VIEW:]X,Y,X,Y,...")] = ()
    """Polygon in a view: all Gaussians behind it, near and far."""

    box_3d: tuple[float, float, float, float, float, float] | None = None
    """Box in the world: smallest x, y, z, then largest x, y, z, scene units."""

    sphere: tuple[float, float, float, float] | None = None
    """Ball in the world: centre x, y, z and radius, scene units."""

    text: Annotated[tuple[str, ...], _Repeated, tyro.conf.arg(metavar="WORDS")] = ()
    """Word or phrase for the object, instead of clicks: found by recorded features and masks of the
    views, or by models. `splatseg segment --method prompt` has more options. Relations, orders,
    counts and negation are resolved among the objects: "the mug left of the laptop"."""

    objects: Literal["one", "all"] = "one"
    """With --text: select the object with the highest probability, or all that answer. An ambiguous
    phrase is an error that lists its candidates, unless all are wanted."""

    features: str | None = None
    """With --text: evidence of features in the space of words. None takes the only one."""

    grounder: _Model = None
    """With --text: model that finds words in photographs, such as langsam."""

    encoder: _Model = None
    """With --text: the model that made the features, for words that were not recorded."""

    like: Annotated[tuple[str, ...], _Repeated, tyro.conf.arg(metavar="LAYER")] = ()
    """Layer that is a selection: select all objects similar to it."""

    add_to: _Layer = None
    """Selection that this one is added to."""

    subtract_from: _Layer = None
    """Selection that this one is subtracted from."""

    intersect: _Layer = None
    """Selection that this one is intersected with."""

    prompter: _Model = None
    """Model that turns points and boxes into masks of their views first, such as sam, or in up to
    eight views (--source propagate): NAME[=WEIGHTS][,OPTION=VALUE...], such as regions, hed,
    classical; or recorded masks, by name or folder."""

    download: Downloads = False
    device: Device = "auto"

    next_click: bool = False
    """Also compute where another click would change most. Followed on measured scenes, the advice
    did not raise the IoU."""

    save: Path | None = None
    """Also write the selected Gaussians alone: a splat file such as mug.ply, or a folder, in which
    it becomes NAME.ply."""

    picture: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also write DIR/VIEW.png for each view of a prompt, with the selection outlined and points
    marked."""

    memory: Memory = None

    selecting: tyro.conf.OmitArgPrefixes[_Options] = field(default_factory=_Options)
    """Source of the selection, and its post-processing."""


def run(command: Command) -> None:
    """Select in a scene."""
    started = time.monotonic()
    observer = command.observer
    scene = command.open_streamed(command.memory)
    if command.text:
        check_streams(scene, "--text")
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
        options = replace(command.selecting, mode=mode)
        if command.text:
            made = _by_text(command, scene, prompts, options, prompter=prompter, base=base)
            for name, layer in made.made_layers.items():
                save_scene_layer(layer, command.scene, name)
            prompts += text_prompts(made.selection, scene)
        else:
            made = _clicked(command, scene, prompts, options, prompter=prompter, base=base)
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
) -> Selected:
    session = SelectionSession(
        scene,
        options=options,
        prompter=prompter,
        backend=command.backend,
        observer=command.observer,
    )
    try:
        with session:
            return session.select(prompts, base=base, advise=command.next_click)
    finally:
        # Masks take a while to associate: their tree is kept, even where it has no answer.
        for name, layer in session.made_layers.items():
            save_scene_layer(layer, command.scene, name)


def _by_text(
    command: Command,
    scene: Scene,
    prompts: list[SelectionPrompt],
    options: SelectOptions,
    *,
    prompter: PromptableMasks | None,
    base: Selection | None,
) -> Selected:
    """Select by words, within places."""
    places: list[Solid] = []
    for prompt in prompts:
        if isinstance(prompt, ViewPrompt | Similar):
            raise InputError(
                "text: goes with places (--box-3d, --sphere, --lasso) and no other prompts; select "
                "in two steps with --add-to, --subtract-from or --intersect."
            )
        places.append(prompt)
    if options.source != "auto" or options.from_layer is not None:
        raise InputError("source, from_layer: go with clicks; words are found by features.")
    return select_text(
        scene,
        command.text,
        options=TextOptions(
            features=command.features,
            evidence=options.evidence,
            view=command.view,
            prompt=PromptOptions(objects=command.objects),
        ),
        select_options=options,
        models=TextModels(
            grounder=named_model(command, "grounder", GroundedMasks, "finds words in images"),
            prompter=prompter,
            encoder=named_model(command, "encoder", TextFeatures, "encodes words"),
        ),
        places=places,
        base=base,
        backend=command.backend,
        observer=command.observer,
    )


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
    layer = Work(scene=scene).layer(name, option=flag)
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
        "words": _word_facts(made),
        "references": _reference_facts(made),
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
    lines += [
        f"{one['word']}: {one['probability']:.1%} sure, masks in {one['masked_views']} of "
        f"{one['projected_views']} views"
        for one in _word_facts(made)
    ]
    lines += [one["explanation"] for one in _reference_facts(made)]
    lines += [f"note: {warning}" for warning in made.warnings]
    if (hint := made.next_click) is not None:
        x, y = (float(v) for v in hint.point)
        lines.append(
            f"the next click helps most at --point {hint.view.name}:{x:.0f},{y:.0f}, or "
            f"--negative where it is something else (now {100 * float(hint.probability):.0f} % in)"
        )
    return lines


def _word_facts(made: Selected) -> list[dict[str, Any]]:
    """Of each object that answers: its word, how surely, and in how many views it has a mask."""
    found: Any = made.selection.info.details.get("prompts", [])
    keys = ("word", "probability", "projected_views", "masked_views")
    return [{key: one[key] for key in keys} for one in found if "projected_views" in one]


def _reference_facts(made: Selected) -> list[dict[str, Any]]:
    """Of each phrase that refers: what it means, and why."""
    found: Any = made.selection.info.details.get("prompts", [])
    return [dict(one) for one in found if "explanation" in one]


@dataclass
class _Gathered:
    """What was said of one view."""

    view: View
    points: list[list[float]] = field(default_factory=list[list[float]])
    positive: list[bool] = field(default_factory=list[bool])
    box: list[float] | None = None
    mask: Tensor | None = None
    scribble: Tensor | None = None
    negative_scribble: Tensor | None = None

    def prompt(self) -> ViewPrompt:
        return ViewPrompt(
            view=self.view,
            points=torch.tensor(self.points).reshape(-1, 2),
            positive=torch.tensor(self.positive, dtype=torch.bool),
            box=None if self.box is None else torch.tensor(self.box),
            mask=self.mask,
            scribble=self.scribble,
            negative_scribble=self.negative_scribble,
        )


class PromptWords:
    """Reads prompts and gathers them by view.

    Args:
        scene: The scene, whose views they name.
        view: The view of what names none.
    """

    def __init__(self, scene: Scene, view: str | None) -> None:
        self._scene = scene
        self._names = {one.name for one in scene.views}
        self._view = None if view is None else scene.view(view)
        self._gathered: dict[str, _Gathered] = {}

    def add_points(self, flag: str, words: Sequence[str], *, positive: bool) -> None:
        """Points of one sign."""
        for word in words:
            view, rest = self._of_view(flag, word)
            self._in(view).points.append(_numbers(flag, rest, 2))
            self._in(view).positive.append(positive)

    def add_boxes(self, flag: str, words: Sequence[str]) -> None:
        """Boxes x0, y0, x1, y1, at most one a view."""
        for word in words:
            view, rest = self._of_view(flag, word)
            self._in(view).box = self._once(flag, view, self._in(view).box, _numbers(flag, rest, 4))

    def add_images(self, flag: str, name: str, words: Sequence[str]) -> None:
        """Masks or strokes from images: what is not black, and not transparent.

        Args:
            flag: The flag, for messages.
            name: The field of `ViewPrompt`.
            words: Files, at most one a view.
        """
        for word in words:
            view, rest = self._of_view(flag, word)
            held = getattr(self._in(view), name)
            setattr(self._in(view), name, self._once(flag, view, held, _read_mask(Path(rest))))

    def lassos(self, flag: str, words: Sequence[str]) -> list[Lasso]:
        """Polygons of views: x, y, x, y and so on."""
        found: list[Lasso] = []
        for word in words:
            view, rest = self._of_view(flag, word)
            numbers = _numbers(flag, rest, None)
            if len(numbers) % 2 or len(numbers) < 6:
                raise InputError(
                    f"{flag}: expected X,Y of three corners or more, got {len(numbers)} numbers."
                )
            found.append(Lasso(view=view, polygon=torch.tensor(numbers).reshape(-1, 2)))
        return found

    def prompts(self) -> list[ViewPrompt]:
        """One a view, in the order that views were named in."""
        return [gathered.prompt() for gathered in self._gathered.values()]

    def _in(self, view: View) -> _Gathered:
        return self._gathered.setdefault(view.name, _Gathered(view=view))

    def _of_view(self, flag: str, word: str) -> tuple[View, str]:
        """The view that a word names, or the common one, and the rest of the word."""
        name, colon, rest = word.rpartition(":")
        if colon and (name in self._names or not Path(word).exists()):
            return self._scene.view(name), rest
        if self._view is None:
            raise InputError(f"{flag}: expected --view, or VIEW:{word}, got neither.")
        return self._view, word

    @staticmethod
    def _once(flag: str, view: View, held: object, new: _T) -> _T:
        if held is not None:
            raise InputError(f"{flag}: expected at most one in view {view.name}, got two.")
        return new


def _numbers(flag: str, text: str, count: int | None) -> list[float]:
    wanted = "numbers" if count is None else f"{count} numbers"
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    fits = numbers and all(map(math.isfinite, numbers)) and count in (None, len(numbers))
    if not fits:
        raise InputError(f"{flag}: expected {wanted} joined by commas, got {text!r}.")
    return numbers


def _read_mask(path: Path) -> Tensor:
    """Pixels of an image that are neither black nor transparent."""
    with open_image(path) as image, reading(path, "an image"):
        has_alpha = "A" in image.getbands() or "transparency" in image.info
        colours = np.asarray(image.convert("RGBA" if has_alpha else "RGB"))
    lit = colours[..., :3].max(axis=2) > 0
    return torch.from_numpy(lit & (colours[..., 3] > 0) if has_alpha else lit)
