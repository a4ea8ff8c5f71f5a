"""A scene in chunks, which commands stream, of one or a PLY file that is never held; and back."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from splatseg.core import Edited, Layer, Scene, apply_rows
from splatseg.core.boundary import boundary
from splatseg.core.gaussians import no_gaussians
from splatseg.core.options import Natural
from splatseg.core.options import options as options_class
from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures import read_capture
from splatseg.io.chunks import (
    CHUNKS_FOLDER,
    is_in_chunks,
    level_folder,
    level_rows,
    open_chunks,
    write_chunks,
)
from splatseg.io.limits import memory_to_use
from splatseg.io.scene import (
    GaussiansToWrite,
    load_scene,
    load_scene_layer,
    load_scene_views,
    save_scene,
    save_scene_in_chunks,
    scene_layer_names,
)
from splatseg.io.scene_folder import GAUSSIANS_FILE, is_scene
from splatseg.io.splats import splat_rows
from splatseg.tasks.work import (
    EVIDENCE_FOLDER,
    SILENT,
    Observer,
    check_new_folder,
    scene_of_capture,
)


@options_class
class ChunkOptions:
    """How Gaussians are kept in chunks, or the way back."""

    harmonics: Literal["float32", "float16"] = "float32"
    """Numbers of spherical harmonics. float32: renders keep their bits. float16: two thirds of the
    size at degree 2, and colours that differ by less than a level of 8 bit."""

    levels: Natural = 0
    """Coarser levels to write as well, for previews (`render --level`): each has a fourth of the
    Gaussians of the one before, and the largest 1/64 of all."""

    whole: bool = False
    """The other way: SCENE is in chunks, and NEW has its Gaussians in one PLY file, in the order of
    the chunks."""

    level: Natural = 0
    """With `whole`: that coarser level as a scene of its own, such as one that the browser opens.
    Each of its Gaussians has the labels of the one of all that it most stands for. 0 is all."""

    def __post_init__(self) -> None:
        if self.level and not self.whole:
            raise InputError("level: goes with `whole`; `levels` says how many to write.")
        if self.whole and (self.levels or self.harmonics != "float32"):
            raise InputError("whole: takes no `harmonics` and no `levels`.")


@dataclass(frozen=True, slots=True, kw_only=True)
class ChunkedScene:
    """A new scene folder."""

    folder: Path
    gaussians: int
    chunks: int
    """How many; 0 where the Gaussians are in one file."""

    layers: tuple[str, ...]
    """Names of the layers that came along, in the new order of rows."""


@boundary
def chunk_scene(
    source: Path,
    folder: Path,
    *,
    options: ChunkOptions | None = None,
    data: Path | None = None,
    memory: int | None = None,
    observer: Observer = SILENT,
) -> ChunkedScene:
    """Write a scene in chunks of a scene or a PLY file, or the other way, without holding it.

    Layers come along, one after the other, and so does evidence in the scene's own folder.

    Args:
        source: A scene folder, or a PLY file of Gaussians.
        folder: The scene folder to write; none may be there.
        options: How, and which way.
        data: The capture: of a PLY file, whose views the scene has (without moving the Gaussians);
            of a scene where it was moved.
        memory: Bytes that may be held, besides 24 a Gaussian and one layer; None is half of what
            the machine has.
        observer: Is told of the progress.

    Raises:
        MissingFileError: If there is no source.
        InputError: If it is in chunks already, or not yet with `whole`, or is no PLY file.
        FileFormatError: If it is damaged.
    """
    options = options or ChunkOptions()
    memory = memory_to_use(None) if memory is None else memory
    check_new_folder(folder)
    if not source.exists():
        raise MissingFileError(f"{source}: there is no such scene or file.")
    chunked = is_in_chunks(source / CHUNKS_FOLDER)
    if options.whole:
        if not chunked:
            raise InputError(f"{source}: expected a scene in chunks with whole, got another.")
        return _whole(source, folder, level=options.level, data=data, memory=memory)
    if chunked:
        raise InputError(f"{source}: is in chunks already; --whole is the way back.")
    there = is_scene(source)
    if there:
        scene, _ = load_scene_views(source, data=data)
    elif data is not None:
        scene = scene_of_capture(read_capture(data))
    else:
        scene = Scene(gaussians=no_gaussians())
    rows, count = splat_rows(source / GAUSSIANS_FILE if there else source, own=there)
    names = scene_layer_names(source) if there else ()
    order = torch.empty(count, dtype=torch.int64)
    with observer.stage("chunks") as step:

        def write(into: Path) -> None:
            order[:] = write_chunks(
                rows,
                count,
                into,
                memory=memory // 2,
                half=options.harmonics == "float16",
                levels=options.levels,
                progress=step,
            )

        def layers(written: Path) -> Iterable[tuple[str, Layer]]:
            edited = Edited(gaussians=open_chunks(written, memory=memory), rows=order)
            for name in names:
                yield name, apply_rows(load_scene_layer(source, name), edited)

        save_scene_in_chunks(
            scene,
            GaussiansToWrite(count=count, write=write),
            folder,
            layers=layers,
            evidence=_own_evidence(source),
        )
    chunks = open_chunks(folder / CHUNKS_FOLDER, memory=memory).chunks
    return ChunkedScene(
        folder=folder, gaussians=count, chunks=0 if chunks is None else len(chunks), layers=names
    )


def _whole(
    source: Path, folder: Path, *, level: int, data: Path | None, memory: int
) -> ChunkedScene:
    scene = load_scene(source, data=data, memory=memory, level=level)
    layers: Mapping[str, Layer] = scene.layers
    if level:
        rows = level_rows(source / CHUNKS_FOLDER, level)
        edited = Edited(gaussians=scene.gaussians, rows=rows)
        layers = {name: apply_rows(layer, edited) for name, layer in layers.items()}
    save_scene(scene, folder, layers=layers, evidence=_own_evidence(source))
    count = len(scene.gaussians)
    return ChunkedScene(folder=folder, gaussians=count, chunks=0, layers=tuple(layers))


@boundary
def level_within(source: Path, most: int) -> int:
    """The finest level of a scene in chunks that has at most so many Gaussians.

    Raises:
        InputError: If all that it has are larger.
    """
    folder, level, count = source / CHUNKS_FOLDER, 0, 0
    while is_in_chunks(level_folder(folder, level)):
        count = len(open_chunks(level_folder(folder, level), memory=1))
        if count <= most:
            return level
        level += 1
    raise InputError(
        f"{source}: expected a level of at most {most} Gaussians, got {level - 1} coarser ones, "
        f"the last of {count}; `splatseg chunks --levels` makes more."
    )


def _own_evidence(source: Path) -> tuple[Path, ...]:
    """Folders of evidence in a scene's own folder."""
    folder = source / EVIDENCE_FOLDER
    found = folder.iterdir() if folder.is_dir() else ()
    return tuple(sorted(each for each in found if each.is_dir() and each.name[0] != "."))
