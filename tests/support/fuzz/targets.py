"""One function a format: it writes a small sound file and says which file is damaged and read."""

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from splatseg.core import (
    Camera,
    Features,
    Gaussians,
    InstanceTree,
    Labels,
    LayerInfo,
    Rle,
    Scene,
    Selection,
    TreeNode,
    View,
)
from splatseg.fit._checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from splatseg.fit._state import FitState
from splatseg.io.captures import read_capture
from splatseg.io.captures.colmap import read_colmap_model
from splatseg.io.depths import load_depth
from splatseg.io.evidence import load_text_embeddings, open_evidence
from splatseg.io.images import image_size, load_alpha, load_image, load_mask
from splatseg.io.layers import load_layer, save_layer
from splatseg.io.scene import load_scene, save_scene
from splatseg.io.splats import read_splats, write_splats
from splatseg.io.tensors import read_tensors
from splatseg.lift.training import _state as training
from splatseg.pose.doctor._files import read_for_doctor

GOLDEN = Path(__file__).parents[2] / "golden"
WIDTH, HEIGHT = 8, 6


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A sound file and what reads it."""

    file: Path
    read: Callable[[], object]


TARGETS: dict[str, Callable[[Path], Target]] = {}


def target(name: str) -> Callable[[Callable[[Path], Target]], Callable[[Path], Target]]:
    """File a function under the name of its format."""

    def note(make: Callable[[Path], Target]) -> Callable[[Path], Target]:
        TARGETS[name] = make
        return make

    return note


def _whole(file: Path, content: bytes, read: Callable[[Path], object]) -> Target:
    file.write_bytes(content)
    return Target(file=file, read=lambda: read(file))


def _splats(name: str, source: str) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        file = folder / f"a{''.join(Path(source).suffixes[-1:])}"
        return _whole(file, (GOLDEN / source).read_bytes(), read_splats)


_splats("compressed.ply", "splats/three.compressed.ply")
_splats("splat", "splats/three.splat")
_splats("spz-2", "splats/three.v2.spz")
_splats("spz-3", "splats/three.v3.spz")
_splats("spz-4", "splats/three.v4.spz")
_splats("sog-1", "splats/three.v1.sog")
_splats("sog-2", "splats/three.v2.sog")
_splats("gltf", "splats/three.draft.gltf")
_splats("glb", "splats/three.glb")


@target("ply")
def ply(folder: Path) -> Target:
    """With extra columns and the comments that go with them."""
    file = folder / "a.ply"
    extra = {"kind": torch.arange(4), "feature": torch.ones(4, 2)}
    write_splats(_gaussians().replace(extra=extra, antialiased=True, low_pass=0.1), file)
    return Target(file=file, read=lambda: read_splats(file))


@target("sog-meta")
def sog_meta(folder: Path) -> Target:
    """The meta.json of an unbundled SOG."""
    import zipfile

    with zipfile.ZipFile(GOLDEN / "splats/three.v2.sog") as archive:
        archive.extractall(folder)
    return Target(file=folder / "meta.json", read=lambda: read_splats(folder))


def _gaussians(count: int = 4) -> Gaussians:
    return Gaussians(
        means=torch.arange(3.0 * count).reshape(count, 3),
        rotations=torch.eye(4)[:1].expand(count, 4).clone(),
        scales=torch.full((count, 3), 0.1),
        opacities=torch.full((count,), 0.5),
        sh=torch.zeros(count, 4, 3),
    )


def _photographs(folder: Path, count: int = 3) -> list[Path]:
    (folder / "images").mkdir(parents=True, exist_ok=True)
    files = [folder / "images" / f"{i:03d}.png" for i in range(count)]
    for i, file in enumerate(files):
        Image.fromarray(np.full((HEIGHT, WIDTH, 3), 40 * i, np.uint8)).save(file)
    return files


def _frames(**more: Any) -> list[dict[str, Any]]:
    pose = np.diag([1.0, -1.0, -1.0, 1.0]).tolist()
    return [
        {"file_path": f"images/{i:03d}.png", "transform_matrix": pose, **more} for i in range(3)
    ]


def _capture(folder: Path, file: str, content: bytes) -> Target:
    _photographs(folder)
    (folder / file).write_bytes(content)
    return Target(file=folder / file, read=lambda: read_capture(folder))


@target("transforms.json")
def nerfstudio(folder: Path) -> Target:
    """nerfstudio, with every key that is read."""
    lens = {"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": 9.0, "fl_y": 9.0}
    lens |= {"cx": 4.0, "cy": 3.0, "k1": 0.01, "depth_unit_scale_factor": 0.001}
    frames = _frames(mask_path="mask.png", depth_file_path="mask.png", split="train")
    frames[0]["split"] = "test"
    Image.new("L", (WIDTH, HEIGHT), 255).save(folder / "mask.png")
    content = {**lens, "frames": frames, "train_filenames": ["images/001.png"]}
    content |= {"applied_transform": np.eye(4)[:3].tolist(), "ply_file_path": "points.ply"}
    (folder / "points.ply").write_bytes(_ascii_ply())
    return _capture(folder, "transforms.json", json.dumps(content).encode())


@target("doctor-transforms.json")
def doctor(folder: Path) -> Target:
    """A capture whose sizes contradict its photographs, as `splatseg doctor` reads it."""
    lens = {"camera_model": "OPENCV", "w": 3 * WIDTH, "h": HEIGHT, "fl_x": 9.0}
    content = {**lens, "frames": _frames(), "applied_transform": np.eye(4)[:3].tolist()}
    made = _capture(folder, "transforms.json", json.dumps(content).encode())
    return Target(file=made.file, read=lambda: read_for_doctor(folder))


@target("transforms_train.json")
def blender(folder: Path) -> Target:
    """NeRF-synthetic."""
    content = {"camera_angle_x": 0.8, "frames": _frames()}
    return _capture(folder, "transforms_train.json", json.dumps(content).encode())


@target("metadata.json")
def metadata(folder: Path) -> Target:
    """Beside a capture: classes, up, unit."""
    frames = {"camera_angle_x": 0.8, "frames": _frames()}
    (folder / "transforms_train.json").write_text(json.dumps(frames))
    rows = [{"id": 1, "name": "cup", "isthing": True, "colour": [1, 2, 3]}]
    content = {"classes": rows, "instances": rows, "up_axis": "+z", "units": "m"}
    return _capture(folder, "metadata.json", json.dumps(content).encode())


@target("poses_bounds.npy")
def llff(folder: Path) -> Target:
    """LLFF."""
    row = [0, 1, 0, 0, HEIGHT, 1, 0, 0, 0, WIDTH, 0, 0, -1, 0, 9, 0.1, 10]
    np.save(folder / "poses_bounds.npy", np.array([row] * 3, np.float64))
    return _capture(folder, "poses_bounds.npy", (folder / "poses_bounds.npy").read_bytes())


@target("cameras_sphere.npz")
def idr(folder: Path) -> Target:
    """IDR."""
    matrix = np.array([[9, 0, 4, 0], [0, 9, 3, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float32)
    file = folder / "cameras_sphere.npz"
    np.savez(file, **{f"world_mat_{i}": matrix for i in range(3)})
    return _capture(folder, file.name, file.read_bytes())


def _colmap(name: str, kind: str, stem: str) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        model = folder / "sparse"
        model.mkdir()
        for file in (GOLDEN / "colmap" / kind).iterdir():
            (model / file.name).write_bytes(file.read_bytes())
        return Target(file=model / f"{stem}.{kind}", read=lambda: read_colmap_model(model))


for _kind in ("bin", "txt"):
    for _stem in ("cameras", "images", "points3D", "rigs", "frames"):
        if (GOLDEN / "colmap" / _kind / f"{_stem}.{_kind}").is_file():
            _colmap(f"colmap-{_stem}.{_kind}", _kind, _stem)


@target("colmap-capture")
def colmap_capture(folder: Path) -> Target:
    """A whole capture by its cameras.bin, for what is made of the numbers."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    lens = struct.pack("<IiQQ4d", 1, 1, WIDTH, HEIGHT, 9, 9, 4, 3)
    (model / "cameras.bin").write_bytes(struct.pack("<Q", 1) + lens)
    images = struct.pack("<Q", 3)
    for i in range(3):
        images += struct.pack("<I7dI", i, 1, 0, 0, 0, 0, 0, 0, 1) + b"%03d.png\0" % i
        images += struct.pack("<Q", 0)
    (model / "images.bin").write_bytes(images)
    return _capture(folder, "sparse/0/cameras.bin", (model / "cameras.bin").read_bytes())


