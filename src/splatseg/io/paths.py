"""Paths that come from files: where a name may lead, and what a name may be."""

import os
from pathlib import Path

from splatseg.errors import InputError


def path_inside(folder: Path, *names: str, make: bool = True) -> Path:
    """A path below a folder, which it cannot leave: every file named by data is written so.

    Args:
        folder: The folder. It may itself be a link, and need not be there yet.
        names: What is below it; names with a slash lie in further folders.
        make: Make the folders that the path needs.

    Returns:
        The path, as it is written.

    Raises:
        InputError: If a name climbs, is absolute or no name at all, or a link that is there leads
            out of the folder.

    Example:
        >>> path_inside(Path("masks"), "left/0001.json", make=False).as_posix()
        'masks/left/0001.json'
    """
    parts = [part for name in names for part in name.split("/")]
    if any(part in ("", ".", "..") or "\\" in part or "\0" in part for part in parts):
        raise InputError(f"{folder}: expected the name of a file below it, got {names[-1]!r:.60}.")
    path = folder.joinpath(*parts)
    try:
        leaves = not path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError) as error:  # links in a circle
        raise InputError(f"{path}: cannot be followed ({error}).") from error
    if leaves:
        raise InputError(
            f"{path}: expected a place in {folder}, but a link leads out of it to "
            f"{path.resolve()}; nothing is written there."
        )
    if make:
        path.parent.mkdir(parents=True, exist_ok=True)
    return path


def check_utf8(path: Path) -> None:
    """Refuse a path that no JSON file can hold, as its bytes are not UTF-8.

    Raises:
        InputError: If it is one.
    """
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError as error:
        shown = os.fsencode(path)
        raise InputError(
            f"{str(path).encode(errors='replace').decode()}: expected a name in UTF-8, got the "
            f"bytes {shown!r:.200}; rename it (`convmv -f latin1 -t utf8`)."
        ) from error
