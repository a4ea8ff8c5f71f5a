"""Options: frozen values whose ranges stand in their annotations.

    @options(removed={"rate": "the step is found by a line search"})
    class Example:
        share: Share = 0.5
        steps: Count = 100

Each field is converted and held to its range when an options object is made; `__post_init__` is
left for what several fields must satisfy together. A range is a `msgspec.Meta` beside the type, so
that records of files (`io.schema`) declare theirs in the same words. Numbers with a range are
finite, unless it says `MAY_BE_INFINITE`.
"""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar, dataclass_transform, overload

from msgspec import Meta

from splatseg.core.boundary import convert_fields
from splatseg.errors import InputError

Share = Annotated[float, Meta(ge=0, le=1)]
"""A share, in [0, 1]."""

Positive = Annotated[float, Meta(gt=0)]
"""A number above 0."""

NonNegative = Annotated[float, Meta(ge=0)]
"""A number of at least 0."""

Count = Annotated[int, Meta(ge=1)]
"""A whole number of at least 1."""

Natural = Annotated[int, Meta(ge=0)]
"""A whole number of at least 0."""

MAY_BE_INFINITE = {"infinite": True}
"""``Meta(ge=0, extra=MAY_BE_INFINITE)``: infinity is in the range."""

T = TypeVar("T")


@overload
def options(cls: type[T], /) -> type[T]: ...


@overload
def options(*, removed: Mapping[str, str]) -> Callable[[type[T]], type[T]]: ...


@dataclass_transform(frozen_default=True, kw_only_default=True)
def options(cls: type[Any] | None = None, /, *, removed: Mapping[str, str] | None = None) -> Any:
    """Make a class a frozen dataclass with keyword fields, checked as they are declared.

    Args:
        cls: The class.
        removed: Options that went, and what to do instead, as the rest of a sentence. To pass one
            raises `InputError` with it; the command line says the same of its flag.
    """
    if cls is None:
        return functools.partial(_made, gone=dict(removed or {}))
    return _made(cls, gone={})


def removed_options(cls: type[Any]) -> Mapping[str, str]:
    """Options of a class that went, and what to do instead."""
    return _REMOVED.get(f"{cls.__module__}.{cls.__qualname__}", {})


_REMOVED: dict[str, dict[str, str]] = {}


def _made(cls: type[T], *, gone: dict[str, str]) -> type[T]:
    check = getattr(cls, "__post_init__", None)  # an inherited one, too

    def __post_init__(self: Any) -> None:
        convert_fields(self)
        if check is not None:
            check(self)

    cls.__post_init__ = __post_init__  # pyright: ignore[reportAttributeAccessIssue]
    made: Any = dataclass(frozen=True, slots=True, kw_only=True)(cls)
    if gone:
        _REMOVED[f"{cls.__module__}.{cls.__qualname__}"] = gone
        initialise = made.__init__

        @functools.wraps(initialise)
        def __init__(self: Any, **values: Any) -> None:
            for name in values:
                if name in gone:
                    raise InputError(f"{name}: this option was removed; {gone[name]}.")
            initialise(self, **values)

        made.__init__ = __init__
    return made
