"""Models by one word of a command line: a name with its weights and options, or a folder."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from splatseg.core import Model, PromptableMasks, Scene
from splatseg.core.typed_text import typed_field
from splatseg.errors import InputError
from splatseg.io.evidence import evidence_names, find_evidence
from splatseg.models import LoadOptions, find_family, find_model, model_names
from splatseg.models.recorded import recorded_model

_LOADING = ("size", "dtype", "batch")
"""Options of loading that each model may have its own of."""


def model_of(
    named: str, *, download: bool = False, device: str = "auto", report: Callable[[str], None]
) -> Model:
    """The model of ``NAME[=WEIGHTS][,OPTION=VALUE...]``, or a folder.

    What follows a comma without an ``=`` goes on with the value before it.

    Args:
        named: The word.
        download: Whether weights that are not on this machine may be fetched.
        device: Where it runs.
        report: Told in a sentence what the user should know.

    Raises:
        InputError: If there is none, or it has no such option.
    """
    name = name_of(named)
    family = find_family(name) if name in model_names() else None
    if family is None:
        return find_model(named, report=report)
    first, *rest = _pieces(named)
    weights = first.partition("=")[2]
    if weights and not family.needs_weights:
        raise InputError(f"models: {name} has no weights, got {named!r}.")
    loading = LoadOptions(weights=weights or None, download=download, device=device)
    chosen = family.options()
    for text in rest:
        if family.needs_weights and text.partition("=")[0] in _LOADING:
            field, value = typed_field(LoadOptions, text, what=f"model {name}")
            loading = replace(loading, **{field: value})
        else:
            field, value = typed_field(family.options, text, what=f"model {name}")
            chosen = replace(chosen, **{field: value})
    return find_model(
        name, chosen, loading=loading if family.needs_weights else None, report=report
    )


def prompter_of(
    named: str,
    scene: Scene,
    *,
    download: bool = False,
    device: str = "auto",
    report: Callable[[str], None],
) -> PromptableMasks:
    """A model that answers points in views of a scene.

    Args:
        named: As `model_of` takes it, or the name of masks of the scene or its capture: of those
            the ones at a point answer.
        scene: The scene whose photographs it will be asked about.
        download: Whether weights that are not on this machine may be fetched.
        device: Where it runs.
        report: Told in a sentence what the user should know.

    Raises:
        InputError: If there is no such model, or it answers no points.
    """
    folders = scene.evidence_folders
    folder = find_evidence(folders, named) if named in evidence_names(folders) else Path(named)
    if name_of(named) not in model_names() and folder.is_dir():
        model: Model = recorded_model(folder, views=scene.views)
    else:
        model = model_of(named, download=download, device=device, report=report)
    if not isinstance(model, PromptableMasks):
        raise InputError(f"prompter: expected a model that answers points, got {model.name}.")
    return model


def name_of(named: str) -> str:
    """The name of a model that was given with weights and options."""
    return named.split(",")[0].partition("=")[0]


def _pieces(named: str) -> list[str]:
    """The name with its weights, then each option."""
    found: list[str] = []
    for piece in named.split(","):
        if len(found) > 1 and "=" not in piece:
            found[-1] += f",{piece}"
        else:
            found.append(piece)
    return found