def _ascii_ply() -> bytes:
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
    head += "property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
    return (head + "end_header\n0 0 1 255 0 0\n1 2 3 0 255 9\n").encode()


@target("points-ascii.ply")
def points_ascii(folder: Path) -> Target:
    """Start points as text."""
    (folder / "transforms_train.json").write_text(
        json.dumps({"camera_angle_x": 0.8, "frames": _frames()})
    )
    return _capture(folder, "points3D.ply", _ascii_ply())


@target("points-binary.ply")
def points_binary(folder: Path) -> Target:
    """Start points in binary."""
    head, _, _ = _ascii_ply().partition(b"0 0 1")
    body = struct.pack("<3f3B", 0, 0, 1, 255, 0, 0) + struct.pack("<3f3B", 1, 2, 3, 0, 255, 9)
    (folder / "transforms_train.json").write_text(
        json.dumps({"camera_angle_x": 0.8, "frames": _frames()})
    )
    return _capture(folder, "points3D.ply", head.replace(b"ascii", b"binary_little_endian") + body)


def _view(image: Path, **more: Any) -> View:
    camera = Camera(
        width=WIDTH, height=HEIGHT, fx=9, fy=9, cx=4, cy=3, cam_from_world=torch.eye(4).double()
    )
    return View(name="a", camera=camera, split="train", image=image, **more)


