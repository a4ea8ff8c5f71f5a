"""Models by name: those of this package, those that other packages bring, recorded ones.

Another package brings a model by an entry point of the group ``splatseg.models``: its name is
the model's, its value something that gives the model when called without arguments, such as its
class.
"""

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, cast

from splatseg.core.boundary import boundary
from splatseg.core.models import Model
from splatseg.errors import InputError, MissingPackageError

ENTRY_POINT_GROUP = "splatseg.models"

_OWN = {"classical": "splatseg.models.classical:Classical"}


def model_names() -> tuple[str, ...]:
    """Names that `find_model` knows, sorted. Nothing is loaded for it."""
    return tuple(sorted(_known()))


@boundary
def find_model(name: str | Path) -> Model:
    """The model of this name, or the recorded one of this folder.

    A name comes before a folder; ``./classical`` is always the folder.

    Raises:
        InputError: If there is neither, or what another package brings is no model.
        MissingPackageError: If the package that brings it, or one it needs, cannot be imported.
    """
    known = _known()
    if str(name) in known:
        return _load(known[str(name)])
    if Path(name).is_dir():
        from splatseg.models.recorded import recorded_model

        return recorded_model(name)
    names = ", ".join(sorted(known))
    raise InputError(
        f"model: expected one of {names}, or a folder of recorded evidence, got {str(name)!r}."
    )


def _known() -> dict[str, EntryPoint]:
    found = {entry.name: entry for entry in entry_points(group=ENTRY_POINT_GROUP)}
    own = {
        name: EntryPoint(name=name, value=value, group=ENTRY_POINT_GROUP)
        for name, value in _OWN.items()
    }
    return found | own  # another package cannot take the place of one of ours


def _load(entry: EntryPoint) -> Model:
    try:
        make: object = entry.load()
    except (ImportError, AttributeError) as error:
        raise MissingPackageError(
            f"model {entry.name!r} ({entry.value}) cannot be loaded: {error}."
        ) from error
    if not callable(make):
        raise InputError(
            f"model {entry.name!r} ({entry.value}): expected something to call, "
            f"got {type(make).__name__}."
        )
    model = cast(Callable[[], Any], make)()
    if not isinstance(model, Model):
        raise InputError(
            f"model {entry.name!r} ({entry.value}): expected an object with name, settings and "
            f"note, got {type(model).__name__}."
        )
    return model
