"""Where a new scene may be written: refused before the work, not after it."""

from pathlib import Path

from splatseg.errors import InputError
from splatseg.io.atomic import check_utf8, check_writable, is_vacant, sweep
from splatseg.io.scene import scene_layer_names
from splatseg.io.scene_folder import check_unlocked, is_scene, is_unfinished


def check_new_folder(folder: Path) -> None:
    """Refuse a place where no folder can be made, or where one with files is.

    Raises:
        InputError: If something is in the way.
    """
    check_parent(folder)
    if folder.exists() and not (folder.is_dir() and is_vacant(folder)):
        raise InputError(f"{folder}: expected a new folder, got one that is there.")


def check_replaceable_scene(root: Path, *, unfinished: bool = False) -> None:
    """Refuse a place that holds anything but a scene without layers.

    Args:
        root: The scene folder to be.
        unfinished: Whether a fit that was stopped there is no obstacle.

    Raises:
        InputError: If something else is in the way, or another process works on it.
    """
    if root.exists() and not root.is_dir():
        raise InputError(f"{root}: expected a folder to write to, got a file.")
    check_unlocked(root)
    check_parent(root)
    if is_scene(root):
        layers = scene_layer_names(root)
        if layers:
            raise InputError(
                f"{root}: expected a new folder, got a scene with layers ({', '.join(layers)}), "
                "which belong to its Gaussians; remove it or choose another name."
            )
    elif root.is_dir() and not is_vacant(root) and not (unfinished and is_unfinished(root)):
        raise InputError(f"{root}: expected an empty folder or a new one, got one with files.")


def check_parent(path: Path) -> None:
    """Refuse a path whose folder is not there, or where nothing can be written.

    What processes that were killed were writing there is cleared.

    Raises:
        InputError: If it is so, or the path is not UTF-8.
    """
    check_utf8(path)
    parent = path.resolve().parent
    if not parent.is_dir():
        raise InputError(f"{path}: expected a place in a folder that is there, got none.")
    check_writable(parent)
    sweep(parent)
    if path.is_dir():
        check_writable(path)


def check_parent_writable(path: Path) -> None:
    """Refuse a folder that is to be made, with the folders it lies in, where it cannot be.

    Raises:
        InputError: If it cannot be, or the path is not UTF-8.
    """
    check_utf8(path)
    there = next(place for place in (path, *path.absolute().parents) if place.exists())
    if not there.is_dir():
        raise InputError(f"{path}: expected a folder to write to, got a file in its way: {there}.")
    check_writable(there)