def _scene(name: str, file: str) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        view = _view(_photographs(folder / "capture", 1)[0])
        scene = Scene(
            gaussians=_gaussians(), views=(view,), source=folder / "capture", up=(0, 0, 1)
        )
        save_scene(scene, folder / "scene")
        return Target(file=folder / "scene" / file, read=lambda: load_scene(folder / "scene"))


_scene("scene.json", "scene.json")
_scene("scene-cameras", "cameras/transforms.json")


def _layer(name: str, make_layer: Callable[[], Any]) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        file = folder / "a.npz"
        save_layer(make_layer(), file)
        return Target(file=file, read=lambda: load_layer(file))


def _labels() -> Labels:
    info = LayerInfo(method="vote", names={1: "cup"}, class_of={1: 3}, views=("a",), seed=1)
    return Labels(
        ids=torch.tensor([1, 2, -1, 1], dtype=torch.int32),
        confidence=torch.rand(4, generator=torch.Generator().manual_seed(0)),
        evidence=torch.ones(4),
        inferred=torch.zeros(4, dtype=torch.bool),
        info=info.with_edit("complete", {"inferred": 2}),
    )


def _tree() -> InstanceTree:
    nodes = (TreeNode(id=1, level="group"), TreeNode(id=2, parent=1, name="cup", support=0.5))
    return InstanceTree(nodes=nodes, labels=_labels())


_layer("layer-labels", _labels)
_layer("layer-tree", _tree)
_layer("layer-features", lambda: Features(values=torch.rand(4, 3), weights=torch.ones(4)))
_layer("layer-selection", lambda: Selection(mask=torch.tensor([True, False, True, False])))


def _evidence(folder: Path, file: Path, ask: str = "label_map") -> Target:
    def read() -> None:
        evidence = open_evidence(folder)
        _ = evidence.classes, evidence.source_ids, evidence.view_names
        for view in evidence.view_names:
            getattr(evidence, ask)(view)

    return Target(file=file, read=read)


def _label_png(folder: Path, bits: int) -> Path:
    ids = (np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) % 5).astype(f"u{bits // 8}")
    Image.fromarray(ids).save(folder / "a.png")
    return folder / "a.png"


