"""Arguments converted and checked as their annotations say, where callers come in.

Shape, type and meaning of an argument stand in its annotation already; `boundary` reads them once
for each public function, and `convert_fields` for each public class. Private code calls private
code without either.

    tensors     Float[Tensor, "n 3"]: tensors, arrays, lists of numbers, see `coerce`. A last axis
                called ``channels`` may be left out where there is one; (H, W) is taken for
                ``height width 3``, three times the same. Axes are those of the annotation, and
                of the fields of a class axes of one name have one length
    numbers     int, float, bool: Python's, NumPy's, tensors of one
    paths       Path: paths and text
    values      any class: an instance of it
    many        tuple, Sequence, Mapping: each of them, lists and arrays included
    words       Literal: one of them
    ranges      Annotated[float, Meta(ge=0)]: a number in it, finite unless it says otherwise
"""

import collections.abc
import errno
import functools
import inspect
import math
import os
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, Union, cast

import numpy as np
import torch
from jaxtyping import AbstractArray
from msgspec import Meta
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core.coerce import (
    Kind,
    as_any_tensor,
    as_array,
    as_bool,
    as_integer,
    as_number,
    as_path,
    as_tensor,
    as_text,
    describe,
)
from splatseg.core.threads import is_limited, one_torch_thread
from splatseg.errors import InputError, RangeError, ShapeError

Converter = Callable[[str, Any], Any]
P = ParamSpec("P")
R = TypeVar("R")
_SCALARS: dict[Any, Converter] = {
    int: as_integer,
    float: as_number,
    bool: as_bool,
    str: as_text,
    Path: as_path,
    Tensor: as_any_tensor,
}
_IMAGE = ("height", "width", "3")
_MAPPINGS = (collections.abc.Mapping, dict)
_MANY = (collections.abc.Sequence, collections.abc.Collection, collections.abc.Iterable, list)


def boundary(function: Callable[P, R]) -> Callable[P, R]:
    """Convert the arguments of a public function by its annotations; torch has one thread in it.

    Raises:
        InputError: When the function is called with an argument that cannot be what it should
            be; the sentence names the argument, what was expected and what came. Also where a
            name is too long for any file.
    """
    names = tuple(inspect.signature(function).parameters)
    found: dict[str, Converter] = {}
    resolved = False

    @functools.wraps(function)
    def converted(*args: P.args, **kwargs: P.kwargs) -> R:
        nonlocal resolved
        if not resolved:
            found.update(converters(function, names))
            resolved = True
        given: list[Any] = list(args)
        for i, name in enumerate(names[: len(given)]):
            if name in found:
                given[i] = found[name](name, given[i])
        for name in kwargs:
            if name in found:
                kwargs[name] = found[name](name, kwargs[name])
        try:
            if is_limited():
                return function(*given, **kwargs)  # pyright: ignore[reportCallIssue]
            with one_torch_thread():
                return function(*given, **kwargs)  # pyright: ignore[reportCallIssue]
        except OSError as error:
            if error.errno != errno.ENAMETOOLONG:
                raise
            raise InputError(
                f"{error.filename}: expected the name of a file, got one that is too long."
            ) from error

    return converted


def convert_fields(value: Any) -> None:
    """Convert the fields of a dataclass as their annotations say; first in its `__post_init__`.

    Raises:
        InputError: If a field cannot be what it should be.
    """
    lengths: dict[str, int] = {}
    for name, convert, axes in _field_converters(type(value)):
        given = getattr(value, name)
        made = convert(name, given)
        if made is not given:
            object.__setattr__(value, name, made)
        if axes and made is not None:
            pairs = list(zip(axes, made.shape, strict=True))
            check_shape(name, made, [lengths.get(axis, length) for axis, length in pairs])
            lengths.update(pairs)


@functools.cache
def _field_converters(owner: type[Any]) -> tuple[tuple[str, Converter, tuple[str, ...]], ...]:
    """Name, converter and axes of the fields that have a converter."""
    hints = _hints(owner)
    names = tuple(field.name for field in fields(owner))
    return tuple((n, c, _axes_of(hints[n])) for n, c in converters(owner, names).items())


def _hints(owner: Any) -> dict[str, Any]:
    # JSON's alias is text that names what the module of the annotation may not import.
    known = {"JSON": object, "Sequence": Sequence, "Mapping": Mapping}
    return typing.get_type_hints(owner, localns=known, include_extras=True)


