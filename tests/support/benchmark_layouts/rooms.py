"""Layouts of scanned rooms: Replica in its two forms, ScanNet and ScanNet++."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from splatseg.core import Camera, View
from support.benchmark_layouts.fisheye import (
    FISHEYE,
    fisheye_inside,
    fisheye_maps,
    fisheye_names,
)
from support.benchmark_layouts.source import Source, link
from support.benchmark_layouts.sparse import rotation_and_translation, write_sparse

POINTS = 220_000
FRAME_STEP = 20

_ROW = {0: "train", 2: "test"}
_STEP = 5

NYU40_OF = {
    "wall": 1, "floor": 2, "cabinet": 3, "bed": 4, "chair": 5, "office chair": 5, "stool": 5,
    "sofa": 6, "table": 7, "door": 8, "window": 9, "picture": 11, "counter": 12, "desk": 14,
    "shelf": 15, "curtain": 16, "pillow": 18, "cushion": 18, "mirror": 19, "rug": 20,
    "ceiling": 22, "book": 23, "television": 25, "box": 29, "whiteboard": 30, "board": 30,
    "lamp": 35, "backpack": 37, "bag": 37,
}  # fmt: skip
"""Classes of ours that NYU40 has; all others are its otherprop."""

OTHERPROP = 40


def write_replica(source: Source, folder: Path) -> None:
    """Semantic-NeRF's renders: every fifth frame is trained on, one between two is scored.

    A scene has fewer photographs than that asks for, so that those in between come again: every
    training view is one training frame, and test views repeat in turn.
    """
    sequence = folder / source.name / "Sequence_1"
    for name in ("rgb", "depth", "semantic_class", "semantic_instance"):
        (sequence / name).mkdir(parents=True)
    train, tests = source.capture.train_views, source.capture.test_views
    rows: list[str] = []
    first: dict[str, int] = {}
    for i in range(len(train) * _STEP):
        group, place = divmod(i, _STEP)
        view = tests[group % len(tests)] if _ROW.get(place) == "test" else train[group]
        rows.append(" ".join(f"{v:.17g}" for v in view.camera.world_from_cam.numpy().ravel()))
        _replica_frame(source, sequence, view, i, first)
    (sequence / "traj_w_c.txt").write_text("\n".join(rows) + "\n")
    camera = source.views[0].camera
    lens = {"w": camera.width, "h": camera.height, "fx": camera.fx, "fy": camera.fy}
    lens |= {"cx": camera.cx, "cy": camera.cy, "scale": 1000.0}
    (sequence / "cam_params.json").write_text(json.dumps({"camera": lens}))
    names = {row["id"]: row["name"] for row in source.metadata["classes"]}
    info = {
        "classes": [{"id": i, "name": name} for i, name in names.items()],
        "objects": [
            {"id": row["id"], "class_id": _class_of(row), "class_name": names[_class_of(row)]}
            for row in source.metadata["instances"]
        ],
    }
    described = folder / "semantic_info" / source.name / "info_semantic.json"
    described.parent.mkdir(parents=True)
    described.write_text(json.dumps(info))


def write_grouping_replica(source: Source, folder: Path) -> None:
    """Gaussian Grouping's form: a COLMAP capture, and an instance of every pixel."""
    scene = folder / source.name
    views = sorted(source.views, key=lambda view: view.name)
    (scene / "object_mask").mkdir(parents=True)
    for view in views:
        link(view.image, scene / "images" / f"{view.name}.jpg")
        if view.split == "train":
            link(view.image, scene / "images_train" / f"{view.name}.jpg")
        _save_ids(source.ids("instance", view), scene / "object_mask" / f"{view.name}.png")
    names = [f"{view.name}.jpg" for view in views]
    write_sparse(scene / "sparse/0", views, names, source.capture.points)


