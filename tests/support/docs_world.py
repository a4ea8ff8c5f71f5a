"""The files that the pages of docs speak of, tiny: what a reader has when he begins.

`write_world` makes them once, of the room of `support.docs_room` and by the commands themselves
where commands make them. Names are those of the pages; `NAMES` says which are the same. Networks
have random weights, and lie in folders that are named as their repositories: an id that is a folder
is read there.
"""

import json
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from splatseg.cli import main
from splatseg.core import Gaussians, Pointmap
from splatseg.core.scans import MovingBox
from splatseg.io.captures import read_capture
from splatseg.io.depths import read_depth_map
from splatseg.io.images import load_image, write_video
from splatseg.io.moving import write_moving
from splatseg.io.pointmaps import create_pointmaps
from splatseg.io.scene import load_scene, save_scene
from splatseg.io.splats import write_splats
from splatseg_bench.layouts import read_benchmark
from splatseg_bench.worlds import PointmapErrors, synthetic_pointmaps
from support.benchmark_layouts import read_source, write_layout
from support.benchmark_layouts.evidence import write_evidence
from support.checkpoints import saved
from support.checkpoints_lseg import LSegFiles
from support.docs_room import (
    HEIGHT,
    WIDTH,
    write_later_photographs,
    write_photographs,
    write_room_capture,
)
from support.ply import write_ply

NAMES: Mapping[str, Sequence[str]] = {
    "room": ("room", "SCENE", "toys", "office", "garden", "OTHER"),
    "CAPTURE": ("CAPTURE", "DATA"),
    "drive": ("drive", "DRIVE", "SCANS"),
}
"""What pages call the scene of the room, its capture, and the drive."""

_SMALL: Mapping[str, int] = {"shortest_edge": 64, "longest_edge": 96}
_SQUARE: Mapping[str, int] = {"height": 64, "width": 64}

WEIGHTS: Mapping[str, tuple[str, Mapping[str, int]]] = {
    "CIDAS/clipseg-rd64-refined": ("clipseg", _SQUARE),
    "IDEA-Research/grounding-dino-tiny": ("grounding_dino", _SMALL),
    "depth-anything/Depth-Anything-V2-Small-hf": ("depth_anything", _SQUARE),
    "facebook/dinov2-small": ("dinov2", {}),
    "facebook/mask2former-swin-base-coco-panoptic": ("mask2former", _SMALL),
    "facebook/sam-vit-base": ("sam", {}),
    "facebook/sam2.1-hiera-small": ("sam2", {}),
    "nvidia/segformer-b0-finetuned-ade-512-512": ("segformer", _SQUARE),
    "openai/clip-vit-base-patch16": ("clip", {}),
    "tue-mps/coco_panoptic_eomt_large_640": ("eomt", {}),
}
"""The default weights of models, the tiny checkpoint that has their place, and the size of images
that its settings say."""

DATA_SETS: Mapping[str, str] = {
    "nvos": "fern", "lerf-ovs": "teatime", "spin-nerf": "fortress", "replica": "room_0",
    "scannet": "scene0010_00", "kitti360": "drive", "waymo": "segment",
}  # fmt: skip
"""Layouts of benchmarks, and the name of the scene of each."""

THINNED = ("left", "train_0010", "test_0008")
"""Left out of the data set that networks look at again and again."""

FEW = ("left", "front", "train_0012")
"""Views whose photographs a network of pointmaps is asked about."""

_ERRORS = PointmapErrors(noise=0.01)
_FIT = ("--steps", "200", "--max-gaussians", "1500")


def furnish(folder: Path, world: Path, lines: Iterable[str]) -> None:
    """Copy what these command lines name, and the capture of the room, into an empty folder."""
    text = "\n".join(lines)
    for path in world.iterdir():
        for name in NAMES.get(path.name, (path.name,)):
            if name == "CAPTURE" or re.search(rf"(?<![\w.-]){re.escape(name)}(?![\w-])", text):
                copy = shutil.copytree if path.is_dir() else shutil.copy
                copy(path, folder / name)


def run(*words: object) -> None:
    """A command that makes a part of the world."""
    status = main([*(str(word) for word in words), "--quiet"])
    if status != 0:
        raise RuntimeError(f"splatseg {' '.join(map(str, words))}: ended with status {status}.")


