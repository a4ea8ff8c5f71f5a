"""Small files that stand for gigabytes, at full size: seconds and memory until they are refused.

    python benchmarks/bombs.py

Each file goes to a command in a process of its own: splats to `info`, evidence to `see`, a
photograph to `doctor`. A row says the size of the file, what it would unpack to, CPU seconds and
peak memory beyond those of the same command on a small good file, the exit status (2: refused) and
the message.
"""

import gzip
import io
import json
import os
import struct
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from splatseg.core import Camera, Gaussians, Scene, View
from splatseg.io.scene import save_scene
from splatseg.io.splats import write_splats

GOLDEN = Path(__file__).resolve().parents[1] / "tests" / "golden" / "splats"
PROGRAM = "import sys, splatseg.cli; sys.exit(splatseg.cli.main())"


def spz(path: Path) -> str:
    """15 M Gaussians of zeros."""
    header = struct.pack("<4sIIBBBB", b"NGSP", 2, 15_000_000, 0, 12, 0, 0)
    with gzip.open(path, "wb", compresslevel=9) as file:
        file.write(header)
        for _ in range(19):
            file.write(bytes(15_000_000))
    return "15 M Gaussians"


def gltf(path: Path) -> str:
    """60 000 nodes that show one mesh of 500 Gaussians."""
    count, nodes, at, views, accessors, attributes = 500, 60_000, 0, [], [], {}
    extension, buffer = "KHR_gaussian_splatting", b""
    for name, width in (
        ("POSITION", 3),
        (f"{extension}:ROTATION", 4),
        (f"{extension}:SCALE", 3),
        (f"{extension}:OPACITY", 1),
        (f"{extension}:SH_DEGREE_0_COEF_0", 3),
    ):
        data = np.ones((count, width), "<f4").tobytes()
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[width]
        attributes[name] = len(accessors)
        accessors.append(
            {"bufferView": len(views), "componentType": 5126, "count": count, "type": kind}
        )
        views.append({"buffer": 0, "byteOffset": at, "byteLength": len(data)})
        buffer, at = buffer + data, at + len(data)
    said = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {extension: said}}
    (path.parent / "bomb.bin").write_bytes(buffer)
    content = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": "bomb.bin", "byteLength": len(buffer)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0} for _ in range(nodes)],
        "scenes": [{"nodes": list(range(nodes))}],
    }
    path.write_text(json.dumps(content))
    return "30 M Gaussians"


def sog(path: Path) -> str:
    """Three Gaussians that are said to be 16 M."""
    with zipfile.ZipFile(GOLDEN / "three.v2.sog") as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == "meta.json":
                content = json.dumps({**json.loads(content), "count": 16_000_000}).encode()
            new.writestr(name, content)
    return "16 M Gaussians"


def _npz(path: Path, name: str, shape: tuple[int, ...], kind: str) -> None:
    """An npz with one member of zeros, written without its array."""
    head = io.BytesIO()
    header = {"descr": kind, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(head, header)
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive,
        archive.open(f"{name}.npy", "w", force_zip64=True) as member,
    ):
        member.write(head.getvalue())
        for start in range(0, size, 1 << 24):
            member.write(bytes(min(1 << 24, size - start)))


def masks_npz(path: Path) -> str:
    """Masks of zeros."""
    _npz(path, "masks", (4000, 1000, 1000), "|b1")
    return "4 GB of masks"


def features_npz(path: Path) -> str:
    """Features of zeros."""
    _npz(path, "features", (1000, 1000, 1000), "<f4")
    return "4 GB of features"


def coco(path: Path) -> str:
    """A run length whose number does not end."""
    row = {"segmentation": {"size": [64, 64], "counts": "o" * 2_000_000 + "0"}}
    path.write_text(json.dumps({"height": 64, "width": 64, "masks": [row]}))
    return "a number of 10 M bits"


def label_png(path: Path) -> str:
    """A label map of one colour, far larger than its photograph."""
    Image.new("L", (30_000, 30_000)).save(path, compress_level=9)
    return "30000 x 30000 ids"


def capture(photograph: Path) -> None:
    """A capture of one photograph with its pose."""
    frame = {"file_path": photograph.name, "transform_matrix": np.eye(4).tolist()}
    content = {"fl_x": 60, "fl_y": 60, "cx": 32, "cy": 32, "w": 64, "h": 64, "frames": [frame]}
    (photograph.parent / "transforms.json").write_text(json.dumps(content))


def tiff(path: Path) -> str:
    """A photograph of hostile size."""
    Image.new("1", (40_000, 40_000)).save(path, compression="group4")
    capture(path)
    return "40000 x 40000 pixels"


SPLATS = {"bomb.spz": spz, "bomb.gltf": gltf, "bomb.sog": sog}
EVIDENCE = {
    "masks/v.npz": masks_npz,
    "features/v.npz": features_npz,
    "coco/v.json": coco,
    "labels/v.png": label_png,
}


def made(make: Callable[[Path], str], path: Path) -> str:
    """Make a file in a process of its own, whose memory is not counted as that of the reader."""
    path.parent.mkdir(exist_ok=True)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(make, path).result()


def measured(*words: object) -> tuple[int, float, float, str]:
    """Status, CPU seconds, peak memory in MiB and last line of a command."""
    command = [sys.executable, "-c", PROGRAM, *map(str, words)]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    said = process.stderr.read().strip().splitlines()
    _, status, used = os.wait4(process.pid, 0)
    code = os.waitstatus_to_exitcode(status)
    return code, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, said[-1] if said else ""


def one_gaussian() -> Gaussians:
    """A scene of one."""
    return Gaussians(
        means=torch.zeros(1, 3),
        rotations=torch.eye(4)[:1],
        scales=torch.ones(1, 3),
        opacities=torch.ones(1),
        sh=torch.zeros(1, 1, 3),
    )


def small_scene(folder: Path) -> Path:
    """One Gaussian, one photograph."""
    camera = Camera(
        width=64, height=64, fx=60, fy=60, cx=32, cy=32, cam_from_world=torch.eye(4).double()
    )
    Image.new("RGB", (64, 64)).save(folder / "v.png")
    views = (View(name="v", camera=camera, split="train", image=folder / "v.png"),)
    save_scene(Scene(gaussians=one_gaussian(), views=views), folder / "scene")
    return folder / "scene"


def main() -> None:
    """Make each bomb, have it read, print a row."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        see = ("see", small_scene(folder), "--evidence", "e", "--overwrite", "--model")
        good = folder / "good"
        good.mkdir()
        write_splats(one_gaussian(), good / "one.ply")
        Image.new("L", (64, 64), 1).save(good / "v.png")
        capture(good / "v.png")
        for make, file, words, least in [
            *((make, folder / file, ("info",), good / "one.ply") for file, make in SPLATS.items()),
            *((make, folder / file, see, good) for file, make in EVIDENCE.items()),
            (tiff, folder / "photographs" / "v.tiff", ("doctor",), good),
        ]:
            what = made(make, file)
            _, seconds_before, memory_before, _ = measured(*words, least)
            asked = file.parent if file.parent != folder else file
            code, seconds, memory, message = measured(*words, asked)
            print(
                f"{file.name:10s} {file.stat().st_size / 1e3:6.0f} kB  {what:22s} "
                f"{seconds - seconds_before:6.2f} s {memory - memory_before:6.0f} MiB  "
                f"status {code}  {message.replace(str(folder), '')[:150]}",
                flush=True,
            )


if __name__ == "__main__":
    main()
