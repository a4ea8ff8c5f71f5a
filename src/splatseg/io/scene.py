"""Scene folders: Gaussians, cameras, layers and where they came from; see ``docs/formats.md``.

    SCENE/
      scene.json                format version, source capture, split, up, metres, classes
      gaussians.ply             the Gaussians
      cameras/transforms.json   views, in nerfstudio's layout
      evidence/<name>/          what 2D models saw
      layers/<name>.npz         what is known of each Gaussian
      reports/
      fit/checkpoint.npz        state of a fit that was stopped
      training/<layer>.npz      state of a training of this layer that was stopped
      capture/                  poses that were found for bare photographs
      .splatseg-lock            who works on the scene now, see `scene_lock`
      .splatseg-pending/        files of the scene that are about to take their places

Photographs stay where they are: a scene knows its capture by a path relative to itself and an
absolute one, and opens without it.
"""

import os
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from splatseg.core import Layer, Scene, View
from splatseg.core.boundary import boundary
from splatseg.core.json_values import json_integer, json_number
from splatseg.errors import FileFormatError, InputError, MissingFileError, quoted
from splatseg.io.atomic import atomic_folder, hidden_folder, is_vacant, sync, sync_tree
from splatseg.io.cameras import (
    cameras_content,
    relative_path,
    source_paths,
    views_from_content,
)
from splatseg.io.class_tables import class_rows, class_table
from splatseg.io.foreign import is_file, is_folder, made_from
from splatseg.io.json_files import read_json, write_json
from splatseg.io.layers import load_layer, save_layer
from splatseg.io.lock import scene_lock
from splatseg.io.scene_folder import (
    CAMERAS_FILE,
    FOLDERS,
    GAUSSIANS_FILE,
    PENDING,
    SCENE_FILE,
    current_file,
    finish_pending,
    is_scene,
    is_unfinished,
    scene_path,
)
from splatseg.io.splats import read_scene_splats, write_splats
from splatseg.io.write_errors import named_write_failures

FORMAT = "splatseg-scene"
VERSION = 1
"""Version of the folders written; all versions up to it are read."""

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,199}")


@boundary
def save_scene(
    scene: Scene,
    root: Path | str,
    *,
    layers: Mapping[str, Layer] | None = None,
    evidence: Sequence[Path] = (),
) -> Scene:
    """Write a scene folder; layers, evidence and reports that are there stay.

    A new folder appears whole or not at all, with its `layers` and copies of the folders of
    `evidence`, each under its own name. In one that is there, be it a
    scene or the checkpoint of one that was being fitted, the new files take the places of the
    old ones together: a process that is killed leaves the old scene or the new one.

    Returns:
        The scene with `root` set.

    Raises:
        InputError: If `root` is a folder of something else, a value has no place in JSON, a layer
            has not one row a Gaussian, evidence is no folder, or is given to a scene that is there.
        MissingFileError: If the parent of `root` does not exist.
        OutputError: If the disk is full, or there is no permission.
    """
    root = Path(root)
    for name, layer in (layers or {}).items():
        _check_layer(name, layer, len(scene.gaussians))
    for folder in evidence:
        if not folder.is_dir():
            raise InputError(f"{folder}: expected a folder of evidence, got none.")
    there = is_scene(root) or is_unfinished(root)
    if there and evidence:
        raise InputError(f"{root}: expected a new folder to copy evidence to, got a scene.")
    if root.is_dir() and not there and not is_vacant(root):
        raise InputError(f"{root}: expected an empty folder or a scene to write to, got neither.")
    if there:
        with scene_lock(root, "saving"):
            _replace(scene, root, layers or {})
    else:
        with atomic_folder(root, durable=True) as temporary:
            _write(scene, temporary, layers or {}, final=root)
            for folder in evidence:
                shutil.copytree(folder, temporary / "evidence" / folder.name)
    return replace(scene, root=root)