def write_world(folder: Path, drive: Path, pages: Path) -> None:
    """Write everything but networks and data sets into a new folder.

    Args:
        folder: Where.
        drive: The generated drive of `support.drive`.
        pages: The folder of docs, which has packages to install.
    """
    folder.mkdir()
    capture, scene = folder / "CAPTURE", folder / "room"
    write_room_capture(capture)
    write_photographs(folder / "PHOTOS")
    write_later_photographs(folder / "MORE")
    run("fit", capture, "-o", scene, *_FIT)
    run("see", scene, "--model", "regions", "--evidence", "masks")
    lift = ("segment", scene, "--method", "uplift", "--evidence")
    run("segment", scene, "--method", "associate", "--evidence", "masks")
    run(*lift, "labels_semantic", "--layer", "semantic")
    run(*lift, "labels_tracked", "--layer", "objects")
    made = load_scene(scene)
    save_scene(replace(made, gaussians=_closer(made.gaussians)), folder / "closer")
    for name in ("guitar.ply", "guitar.compressed.ply"):
        write_splats(made.gaussians, folder / name)
    shutil.copytree(drive, folder / "drive")
    views = read_capture(capture).views
    write_predictions(folder, capture)
    write_annotations(folder, [view.name for view in views])
    write_pointmaps(folder / "FEW_PHOTOS", capture)
    shutil.copytree(folder / "FEW_PHOTOS" / "pointmaps", folder / "pointmaps")
    photographs = sorted((folder / "PHOTOS").iterdir())
    film = [torch.from_numpy(np.array(Image.open(path))) for path in photographs]
    write_video(film, folder / "walk.mp4", fps=5)
    write_scan(folder / "scan_vh_clean_2.labels.ply")
    write_boxes(drive, folder / "boxes.json")
    write_package(folder / "installed", pages)


def _closer(gaussians: Gaussians) -> Gaussians:
    """Each four times, a little aside: `cosseg` asks for the surroundings of 4096 Gaussians."""
    four = gaussians[torch.arange(len(gaussians)).repeat(4)]
    steps = torch.linspace(-0.01, 0.01, 4).repeat_interleave(len(gaussians))
    return replace(four, means=four.means + steps.unsqueeze(1))


def write_predictions(folder: Path, capture: Path) -> None:
    """What a program of one's own left: masks, and ids of ADE20K as networks predict them."""
    shutil.copytree(capture / "masks_sam", folder / "MY_MASKS")
    (folder / "predictions").mkdir()
    for path in (capture / "labels_semantic").iterdir():
        with Image.open(path) as ids:
            predicted = np.maximum(np.asarray(ids), 1) - 1
        Image.fromarray(predicted).save(folder / "predictions" / f"{path.stem}_pred.png")