def write_scannet(source: Source, folder: Path) -> None:
    """SensReader's export of every 20th frame, labelled vertices, and labels of frames.

    The last frame has no pose, as where the tracker was lost.
    """
    scene = folder / "scans" / "scene0000_00"
    for name in ("pose", "intrinsic", "label-filt", "instance-filt", "depth"):
        (scene / name).mkdir(parents=True)
    lens = np.eye(4)
    lens[:3, :3] = source.views[0].camera.K.numpy()
    for name in ("color", "depth"):
        _save_matrix(lens, scene / "intrinsic" / f"intrinsic_{name}.txt")
    for i, view in enumerate(source.views):
        number = i * FRAME_STEP
        link(view.image, scene / "color" / f"{number}.jpg")
        _save_matrix(view.camera.world_from_cam.numpy(), scene / "pose" / f"{number}.txt")
        _save_ids(_depth(source, view), scene / "depth" / f"{number}.png", wide=True)
        ids = source.ids("semantic", view)
        _save_ids(ids, scene / "label-filt" / f"{number}.png", wide=True)
        _save_ids(source.ids("instance", view), scene / "instance-filt" / f"{number}.png")
    lost = len(source.views) * FRAME_STEP
    link(source.views[0].image, scene / "color" / f"{lost}.jpg")
    _save_matrix(np.full((4, 4), -np.inf), scene / "pose" / f"{lost}.txt")
    _write_tsv(source, folder / "scannetv2-labels.combined.tsv")
    points = surface_points(source)
    nyu = _nyu40(source)[points["semantic"]]
    stem = scene / "scene0000_00_vh_clean_2"
    write_ply(stem.with_name(f"{stem.name}.ply"), points["xyz"], points["rgb"])
    colours = (nyu[:, None] * np.array([37, 91, 153]) % 256).astype(np.uint8)
    write_ply(stem.with_name(f"{stem.name}.labels.ply"), points["xyz"], colours, label=nyu)


def write_scannetpp(source: Source, folder: Path) -> None:
    """Photographs taken again through a fisheye lens, and named segments of the mesh."""
    scene = folder / "data" / "0a0b0c0d0e"
    images = scene / "dslr/resized_images"
    images.mkdir(parents=True)
    lens = fisheye_inside(source.views[0].camera)
    maps = fisheye_maps(source.views[0].camera, lens)
    names = {name: f"{photograph}.JPG" for name, photograph in fisheye_names(source).items()}
    for view in source.views:
        with Image.open(view.image) as image:
            pixels = cv2.remap(np.asarray(image), *maps, cv2.INTER_LINEAR)
        Image.fromarray(pixels).save(images / names[view.name], format="JPEG", quality=95)
    _write_nerfstudio(source, scene / "dslr", lens, names)
    _write_colmap_text(source, scene / "dslr/colmap", lens, names)
    _write_annotation(source, scene / "scans")


def surface_points(source: Source) -> dict[str, NDArray[Any]]:
    """xyz, rgb, semantic and instance of points: the scene's own, or those of its pixels."""
    path = source.folder / "surface_points.npz"
    if path.is_file():
        with np.load(path) as archive:
            return {name: archive[name] for name in ("xyz", "rgb", "semantic", "instance")}
    parts: dict[str, list[NDArray[Any]]] = {}
    for view in source.capture.train_views:
        for name, values in _seen_points(source, view).items():
            parts.setdefault(name, []).append(values)
    points = {name: np.concatenate(values) for name, values in parts.items()}
    count = len(points["xyz"])
    rows = np.random.default_rng(0).permutation(count)[: min(POINTS, count)]
    return {name: values[rows] for name, values in points.items()}