@target("labels-8.png")
def labels_8(folder: Path) -> Target:
    """A label map of 8 bits."""
    return _evidence(folder, _label_png(folder, 8))


@target("labels-16.png")
def labels_16(folder: Path) -> Target:
    """A label map of 16 bits."""
    return _evidence(folder, _label_png(folder, 16), "masks")


@target("evidence.json")
def evidence_json(folder: Path) -> Target:
    """The header of evidence that splatseg wrote."""
    _label_png(folder, 8)
    rows = [{"id": i, "name": f"n{i}", "isthing": False} for i in range(1, 5)]
    header = {"format": "splatseg-evidence", "version": 1, "kind": "labels", "classes": rows}
    header |= {"source_ids": {"1": 0, "2": 1, "3": 2, "4": 7}, "metadata": {"complete": True}}
    (folder / "evidence.json").write_text(json.dumps(header))
    return _evidence(folder, folder / "evidence.json")


@target("segments.json")
def segments(folder: Path) -> Target:
    """The table of panoptic evidence."""
    _label_png(folder, 8)
    rows = [{"id": i, "category_id": 1, "isthing": True, "score": 0.5} for i in range(1, 5)]
    (folder / "segments.json").write_text(json.dumps({"a": {"segments_info": rows}}))
    return _evidence(folder, folder / "segments.json")


@target("tracks.json")
def tracks(folder: Path) -> Target:
    """The table of tracked evidence."""
    _label_png(folder, 8)
    rows = {str(i): {"category_votes": {"cup": i, "2": 1}} for i in range(1, 5)}
    (folder / "tracks.json").write_text(json.dumps({"order": ["a"], "tracks": rows}))
    return _evidence(folder, folder / "tracks.json")


@target("masks.json")
def masks_json(folder: Path) -> Target:
    """COCO run lengths, compressed and not."""
    mask = torch.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) % 7 < 2
    rle = Rle.encode(mask)
    size = [HEIGHT, WIDTH]
    rows: list[dict[str, Any]] = [
        {"segmentation": {"size": size, "counts": rle.to_coco()}, "score": 0.5, "level": 1},
        {"segmentation": {"size": size, "counts": rle.counts.tolist()}, "predicted_iou": 1},
    ]
    content = {"height": HEIGHT, "width": WIDTH, "masks": rows}
    (folder / "a.json").write_text(json.dumps(content))
    return _evidence(folder, folder / "a.json", "masks")


@target("masks.npz")
def masks_npz(folder: Path) -> Target:
    """Masks as an array."""
    np.savez(folder / "a.npz", masks=np.ones((2, HEIGHT, WIDTH), bool), scores=np.ones(2))
    return _evidence(folder, folder / "a.npz", "masks")


@target("masks-metadata.csv")
def masks_csv(folder: Path) -> Target:
    """Pictures of masks with the table of SAM's tool."""
    (folder / "a").mkdir()
    for i in range(2):
        Image.new("L", (WIDTH, HEIGHT), 255 * i).save(folder / "a" / f"{i}.png")
    (folder / "a" / "metadata.csv").write_text("id,area,predicted_iou\n0,1,0.9\n1,2,0.8\n")
    return _evidence(folder, folder / "a" / "metadata.csv", "masks")


@target("features.npz")
def features(folder: Path) -> Target:
    """Features in our own layout."""
    size = np.array([HEIGHT, WIDTH])
    np.savez(folder / "a.npz", features=np.ones((3, 4, 2), "f2"), stride=np.int64(2), size=size)
    return _evidence(folder, folder / "a.npz", "features")


def _quantised(name: str, shared: dict[str, Any]) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        np.savez(folder / name, scale=np.ones(2, "f4"), offset=np.zeros(2, "f4"), **shared)
        np.savez(folder / "a.npz", f=np.ones((3, 4, 2), np.uint8))
        return _evidence(folder, folder / name, "features")


_quantised("basis.npz", {"stride": 2, "basis": np.ones((2, 5)), "mean": np.zeros(5)})


