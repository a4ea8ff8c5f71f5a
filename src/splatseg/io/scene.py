"""Scene folders: Gaussians, cameras, layers and where they came from; see ``docs/formats.md``.

    SCENE/
      scene.json                format version, source capture, split, up, metres, classes
      gaussians.ply             the Gaussians, or
      gaussians/                the Gaussians in chunks, which commands stream, see `io.chunks`
      cameras/transforms.json   views, in nerfstudio's layout
      evidence/<name>/          what 2D models saw
      layers/<name>.npz         what is known of each Gaussian
      fields/<name>.safetensors, fields/<name>/drive.json    fields that are no Gaussians
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
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from splatseg.core import Gaussians, Layer, Scene, View
from splatseg.core.boundary import boundary
from splatseg.core.gaussians import no_gaussians
from splatseg.core.json_values import MAX_NUMBER
from splatseg.core.options import Natural
from splatseg.errors import InputError, MissingFileError
from splatseg.io.atomic import (
    atomic_folder,
    hidden_folder,
    is_vacant,
    named_write_failures,
    sync,
    sync_tree,
)
from splatseg.io.cameras import cameras_content, relative_path, source_paths, views_from_content
from splatseg.io.chunks import (
    CHUNKS_FOLDER,
    INDEX_FILE,
    is_in_chunks,
    level_folder,
    open_chunks,
)
from splatseg.io.foreign import derived_from, expect, is_file, is_folder
from splatseg.io.json_files import check_version, read_json, write_json
from splatseg.io.layers import load_layer, save_layer
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
    scene_lock,
    scene_path,
)
from splatseg.io.schema import structured
from splatseg.io.splats import read_scene_splats, write_splats
from splatseg.io.tables import class_rows, class_table

FORMAT = "splatseg-scene"
VERSION = 1
"""Version of the folders written; all versions up to it are read."""

_Number = Annotated[float, Meta(ge=-MAX_NUMBER, le=MAX_NUMBER)]


@dataclass(frozen=True, slots=True)
class _Source:
    """Where the capture was: seen from the scene, and absolute."""

    absolute: str
    relative: str = ""


@dataclass(frozen=True, slots=True)
class _SceneFile:
    """What scene.json must have besides its format and version."""

    gaussians: Annotated[int, Meta(ge=0)]
    split: dict[str, list[str]]
    source: _Source | None = None
    up: tuple[_Number, _Number, _Number] | None = None
    metres_per_unit: _Number | None = None
    classes: Any = None
    """Rows of `tables.class_table`."""

    provenance: dict[str, Any] | None = None


NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,199}")
"""What layers and fields may be called."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GaussiansToWrite:
    """Gaussians of a new scene that are written in chunks, and not held."""

    count: int
    """How many there are."""

    write: Callable[[Path], None]
    """Writes them into an empty folder, see `io.chunks.ChunkWriter`."""


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
    if is_in_chunks(root / CHUNKS_FOLDER):
        raise InputError(f"{root}: expected a new folder, got a scene in chunks.")
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


def _no_layers(_: Path) -> Iterable[tuple[str, Layer]]:
    return ()


@boundary
def save_scene_in_chunks(
    scene: Scene,
    gaussians: GaussiansToWrite,
    root: Path | str,
    *,
    layers: Callable[[Path], Iterable[tuple[str, Layer]]] = _no_layers,
    evidence: Sequence[Path] = (),
) -> None:
    """Write a new scene folder whose Gaussians are in chunks, whole or not at all.

    Args:
        scene: The scene; its own Gaussians are not looked at.
        gaussians: The Gaussians.
        root: The folder.
        layers: Gives layers of these Gaussians and their names, one after the other, of the folder
            of the Gaussians that were written.
        evidence: Folders of evidence, copied under their own names.

    Raises:
        InputError: If something is there already, or a layer has not one row a Gaussian.
        MissingFileError: If the parent of `root` does not exist.
        OutputError: If the disk is full, or there is no permission.
    """
    root = Path(root)
    if root.exists() and not (root.is_dir() and is_vacant(root)):
        raise InputError(f"{root}: expected a new folder, got one that is there.")
    with atomic_folder(root, durable=True) as temporary:
        folder = temporary / CHUNKS_FOLDER
        folder.mkdir()
        gaussians.write(folder)
        written = len(open_chunks(folder, memory=1))
        what = f"{gaussians.count} Gaussians to be written, got {written}"
        expect(written == gaussians.count, "gaussians", what, error=InputError)
        _write(scene, temporary, {}, final=root, count=gaussians.count)
        for name, layer in layers(folder):
            _check_layer(name, layer, gaussians.count)
            save_layer(layer, temporary / "layers" / f"{name}.npz")
        for each in evidence:
            shutil.copytree(each, temporary / "evidence" / each.name)


