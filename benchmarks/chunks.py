"""A scene of 20 M Gaussians that is never held: render, lift, click, removal and export of it.

    python benchmarks/chunks.py SCENE FOLDER [--tiles 106] [--memory 8GB] [--formats]

SCENE is a fit of the office. Its Gaussians are laid out in tiles side by side, 106 of them are
20 M, and each tile has ids of its own: its number times 100 and the class of a lift of the office.
Views, photographs and class maps are the office's own, in the tile in the middle. FOLDER gets the
scene in chunks and all that is made of it, 20 GB for 106 tiles; nothing in it is removed.

Every step is a command in a process of its own; what counts is the wall, CPU time, and the peak of
resident memory, files that are mapped included. `--formats` measures instead what else chunks could
be kept as: CPU seconds to write all, milliseconds of the wall to read a chunk of 16 384 Gaussians
that no cache has, CPU milliseconds of one that is cached, and of each of 40 read together (Zarr and
Parquet where they are installed).
"""

import argparse
import os
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from splatseg.core import UNLABELLED, Gaussians, Labels, LayerInfo, Scene, Similarity
from splatseg.core.chunks import morton_order
from splatseg.edit.history import moved_view
from splatseg.io.chunks import CHUNK_ROWS, ChunkWriter, open_chunks, write_chunks
from splatseg.io.limits import parse_size
from splatseg.io.scene import GaussiansToWrite, load_scene, save_scene_in_chunks
from splatseg.io.splats import read_splats, write_splats
from splatseg.methods.uplift import lift_labels
from splatseg.tasks.work import Work

PITCH = (8.0, 7.0)
"""Between tiles, scene units: the room is 6.4 x 5.2."""


def offset(tile: int, tiles: int) -> torch.Tensor:
    """Where a tile lies; the one in the middle is at the origin."""
    side = int(np.ceil(np.sqrt(tiles)))
    column, row = tile % side - side // 2, tile // side - side // 2
    return torch.tensor([column * PITCH[0], row * PITCH[1], 0.0])


