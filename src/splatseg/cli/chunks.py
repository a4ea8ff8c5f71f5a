"""``splatseg chunks``: a scene whose Gaussians stay on the disk, and back."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from splatseg.cli._shared import Memory, NewScene, Printing, print_result
from splatseg.io.limits import memory_to_use
from splatseg.tasks import ChunkOptions, chunk_scene


@dataclass(frozen=True, kw_only=True)
class Command(Printing):
    """Write a scene in chunks: Gaussians that commands stream from the disk.

    A scene larger than memory is a folder of chunks, which lie near each other and of which a view
    reads those before it. render, segment (uplift, associate), select, edit and export stream
    it within --memory; other commands refuse it. Rows are put into another order, layers and
    the scene's own evidence come along, and SCENE stays as it is.

    SCENE is a scene folder or a binary PLY file, which may be larger than memory; a PLY file gets
    the views of --data, or none. --whole goes the other way, with --level to a smaller scene.

    For example:

    splatseg chunks city -o city-chunks

    splatseg chunks city.ply --data capture -o city-chunks --harmonics float16 --memory 4GB

    splatseg chunks city-chunks -o city-whole --whole

    splatseg chunks city-chunks -o city-small --whole --level 1
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """A scene folder, or a PLY file of Gaussians."""

    output: NewScene

    data: Annotated[Path | None, tyro.conf.arg(metavar="CAPTURE")] = None
    """Folder of the capture: of a scene, if it was moved; of a PLY file, whose views the scene
    gets. The Gaussians must lie in its frame."""

    options: Annotated[ChunkOptions, tyro.conf.arg(name="")] = field(default_factory=ChunkOptions)
    """How Gaussians are kept."""

    memory: Memory = None


def run(command: Command) -> None:
    """Write a scene in chunks, or one that is not."""
    started = time.monotonic()
    made = chunk_scene(
        command.scene,
        command.output,
        options=command.options,
        data=command.data,
        memory=memory_to_use(command.memory),
        observer=command.observer,
    )
    facts = {
        "scene": made.folder,
        "gaussians": made.gaussians,
        "chunks": made.chunks,
        "layers": list(made.layers),
        "seconds": round(time.monotonic() - started, 3),
    }
    layers = ", ".join(made.layers) or "no layers"
    kept = f"in {made.chunks} chunks" if made.chunks else "in one file"
    line = f"{made.folder}: {made.gaussians} Gaussians {kept}; {layers}"
    print_result(facts, [line], json=command.json)