@boundary
def load_scene(root: Path | str, *, data: Path | str | None = None) -> Scene:
    """Read a scene folder. Inverse of `save_scene`.

    Args:
        root: The scene folder.
        data: The capture's folder, where its photographs moved. None looks where they were,
            seen from the scene first, then by the absolute path. Without them the scene opens
            all the same; reading a photograph then fails.

    Raises:
        MissingFileError: If there is no scene, or `data` lacks photographs of it.
        FileFormatError: If a file of it is broken, or of a later version.
    """
    root = Path(root)
    content = _scene_content(root)
    cameras = read_json(current_file(root, CAMERAS_FILE))
    source = _source(root, content, cameras, None if data is None else Path(data))
    views = views_from_content(
        cameras, folder=root / "cameras", source=source, path=root / CAMERAS_FILE
    )
    gaussians = read_scene_splats(current_file(root, GAUSSIANS_FILE))
    if len(gaussians) != content["gaussians"]:
        raise FileFormatError(
            f"{root / GAUSSIANS_FILE}: expected {content['gaussians']} Gaussians as {SCENE_FILE} "
            f"says, got {len(gaussians)}."
        )
    classes, metres = content.get("classes"), content.get("metres_per_unit")
    with made_from(root / SCENE_FILE):
        return Scene(
            gaussians=gaussians,
            views=_with_splits(root, content, views),
            classes=None if classes is None else class_table(classes, where=str(root / SCENE_FILE)),
            up=_up(root, content),
            metres_per_unit=None
            if metres is None
            else json_number(metres, where=f"{root / SCENE_FILE}: metres_per_unit"),
            source=source,
            root=root,
            provenance=_provenance(root, content),
        )


@boundary
def scene_layer_names(root: Path | str) -> tuple[str, ...]:
    """Names of the layers of a scene folder, sorted. Other files in their folder are none."""
    names = (path.stem for path in (Path(root) / "layers").glob("*.npz"))
    return tuple(sorted(name for name in names if _NAME.fullmatch(name)))


@boundary
def load_scene_layer(root: Path | str, name: str) -> Layer:
    """A layer of a scene folder.

    Raises:
        InputError: If the scene has no layer of this name, or it belongs to other Gaussians.
    """
    root = Path(root)
    names = scene_layer_names(root)
    if name not in names:
        known = ", ".join(names) if names else "it has none"
        raise InputError(f"layer: expected one of {root} ({known}), got {name!r}.")
    layer = load_layer(root / "layers" / f"{name}.npz")
    count = _scene_content(root)["gaussians"]
    if len(layer) != count:
        raise FileFormatError(
            f"{root / 'layers' / name}.npz: expected {count} rows as the scene has Gaussians, "
            f"got {len(layer)}; the layer is from before the Gaussians changed."
        )
    return layer


@boundary
def save_scene_layer(layer: Layer, root: Path | str, name: str) -> Path:
    """Write a layer into a scene folder; gives the file.

    Raises:
        InputError: If the name cannot be a file's, the layer has not one row a Gaussian, a link
            leads out of the scene, or another process works on it.
        MissingFileError: If there is no scene.
        OutputError: If the disk is full, or there is no permission.
    """
    root = Path(root)
    _check_layer(name, layer, _scene_content(root)["gaussians"])
    with scene_lock(root, "saving"):
        path = scene_path(root, "layers", f"{name}.npz")
        save_layer(layer, path)
    return path


@boundary
def check_name(what: str, name: str) -> None:
    """Raise `InputError` unless `name` can be that of a layer or of evidence."""
    if not _NAME.fullmatch(name):
        raise InputError(
            f"{what}: expected a name of letters, digits and _ . + - that does not start with "
            f"a point or a sign, got {name!r}."
        )


def _check_layer(name: str, layer: Layer, count: int) -> None:
    check_name("layer", name)
    if len(layer) != count:
        raise InputError(
            f"layer {name!r}: expected {count} rows as the scene has Gaussians, got {len(layer)}."
        )


def _replace(scene: Scene, root: Path, layers: Mapping[str, Layer]) -> None:
    """Write over a scene: from one rename on, the new files count."""
    finish_pending(root)
    with hidden_folder(root / PENDING) as holder, named_write_failures(root, within=holder):
        new = holder / "scene"
        new.mkdir()
        _write(scene, new, layers, final=root)
        sync_tree(new)
        new.replace(root / PENDING)
        sync(root)
    with named_write_failures(root):
        finish_pending(root)


def _write(scene: Scene, folder: Path, layers: Mapping[str, Layer], *, final: Path) -> None:
    """Write into `folder`, with paths as they will be seen from `final`."""
    for name in FOLDERS:
        (folder / name).mkdir(exist_ok=True)
    final, source = final.absolute(), scene.source and scene.source.absolute()
    views = [_absolute(view) for view in scene.views]
    cameras = cameras_content(views, folder=final / "cameras", source=source)
    write_splats(scene.gaussians, folder / GAUSSIANS_FILE)
    write_json(cameras, folder / CAMERAS_FILE)
    for name, layer in layers.items():
        save_layer(layer, folder / "layers" / f"{name}.npz")
    splits = sorted({view.split for view in scene.views})
    write_json(
        {
            "format": FORMAT,
            "version": VERSION,
            "gaussians": len(scene.gaussians),
            "source": None
            if source is None
            else {
                "relative": relative_path(source, start=final),
                "absolute": source.as_posix(),
            },
            "split": {
                split: [view.name for view in scene.views if view.split == split]
                for split in splits
            },
            "up": None if scene.up is None else list(scene.up),
            "metres_per_unit": scene.metres_per_unit,
            "classes": None if scene.classes is None else class_rows(scene.classes),
            "provenance": dict(scene.provenance),
        },
        folder / SCENE_FILE,
    )


