"""Fields of a scene folder, which are no Gaussians: a file, or the folder of a drive in blocks.

What is in them is the business of who makes them (`splatseg.street`); here is where they are, and
how they are called.
"""

from contextlib import suppress
from pathlib import Path

from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.atomic import named_write_failures
from splatseg.io.scene import NAME, check_name
from splatseg.io.scene_folder import scene_path

FOLDER = "fields"
SUFFIX = ".safetensors"
DRIVE_FILE = "drive.json"
"""What makes a folder that of a drive in blocks."""


@boundary
def scene_field_names(root: Path) -> tuple[str, ...]:
    """Names of the fields of a scene folder, sorted. Other files in their folder are none."""
    folder = root / FOLDER
    files = {p.name.removesuffix(SUFFIX) for p in folder.glob(f"*{SUFFIX}") if p.is_file()}
    drives = {path.parent.name for path in folder.glob(f"*/{DRIVE_FILE}")}
    return tuple(sorted(name for name in files | drives if NAME.fullmatch(name)))


@boundary
def scene_field_path(root: Path, name: str) -> Path:
    """The file of a field that a scene has, or the folder of a drive in blocks.

    Raises:
        InputError: If it has none of this name.
    """
    names = scene_field_names(root)
    if name not in names:
        known = ", ".join(names) if names else "it has none; `splatseg street` makes one"
        raise InputError(f"field: expected one of {root} ({known}), got {name!r:.80}.")
    file = root / FOLDER / f"{name}{SUFFIX}"
    return file if file.is_file() else root / FOLDER / name


@boundary
def new_field_file(root: Path, name: str) -> Path:
    """Where the file of a field is to be written; its folder is made.

    Raises:
        InputError: If the name cannot be a file's, or a link leads out of the scene.
        OutputError: If the folder cannot be made.
    """
    check_name("field", name)
    return scene_path(root, FOLDER, f"{name}{SUFFIX}")


@boundary
def new_field_folder(root: Path, name: str) -> Path:
    """The folder of a field in blocks, which is made where it is not there.

    Raises:
        InputError: If the name cannot be a folder's, or a link leads out of the scene.
        OutputError: If the folder cannot be made.
    """
    check_name("field", name)
    return scene_path(root, FOLDER, name, DRIVE_FILE).parent


@boundary
def remove_field_file(root: Path, name: str) -> None:
    """Remove a field that is a file, where there is one.

    Raises:
        InputError: If a link leads out of the scene.
        OutputError: If it cannot be removed.
    """
    path = new_field_file(root, name)
    with named_write_failures(path):
        path.unlink(missing_ok=True)


@boundary
def remove_field_folder(root: Path, name: str) -> None:
    """Remove a field in blocks, where there is one; what else its folder holds stays.

    Raises:
        InputError: If a link leads out of the scene.
        OutputError: If it cannot be removed.
    """
    check_name("field", name)
    if not (root / FOLDER / name).is_dir():
        return
    folder = new_field_folder(root, name)
    with named_write_failures(folder):
        # The table first: without it the rest is no field.
        (folder / DRIVE_FILE).unlink(missing_ok=True)
        for block in folder.glob(f"[0-9]*{SUFFIX}"):
            block.unlink()
        with suppress(OSError):  # it is not empty
            folder.rmdir()