def _axes_of(annotation: Any) -> tuple[str, ...]:
    """Axes of a tensor, which may be None; empty where the annotation does not fix them."""
    is_union = typing.get_origin(annotation) in (Union, types.UnionType)
    found = {
        member.dim_str
        for member in (typing.get_args(annotation) if is_union else (annotation,))
        if isinstance(member, type) and issubclass(member, AbstractArray)
    }
    axes = tuple(found.pop().split()) if len(found) == 1 else ()
    return axes if all(a.isidentifier() or a.isdecimal() for a in axes) else ()


def converters(owner: Any, names: tuple[str, ...]) -> dict[str, Converter]:
    """What converts each of the named arguments of a function or fields of a dataclass.

    A converter takes the name, for the error, and the value. Names that may be anything have none.
    """
    hints = _hints(owner)
    found = {name: _converter(hints[name]) for name in names if name in hints}
    return {name: convert for name, convert in found.items() if convert is not None}


def _converter(annotation: Any) -> Converter | None:
    """What makes a value of an annotation, None where anything will do."""
    annotation = _unaliased(annotation)
    if annotation in _SCALARS:
        return _SCALARS[annotation]
    origin, args = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        return _within(_converter(args[0]), [m for m in args[1:] if _is_range(m)])
    if origin in (Union, types.UnionType):
        return _one_of(args)
    if origin is Literal:
        return functools.partial(_word, args)
    if origin is np.ndarray:
        return functools.partial(_array, _dtype_of(args))
    if origin is os.PathLike:
        return as_path
    if origin is tuple:
        return _tuple_of(args)
    if origin in _MAPPINGS:
        return functools.partial(_mapping, _converter(args[1]))
    if origin in _MANY:
        item = _converter(args[0])
        lazy = origin is collections.abc.Iterable
        return functools.partial(_iterable if lazy else _sequence, item)
    if origin is collections.abc.Callable:
        return _callable
    if isinstance(annotation, type) and origin is None:
        if issubclass(annotation, AbstractArray):
            return _tensor_of(annotation)
        return functools.partial(_instance, annotation) if _is_checkable(annotation) else None
    return None


def _unaliased(annotation: Any) -> Any:
    """What a `type` statement gave a name to; NumPy's `NDArray` is such a name from 2.5 on."""
    alias = typing.get_origin(annotation) or annotation
    if not hasattr(alias, "__value__"):
        return annotation
    args = typing.get_args(annotation)
    return _unaliased(alias.__value__[args] if args else alias.__value__)


def _is_checkable(annotation: type[Any]) -> bool:
    if annotation in (object, Any):
        return False
    is_protocol = getattr(annotation, "_is_protocol", False)
    return not is_protocol or getattr(annotation, "_is_runtime_protocol", False)


def _instance(wanted: type[Any], name: str, value: Any) -> Any:
    if isinstance(value, wanted):
        return value
    raise InputError(f"{name}: expected {_called(wanted)}, got {describe(value)}.")


def _called(annotation: Any) -> str:
    """An annotation in words."""
    words = {
        int: "a whole number",
        float: "a number",
        bool: "True or False",
        str: "text",
        Path: "a path",
        Tensor: "a tensor",
        type(None): "None",
    }
    if annotation in words:
        return words[annotation]
    if typing.get_origin(annotation) is Annotated:
        plain, *facts = typing.get_args(annotation)
        return ", ".join([_called(plain), *(range_in_words(f) for f in facts if _is_range(f))])
    if typing.get_origin(annotation) is Literal:
        return f"one of {', '.join(str(word) for word in typing.get_args(annotation))}"
    if isinstance(annotation, type) and issubclass(annotation, AbstractArray):
        return "a tensor"
    word = str(getattr(annotation, "__name__", annotation))
    return f"{'an' if word[0] in 'AEIOU' else 'a'} {word}"


