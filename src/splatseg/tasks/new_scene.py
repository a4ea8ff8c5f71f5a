"""Where a new scene may be written: refused before the work, not after it."""

from pathlib import Path

from splatseg.errors import InputError
from splatseg.io.scene import is_scene, is_unfinished, scene_layer_names


def check_new_folder(folder: Path) -> None:
    """Refuse a place where no folder can be made, or where one with files is.

    Raises:
        InputError: If something is in the way.
    """
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"{folder}: expected a new folder, got one that is there.")
    check_parent(folder)


def check_replaceable_scene(root: Path, *, unfinished: bool = False) -> None:
    """Refuse a place that holds anything but a scene without layers.

    Args:
        root: The scene folder to be.
        unfinished: Whether a fit that was stopped there is no obstacle.

    Raises:
        InputError: If something else is in the way.
    """
    if root.exists() and not root.is_dir():
        raise InputError(f"{root}: expected a folder to write to, got a file.")
    check_parent(root)
    if is_scene(root):
        layers = scene_layer_names(root)
        if layers:
            raise InputError(
                f"{root}: expected a new folder, got a scene with layers ({', '.join(layers)}), "
                "which belong to its Gaussians; remove it or choose another name."
            )
    elif root.is_dir() and any(root.iterdir()) and not (unfinished and is_unfinished(root)):
        raise InputError(f"{root}: expected an empty folder or a new one, got one with files.")


def check_parent(path: Path) -> None:
    """Refuse a path whose folder is not there.

    Raises:
        InputError: If it is not.
    """
    if not path.resolve().parent.is_dir():
        raise InputError(f"{path}: expected a place in a folder that is there, got none.")
