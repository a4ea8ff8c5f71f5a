"""Which folders and files an export may replace: those that an export wrote."""

from pathlib import Path

from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError, InputError
from splatseg.io.atomic import check_writable, is_vacant, sweep
from splatseg.io.export._tables import MADE_BY
from splatseg.io.json_files import read_json
from splatseg.io.paths import check_utf8


@boundary
def check_replaceable(path: Path, record: str) -> None:
    """Refuse a target that holds something other than an earlier export.

    Args:
        path: The folder to write.
        record: Name of the JSON file in it that says who made it.

    Raises:
        InputError: If it is a file, has no folder to be in, or holds other files.
    """
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: expected a folder to write to, got a file.")
    check_parent(path)
    if path.is_dir() and not is_vacant(path) and not is_ours(path / record):
        raise InputError(
            f"{path}: expected a new or empty folder or one that an earlier export made, got one "
            "with other files; choose another."
        )


@boundary
def check_parent(path: Path) -> None:
    """Raise `InputError` unless `path` can be written: its folder is there, and lets us.

    What processes that were killed were writing there is cleared.
    """
    check_utf8(path)
    parent = path.absolute().parent
    if not parent.is_dir():
        raise InputError(f"{path}: expected an existing folder to write in.")
    check_writable(parent)
    sweep(parent)


def is_ours(path: Path) -> bool:
    """Whether a JSON file says that an export wrote it."""
    if not path.is_file():
        return False
    try:
        content = read_json(path)
    except FileFormatError:
        return False
    # Version 0.1 wrote tables of columns without the word.
    return content.get("made_by") == MADE_BY or {"gaussians", "columns"} <= set(content)
