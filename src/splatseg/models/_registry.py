"""Models by name: those of this package, those that other packages bring, recorded ones.

Another package brings a model by an entry point of the group ``splatseg.models``: its name is
the model's, its value something that gives the model when called without arguments, such as its
class, or a `ModelFamily`, which has options and weights.
"""

import difflib
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, cast

from splatseg.core.boundary import boundary
from splatseg.core.models import Model
from splatseg.errors import InputError, MissingFileError, MissingPackageError, quoted
from splatseg.io.foreign import is_file, is_folder
from splatseg.models._family import LoadOptions, ModelFamily
from splatseg.models._loading import loading_of

ENTRY_POINT_GROUP = "splatseg.models"

_NETWORKS = "splatseg.models.networks"
_OWN = {
    "classical": "splatseg.models.classical:CLASSICAL",
    "sam": f"{_NETWORKS}.sam:SAM",
    "sam-hq": f"{_NETWORKS}.sam:SAM_HQ",
    "sam2": f"{_NETWORKS}.sam:SAM2",
    "sam3": f"{_NETWORKS}.sam:SAM3",
    "sam2-video": f"{_NETWORKS}.sam_video:SAM2_VIDEO",
    "sam3-video": f"{_NETWORKS}.sam_video:SAM3_VIDEO",
    "dino": f"{_NETWORKS}.dino:DINO",
    "dinov2": f"{_NETWORKS}.dino:DINOV2",
    "dinov3": f"{_NETWORKS}.dino:DINOV3",
    "maskformer": f"{_NETWORKS}.segmenters:MASKFORMER",
    "mask2former": f"{_NETWORKS}.segmenters:MASK2FORMER",
    "oneformer": f"{_NETWORKS}.segmenters:ONEFORMER",
    "eomt": f"{_NETWORKS}.segmenters:EOMT",
    "segformer": f"{_NETWORKS}.semantic:SEGFORMER",
    "dpt-semantic": f"{_NETWORKS}.semantic:DPT_SEMANTIC",
    "depth-anything": f"{_NETWORKS}.depth:DEPTH_ANYTHING",
    "dpt": f"{_NETWORKS}.depth:DPT",
    "clip": f"{_NETWORKS}.clip:CLIP",
    "siglip2": f"{_NETWORKS}.siglip:SIGLIP2",
    "clipseg": f"{_NETWORKS}.clipseg:CLIPSEG",
    "grounding-dino": f"{_NETWORKS}.grounding_dino:GROUNDING_DINO",
    "langsam": f"{_NETWORKS}.langsam:LANGSAM",
    "sam3-text": f"{_NETWORKS}.sam3_text:SAM3_TEXT",
    "lseg": "splatseg.models.lseg:LSEG",
}


def model_names() -> tuple[str, ...]:
    """Names that `find_model` knows, ours first. Nothing is loaded for it."""
    return tuple(_known())


@boundary
def find_family(name: str) -> ModelFamily | None:
    """What a model of this name is made from; None for one that another package makes whole.

    Raises:
        InputError: If there is none, or what another package brings is no model.
        MissingPackageError: If the package that brings it cannot be imported.
    """
    known = _known()
    if name not in known:
        close = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(close)}?" if close else f"known: {', '.join(known)}."
        raise InputError(f"there is no model {name!r}; {hint}")
    found = _loaded(known[name])
    if isinstance(found, ModelFamily) and found.name != name:
        raise InputError(f"model {name!r}: expected a family of this name, got {found.name!r}.")
    return found if isinstance(found, ModelFamily) else None


@boundary
def find_model(
    name: str | Path,
    options: object = None,
    *,
    loading: LoadOptions | None = None,
    report: Callable[[str], None] | None = None,
) -> Model:
    """The model of this name, or the recorded one of this folder.

    A name comes before a folder; ``./classical`` is always the folder.

    Args:
        name: The name, or the folder.
        options: An instance of the family's options; None takes its defaults.
        loading: Its weights, and where and how it runs; goes with models that have weights.
        report: Told in a sentence what the user should know, such as what is fetched.

    Raises:
        InputError: If there is neither, options are not those of the model, or what another
            package brings is no model.
        MissingFileError: If the weights are not on this machine, or a path leads to nothing.
        FileFormatError: If the weights are broken, or of another model.
        MissingPackageError: If the package that brings it, or one it needs, cannot be imported.
    """
    known = _known()
    text = str(name)
    if text not in known:
        if not is_file(Path(name)) and not is_folder(Path(name)):
            if Path(name).suffix or len(Path(name).parts) > 1:
                raise MissingFileError(f"model: {quoted(text)}: there is no such file or folder.")
            names = ", ".join(known)
            raise InputError(
                f"model: expected one of {names}, or a file or folder of recorded evidence, got "
                f"{quoted(text)}."
            )
        _refuse(text, options, loading)
        from splatseg.models.recorded import recorded_model

        return recorded_model(name)
    family = find_family(text)
    if family is None:
        _refuse(text, options, loading)
        return _made(known[text])
    if options is not None and not isinstance(options, family.options):
        raise InputError(
            f"options: expected {family.options.__name__} for model {text}, "
            f"got {type(options).__name__}."
        )
    settings = family.options() if options is None else options
    if not family.needs_weights:
        if loading not in (None, LoadOptions()):
            raise InputError(f"weights: model {text} has none.")
        return family.load(settings, None)
    place = loading_of(family, loading or LoadOptions(), report=report or _silent)
    return family.load(settings, place)


def _refuse(name: str, options: object, loading: LoadOptions | None) -> None:
    if options is not None or loading not in (None, LoadOptions()):
        raise InputError(f"options: model {name} takes neither options nor weights.")


def _silent(sentence: str) -> None:
    """Where nobody listens."""


def _known() -> dict[str, EntryPoint]:
    own = {
        name: EntryPoint(name=name, value=value, group=ENTRY_POINT_GROUP)
        for name, value in _OWN.items()
    }
    others = {entry.name: entry for entry in entry_points(group=ENTRY_POINT_GROUP)}
    # Another package cannot take the place of one of ours.
    return own | {name: others[name] for name in sorted(others) if name not in own}


def _loaded(entry: EntryPoint) -> object:
    try:
        return cast(object, entry.load())
    except (ImportError, AttributeError) as error:
        raise MissingPackageError(
            f"model {entry.name!r} ({entry.value}) cannot be loaded: {error}."
        ) from error


def _made(entry: EntryPoint) -> Model:
    """A model that another package makes whole."""
    make = _loaded(entry)
    if not callable(make):
        raise InputError(
            f"model {entry.name!r} ({entry.value}): expected something to call or a family, "
            f"got {type(make).__name__}."
        )
    model = cast(Callable[[], Any], make)()
    if not isinstance(model, Model):
        raise InputError(
            f"model {entry.name!r} ({entry.value}): expected an object with name, settings and "
            f"note, got {type(model).__name__}."
        )
    return model