def _one_of(members: tuple[Any, ...]) -> Converter | None:
    """The first member that takes the value as it stands, else the first that can convert it."""
    attempts = [(member, _converter(member)) for member in members if member is not type(None)]
    if any(convert is None for _, convert in attempts):
        return None
    optional = type(None) in members
    exact = tuple(m for m in members if isinstance(m, type) and _is_checkable(m))

    def convert(name: str, value: Any) -> Any:
        if value is None and optional:
            return None
        if len(attempts) == 1:
            return cast(Converter, attempts[0][1])(name, value)
        plain = tuple(m for m in exact if not issubclass(m, AbstractArray))
        if isinstance(value, plain) and not isinstance(value, (bool, int, str, Tensor)):
            return value
        if isinstance(value, str) and str in plain:
            if Path in members:
                as_path(name, value)
            return as_text(name, value)
        if all(isinstance(m, type) and issubclass(m, AbstractArray) for m, _ in attempts):
            value = as_tensor(name, value)
        errors: list[InputError] = []
        made: list[Any] = []
        for _, attempt in attempts:
            try:
                made.append(cast(Converter, attempt)(name, value))
            except InputError as error:
                errors.append(error)
        if made:
            return next((one for one in made if one is value), made[0])
        if misshapen := next((one for one in errors if isinstance(one, ShapeError)), None):
            raise misshapen
        words = " or ".join(dict.fromkeys(_called(member) for member, _ in attempts))
        raise InputError(f"{name}: expected {words}, got {describe(value)}.") from errors[0]

    return convert


def _is_range(note: Any) -> bool:
    bounds = ("ge", "gt", "le", "lt")
    return isinstance(note, Meta) and any(getattr(note, name) is not None for name in bounds)


def _within(convert: Converter | None, ranges: list[Meta]) -> Converter | None:
    if convert is None or not ranges:
        return convert

    def within(name: str, value: Any) -> Any:
        made = convert(name, value)
        for bounds in ranges:
            check_bounds(name, made, bounds)
        return made

    return within


def check_bounds(name: str, value: float, bounds: Meta) -> None:
    """Raise `RangeError` unless a number is in a declared range.

    A number is finite unless the range has the extra ``infinite``; NaN is in none.
    """
    low = -math.inf if (lowest := _first(bounds.ge, bounds.gt)) is None else lowest
    high = math.inf if (highest := _first(bounds.le, bounds.lt)) is None else highest
    above = value > low if bounds.gt is not None else value >= low
    below = value < high if bounds.lt is not None else value <= high
    if above and below and (math.isfinite(value) or (bounds.extra or {}).get("infinite")):
        return
    raise RangeError(f"{name}: expected {range_in_words(bounds)}, got {value:g}.")


def range_in_words(bounds: Meta) -> str:
    """A declared range as messages and help have it: ``a value in [0, 1]``, ``at least 1``."""
    lowest, highest = _first(bounds.ge, bounds.gt), _first(bounds.le, bounds.lt)
    if lowest is not None and highest is not None:
        opening = "(" if bounds.gt is not None else "["
        closing = ")" if bounds.lt is not None else "]"
        return f"a value in {opening}{lowest:g}, {highest:g}{closing}"
    if lowest is not None:
        return f"{'at least' if bounds.ge is not None else 'more than'} {lowest:g}"
    return f"{'at most' if bounds.le is not None else 'less than'} {highest:g}"


def _first(closed: float | None, opened: float | None) -> float | None:
    return closed if closed is not None else opened


def _word(words: tuple[Any, ...], name: str, value: Any) -> Any:
    if isinstance(value, (str, int)) and value in words:
        return value
    shown = repr(value) if isinstance(value, str) else describe(value)
    raise InputError(f"{name}: expected one of {', '.join(map(str, words))}, got {shown:.60}.")


def _callable(name: str, value: Any) -> Any:
    if callable(value):
        return value
    raise InputError(f"{name}: expected a function, got {describe(value)}.")


def _mapping(item: Converter | None, name: str, value: Any) -> Any:
    if not isinstance(value, Mapping):
        raise InputError(f"{name}: expected a mapping, got {describe(value)}.")
    given = cast(Mapping[Any, Any], value)
    if item is None:
        return given
    made = {key: item(f"{name}[{describe(key)}]", one) for key, one in given.items()}
    return given if all(made[key] is one for key, one in given.items()) else made


def _iterable(item: Converter | None, name: str, value: Any) -> Any:
    if isinstance(value, (collections.abc.Collection, Tensor, np.ndarray)):
        return _sequence(item, name, value)
    if isinstance(value, (str, bytes)) or not isinstance(value, collections.abc.Iterable):
        raise InputError(f"{name}: expected a sequence, got {describe(value)}.")
    given = cast(Any, value)
    if item is None:
        return given
    return (item(f"{name}[{i}]", one) for i, one in enumerate(given))


