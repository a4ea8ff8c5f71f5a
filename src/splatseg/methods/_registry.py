"""Methods by name: those of this package, and those that other packages bring.

Another package brings a method by an entry point of the group ``splatseg.methods``: its name is
the method's, its value a `Method`. ``docs/methods.md`` has one of ten lines.
"""

import difflib
from importlib.metadata import EntryPoint, entry_points

from splatseg.core.boundary import boundary
from splatseg.errors import InputError, MissingPackageError
from splatseg.methods._method import Method

ENTRY_POINT_GROUP = "splatseg.methods"

_OWN = ("uplift", "features", "vote", "associate", "identity", "logits", "probabilities")


def method_names() -> tuple[str, ...]:
    """Names that `find_method` knows: ours in the order of the documentation, then others'."""
    return tuple(_known())


@boundary
def find_method(name: str) -> Method:
    """The method of this name.

    Raises:
        InputError: If there is none, or what another package brings is no method.
        MissingPackageError: If the package that brings it, or one it needs, cannot be imported.
    """
    known = _known()
    if name not in known:
        close = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(close)}?" if close else f"known: {', '.join(known)}."
        raise InputError(f"there is no method {name!r}; {hint}")
    entry = known[name]
    try:
        found: object = entry.load()
    except (ImportError, AttributeError) as error:
        raise MissingPackageError(
            f"method {name!r} ({entry.value}) cannot be loaded: {error}."
        ) from error
    if not isinstance(found, Method):
        raise InputError(
            f"method {name!r} ({entry.value}): expected a splatseg.methods.Method, "
            f"got {type(found).__name__}."
        )
    if found.name != name:
        raise InputError(
            f"method {name!r} ({entry.value}): expected a method of this name, got {found.name!r}."
        )
    return found


def methods() -> tuple[Method, ...]:
    """All methods, in the order of `method_names`."""
    return tuple(find_method(name) for name in method_names())


@boundary
def keeps_ids(method: object) -> bool:
    """Whether layers of this method have the ids of the evidence that they were made from.

    Args:
        method: Its name, as the info of a layer has it; no method keeps no ids.
    """
    return isinstance(method, str) and method in _known() and find_method(method).keeps_ids


def _known() -> dict[str, EntryPoint]:
    own = {
        name: EntryPoint(
            name=name, value=f"splatseg.methods.{name}:METHOD", group=ENTRY_POINT_GROUP
        )
        for name in _OWN
    }
    others = {entry.name: entry for entry in entry_points(group=ENTRY_POINT_GROUP)}
    # Another package cannot take the place of a method of ours.
    return own | {name: others[name] for name in sorted(others) if name not in own}