def _absolute(view: View) -> View:
    return replace(
        view,
        image=view.image and view.image.absolute(),
        mask=view.mask and view.mask.absolute(),
        depth=view.depth and view.depth.absolute(),
    )


def _scene_content(root: Path) -> dict[str, Any]:
    path = current_file(root, SCENE_FILE)
    if not path.is_file():
        raise MissingFileError(f"{root}: expected a scene folder, got none (no {SCENE_FILE}).")
    content = read_json(path)
    version = content.get("version")
    if content.get("format") != FORMAT or not isinstance(version, int):
        raise FileFormatError(f"{path}: expected a scene, got {quoted(content.get('format'))}.")
    if not 1 <= version <= VERSION:
        raise FileFormatError(
            f"{path}: expected a scene of version {VERSION} or less, "
            f"got version {quoted(version)}; a later splatseg wrote it."
        )
    json_integer(content.get("gaussians"), where=f"{path}: gaussians")
    return content


def _source(
    root: Path,
    content: Mapping[str, Any],
    cameras: Mapping[str, Any],
    data: Path | None,
) -> Path | None:
    photographs = source_paths(cameras)
    if data is not None:
        if not data.is_dir():
            raise MissingFileError(f"{data}: there is no such folder of photographs.")
        missing = [name for name in photographs if not is_file(data / name)]
        if missing:
            raise MissingFileError(
                f"{data}: {len(missing)} of {len(photographs)} photographs of the scene are not "
                f"there ({', '.join(missing[:5])}{', ...' if len(missing) > 5 else ''})."
            )
        return data
    source = content.get("source")
    if not isinstance(source, dict):
        return None
    entry = cast(dict[str, Any], source)
    if any("\0" in str(entry.get(key)) for key in ("relative", "absolute")):
        raise FileFormatError(
            f"{root / SCENE_FILE}: expected paths of the source, got {quoted(source)}."
        )
    candidates = [
        Path(os.path.normpath(root / str(entry.get("relative")))),
        Path(str(entry.get("absolute"))),
    ]
    there = [candidate for candidate in candidates if is_folder(candidate)]
    with_photographs = [p for p in there if not photographs or is_file(p / photographs[0])]
    return next(iter([*with_photographs, *there, candidates[1]]))


def _with_splits(
    root: Path, content: Mapping[str, Any], views: tuple[View, ...]
) -> tuple[View, ...]:
    """Views with the splits of scene.json, which come before those of the cameras file."""
    split = content.get("split")
    if not isinstance(split, dict) or not all(isinstance(v, list) for v in split.values()):  # pyright: ignore[reportUnknownVariableType, reportUnknownMemberType]
        raise FileFormatError(f"{root / SCENE_FILE}: expected a split of lists of view names.")
    entries = cast(dict[str, list[object]], split)
    if not all(isinstance(name, str) for names in entries.values() for name in names):
        raise FileFormatError(f"{root / SCENE_FILE}: expected a split of names, got others.")
    lists = cast(dict[str, list[str]], split)
    of_view = {name: key for key, names in lists.items() for name in names}
    names = {view.name for view in views}
    if set(of_view) != names or sum(len(n) for n in lists.values()) != len(names):
        raise FileFormatError(
            f"{root / SCENE_FILE}: expected a split that names each view of {CAMERAS_FILE} once."
        )
    return tuple(
        view if view.split == of_view[view.name] else replace(view, split=of_view[view.name])
        for view in views
    )


def _provenance(root: Path, content: Mapping[str, Any]) -> dict[str, Any]:
    provenance = content.get("provenance") or {}
    if not isinstance(provenance, dict):
        raise FileFormatError(
            f"{root / SCENE_FILE}: expected an object as provenance, got {quoted(provenance)}."
        )
    return cast(dict[str, Any], provenance)


def _up(root: Path, content: Mapping[str, Any]) -> tuple[float, float, float] | None:
    up = content.get("up")
    if up is None:
        return None
    values = cast(list[object], up) if isinstance(up, list) else []
    if len(values) != 3:
        raise FileFormatError(
            f"{root / SCENE_FILE}: expected up as three numbers, got {quoted(up)}."
        )
    x, y, z = (json_number(v, where=f"{root / SCENE_FILE}: up") for v in values)
    return (x, y, z)
