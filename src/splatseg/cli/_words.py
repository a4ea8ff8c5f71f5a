"""Words of a command line, and help that is kept as text.

To make a page takes all the imports of a command, to show it none. ``scripts/help_pages`` writes
them, and a test holds them equal to what the parser says.
"""

import re
from collections.abc import Collection, Sequence
from dataclasses import fields, is_dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, cast, get_type_hints

from splatseg.errors import InputError

_QUOTED = re.compile(r"`(\w+)`")
_NAMED = re.compile(r"^(\w+(?:, \w+)*): ")


def option_value(words: Sequence[str], flag: str) -> str | None:
    """The value that words give an option, as ``--flag VALUE`` or ``--flag=VALUE``; the last."""
    found = None
    for index, word in enumerate(words):
        if word == flag and index + 1 < len(words):
            found = words[index + 1]
        elif word.startswith(f"{flag}="):
            found = word.removeprefix(f"{flag}=")
    return found


def listed(flag: str, words: Sequence[str]) -> tuple[str, ...]:
    """Names given as several words, with commas between them, or both.

    Example:
        >>> listed("--what", ["rgb,depth", "left wall"])
        ('rgb', 'depth', 'left wall')
    """
    names = tuple(name.strip() for word in words for name in word.split(",") if name.strip())
    if not names:
        raise InputError(f"{flag}: expected one name or more, got none.")
    return names


def with_flags(message: str, fields: Collection[str]) -> str:
    """A message with the flags of a command for names of options, at its start or in backticks.

    Example:
        >>> with_flags("min_confidence: expected 0 to 1, got 2.", {"min_confidence"})
        '--min-confidence: expected 0 to 1, got 2.'
        >>> with_flags("x: is there; `overwrite` replaces it.", {"overwrite"})
        'x: is there; --overwrite replaces it.'
    """
    message = names_as_flags(message, fields)
    found = _NAMED.match(message)
    if found is None:
        return message
    names = found[1].split(", ")
    if not all(name in fields for name in names):
        return message
    return ", ".join(map(_flag, names)) + message[found.end(1) :]


def names_as_flags(text: str, names: Collection[str]) -> str:
    """A text with flags for names of options in backticks.

    Example:
        >>> names_as_flags("as `min_share` says; `x` stays", {"min_share"})
        'as --min-share says; `x` stays'
    """

    def flag(match: re.Match[str]) -> str:
        return _flag(match[1]) if match[1] in names else match[0]

    return _QUOTED.sub(flag, text)


def option_names(command: type[Any]) -> set[str]:
    """Names of all fields of a command's class, those of nested dataclasses included."""
    names: set[str] = set()
    hints = get_type_hints(command)
    for field in fields(command):
        names.add(field.name)
        if is_dataclass(kind := hints[field.name]):
            names |= option_names(cast("type[Any]", kind))
    return names


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


FOLDER = Path(__file__).parent / "pages"
_HELP = ("--help", "-h")
KINDS = {"segment": "--method", "see": "--model"}
"""Commands whose options depend on the value of one of them."""


def stored_page(name: str, words: Sequence[str]) -> str | None:
    """The page that answers the words of a command, None where it must be made.

    Args:
        name: The command.
        words: What follows it.
    """
    option = KINDS.get(name, "")
    kind = option_value(words, option) if option else None
    rest = [word for word in words if word not in _HELP]
    if len(rest) == len(words):
        return None
    if kind is None and not rest:
        if option and entry_points(group=f"splatseg.{option.removeprefix('--')}s"):
            return None  # other packages' methods and models are to be listed too
        path = FOLDER / f"{name}.txt"
    elif option and rest in ([option, kind], [f"{option}={kind}"]):
        path = FOLDER / f"{name}-{kind}.txt"
    else:
        return None
    # A method's name is a word of the user's, and no path.
    if path.parent != FOLDER or not path.is_file():
        return None
    return path.read_text(encoding="utf-8")


def default_config() -> tuple[Any, ...]:
    """How tyro reads the fields of a command."""
    import tyro

    return (
        tyro.conf.OmitArgPrefixes,  # --steps, not --options.steps
        tyro.conf.HelptextFromCommentsOff,  # comments speak to readers of the code
    )
