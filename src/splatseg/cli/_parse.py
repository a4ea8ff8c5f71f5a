"""Frozen dataclasses as command lines: flags, help as flowing text, short placeholders.

tyro makes the parser. It takes the strings below fields for help line by line as they stand in
the source, and writes ``{None}|STR`` for an optional word; so it is given a copy of the class in
which both are as a person wants to read them, and its answer is copied back.
"""

import contextlib
import dataclasses
import functools
import inspect
import io
import os
import re
import textwrap
import types
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

import docstring_parser
import tyro

from splatseg.cli._words import names_as_flags, option_names
from splatseg.core.options import removed_options
from splatseg.core.typed_text import REPEATED
from splatseg.errors import InputError, quoted

if TYPE_CHECKING:
    from splatseg.cli import CommandEntry

_WIDTH = 80
"""Columns of a kept page of help."""

_SHARED = ("seed", "backend", "data", "json", "quiet")
_ITEMS = {str: "names", int: "whole numbers", float: "numbers"}
_PLACEHOLDERS: dict[Any, str] = {str: "NAME", int: "N", float: "X", Path: "PATH"}


def parse(
    command: type[Any], words: Sequence[str], *, prog: str, config: tuple[Any, ...]
) -> object:
    """An instance of a dataclass from the words of a command line.

    Raises:
        SystemExit: After the help (status 0), or after words that cannot be used (2).
        InputError: If an item of a list is no number, or options refuse their values.
    """
    _refuse_removed(command, words, config)
    shown = _readable(command, option_names(command))
    try:
        made = tyro.cli(shown, prog=prog, args=list(words), config=config)
    except _UnreadableError as error:
        raise InputError(str(error)) from error
    return _with_values_of(made, command)


def _refuse_removed(command: type[Any], words: Sequence[str], config: tuple[Any, ...]) -> None:
    """Say of a flag that went what to use instead: of options, and of `REMOVED` of the command."""
    plain = tyro.conf.OmitArgPrefixes in config
    removed = _removed(command, "", plain=plain) | dict(getattr(command, "REMOVED", {}))
    for word in words:
        flag = word.partition("=")[0]
        name = flag.removeprefix("--").replace("-", "_")
        said = removed.get(name, removed.get(name.removeprefix("no_")))
        if flag.startswith("--") and said is not None:
            hint = names_as_flags(said, option_names(command))
            raise InputError(f"{flag}: this option was removed; {hint}.")


def _removed(kind: type[Any], prefix: str, *, plain: bool) -> dict[str, str]:
    """What to use instead of the flags that went, by their names with prefixes."""
    found = {
        f"{prefix}{name}": said
        for owner in kind.__mro__
        for name, said in removed_options(owner).items()
    }
    hints = get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        inner, notes = _unwrapped(hints[field.name])
        if dataclasses.is_dataclass(inner):
            unnamed = any(_is_argument(note) and note.name == "" for note in notes)
            bare = plain or unnamed or tyro.conf.OmitArgPrefixes in notes
            deeper = prefix if bare else f"{prefix}{field.name}."
            found |= _removed(cast("type[Any]", inner), deeper, plain=plain)
    return {name: said for name, said in found.items() if name not in hints}


class _UnreadableError(Exception):
    """A word that is no item of a list; no `ValueError`, of which tyro would make a box."""


def flowing(text: str) -> str:
    r"""Text without the line breaks of the source; paragraphs and items of lists stay.

    Example:
        >>> flowing("one line,\n    and its end.\n\n    - an\n      item\n    - another")
        'one line, and its end.\n\n- an item\n- another'
    """
    blocks = re.split(r"(\n{2,}|\n(?=- ))", inspect.cleandoc(text))
    return "".join(
        "\n" * min(block.count("\n"), 2) if not block.strip() else " ".join(block.split())
        for block in blocks
    )


def _readable(command: type[Any], names: Collection[str]) -> type[Any]:
    """A class of the same fields, annotated, which checks nothing; nested dataclasses likewise.

    Args:
        command: The class.
        names: All options of the command, which texts name in backticks.
    """
    hints = get_type_hints(command, include_extras=True)
    kinds = get_type_hints(command)  # without the ranges that options declare, inside of lists too
    texts = _texts(command)
    made: list[tuple[str, Any, Any]] = []
    # What all commands have stands last in their help.
    place = {name: index for index, name in enumerate(_SHARED)}
    order = sorted(dataclasses.fields(command), key=lambda field: place.get(field.name, -1))
    for field in order:
        kind: Any = kinds[field.name]
        _, notes = _unwrapped(hints[field.name])
        default = field.default
        factory = field.default_factory
        if dataclasses.is_dataclass(kind):
            inner = _readable(cast("type[Any]", kind), names)
            value = factory() if factory is not dataclasses.MISSING else default
            if value is not dataclasses.MISSING:
                default = _with_values_of(value, inner)
            factory = dataclasses.MISSING
            kind = inner
        configured = [note for note in notes if _is_argument(note)]
        help = next((note.help for note in configured if note.help), None) or texts.get(field.name)
        metavar = next((note.metavar for note in configured if note.metavar), None)
        metavar = metavar or field.metadata.get(REPEATED)
        if metavar is None and not dataclasses.is_dataclass(kind):
            metavar = _placeholder(kind)
        argument = tyro.conf.arg(
            name=next((note.name for note in configured if note.name is not None), None),
            help=None if help is None else names_as_flags(help, names),
            metavar=metavar,
            aliases=next((note.aliases for note in configured if note.aliases), None),
        )
        others = [note for note in notes if not _is_argument(note)]
        if kind is bool and field.default is False:
            others.append(tyro.conf.FlagCreatePairsOff)  # --no-x would say what is so anyway
        if field.metadata.get(REPEATED):
            others.append(tyro.conf.UseAppendAction)
        # A flag that is given again and again has one item each time, commas and all.
        item = _item_of(kind)
        if item is not None and tyro.conf.UseAppendAction not in others:
            others.append(_list_of(item, field.name))
        annotated: Any = Annotated[kind, argument]
        for note in others:
            annotated = Annotated[annotated, note]
        spec = (
            dataclasses.field(default_factory=factory)
            if factory is not dataclasses.MISSING
            else dataclasses.field(default=default)
            if default is not dataclasses.MISSING
            else dataclasses.field()
        )
        made.append((field.name, annotated, spec))
    shown = dataclasses.make_dataclass(command.__name__, made, frozen=True, kw_only=True)
    shown.__doc__ = flowing(command.__doc__ or "")
    return shown


