"""``splatseg select --text``: what words ask of the task, and what is printed of it."""

from collections.abc import Callable
from typing import Any, Protocol

from splatseg.core import PromptableMasks, Scene, Selection
from splatseg.core.models import GroundedMasks, TextFeatures
from splatseg.errors import InputError
from splatseg.methods.prompt import PromptOptions
from splatseg.prompting.prompts import SelectionPrompt, Similar, Solid, ViewPrompt
from splatseg.tasks import Observer, Selected, SelectOptions, TextModels, TextOptions, select_text
from splatseg.tasks.named_models import model_of


class TextCommand(Protocol):
    """The flags that words go by."""

    @property
    def text(self) -> tuple[str, ...]: ...
    @property
    def objects(self) -> str: ...
    @property
    def features(self) -> str | None: ...
    @property
    def grounder(self) -> str | None: ...
    @property
    def encoder(self) -> str | None: ...
    @property
    def download(self) -> bool: ...
    @property
    def device(self) -> str: ...
    @property
    def backend(self) -> Any: ...


def selected_by_text(
    command: TextCommand,
    scene: Scene,
    prompts: list[SelectionPrompt],
    options: SelectOptions,
    *,
    prompter: PromptableMasks | None,
    base: Selection | None,
    observer: Observer,
    report: Callable[[str], None],
) -> Selected:
    """Select by words, within places.

    Raises:
        InputError: If there are prompts of views besides, or a model answers something else.
    """
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
    objects = "all" if command.objects == "all" else "one"
    return select_text(
        scene,
        command.text,
        options=TextOptions(
            features=command.features,
            evidence=options.evidence,
            prompt=PromptOptions(objects=objects),
        ),
        select_options=options,
        models=TextModels(
            grounder=_model(command, "grounder", GroundedMasks, report),
            prompter=prompter,
            encoder=_model(command, "encoder", TextFeatures, report),
        ),
        places=places,
        base=base,
        backend=command.backend,
        observer=observer,
    )


def _model(
    command: TextCommand, option: str, protocol: type[Any], report: Callable[[str], None]
) -> Any:
    named = getattr(command, option)
    if named is None:
        return None
    model = model_of(named, download=command.download, device=command.device, report=report)
    if not isinstance(model, protocol):
        wanted = "finds words in images" if option == "grounder" else "encodes words"
        raise InputError(f"{option}: expected a model that {wanted}, got {model.name}.")
    return model


def word_facts(made: Selected) -> list[dict[str, Any]]:
    """Of each object that answers: its word, how surely, and in how many views it has a mask."""
    found: Any = made.selection.info.details.get("prompts", [])
    return [{key: one[key] for key in _FACTS} for one in found if "word" in one]


def word_lines(made: Selected) -> list[str]:
    """The same for people."""
    return [
        f"{one['word']}: {one['probability']:.1%} sure, masks in {one['masked_views']} of "
        f"{one['projected_views']} views"
        for one in word_facts(made)
    ]


_FACTS = ("word", "probability", "projected_views", "masked_views")