def write_annotations(folder: Path, names: Sequence[str]) -> None:
    """The left half of every photograph is a chair: in XML of CVAT, COCO's JSON, colours of VOC."""
    x, y = WIDTH / 2, float(HEIGHT)
    images = [
        f'<image id="{i}" name="{name}.jpg" width="{WIDTH}" height="{HEIGHT}">'
        f'<polygon label="chair" points="0,0;{x},0;{x},{y};0,{y}" z_order="0"></polygon></image>'
        for i, name in enumerate(names)
    ]
    text = f"<annotations><version>1.1</version>{''.join(images)}</annotations>"
    (folder / "annotations.xml").write_text(text)
    content = {
        "images": [
            {"id": i, "file_name": f"{name}.jpg", "width": WIDTH, "height": HEIGHT}
            for i, name in enumerate(names)
        ],
        "annotations": [
            {"id": i, "image_id": i, "category_id": 1, "segmentation": [[0, 0, x, 0, x, y, 0, y]]}
            for i in range(len(names))
        ],
        "categories": [{"id": 1, "name": "chair"}],
    }
    (folder / "instances_default.json").write_text(json.dumps(content))
    coloured = folder / "cvat-export" / "SegmentationClass"
    coloured.mkdir(parents=True)
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[:, : WIDTH // 2] = 128, 0, 0
    for name in names:
        Image.fromarray(pixels).save(coloured / f"{name}.png")
    table = "# label:color_rgb:parts:actions\nbackground:0,0,0::\nchair:128,0,0::\n"
    (folder / "cvat-export" / "labelmap.txt").write_text(table)


class KnowsTheRoom:
    """A network of pointmaps, which knows a few photographs of the room by what they show."""

    name, settings, note = "my-network", {"weights": "none"}, ""

    def __init__(self, capture: Path = Path("CAPTURE")) -> None:
        views = {view.name: view for view in read_capture(capture).views if view.name in FEW}
        self.photographs = {f"{name}.jpg": view.image for name, view in views.items()}
        # Depth is of every second pixel: of cells of four pixels it is taken beside the middle.
        depths = {
            f"{name}.jpg": read_depth_map(capture / "depth" / f"{name}.png", unit=1e-3)
            .values[1::2, 1::2]
            for name in views
        }  # fmt: skip
        cameras = {f"{name}.jpg": view.camera for name, view in views.items()}
        self.pairs = list(permutations(sorted(cameras), 2))
        self._answers = synthetic_pointmaps(cameras, depths, self.pairs, errors=_ERRORS)
        self._names = {
            int(load_image(view).long().sum()): f"{name}.jpg" for name, view in views.items()
        }

    def pointmaps(self, first: torch.Tensor, second: torch.Tensor) -> tuple[Pointmap, Pointmap]:
        """Points of both photographs."""
        return self.named(*(self._names[int(image.long().sum())] for image in (first, second)))

    def named(self, first: str, second: str) -> tuple[Pointmap, Pointmap]:
        """The same by the names of their files."""
        return self._answers.pointmaps(first, second)


def write_pointmaps(folder: Path, capture: Path) -> None:
    """A few photographs, and beside them what that network says of them."""
    network = KnowsTheRoom(capture)
    folder.mkdir()
    for name, path in network.photographs.items():
        shutil.copy(path, folder / name)
    kept = create_pointmaps(
        folder / "pointmaps", photographs=sorted(network.photographs), metadata={"model": "none"}
    )
    for pair in network.pairs:
        kept.save(*pair, network.named(*pair))


def write_package(folder: Path, pages: Path) -> None:
    """The packages that pages say how to write, and the network of pointmaps, as if installed."""
    about = folder / "yours-1.0.dist-info"
    about.mkdir(parents=True)
    about.joinpath("METADATA").write_text("Metadata-Version: 2.1\nName: yours\nVersion: 1.0\n")
    text = "\n".join(page.read_text(encoding="utf-8") for page in sorted(pages.glob("*.md")))
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    for module, holds in (("bright_side", "class BrightSide"), ("majority", "METHOD = Method(")):
        (code,) = (block for block in blocks if holds in block)
        (folder / f"{module}.py").write_text(code)
    about.joinpath("entry_points.txt").write_text(
        "[splatseg.models]\n"
        "halves = bright_side:BrightSide\n"
        "bright-side = bright_side:BrightSide\n"
        f"my-network = {KnowsTheRoom.__module__}:{KnowsTheRoom.__qualname__}\n"
        "[splatseg.methods]\n"
        "majority = majority:METHOD\n"
    )


def write_scan(path: Path) -> None:
    """The back wall and the floor of the room as a mesh with a class at every corner."""
    corners = [(-2.6, 2, 0), (2.6, 2, 0), (2.6, 2, 2.5), (-2.6, 2, 2.5)]
    corners += [(-2.6, -3.6, 0), (2.6, -3.6, 0), (2.6, 2, 0), (-2.6, 2, 0)]
    x, y, z = ([float(corner[k]) for corner in corners] for k in range(3))
    labels = [1] * 4 + [2] * 4
    faces = [(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)]
    vertex = [("float", "x", x), ("float", "y", y), ("float", "z", z), ("ushort", "label", labels)]
    write_ply({"vertex": vertex, "face": [("list uchar int", "vertex_indices", faces)]}, path)


def write_boxes(drive: Path, path: Path) -> None:
    """A box that moves before the third training view of the drive."""
    view = read_capture(drive).train_views[2]
    time = float(view.name[-4:])
    box = MovingBox(
        centre=view.camera.centre + 6.0 * view.camera.world_from_cam[:3, 2],
        size=(2.0, 2.0, 2.0), rotation=torch.tensor([1.0, 0, 0, 0]), start=time, end=time,
    )  # fmt: skip
    write_moving([box], path)


def write_networks(folder: Path) -> None:
    """Tiny networks: those of `WEIGHTS` in folders of these names, others in ``weights``."""
    for id, (kind, size) in WEIGHTS.items():
        made = saved(kind, folder / "weights")
        if size:
            (made / "preprocessor_config.json").write_text(json.dumps({"size": size}))
        (folder / id).parent.mkdir(exist_ok=True)
        shutil.move(made, folder / id)
    for kind in ("hed", "sam_hq", "sam2_video"):
        saved(kind, folder / "weights")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        LSegFiles(context=77).save_pretrained(folder / "weights" / "lseg")


def write_data_sets(folder: Path, capture: Path, drive: Path) -> None:
    """The room and the drive in the layouts of benchmarks, as scenes that these have."""
    folder.mkdir()
    for layout, name in DATA_SETS.items():
        source = shutil.copytree(
            drive if layout in ("kitti360", "waymo") else capture, folder / "sources" / name
        )
        if layout == "spin-nerf":
            _leave_out(source, THINNED)
        write_layout(layout, source, folder / layout)
    scan = folder / "scannet" / "scans"
    (scan / "scene0000_00").rename(scan / DATA_SETS["scannet"])
    (rooms,) = read_benchmark("replica", folder / "replica")
    tracks = write_evidence(
        read_source(capture), rooms.capture, "labels_tracked", folder / "replica" / "evidence"
    )
    (folder / "TRACKS").mkdir()
    tracks.rename(folder / "TRACKS" / DATA_SETS["replica"])
    shutil.rmtree(folder / "sources")


def _leave_out(capture: Path, names: Sequence[str]) -> None:
    """Take photographs out of a capture."""
    path = capture / "transforms.json"
    content = json.loads(path.read_text())
    files = {f"images/{name}.jpg" for name in names}
    for key, value in content.items():
        if key.endswith("_filenames"):
            content[key] = [file for file in value if file not in files]
    content["frames"] = [one for one in content["frames"] if one["file_path"] not in files]
    path.write_text(json.dumps(content))