def _with_values_of(value: object, kind: type[Any]) -> Any:
    """An instance of a class from one of its readable copy, or the other way round."""
    kinds = get_type_hints(kind)
    values: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        inner, held = kinds[field.name], getattr(value, field.name)
        values[field.name] = (
            _with_values_of(held, cast("type[Any]", inner))
            if dataclasses.is_dataclass(inner)
            else held
        )
    return kind(**values)


def _list_of(kind: type[str] | type[int] | type[float], name: str) -> Any:
    """How a list is read: its items by comma, by space, or both."""

    def read(words: list[str]) -> tuple[Any, ...]:
        items = (item.strip() for word in words for item in word.split(","))
        return tuple(read_item(item) for item in items if item)

    def read_item(item: str) -> Any:
        try:
            return kind(item)
        except ValueError as error:
            raise _UnreadableError(
                f"{name}: expected {_ITEMS[kind]}, got {quoted(item)}."
            ) from error

    def written(values: tuple[Any, ...]) -> list[str]:
        return [str(value) for value in values]

    def fits(values: object) -> bool:
        return isinstance(values, tuple)

    return tyro.constructors.PrimitiveConstructorSpec(
        nargs="*",
        metavar="NAME ..",
        instance_from_str=read,
        is_instance=fits,
        str_from_instance=written,
    )


def _texts(command: type[Any]) -> dict[str, str]:
    """The string below each field, flowing; a subclass's before its base's."""
    found: dict[str, str] = {}
    for cls in reversed(command.__mro__):
        if dataclasses.is_dataclass(cls) and cls.__module__ != types.__name__:
            found |= _texts_below(cls)  # others were made at run time: they have no source
    return found


@functools.cache
def _texts_below(cls: type[Any]) -> dict[str, str]:
    """The string below each field of a class; read once, for many commands share their bases."""
    try:
        parsed = docstring_parser.parse_from_object(cls)
    except (OSError, TypeError):  # it has no source
        return {}
    return {
        entry.arg_name: flowing(entry.description)
        for entry in parsed.params
        if entry.description is not None
    }


def _item_of(kind: Any) -> type[str] | type[int] | type[float] | None:
    """The type of the items of a list of words or numbers; None for everything else."""
    args = get_args(kind)
    if get_origin(kind) is not tuple or len(args) != 2 or args[1] is not Ellipsis:
        return None
    item, _ = _unwrapped(args[0])
    if get_origin(item) is Literal:
        return str
    return item if item in _ITEMS else None


def _unwrapped(hint: Any) -> tuple[Any, list[Any]]:
    if get_origin(hint) is Annotated:
        kind, *notes = get_args(hint)
        return kind, notes
    return hint, []


def _is_argument(note: object) -> bool:
    return type(note).__name__ == "_ArgConfig"


def _placeholder(kind: Any) -> str | None:
    """What stands for the value of a word; None leaves it to tyro."""
    kind, _ = _unwrapped(kind)
    if get_origin(kind) in (Union, types.UnionType):
        inner = [part for part in get_args(kind) if part is not type(None)]
        return _placeholder(inner[0]) if len(inner) == 1 else None
    if get_origin(kind) is tuple and Ellipsis not in get_args(kind):
        parts = [_placeholder(part) for part in get_args(kind)]
        return None if None in parts else " ".join(part for part in parts if part is not None)
    if (item := _item_of(kind)) is not None:
        return f"{_PLACEHOLDERS[item]} .."
    return _PLACEHOLDERS.get(kind)


def rendered_page(name: str, entry: "CommandEntry", words: Sequence[str] = ()) -> str:
    """The help of a command, 80 columns wide.

    Args:
        name: The command.
        entry: Where it is.
        words: Further words that the help depends on, such as the method's.
    """
    kind, config = entry.kind_for(words)
    printed = io.StringIO()
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(_WIDTH)
    try:
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            parse(kind, [*words, "--help"], prog=f"splatseg {name}", config=config)
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
    return wrapped(printed.getvalue())


def wrapped(page: str) -> str:
    """A page without lines that are too long, blanks at their ends or two empty lines in a row.

    The heading of options within a method's options names them alone, as their flags do.
    """
    lines: list[str] = []
    for line in re.sub(r"(?m)^ options\.(?=\w+ options *$)", " ", page).rstrip().splitlines():
        if not line.strip() and lines and not lines[-1]:
            continue
        # A command line is to be copied in one piece.
        long = len(line) > _WIDTH and not line.startswith("splatseg ")
        further = "  " if line.startswith("- ") else ""
        lines += textwrap.wrap(line, _WIDTH, subsequent_indent=further) if long else [line.rstrip()]
    return "\n".join(lines) + "\n"