def _sequence(item: Converter | None, name: str, value: Any) -> Any:
    given = _listed(name, value)
    if item is None:
        return given
    made = [item(f"{name}[{i}]", one) for i, one in enumerate(given)]
    same = all(new is old for new, old in zip(made, given, strict=True))
    return given if same else tuple(made)


def _listed(name: str, value: Any) -> Any:
    """A sequence of Python's; arrays and tensors of one axis give their numbers."""
    if isinstance(value, (Tensor, np.ndarray)):
        tensor = as_tensor(name, value)
        if tensor.ndim == 0:
            raise InputError(f"{name}: expected a sequence, got {describe(value)}.")
        return tensor.tolist() if tensor.ndim == 1 else tuple(tensor)
    if isinstance(value, (str, bytes)) or not isinstance(value, collections.abc.Collection):
        raise InputError(f"{name}: expected a sequence, got {describe(value)}.")
    return cast(Any, value)


def _tuple_of(args: tuple[Any, ...]) -> Converter:
    if len(args) == 2 and args[1] is Ellipsis:
        item = _converter(args[0])

        def many(name: str, value: Any) -> Any:
            made = _sequence(item, name, value)
            return made if isinstance(made, tuple) else tuple(made)

        return many
    items = tuple(_converter(arg) for arg in args)

    def fixed(name: str, value: Any) -> Any:
        given = _listed(name, value)
        if len(given) != len(items):
            raise ShapeError(f"{name}: expected {len(items)} values, got {len(given)}.")
        made = tuple(
            one if item is None else item(f"{name}[{i}]", one)
            for i, (item, one) in enumerate(zip(items, given, strict=True))
        )
        same = isinstance(given, tuple) and all(
            new is old for new, old in zip(made, cast(Any, given), strict=True)
        )
        return cast(Any, given) if same else made

    return fixed


def _array(dtype: "np.dtype[Any] | None", name: str, value: Any) -> Any:
    if isinstance(value, np.ndarray) and (dtype is None or value.dtype == dtype):
        return cast(Any, value)
    return as_array(name, value, dtype)


def _dtype_of(args: tuple[Any, ...]) -> "np.dtype[Any] | None":
    """The element type of ``NDArray[X]``, None for any."""
    inner: tuple[Any, ...] = typing.get_args(args[1]) if len(args) > 1 else ()
    known = bool(inner) and isinstance(inner[0], type) and inner[0] is not np.generic
    return np.dtype(inner[0]) if known else None


def _tensor_of(annotation: Any) -> Converter | None:
    if annotation.array_type is not Tensor:
        return None
    kind = _kind_of(annotation.dtypes)
    axes = tuple(annotation.dim_str.split())
    is_image = axes == _IMAGE and kind == "byte"
    signal = kind == "float" and axes[-1:] == ("channels",)
    fixed = not any(axis.startswith(("*", "#", "...")) for axis in axes)

    def convert(name: str, value: Any) -> Tensor:
        tensor = as_tensor(name, value, "any" if signal else kind)
        if signal:
            # Blended ids would be ids of other things.
            if tensor.numel() and not tensor.is_floating_point() and tensor.dtype != torch.bool:
                raise InputError(
                    f"{name}: expected floating-point values, got {tensor.dtype}; pass x.float() "
                    "if these are no ids, x / 255 for pixels."
                )
            tensor = as_tensor(name, tensor, kind)
        if fixed and axes and tensor.ndim == len(axes) - 1 > 0:
            if axes[-1] == "channels":
                return tensor.unsqueeze(-1)
            if is_image:
                tensor = tensor.unsqueeze(-1).expand(*tensor.shape, 3)
        if is_image and (tensor.ndim != 3 or tensor.shape[2] != 3 or not tensor.numel()):
            raise ShapeError(
                f"{name}: expected an image (height, width, 3) of at least a pixel, "
                f"got {tuple(tensor.shape)}."
            )
        if fixed and axes:
            check_shape(name, tensor, [int(a) if a.isdecimal() else None for a in axes])
        return tensor

    return convert


def _kind_of(dtypes: Any) -> Kind:
    names = [str(dtype) for dtype in dtypes] if isinstance(dtypes, (list, tuple)) else []
    if names == ["uint8"]:
        return "byte"
    for start, kind in (("float", "float"), ("bfloat", "float"), ("bool", "bool")):
        if names and all(name.startswith((start, "bfloat")) for name in names):
            return cast(Kind, kind)
    whole = names and all(name.startswith(("int", "uint")) for name in names)
    return "integer" if whole else "any"
