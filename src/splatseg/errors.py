"""What splatseg raises. Everything it raises on purpose derives from `SplatsegError`.

    SplatsegError
    ├── InputError (ValueError)               what the caller gave cannot be used
    │   ├── ShapeError                        an array has the wrong shape
    │   ├── RangeError                        a value is outside its range, NaN or infinite
    │   ├── FileFormatError                   a file is not what it should be
    │   └── MissingFileError (FileNotFoundError)
    ├── OutputError (OSError)                 a file or folder cannot be written
    ├── MissingPackageError (ImportError)     an optional package is not installed
    └── BackendError (RuntimeError)           a backend cannot run here

Each class is also the builtin that fits, so ``except ValueError`` works. A message is one
sentence that names the argument or the file, what was expected and what came. What came is foreign
text, of any length and with any characters: `quoted` and `reason` make it fit for a message, and
`visible` for people, and none is longer than a message may be.
"""

import importlib
import re
import reprlib
from typing import Any

_QUOTED = 60
_REASON = 120

_WORD = 40
_LONG_WORD = re.compile(r"[^\s/]{300,}")
"""No file has such a name; 255 bytes are the most."""

_MESSAGE = 1000


class SplatsegError(Exception):
    """Base of every error that splatseg raises on purpose.

    What stands in a message and is longer than any file's name is cut, and so is a message of more
    than 1000 characters.
    """

    def __init__(self, *args: object) -> None:
        super().__init__(*(_fitting(arg) if isinstance(arg, str) else arg for arg in args))


class InputError(SplatsegError, ValueError):
    """What the caller gave cannot be used."""


class ShapeError(InputError):
    """An array has the wrong shape."""


class RangeError(InputError):
    """A value lies outside its range, or is NaN or infinite."""


class FileFormatError(InputError):
    """A file is not what it should be; the message starts with its path."""


class MissingFileError(InputError, FileNotFoundError):
    """A file or folder that was named does not exist."""


class OutputError(SplatsegError, OSError):
    """A file or folder cannot be written: the message names it and says what to do."""


class MissingPackageError(SplatsegError, ImportError):
    """An optional package is not installed; the message says how to install it."""


class BackendError(SplatsegError, RuntimeError):
    """A rendering backend cannot run here or refuses what was asked of it."""


def import_package(name: str, what: str, extra: str) -> Any:
    """A module of an optional package.

    Args:
        name: The module.
        what: What needs it; starts the message.
        extra: The extra of splatseg that installs it.

    Raises:
        MissingPackageError: If it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0].replace("_", "-")
        raise MissingPackageError(
            f"{what} needs a package that is not installed ({package}). Try: pip install "
            f"'splatseg[{extra}]'."
        ) from error


def _fitting(message: str) -> str:
    """A message without what nobody reads: the middle of long words, and of itself."""
    text = _LONG_WORD.sub(lambda found: _ends(found.group(), _WORD), message)
    return _ends(text, _MESSAGE)


def _ends(text: str, limit: int) -> str:
    """The first two thirds of what fits, and the last."""
    if len(text) <= limit:
        return text
    last = limit // 3
    return f"{text[: limit - last - 3]}...{text[-last:]}"


def quoted(value: object, limit: int = _QUOTED) -> str:
    """A value of a file as a message shows it: on one line, cut, all characters printable.

    Only as much of it is looked at as is shown, so a list of millions costs nothing.

    Example:
        >>> quoted("a" * 100, 20)
        "'aaaaaaa...aaaaaaaa'"
        >>> quoted({"a": [1, float("nan")]})
        "{'a': [1, nan]}"
    """
    shown = _Shown(limit).repr(value)
    return shown if len(shown) <= limit else f"{shown[: limit - 3]}..."


def reason(error: BaseException) -> str:
    r"""What another library said of a file, as a message shows it: one line, cut, no full stop.

    Example:
        >>> reason(ValueError("bad header:\n" + "x" * 1000))[:14]
        'bad header: xx'
    """
    try:
        words = " ".join(str(error).split()[:40])
    except ValueError:  # the error names a number of too many digits
        words = ""
    return brief(words.rstrip(".")) or type(error).__name__


def brief(text: str, limit: int = _REASON) -> str:
    """Words that hold foreign text, as a message shows them: printable, cut.

    Example:
        >>> brief("other rows, other " + "x" * 1000, 30)
        'other rows, other xxxxxxxxx...'
    """
    clean = "".join(c if c.isprintable() else "?" for c in text[: limit + 1])
    return clean if len(clean) <= limit else f"{clean[: limit - 3]}..."


_TURNING = "\u061c\u200b\u200e\u200f\u202a-\u202e\u2060-\u206f\ufeff\U000e0000-\U000e007f"
"""Marks of direction and of nothing: text that holds them reads otherwise than it is. The joiners
that scripts and emoji need (U+200C, U+200D) are none of them."""

# Control characters, line and paragraph ends, and halves of pairs besides.
_HIDDEN = re.compile(f"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff{_TURNING}]")


def visible(text: str) -> str:
    r"""Text of others as people are to see it, in a page and on a terminal.

    Nothing in it moves the cursor, colours or turns what follows: control characters and marks of
    direction become escapes, as Python writes them.

    Example:
        >>> visible("chair\x1b[31m"), visible("a\u202eb\nc")
        ('chair\\x1b[31m', 'a\\u202eb\\nc')
        >>> visible("Stühle und 椅子")
        'Stühle und 椅子'
    """
    return _HIDDEN.sub(lambda match: ascii(match[0])[1:-1], text)


class _Shown(reprlib.Repr):
    """`repr` of as much of a value as fits."""

    def __init__(self, limit: int) -> None:
        super().__init__()
        self.maxstring = self.maxother = self.maxlong = limit
        self.maxlevel = 3

    def repr_int(self, x: int, level: int) -> str:
        if x.bit_length() > 1024:  # Python refuses to write out numbers of many digits
            return f"a number of {x.bit_length()} bits"
        return super().repr_int(x, level)