@boundary
def load_scene(
    root: Path | str,
    *,
    data: Path | str | None = None,
    memory: int | None = None,
    level: Natural = 0,
) -> Scene:
    """Read a scene folder. Inverse of `save_scene`.

    Args:
        root: The scene folder.
        data: The capture's folder, where its photographs moved. None looks where they were,
            seen from the scene first, then by the absolute path. Without them the scene opens
            all the same; reading a photograph then fails.
        memory: Bytes that the Gaussians of a view may take, of a scene in chunks, which stay on
            the disk; others are read as a whole all the same. None refuses a scene in chunks.
        level: Of a scene in chunks a coarser level, which its layers are not of; 0 is all of it.

    Raises:
        InputError: If it is in chunks, and the caller cannot stream; or it has no such level.
        MissingFileError: If there is no scene, or `data` lacks photographs of it.
        FileFormatError: If a file of it is broken, or of a later version.
    """
    root = Path(root)
    scene, count = load_scene_views(root, data=data)
    gaussians = _gaussians(root, memory, level)
    if level:
        return replace(scene, gaussians=gaussians)
    what = f"{count} Gaussians as {SCENE_FILE} says, got {len(gaussians)}"
    name = GAUSSIANS_FILE if gaussians.chunks is None else CHUNKS_FOLDER
    expect(len(gaussians) == count, root / name, what)
    return replace(scene, gaussians=gaussians)


@boundary
def load_scene_views(root: Path | str, *, data: Path | str | None = None) -> tuple[Scene, int]:
    """Read a scene folder but for its Gaussians: a scene without any, and how many it has.

    Args:
        root: The scene folder.
        data: As for `load_scene`.

    Raises:
        MissingFileError: If there is no scene, or `data` lacks photographs of it.
        FileFormatError: If a file of it is broken, or of a later version.
    """
    root = Path(root)
    where = root / SCENE_FILE
    content = _scene_content(root)
    cameras = read_json(current_file(root, CAMERAS_FILE))
    source = _source(root, content.source, cameras, None if data is None else Path(data))
    views = views_from_content(
        cameras, folder=root / "cameras", source=source, path=root / CAMERAS_FILE
    )
    of_view = {name: split for split, names in content.split.items() for name in names}
    once = sum(len(names) for names in content.split.values()) == len(views)
    what = f"a split that names each view of {CAMERAS_FILE} once"
    expect(once and set(of_view) == {view.name for view in views}, where, what)
    classes = None if content.classes is None else class_table(content.classes, where=str(where))
    with derived_from(where):
        scene = Scene(
            gaussians=no_gaussians(),
            # The splits of scene.json come before those of the cameras file.
            views=tuple(replace(view, split=of_view[view.name]) for view in views),
            classes=classes,
            up=content.up,
            metres_per_unit=content.metres_per_unit,
            source=source,
            root=root,
            provenance=content.provenance or {},
        )
    return scene, content.gaussians


