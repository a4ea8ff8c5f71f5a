"""Labels and poses of public benchmarks, in the files that they come in."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from splatseg.io.captures import read_capture
from splatseg_bench.layouts.lerf_ovs import filled, read_label, read_lerf_ovs
from splatseg_bench.layouts.replica import read_replica_scenes
from splatseg_bench.layouts.scannet import read_labelled_points, read_nyu40_ids
from splatseg_bench.layouts.scannetpp import read_annotated_points
from support.benchmark_layouts.rooms import write_ply
from support.fuzz.targets.base import HEIGHT, WIDTH, Target, photographs, target, whole

_EYE = " ".join(str(v) for v in np.eye(4).ravel())
_ROWS = "\n".join(" ".join(str(v) for v in row) for row in np.eye(4))


@target("langsplat-label.json")
def langsplat_label(folder: Path) -> Target:
    """Outlines by category, filled as well."""
    item = {"category": "cup", "group": 1, "bbox": [1, 1, 5, 4]}
    item["segmentation"] = [[1, 1], [5.5, 1], [4, 4]]
    info = {"name": "frame_00001.jpg", "width": WIDTH, "height": HEIGHT}

    def read(file: Path) -> object:
        frame = read_label(file)
        polygons = [item.polygon for item in frame.objects]
        return filled(polygons, frame.width, frame.height)

    content = json.dumps({"info": info, "objects": [item, item]}).encode()
    return whole(folder / "label.json", content, read)


@target("langsplat-scene.json")
def langsplat_scene(folder: Path) -> Target:
    """A scene with a label, for what is made of its words."""
    item = {"category": "cup", "bbox": [1, 1, 5, 4], "segmentation": [[1, 1], [5, 1], [4, 4]]}
    frames = [{"file_path": "images/000.png", "transform_matrix": np.eye(4).tolist()}]
    photographs(folder / "cups", 1)
    lens = {"camera_angle_x": 0.8, "w": WIDTH, "h": HEIGHT}
    (folder / "cups/transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    label = folder / "label/cups/000.json"
    label.parent.mkdir(parents=True)
    info = {"name": "000.png", "width": WIDTH, "height": HEIGHT}
    label.write_text(json.dumps({"info": info, "objects": [item]}))
    return Target(file=label, read=lambda: read_lerf_ovs(folder))


@target("scannet-labels.ply")
def scannet_labels(folder: Path) -> Target:
    """Vertices with a class each."""
    file = folder / "scene_vh_clean_2.labels.ply"
    write_ply(file, np.eye(4, 3), np.zeros((4, 3)), label=np.array([0, 1, 40, 7]))
    return Target(file=file, read=lambda: read_labelled_points(file))


@target("scannetv2-labels.tsv")
def scannet_table(folder: Path) -> Target:
    """What ScanNet's own ids are in NYU40."""
    content = b"id\traw_category\tnyu40id\n1\twall\t1\n22\tceiling\t22\n"
    return whole(folder / "labels.tsv", content, read_nyu40_ids)


def _scans(folder: Path) -> None:
    write_ply(folder / "mesh_aligned_0.05_semantic.ply", np.eye(4, 3), np.zeros((4, 3)))
    (folder / "segments.json").write_text(json.dumps({"segIndices": [1, 2, 2, 3]}))
    groups = [{"label": "cup", "segments": [1]}, {"label": "table", "segments": [2, 3]}]
    (folder / "segments_anno.json").write_text(json.dumps({"segGroups": groups}))


@target("scannetpp-segments.json")
def scannetpp_segments(folder: Path) -> Target:
    """The segment of each vertex."""
    _scans(folder)
    return Target(file=folder / "segments.json", read=lambda: read_annotated_points(folder))


@target("scannetpp-segments_anno.json")
def scannetpp_annotation(folder: Path) -> Target:
    """Named objects of segments."""
    _scans(folder)
    return Target(file=folder / "segments_anno.json", read=lambda: read_annotated_points(folder))


def _replica(folder: Path) -> None:
    for kind in ("rgb", "semantic_class"):
        (folder / kind).mkdir()
    for i in range(3):
        Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "rgb" / f"rgb_{i}.png")
        ids = Image.new("L", (WIDTH, HEIGHT), i)
        ids.save(folder / "semantic_class" / f"semantic_class_{i}.png")
    (folder / "traj_w_c.txt").write_text("\n".join([_EYE] * 3))
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 9, "fy": 9, "cx": 4, "cy": 3}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    rows = [{"id": 1, "name": "cup"}], [{"id": 1, "class_name": "cup"}]
    info = {"classes": rows[0], "objects": rows[1]}
    (folder / "info_semantic.json").write_text(json.dumps(info))


def _of_replica(file: str) -> None:
    @target(f"replica-{file}")
    def make(folder: Path) -> Target:
        _replica(folder)
        return Target(file=folder / file, read=lambda: read_replica_scenes(folder))


for _file in ("traj_w_c.txt", "cam_params.json", "info_semantic.json"):
    _of_replica(_file)


def _of_scannet(name: str, file: str) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        for kind in ("pose", "color", "intrinsic"):
            (folder / kind).mkdir()
        for i in range(3):
            Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "color" / f"{i}.jpg")
            (folder / "pose" / f"{i}.txt").write_text(_ROWS)
        lens = "9 0 4 0\n0 9 3 0\n0 0 1 0\n0 0 0 1\n"
        (folder / "intrinsic/intrinsic_color.txt").write_text(lens)
        return Target(file=folder / file, read=lambda: read_capture(folder))


_of_scannet("scannet-pose.txt", "pose/1.txt")
_of_scannet("scannet-intrinsic.txt", "intrinsic/intrinsic_color.txt")


def _of_scannetpp(name: str, file: str) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        dslr = folder / "dslr"
        for kind in ("nerfstudio", "resized_images"):
            (dslr / kind).mkdir(parents=True)
        names = [f"DSC{i:05d}.JPG" for i in range(3)]
        for image in names:
            picture = Image.new("RGB", (WIDTH, HEIGHT))
            picture.save(dslr / "resized_images" / image, format="JPEG")
        frames = [{"file_path": n, "transform_matrix": np.eye(4).tolist()} for n in names]
        lens = {"camera_model": "OPENCV_FISHEYE", "w": WIDTH, "h": HEIGHT, "fl_x": 9, "k1": 0.1}
        content = {**lens, "frames": frames[:2], "test_frames": frames[2:]}
        (dslr / "nerfstudio/transforms.json").write_text(json.dumps(content))
        lists = {"train": names[:2], "test": names[2:]}
        (dslr / "train_test_lists.json").write_text(json.dumps(lists))
        return Target(file=dslr / file, read=lambda: read_capture(folder))


_of_scannetpp("scannetpp-transforms.json", "nerfstudio/transforms.json")
_of_scannetpp("scannetpp-lists.json", "train_test_lists.json")