def write_ply(
    path: Path, xyz: NDArray[Any], rgb: NDArray[Any], label: NDArray[Any] | None = None
) -> None:
    """A mesh as ScanNet writes it, without faces: points are all that is known of the surface."""
    columns = [(axis, "<f4") for axis in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")]
    columns.append(("alpha", "u1"))
    if label is not None:
        columns.append(("label", "<u2"))
    rows = np.zeros(len(xyz), columns)
    for i in range(3):
        rows["xyz"[i]], rows[("red", "green", "blue")[i]] = xyz[:, i], rgb[:, i]
    rows["alpha"] = 255
    if label is not None:
        rows["label"] = label
    words = {"<f4": "float", "u1": "uchar", "<u2": "ushort"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    head += [f"property {words[kind]} {name}" for name, kind in columns]
    head += ["element face 0", "property list uchar int vertex_indices", "end_header"]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(("\n".join(head) + "\n").encode() + rows.tobytes())


def _replica_frame(
    source: Source, sequence: Path, view: View, number: int, first: dict[str, int]
) -> None:
    """One frame; a view that comes again is linked to its first frame."""
    kinds = {"rgb": "rgb", "depth": "depth"}
    kinds |= {name: name for name in ("semantic_class", "semantic_instance")}

    def path(kind: str, i: int) -> Path:
        return sequence / kind / f"{kind}_{i}.png"

    if view.name in first:
        for kind in kinds:
            link(path(kind, first[view.name]), path(kind, number))
        return
    first[view.name] = number
    with Image.open(view.image) as image:
        image.convert("RGB").save(path("rgb", number))
    _save_ids(_depth(source, view), path("depth", number), wide=True)
    _save_ids(source.ids("semantic", view), path("semantic_class", number))
    _save_ids(source.ids("instance", view), path("semantic_instance", number), wide=True)


def _depth(source: Source, view: View) -> NDArray[np.int32]:
    """Depth of every pixel in millimetres; the source has it of every second one."""
    unit = source.metadata["depth"]["unit_m"]
    with Image.open(source.folder / "depth" / f"{view.name}.png") as image:
        half = np.asarray(image).astype(np.float64)
    steps = np.rint(half * unit * 1000).astype(np.int32).repeat(2, 0).repeat(2, 1)
    return steps[: view.camera.height, : view.camera.width]


def _seen_points(source: Source, view: View) -> dict[str, NDArray[Any]]:
    """Points of every fourth pixel of a view, with what they are."""
    camera, stride = view.camera, 4
    with Image.open(source.folder / "depth" / f"{view.name}.png") as image:
        depth = np.asarray(image)[::2, ::2] * source.metadata["depth"]["unit_m"]
    with Image.open(view.image) as image:
        rgb = np.asarray(image)[::stride, ::stride]
    v, u = np.mgrid[0 : camera.height : stride, 0 : camera.width : stride] + 0.5
    rays = np.stack(((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)), -1)
    pose = camera.world_from_cam.numpy()
    xyz = (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    hit = depth > 0
    found = {"xyz": xyz.astype(np.float32), "rgb": rgb}
    for name in ("semantic", "instance"):
        found[name] = source.ids(name, view)[::stride, ::stride]
    return {name: values[hit] for name, values in found.items()}


def _class_of(row: dict[str, Any]) -> int:
    return int(row["class_id"] if "class_id" in row else row["class"])


def _nyu40(source: Source) -> NDArray[np.int64]:
    """Class of NYU40 by class of the source; 0 stays 0."""
    rows = source.metadata["classes"]
    table = np.zeros(max(row["id"] for row in rows) + 1, np.int64)
    for row in rows:
        table[row["id"]] = NYU40_OF.get(row["name"], OTHERPROP)
    return table


def _write_tsv(source: Source, path: Path) -> None:
    """The columns that are needed of ScanNet's table, with others around them."""
    nyu = _nyu40(source)
    rows = ["id\traw_category\tcategory\tcount\tnyu40id\tnyu40class"]
    for row in source.metadata["classes"]:
        name, id = row["name"], row["id"]
        rows.append(f"{id}\t{name}\t{name}\t1\t{nyu[id]}\t{name}")
    path.write_text("\n".join(rows) + "\n")


def _write_nerfstudio(source: Source, dslr: Path, lens: Camera, names: dict[str, str]) -> None:
    """transforms.json in the world that nerfstudio makes of COLMAP's, and the lists."""
    frames: dict[str, list[dict[str, Any]]] = {"frames": [], "test_frames": []}
    for view in source.views:
        opengl = view.camera.world_from_cam.numpy() @ np.diag([1.0, -1, -1, 1])
        swapped = opengl[[1, 0, 2, 3]] * np.array([[1], [1], [-1], [1]])
        name = names[view.name]
        frame = {"file_path": name, "mask_path": name.replace(".JPG", ".png"), "is_bad": False}
        frame["transform_matrix"] = swapped.tolist()
        frames["frames" if view.split == "train" else "test_frames"].append(frame)
    content = {"camera_model": "OPENCV_FISHEYE", "w": lens.width, "h": lens.height}
    content |= {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
    content |= dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True))
    (dslr / "nerfstudio").mkdir()
    text = json.dumps(content | {"has_mask": False} | frames, indent=1)
    (dslr / "nerfstudio/transforms.json").write_text(text)
    lists = {
        split: [frame["file_path"] for frame in frames[key]]
        for split, key in (("train", "frames"), ("test", "test_frames"))
    }
    (dslr / "train_test_lists.json").write_text(json.dumps(lists | {"has_masks": False}))


def _write_colmap_text(source: Source, folder: Path, lens: Camera, names: dict[str, str]) -> None:
    folder.mkdir()
    numbers = [lens.fx, lens.fy, lens.cx, lens.cy, *FISHEYE]
    size = f"{lens.width} {lens.height}"
    camera = f"1 OPENCV_FISHEYE {size} {' '.join(map(str, numbers))}\n"
    (folder / "cameras.txt").write_text(camera)
    images = "".join(
        f"{i} {' '.join(f'{v:.17g}' for v in rotation_and_translation(view.camera))} 1 "
        f"{names[view.name]}\n\n"
        for i, view in enumerate(source.views, start=1)
    )
    (folder / "images.txt").write_text(images)
    cloud = source.capture.points
    lines = (
        f"{i} {x:.6f} {y:.6f} {z:.6f} {r} {g} {b} 1.0\n"
        for i, ((x, y, z), (r, g, b)) in enumerate(
            zip(cloud.points.tolist(), cloud.colours.tolist(), strict=True), start=1
        )
    )
    (folder / "points3D.txt").write_text("".join(lines))


def _write_annotation(source: Source, scans: Path) -> None:
    """The mesh, a segment of each vertex (an object is two of them), and named objects."""
    points = surface_points(source)
    instance = points["instance"].astype(np.int64)
    halves = (points["xyz"][:, 2] > np.median(points["xyz"][:, 2])).astype(np.int64)
    segments = 2 * instance + halves
    write_ply(scans / "mesh_aligned_0.05.ply", points["xyz"], points["rgb"])
    label = points["semantic"]
    write_ply(scans / "mesh_aligned_0.05_semantic.ply", points["xyz"], points["rgb"], label=label)
    (scans / "segments.json").write_text(json.dumps({"segIndices": segments.tolist()}))
    names = {row["id"]: row["name"] for row in source.metadata["classes"]}
    groups = [
        {
            "id": i,
            "objectId": i,
            "label": names[_class_of(row)],
            "segments": [2 * row["id"], 2 * row["id"] + 1],
        }
        for i, row in enumerate(source.metadata["instances"], start=1)
        if (instance == row["id"]).any()
    ]
    (scans / "segments_anno.json").write_text(json.dumps({"segGroups": groups}))


def _save_matrix(matrix: NDArray[Any] | Sequence[Sequence[float]], path: Path) -> None:
    path.write_text("\n".join(" ".join(f"{v:.9g}" for v in row) for row in matrix) + "\n")


def _save_ids(ids: NDArray[Any], path: Path, *, wide: bool = False) -> None:
    Image.fromarray(ids.astype(np.uint16 if wide else np.uint8)).save(path)