def make(scene: Scene, folder: Path, tiles: int, memory: int) -> None:
    """Write the tiles as a scene in chunks, with the layer ``tiles``."""
    gaussians, own = scene.gaussians, len(scene.gaussians)
    evidence = Work(scene=scene).evidence("labels_semantic")
    classes = lift_labels(gaussians, scene.train_views, evidence).ids
    count = own * tiles

    def rows(first: int, end: int) -> Gaussians:
        parts: list[Gaussians] = []
        while first < end:
            tile, start = divmod(first, own)
            stop = min(own, start + end - first)
            part = gaussians[start:stop]
            parts.append(part.replace(means=part.means + offset(tile, tiles)))
            first += stop - start
        return Gaussians.concatenate(parts)

    order = torch.empty(count, dtype=torch.int64)

    def write(into: Path) -> None:
        order[:] = write_chunks(rows, count, into, memory=memory // 2)

    def layers(_: Path) -> list[tuple[str, Labels]]:
        tile, row = order // own, order % own
        own_class = classes[row]
        ids = torch.where(own_class == UNLABELLED, UNLABELLED, 100 * (tile + 1) + own_class)
        return [("tiles", Labels(ids=ids.int(), confidence=torch.ones(count), info=LayerInfo()))]

    save_scene_in_chunks(scene, GaussiansToWrite(count=count, write=write), folder, layers=layers)


def middle(scene: Scene, tiles: int) -> Scene:
    """The scene with its views in the tile at the origin."""
    side = int(np.ceil(np.sqrt(tiles)))
    tile = side // 2 * side + side // 2
    moved = Similarity(
        rotation=torch.eye(3).double(), translation=offset(tile, tiles).double(), scale=1.0
    )
    return replace(scene, views=tuple(moved_view(view, moved) for view in scene.views))


def measured(what: str, words: Sequence[str | Path]) -> None:
    """Run a command of splatseg and print a row of the table."""
    began = time.monotonic()
    command = [sys.executable, "-m", "splatseg", *map(str, words), "--quiet"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    out = "" if process.stdout is None else process.stdout.read()
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    wall, cpu = time.monotonic() - began, used.ru_utime + used.ru_stime
    said = out.strip().splitlines()[0] if out.strip() else f"status {process.returncode}"
    print(f"| {what} | {wall:.1f} | {cpu:.1f} | {used.ru_maxrss / 1e6:.2f} | {said} |", flush=True)


def commands(folder: Path, memory: str) -> None:
    """All steps, one after the other."""
    chunks, removed, ply = folder / "chunks", folder / "removed", folder / "removed.ply"
    limit = ("--memory", memory)
    print("| step | wall, s | CPU, s | peak, GB | |\n| --- | --- | --- | --- | --- |")
    measured(
        "render, 25 views: rgb, depth, ids",
        ["render", chunks, "-o", folder / "renders", "--what", "rgb,depth,tiles", *limit],
    )
    lift = ["segment", chunks, "--method", "uplift", "--evidence", "labels_semantic"]
    measured("lift of 100 class maps", [*lift, "--layer", "classes", "--no-complete", *limit])
    click = ["select", chunks, "--view", "test_0000", "--point", "256,250", "--source", "layer"]
    measured("click", [*click, "--from-layer", "tiles", "--layer", "clicked", *limit])
    remove = ["edit", chunks, "-o", removed, "--remove", "--layer", "clicked", "--cut", "off"]
    measured("remove", [*remove, "--specks", "0", "--pictures", "0", *limit])
    measured("export", ["export", removed, "-o", ply, "--layer", "tiles", *limit])
    measured("chunks of the PLY", ["chunks", ply, "-o", folder / "again", *limit])
    measured(
        "associate 100 views of masks",
        [
            "segment", chunks, "--method", "associate", "--evidence", "masks_sam", "--layer",
            "objects", "--no-complete", *limit,
        ],
    )  # fmt: skip
    measured("as a whole", ["chunks", chunks, "-o", folder / "whole", "--whole"])
    measured(
        "render as a whole, 25 views: rgb, depth, ids",
        [
            "render", folder / "whole", "-o", folder / "renders_whole", "--what",
            "rgb,depth,tiles",
        ],
    )  # fmt: skip
    same = [
        path.read_bytes()
        == (folder / "renders_whole" / path.relative_to(folder / "renders")).read_bytes()
        for path in sorted((folder / "renders").rglob("*.png"))
    ]
    print(f"\n{sum(same)} of {len(same)} pictures are the same to the byte")


def formats(scene: Scene, folder: Path) -> None:
    """What else chunks could be kept as."""
    tiles = [
        scene.gaussians.replace(means=scene.gaussians.means + offset(tile, 5)) for tile in range(5)
    ]
    gaussians = Gaussians.concatenate(tiles)
    order, _ = morton_order(gaussians.means, gaussians.scales.amax(dim=1))
    gaussians = gaussians[order]
    count = len(gaussians)
    picks = [int(i) for i in np.linspace(0, count // CHUNK_ROWS - 1, 12)]
    print(
        "| | bytes a Gaussian | write, s | not cached, ms | cached | of 40 |\n" + 6 * "| --- " + "|"
    )

    def rows(index: int) -> Gaussians:
        return gaussians[index * CHUNK_ROWS : (index + 1) * CHUNK_ROWS]

    def row(
        what: str, path: Path, write: Callable[[], None], read: Callable[[range], object]
    ) -> None:
        began = time.process_time()
        write()
        wrote = time.process_time() - began
        cold: list[float] = []
        warm: list[float] = []
        runs: list[float] = []
        for pick in picks:
            _forget(path)
            began = time.monotonic()
            read(range(pick, pick + 1))
            cold.append(1e3 * (time.monotonic() - began))
            began = time.process_time()
            for _ in range(5):
                read(range(pick, pick + 1))
            warm.append(200 * (time.process_time() - began))
        if "a chunk" not in what:
            for _ in range(5):
                began = time.process_time()
                read(range(8, 48))
                runs.append(25 * (time.process_time() - began))
        files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
        some = len(set(picks)) * CHUNK_ROWS / count if "a chunk" in what else 1.0
        size = sum(file.stat().st_size for file in files) / (some * count)
        times = [statistics.median(each) if each else float("nan") for each in (cold, warm, runs)]
        shown = " | ".join(f"{each:.1f}" for each in times)
        print(f"| {what} | {size:.0f} | {wrote / some:.1f} | {shown} |", flush=True)

    for half in (False, True):
        into = folder / f"npy_{half}"
        into.mkdir()

        def write_npy(into: Path = into, half: bool = half) -> None:
            with ChunkWriter(into, count, like=gaussians[:1], half=half) as writer:
                for index in range(-(-count // CHUNK_ROWS)):
                    writer.append(rows(index))

        opened: list[Gaussians] = []

        def read_npy(some: range, into: Path = into, opened: list[Gaussians] = opened) -> object:
            if not opened:
                opened.append(open_chunks(into, memory=1 << 40))
            chunks = opened[0].chunks
            return chunks and chunks.read([(some.start * CHUNK_ROWS, some.stop * CHUNK_ROWS)])

        kind = "float16" if half else "float32"
        row(f"npy, harmonics {kind}", into, write_npy, read_npy)
    columns = {
        f"{name}_{i}": array[:, i].contiguous().numpy()
        for name, array in (
            ("means", gaussians.means), ("rotations", gaussians.rotations),
            ("scales", gaussians.scales), ("opacities", gaussians.opacities[:, None]),
            ("sh", gaussians.sh.reshape(count, -1)),
        )
        for i in range(array.shape[1])
    }  # fmt: skip
    for codec in ("none", "zstd"):
        _parquet(row, folder / f"{codec}.parquet", columns, codec)
        _zarr(row, folder / f"{codec}.zarr", columns, codec)
    warnings.simplefilter("ignore")
    for ending in ("ply", "sog", "spz"):
        into = folder / ending
        into.mkdir()

        def write_files(into: Path = into, ending: str = ending) -> None:
            for pick in sorted(set(picks)):
                write_splats(rows(pick), into / f"{pick}.{ending}")

        def read_file(some: range, into: Path = into, ending: str = ending) -> object:
            return read_splats(into / f"{some.start}.{ending}")

        row(f"a {ending} file a chunk", into, write_files, read_file)


def _parquet(
    row: Callable[..., None], path: Path, columns: dict[str, np.ndarray], codec: str
) -> None:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        return

    def write() -> None:
        parquet.write_table(
            pa.table(columns), path, row_group_size=CHUNK_ROWS, compression=codec,
            use_dictionary=False,
        )  # fmt: skip

    def read(some: range) -> object:
        table = parquet.ParquetFile(path).read_row_groups(list(some))
        return np.stack([column.to_numpy() for column in table.columns], axis=1)

    row(f"Parquet, {codec}", path, write, read)


def _zarr(row: Callable[..., None], path: Path, columns: dict[str, np.ndarray], codec: str) -> None:
    try:
        import zarr
        from zarr.codecs import ZstdCodec
    except ImportError:
        return
    arrays = {
        name: np.stack([c for key, c in columns.items() if key.startswith(f"{name}_")], axis=1)
        for name in ("means", "rotations", "scales", "opacities", "sh")
    }

    def write() -> None:
        group = zarr.open_group(path, mode="w")
        for name, array in arrays.items():
            made = group.create_array(
                name, shape=array.shape, chunks=(CHUNK_ROWS, array.shape[1]), dtype="f4",
                compressors=ZstdCodec() if codec == "zstd" else None,
            )  # fmt: skip
            made[:] = array

    def read(some: range) -> object:
        group = zarr.open_group(path, mode="r")
        rows = slice(some.start * CHUNK_ROWS, some.stop * CHUNK_ROWS)
        return [group[name][rows] for name in arrays]

    row(f"Zarr 3, {codec}", path, write, read)


def _forget(path: Path) -> None:
    """Take files out of the system's cache."""
    for file in [path] if path.is_file() else path.rglob("*"):
        if file.is_file():
            handle = os.open(file, os.O_RDONLY)
            os.fsync(handle)
            os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
            os.close(handle)


def main() -> None:
    """Make the tiles and measure all steps."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tiles", type=int, default=106)
    parser.add_argument("--memory", default="8GB")
    parser.add_argument("--formats", action="store_true")
    parser.add_argument("--make", action="store_true", help="only make the tiles (its own process)")
    asked = parser.parse_args()
    asked.folder.mkdir(exist_ok=True)
    scene = load_scene(asked.scene)
    if asked.formats:
        formats(scene, asked.folder)
        return
    if asked.make:
        tiles = middle(scene, asked.tiles)
        make(tiles, asked.folder / "chunks", asked.tiles, parse_size(asked.memory))
        return
    if not (asked.folder / "chunks").is_dir():
        began = time.monotonic()
        words = [sys.executable, *sys.argv, "--make"]
        process = subprocess.Popen(words)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if status:
            raise SystemExit(1)
        cpu = used.ru_utime + used.ru_stime
        wall = time.monotonic() - began
        print(f"made: {wall:.1f} s, CPU {cpu:.1f} s, peak {used.ru_maxrss / 1e6:.2f} GB")
    commands(asked.folder, asked.memory)


if __name__ == "__main__":
    main()
