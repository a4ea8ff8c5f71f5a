"""Values as people type them: ``NAME=VALUE`` for a field of a dataclass."""

from typing import Any, Literal, get_args, get_origin, get_type_hints

from splatseg.errors import InputError

_WORDS = {int: "a whole number", float: "a number", str: "text"}
REPEATED = "repeated"
"""Key of the metadata of a dataclass's field whose flag has one item each time that it is given,
commas and all; its value is the placeholder."""

_YES, _NO = ("yes", "true"), ("no", "false")


def typed_field(kind: type[Any], text: str, *, what: str) -> tuple[str, Any]:
    """Name and value of ``NAME=VALUE``, by the annotation of a dataclass's field.

    Args:
        kind: The dataclass.
        text: What was typed. Values of a tuple are separated by commas.
        what: What the names are called in messages, such as ``switch``.

    Raises:
        InputError: If it is not of this form, there is no such field, or the value does not fit.

    Example:
        >>> from dataclasses import make_dataclass
        >>> lens = make_dataclass("Lens", [("wide", bool), ("stops", tuple[float, ...])])
        >>> typed_field(lens, "wide=yes", what="option"), typed_field(lens, "stops=2,4", what="x")
        (('wide', True), ('stops', (2.0, 4.0)))
    """
    name, equals, value = text.partition("=")
    hints = get_type_hints(kind)
    if not equals or name not in hints:
        raise InputError(
            f"{what}: expected NAME=VALUE with a name of {', '.join(sorted(hints))}, got {text!r}."
        )
    return name, _value(f"{what}: {name}", value, hints[name])


def _value(where: str, text: str, kind: Any) -> Any:
    options = [one for one in get_args(kind) if one is not type(None)]
    if type(None) in get_args(kind):
        return None if text.lower() in ("", "none") else _value(where, text, options[0])
    if get_origin(kind) is tuple:
        parts = [one.strip() for one in text.split(",") if one.strip()]
        return tuple(_value(where, one, options[0]) for one in parts)
    if get_origin(kind) is Literal:
        if text not in options:
            raise InputError(f"{where}: expected one of {', '.join(options)}, got {text!r}.")
        return text
    if kind is bool:
        if text.lower() not in (*_YES, *_NO):
            raise InputError(f"{where}: expected yes or no, got {text!r}.")
        return text.lower() in _YES
    if kind not in _WORDS:
        raise InputError(f"{where}: cannot be given as text.")
    try:
        return kind(text)
    except ValueError as error:
        raise InputError(f"{where}: expected {_WORDS[kind]}, got {text!r}.") from error
