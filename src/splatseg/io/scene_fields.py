"""Fields of a scene that are no Gaussians: ``SCENE/fields/NAME.safetensors``.

What is in a file is the business of who makes such fields (`splatseg.street.files`); here is where
they are, and how they are called.
"""

import re
from pathlib import Path

from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.scene import check_name
from splatseg.io.scene_folder import scene_path

FOLDER = "fields"
SUFFIX = ".safetensors"

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,199}")


@boundary
def scene_field_names(root: Path) -> tuple[str, ...]:
    """Names of the fields of a scene folder, sorted. Other files in their folder are none."""
    names = (path.name.removesuffix(SUFFIX) for path in (root / FOLDER).glob(f"*{SUFFIX}"))
    return tuple(sorted(name for name in names if _NAME.fullmatch(name)))


@boundary
def scene_field_file(root: Path, name: str) -> Path:
    """The file of a field that a scene has.

    Raises:
        InputError: If it has none of this name.
    """
    names = scene_field_names(root)
    if name not in names:
        known = ", ".join(names) if names else "it has none; `splatseg street` makes one"
        raise InputError(f"field: expected one of {root} ({known}), got {name!r:.80}.")
    return root / FOLDER / f"{name}{SUFFIX}"


@boundary
def new_field_file(root: Path, name: str) -> Path:
    """Where the file of a field is to be written; its folder is made.

    Raises:
        InputError: If the name cannot be a file's, or a link leads out of the scene.
        OutputError: If the folder cannot be made.
    """
    check_name("field", name)
    return scene_path(root, FOLDER, f"{name}{SUFFIX}")
