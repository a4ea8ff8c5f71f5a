"""A generated scene as a capture on disk, as a camera and a labelling network would leave it."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from splatseg import _native
from splatseg.core import Camera, PointCloud, View
from splatseg.core.boundary import boundary
from splatseg.core.evidence import UNLABELLED
from splatseg.core.threads import in_threads
from splatseg.errors import InputError
from splatseg.io.atomic import atomic_folder
from splatseg.synthetic.photographs import cameras, machine_labels, start_points
from splatseg.synthetic.raycast import Truth, render_truth
from splatseg.synthetic.solids import SyntheticScene

_JPEG_QUALITY = 92
_DEPTH_UNIT = 0.001
_MODELS = {"pinhole": "OPENCV", "opencv": "OPENCV", "fisheye": "OPENCV_FISHEYE", "mei": "MEI"}
_COEFFICIENTS = {
    "pinhole": ("k1", "k2", "p1", "p2"),
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "mei": ("xi", "k1", "k2", "p1", "p2"),
}


@boundary
def write_capture(
    scene: SyntheticScene,
    folder: str | Path,
    *,
    views: Sequence[View] | None = None,
    points: int = 15000,
    severity: float = 1.0,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Truth]:
    """Photograph a scene and write everything about it into a folder.

    The folder has ``images/`` (JPEG), ``transforms.json`` (nerfstudio), ``points3D.ply`` (start
    points), ``semantic/``, ``instance/`` and ``depth/`` (truth, of all views),
    ``labels_semantic/`` (`machine_labels`, of train views) and ``metadata.json`` (classes,
    objects). Id maps have 0 for none. Depth is of every second pixel of every second row, in
    millimetres. The folder appears only when it is complete; an older one is replaced.

    Args:
        scene: What is photographed.
        folder: Where to write.
        views: From where; None takes `cameras` as it comes. All need the same intrinsics.
        points: Number of start points.
        severity: How wrong the machine labels are, see `machine_labels`.
        seed: Of points and labels.
        progress: Is told after each view how many are done, and how many there are.

    Returns:
        What each view really shows, by name.

    Raises:
        InputError: If there are no train views, or intrinsics differ.
    """
    chosen = cameras(scene) if views is None else tuple(views)
    train = [view for view in chosen if view.split == "train"]
    if not train:
        raise InputError("views: expected at least one train view, got none.")
    intrinsics = _intrinsics(train[0].camera)
    for view in chosen:
        if _intrinsics(view.camera) != intrinsics:
            raise InputError(f"views: expected the same intrinsics, {view.name} has others.")
    truths: dict[str, Truth] = {}
    shown = in_threads(lambda view: render_truth(scene, view.camera), chosen, _native.threads())
    for view, truth in zip(chosen, shown, strict=True):
        truths[view.name] = truth
        if progress is not None:
            progress(len(truths), len(chosen))
    labels = machine_labels(
        scene,
        {view.name: truths[view.name] for view in train},
        seed=seed,
        severity=severity,
    )
    with atomic_folder(Path(folder)) as target:
        _save_images(target, truths, labels)
        cloud = start_points(chosen, truths, count=points, seed=seed)
        (target / "points3D.ply").write_bytes(_ply(cloud))
        _save_json(_transforms(chosen, intrinsics), target / "transforms.json")
        _save_json(_metadata(scene, chosen, truths), target / "metadata.json")
    return truths


def _save_images(folder: Path, truths: Mapping[str, Truth], labels: Mapping[str, Tensor]) -> None:
    """Photographs, true maps and machine labels, each kind in a folder of its own."""
    for name in ("images", "semantic", "instance", "depth", "labels_semantic"):
        (folder / name).mkdir()
    for name, truth in truths.items():
        photograph = Image.fromarray(truth.image.numpy())
        photograph.save(folder / "images" / f"{name}.jpg", quality=_JPEG_QUALITY)
        _save_ids(truth.semantic, folder / "semantic" / f"{name}.png")
        _save_ids(truth.instance, folder / "instance" / f"{name}.png", wide=True)
        depth = (truth.depth[::2, ::2] / _DEPTH_UNIT).round().numpy().astype(np.uint16)
        Image.fromarray(depth).save(folder / "depth" / f"{name}.png")
    for name, ids in labels.items():
        _save_ids(ids, folder / "labels_semantic" / f"{name}.png")


def _save_ids(ids: Tensor, path: Path, *, wide: bool = False) -> None:
    """Ids from 1 on, 0 for none; 16 bit where `wide`, else 8."""
    values = ids.clamp_min(0).numpy().astype(np.uint16 if wide else np.uint8)
    Image.fromarray(values).save(path)


def _save_json(values: Mapping[str, Any], path: Path) -> None:
    path.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


def _intrinsics(camera: Camera) -> dict[str, Any]:
    values: dict[str, Any] = {
        "camera_model": _MODELS[camera.model],
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
    }
    names = _COEFFICIENTS[camera.model]
    return values | dict(zip(names, camera.distortion or (0.0,) * len(names), strict=True))


def _transforms(views: Sequence[View], intrinsics: Mapping[str, Any]) -> dict[str, Any]:
    frames: list[dict[str, Any]] = []
    files: dict[str, list[str]] = {"train": [], "test": []}
    for view in views:
        # The file wants OpenGL axes: y up, z backwards.
        pose = view.camera.world_from_cam.numpy() * np.array([1.0, -1.0, -1.0, 1.0])
        path = f"images/{view.name}.jpg"
        frames.append({"file_path": path, "transform_matrix": pose.tolist(), "split": view.split})
        files.setdefault(view.split, []).append(path)
    lists = {f"{split}_filenames": names for split, names in files.items()}
    return dict(intrinsics) | {
        "ply_file_path": "points3D.ply",
        **lists,
        "val_filenames": files["test"],
        "frames": frames,
    }


def _metadata(
    scene: SyntheticScene, views: Sequence[View], truths: Mapping[str, Truth]
) -> dict[str, Any]:
    camera = views[0].camera
    pixels = _train_pixels(views, truths)
    names = {row.id: row for row in scene.classes.rows}
    seen = {scene.class_of(instance) for instance, count in pixels.items() if count}
    return {
        "scene": scene.name,
        "generator": "splatseg.synthetic",
        "seed": scene.seed,
        "up_axis": "+z",
        "units": "metres",
        "handedness": "right",
        "width": camera.width,
        "height": camera.height,
        "depth": {
            "unit_m": _DEPTH_UNIT,
            "stride": 2,
            "note": "depth[i,j] = camera z at the centre of pixel (2i,2j); 0 = no hit",
        },
        "label_note": "0 = void/none in every map",
        "bounds": scene.bounds,
        "classes": [
            {
                "id": row.id,
                "name": row.name,
                "isthing": row.isthing,
                "colour": row.colour,
                "synonyms": [],
                "present": row.id in seen,
            }
            for row in scene.classes.rows
        ],
        "related_classes": scene.related_classes,
        "instances": [
            {
                "id": item.id,
                "class_id": item.class_id,
                "class_name": names[item.class_id].name,
                "name": item.name,
                "isthing": names[item.class_id].isthing,
                "parent": item.parent,
                "train_pixels": pixels.get(item.id, 0),
            }
            for item in scene.objects
        ],
        "n_train": sum(view.split == "train" for view in views),
        "n_test": sum(view.split == "test" for view in views),
    }


def _train_pixels(views: Sequence[View], truths: Mapping[str, Truth]) -> dict[int, int]:
    """How many pixels of the train views each object has; the sky is none."""
    total: dict[int, int] = {}
    for view in views:
        if view.split == "train":
            instance = truths[view.name].instance
            ids, counts = instance[instance != UNLABELLED].unique(return_counts=True)
            for i, n in zip(ids.tolist(), counts.tolist(), strict=True):
                total[i] = total.get(i, 0) + n
    return total


def _ply(cloud: PointCloud) -> bytes:
    """Binary PLY: position, a normal of zero, colour."""
    names = ("x", "y", "z", "nx", "ny", "nz")
    kinds = [(name, "<f4") for name in names] + [(c, "u1") for c in ("red", "green", "blue")]
    rows: NDArray[Any] = np.zeros(len(cloud), dtype=kinds)
    for i, name in enumerate(names[:3]):
        rows[name] = cloud.points[:, i].numpy()
    if cloud.colours is not None:
        for i, name in enumerate(("red", "green", "blue")):
            rows[name] = cloud.colours[:, i].numpy()
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(cloud)}"]
    header += [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in kinds]
    return ("\n".join([*header, "end_header"]) + "\n").encode("ascii") + rows.tobytes()