def _gaussians(root: Path, memory: int | None, level: int) -> Gaussians:
    folder, file = root / CHUNKS_FOLDER, current_file(root, GAUSSIANS_FILE)
    if not folder.is_dir():
        if level:
            raise InputError(f"level: goes with a scene in chunks, got {level} of {root}.")
        return read_scene_splats(file)
    expect(not file.is_file(), root, f"{GAUSSIANS_FILE} or {CHUNKS_FOLDER}/{INDEX_FILE}, got both")
    if memory is None:
        raise InputError(
            f"{root}: its Gaussians are in chunks, which this cannot stream; "
            "`splatseg chunks SCENE -o NEW --whole` makes a scene that is read as a whole."
        )
    if level and not is_in_chunks(level_folder(folder, level)):
        raise InputError(
            f"level: expected one that {root} has, got {level}; `splatseg chunks --levels` makes "
            "them."
        )
    return open_chunks(level_folder(folder, level), memory=memory)


@boundary
def scene_layer_names(root: Path | str) -> tuple[str, ...]:
    """Names of the layers of a scene folder, sorted. Other files in their folder are none."""
    names = (path.stem for path in (Path(root) / "layers").glob("*.npz"))
    return tuple(sorted(name for name in names if NAME.fullmatch(name)))


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
    count = _scene_content(root).gaussians
    what = f"{count} rows as the scene has Gaussians, got {len(layer)}; the layer is from before "
    what += "the Gaussians changed"
    expect(len(layer) == count, root / "layers" / f"{name}.npz", what)
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
    _check_layer(name, layer, _scene_content(root).gaussians)
    with scene_lock(root, "saving"):
        path = scene_path(root, "layers", f"{name}.npz")
        save_layer(layer, path)
    return path


@boundary
def check_name(what: str, name: str) -> None:
    """Raise `InputError` unless `name` can be that of a layer or of evidence."""
    wanted = "a name of letters, digits and _ . + - that does not start with a point or a sign, "
    wanted += f"got {name!r}"
    expect(NAME.fullmatch(name), what, wanted, error=InputError)


def _check_layer(name: str, layer: Layer, count: int) -> None:
    check_name("layer", name)
    what = f"{count} rows as the scene has Gaussians, got {len(layer)}"
    expect(len(layer) == count, f"layer {name!r}", what, error=InputError)


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


def _write(
    scene: Scene,
    folder: Path,
    layers: Mapping[str, Layer],
    *,
    final: Path,
    count: int | None = None,
) -> None:
    """Write into `folder`, with paths as they will be seen from `final`.

    With a `count` the Gaussians are there already.
    """
    for name in FOLDERS:
        (folder / name).mkdir(exist_ok=True)
    final, source = final.absolute(), scene.source and scene.source.absolute()
    views = [_absolute(view) for view in scene.views]
    cameras = cameras_content(views, folder=final / "cameras", source=source)
    if count is None:
        write_splats(scene.gaussians, folder / GAUSSIANS_FILE)
    write_json(cameras, folder / CAMERAS_FILE)
    for name, layer in layers.items():
        save_layer(layer, folder / "layers" / f"{name}.npz")
    splits = sorted({view.split for view in scene.views})
    write_json(
        {
            "format": FORMAT,
            "version": VERSION,
            "gaussians": len(scene.gaussians) if count is None else count,
            "source": None
            if source is None
            else {"relative": relative_path(source, start=final), "absolute": source.as_posix()},
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


def _scene_content(root: Path) -> _SceneFile:
    path = current_file(root, SCENE_FILE)
    if not path.is_file():
        raise MissingFileError(f"{root}: expected a scene folder, got none (no {SCENE_FILE}).")
    content = read_json(path)
    check_version(path, content, format=FORMAT, version=VERSION, what="a scene")
    return structured(content, _SceneFile, where=str(path))


def _source(
    root: Path, source: _Source | None, cameras: Mapping[str, Any], data: Path | None
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
    if source is None:
        return None
    sound = "\0" not in source.relative + source.absolute
    expect(sound, root / SCENE_FILE, "paths of the source, got others")
    candidates = [Path(os.path.normpath(root / source.relative)), Path(source.absolute)]
    there = [candidate for candidate in candidates if is_folder(candidate)]
    with_photographs = [p for p in there if not photographs or is_file(p / photographs[0])]
    return next(iter([*with_photographs, *there, candidates[1]]))
