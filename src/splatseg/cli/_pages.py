"""Help that is kept as text: to make it takes all the imports of a command, to show it none.

``scripts/help_pages`` writes the pages, and a test holds them equal to what the parser says.
"""

import contextlib
import importlib
import io
import os
import re
import textwrap
from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, cast

from splatseg.cli._words import option_value

FOLDER = Path(__file__).parent / "pages"
_WIDTH = 80
_HELP = ("--help", "-h")
KINDS = {"segment": "--method", "see": "--model"}
"""Commands whose options depend on the value of one of them."""


def kept_page(name: str, words: Sequence[str]) -> str | None:
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


def made_page(name: str, module: str, words: Sequence[str] = ()) -> str:
    """The help of a command, 80 columns wide.

    Args:
        name: The command.
        module: Where it is.
        words: Further words that the help depends on, such as the method's.
    """
    from splatseg.cli._parse import parse

    command = cast("Any", importlib.import_module(module))
    command_for = getattr(command, "command_for", None)
    kind = command.Command if command_for is None else command_for(words)
    config = getattr(command, "CONFIG", None) or default_config()
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


def default_config() -> tuple[Any, ...]:
    """How tyro reads the fields of a command."""
    import tyro

    return (
        tyro.conf.OmitArgPrefixes,  # --steps, not --options.steps
        tyro.conf.HelptextFromCommentsOff,  # comments speak to readers of the code
    )
