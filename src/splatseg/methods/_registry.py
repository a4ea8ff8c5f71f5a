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

_OWN = (
    "uplift", "features", "objects", "voxels", "vote", "associate", "object-classes", "identity",
    "saga", "cosseg", "logits", "probabilities", "prompt",
)  # fmt: skip
_ABOVE = {"dnmp": "splatseg.street.method:METHOD"}
"""Methods of packages above this one, imported when they are asked for, and where they are."""

_REGISTERED: dict[str, Method] = {}


def method_names() -> tuple[str, ...]:
    """Names that `find_method` knows: ours in the order of the documentation, then others'."""
    return (*_known(), *_REGISTERED)


@boundary
def find_method(name: str) -> Method:
    """The method of this name.

    Raises:
        InputError: If there is none, or what another package brings is no method.
        MissingPackageError: If the package that brings it, or one it needs, cannot be imported.
    """
    if name in _REGISTERED:
        return _REGISTERED[name]
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


@boundary
def register_method(method: Method) -> Method:
    """Make a method known by its name for as long as this process runs.

    A notebook tries a method so; a package that brings one for good has an entry point. One that
    was registered before under the name is replaced, which a cell that runs twice does.

    Raises:
        InputError: If the name is that of a method of ours or of an installed package.
    """
    if method.name in _known():
        raise InputError(f"method: expected a name that is free, got {method.name!r}.")
    _REGISTERED[method.name] = method
    return method


def methods() -> tuple[Method, ...]:
    """All methods, in the order of `method_names`."""
    return tuple(find_method(name) for name in method_names())


@boundary
def keeps_ids(method: object) -> bool:
    """Whether layers of this method have the ids of the evidence that they were made from.

    Args:
        method: Its name, as the info of a layer has it; no method keeps no ids.
    """
    return isinstance(method, str) and method in method_names() and find_method(method).keeps_ids


@boundary
def keeps_boundaries(method: object) -> bool:
    """Whether layers of this method have their boundaries where the label maps have them.

    Args:
        method: Its name, as the info of a layer has it; no method keeps none.
    """
    return keeps_ids(method) and not find_method(str(method)).repairs


def _known() -> dict[str, EntryPoint]:
    modules = {name: f"splatseg.methods.{name.replace('-', '_')}:METHOD" for name in _OWN} | _ABOVE
    own = {
        name: EntryPoint(name=name, value=value, group=ENTRY_POINT_GROUP)
        for name, value in modules.items()
    }
    others = {entry.name: entry for entry in entry_points(group=ENTRY_POINT_GROUP)}
    # Another package cannot take the place of a method of ours.
    return own | {name: others[name] for name in sorted(others) if name not in own}
