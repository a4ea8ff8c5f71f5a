"""Names of fields that are taken: refused, unless blocks that were stopped are gone on with."""

from pathlib import Path

from splatseg.errors import InputError
from splatseg.io.scene import scene_field_names, scene_field_path
from splatseg.street.files import missing_blocks


def check_field_name(root: Path, name: str, *, in_blocks: bool) -> None:
    """Refuse a name that is taken, unless what is there are blocks to be gone on with.

    Args:
        root: The scene folder.
        name: Of the field to make.
        in_blocks: Whether it is a drive in blocks.

    Raises:
        InputError: If it is taken.
        FileFormatError: If the drive.json of what is there is broken.
    """
    if name not in scene_field_names(root):
        return
    stopped = is_stopped(scene_field_path(root, name))
    if stopped and in_blocks:
        return
    hint = " that was stopped; the command that began it goes on," if stopped else ";"
    raise InputError(
        f"field: {root} has one called {name!r}{hint} give another name, or `overwrite`."
    )


def is_stopped(path: Path) -> bool:
    """Whether a field is a drive in blocks of which some lack.

    Raises:
        FileFormatError: If its drive.json is broken.
    """
    return path.is_dir() and bool(missing_blocks(path))