@target("quant.npz")
def quantised(folder: Path) -> Target:
    """Scales of several blocks of a network."""
    tables = {"scale": np.ones((2, 3), "f4"), "offset": np.zeros((2, 3), "f4")}
    np.savez(folder / "quant.npz", **tables, stride=2, blocks=np.array(["a", "b"]))
    np.savez(folder / "a.npz", f=np.ones((2, 3, 4, 3), np.uint8))
    return _evidence(folder, folder / "quant.npz", "features")


@target("text_embeddings.npz")
def text(folder: Path) -> Target:
    """Vectors of words."""
    file = folder / "text_embeddings.npz"
    columns = {"labels": np.array(["cup", "a"]), "kind": np.array(["class", "synonym"])}
    np.savez(file, **columns, vectors=np.eye(2, 4, dtype="f4"), target_id=np.array([1, 2]))
    return Target(file=file, read=lambda: load_text_embeddings(file))


def _picture(name: str, mode: str, **options: Any) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        file = folder / f"a.{name.split('-')[0]}"
        exif = Image.Exif()
        exif[0x0112] = 3
        picture = Image.linear_gradient("L").resize((WIDTH, HEIGHT)).convert(mode)
        picture.save(file, **({"exif": exif} | options))
        view = _view(file, mask=file, depth=file, depth_unit=0.001)

        def read() -> None:
            image_size(file)
            for load in (load_image, load_alpha, load_mask):
                load(view)

        return Target(file=file, read=read)


_picture("png", "RGBA")
_picture("png-palette", "P", transparency=0)
_picture("jpg", "RGB")
_picture("tiff", "RGB")
_picture("tiff-deflate", "RGB", compression="tiff_adobe_deflate")
_picture("webp", "RGB")
_picture("bmp", "RGB")


@target("depth.png")
def depth_png(folder: Path) -> Target:
    """A depth map of 16 bits."""
    file = _label_png(folder, 16)
    view = _view(file, depth=file, depth_unit=0.001)
    return Target(file=file, read=lambda: load_depth(view))


@target("depth.npy")
def depth_npy(folder: Path) -> Target:
    """A depth map of real numbers."""
    np.save(folder / "a.npy", np.ones((HEIGHT, WIDTH), np.float32))
    view = _view(folder / "a.png", depth=folder / "a.npy", depth_unit=1.0)
    return Target(file=folder / "a.npy", read=lambda: load_depth(view))


@target("safetensors")
def safetensors(folder: Path) -> Target:
    """Weights."""
    header = {"a": {"dtype": "F32", "shape": [2, 3], "data_offsets": [0, 24]}}
    header |= {"b": {"dtype": "I64", "shape": [1], "data_offsets": [24, 32]}}
    words = json.dumps(header).encode()
    content = len(words).to_bytes(8, "little") + words + bytes(32)
    return _whole(folder / "a.safetensors", content, read_tensors)


@target("weights.npz")
def weights(folder: Path) -> Target:
    """Weights of NumPy."""
    np.savez(folder / "a.npz", **{"a.b": np.eye(3), "c": np.arange(4, dtype=np.float16)})
    return Target(file=folder / "a.npz", read=lambda: read_tensors(folder / "a.npz"))


@target("fit-checkpoint")
def fit_checkpoint(folder: Path) -> Target:
    """A fit that was stopped."""
    file = folder / "checkpoint.npz"
    content = {"steps": 3, "progress": 0.5, "seconds": 1.0, "gaussians": 4}
    state = FitState(tensors={"a/b": torch.ones(3)}, content=content)
    write_checkpoint(Checkpoint(state=state, identity={"data": {}}), file)
    return Target(file=file, read=lambda: read_checkpoint(file))


@target("training")
def training_state(folder: Path) -> Target:
    """A training that was stopped."""
    file = folder / "a.npz"

    def start() -> Any:
        return training.TrainingState.started({"rows": torch.ones(4, 2)}, {"w": torch.ones(3)}, 4)

    identity = {"data": {"rows": "x"}, "options": {"steps": 9}, "defaults": {}}
    training.write_state(start(), file, identity)

    def read() -> None:
        training.training_summary(file)
        training.read_state(file, start(), identity)

    return Target(file=file, read=read)
