"""Names of views: what can be that of a file below a folder, and such a name for any photograph.

Views are named by files that others made, and name files that are written: label maps, masks,
renders. A name that climbs, or that one file system takes for another name, must not get there.
"""

import re
import unicodedata
from collections.abc import Sequence

from splatseg.errors import InputError

MAX_PART = 200
"""Most bytes of a name between two slashes, as UTF-8. File systems allow 255, suffixes included."""

MAX_NAME = 800
"""Most bytes of a whole name."""

_TABLES = ("evidence", "segments", "tracks", "legend", "quant", "basis", "text_embeddings")
"""Files that lie beside those of views; a view of this name would be taken for one."""

_REFUSED = ("Cc", "Cs", "Zl", "Zp")
"""Unicode categories: control characters, lone surrogates (bytes that are no UTF-8), line ends."""


_DIGITS = 18
_NUMBER = re.compile(r"(\d+)\D*$")


def frame_number(name: str) -> tuple[str, int] | None:
    """The rest of a name and its last number, which counts the frames; None without one.

    Numbers of more than 18 digits count nothing.

    Example:
        >>> frame_number("image_01/0000000003"), frame_number("train_0003_L"), frame_number("a")
        (('image_01/', 3), ('train__L', 3), None)
    """
    found = _NUMBER.search(name)
    if found is None or len(found[1]) > _DIGITS:
        return None
    return name[: found.start(1)] + name[found.end(1) :], int(found[1])


def view_name_fault(name: str) -> str | None:
    """What is wrong with a name, as the end of a sentence; None where nothing is.

    Example:
        >>> view_name_fault("left/0001"), view_name_fault("../0001")
        (None, "expected a view's name without . or .. at the start of a part, got '../0001'")
    """
    got = f"got {name!r:.60}"
    if any(unicodedata.category(letter) in _REFUSED for letter in name):
        return f"expected a view's name of UTF-8 without control characters, {got}"
    parts = name.split("/")
    if "" in parts or "\\" in name:
        return f"expected a view's name as of a file below a folder, {got}"
    if any(part.startswith(".") for part in parts):
        return f"expected a view's name without . or .. at the start of a part, {got}"
    longest = max(len(part.encode()) for part in parts)
    if longest > MAX_PART or len(name.encode()) > MAX_NAME:
        return (
            f"expected a view's name of at most {MAX_NAME} bytes, {MAX_PART} between slashes, "
            f"got {len(name.encode())}"
        )
    return None


def check_view_name(name: str) -> None:
    """Raise `InputError` unless `name` can be that of a view."""
    fault = view_name_fault(name)
    if fault is not None:
        raise InputError(f"view: {fault}.")


def clean_view_names(names: Sequence[str]) -> list[str]:
    """Names of views that are valid and distinct on every file system, as near as can be.

    Names that are good stay; of several that differ only in case, or in how their accents are
    written, the first by code point does, and the others get a number.

    Args:
        names: What photographs are called; distinct.

    Example:
        >>> clean_view_names(["000", "../../000", "a", "A"])
        ['000', '000_2', 'a_2', 'A']
    """
    cleaned = [_cleaned(name) for name in names]
    found = list(cleaned)
    taken = {_folded(name) for name in _TABLES}
    others: list[int] = []
    # Names that can stay come first, so that no other one takes theirs.
    for i in sorted(range(len(names)), key=lambda i: (cleaned[i] != names[i], names[i])):
        if _folded(found[i]) in taken:
            others.append(i)
        taken.add(_folded(found[i]))
    for i in others:
        number = 2
        while _folded(found[i]) in taken:
            found[i] = f"{cleaned[i]}_{number}"
            number += 1
        taken.add(_folded(found[i]))
    return found


def _cleaned(name: str) -> str:
    parts = [_cleaned_part(part) for part in name.replace("\\", "/").split("/")]
    parts = [part for part in parts if part]
    while len("/".join(parts).encode()) > MAX_NAME - MAX_PART:
        del parts[0]
    return "/".join(parts) or "view"


def _cleaned_part(part: str) -> str:
    letters = ("_" if unicodedata.category(letter) in _REFUSED else letter for letter in part)
    # Room for a number: 150 bytes, none of them half a letter.
    return "".join(letters).lstrip(".").encode()[: MAX_PART - 50].decode(errors="ignore")


def _folded(name: str) -> str:
    """The same for names that some file system holds for one."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())
