"""Do the files that ``splatseg export`` writes mean to others what they mean to us?

    python benchmarks/exports.py SCENE --layer NAME [--instances NAME] [--tool splat-transform]

Every file is written by the command and read by something that is not splatseg: the labelled PLY
by PlayCanvas's splat-transform (which writes it again) and by a reader of a few lines here, LAS by
laspy, COCO's panoptic folder by the checks of panopticapi and a recount of every pixel, CSV and
JSON tables by Python's own modules. Prints a line a file, and stops at the first disagreement.
"""

import argparse
import csv
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from numpy.typing import NDArray
from PIL import Image

_TYPES = {"float": "<f4", "int": "<i4", "uchar": "u1", "double": "<f8"}


def check(claim: bool, what: str) -> None:
    """Stop with a sentence unless the claim holds."""
    if not claim:
        raise SystemExit(f"does not hold: {what}")


def read_ply(path: Path) -> NDArray[Any]:
    """The vertices of a binary PLY of scalars, by its header alone."""
    content = path.read_bytes()
    end = content.index(b"end_header\n") + len(b"end_header\n")
    lines = content[:end].decode().splitlines()
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    rows = [line.split() for line in lines if line.startswith("property")]
    return np.frombuffer(content, [(n, _TYPES[t]) for _, t, n in rows], count, end)


def layer_ids(scene: Path, name: str) -> NDArray[Any]:
    """Ids of a layer as its file has them, 0 for none."""
    with np.load(scene / "layers" / f"{name}.npz", allow_pickle=False) as archive:
        return archive["ids"]


class Exports:
    """The scene, and a folder for its exports."""

    def __init__(self, arguments: argparse.Namespace, folder: Path) -> None:
        self.scene: Path = arguments.scene
        self.layer: str = arguments.layer
        self.instances: str | None = arguments.instances
        self.tool: Path | None = arguments.tool
        self.folder = folder
        self.ids = layer_ids(self.scene, self.layer)
        self.seconds = 0.0

    def export(self, what: str, name: str, *more: str) -> Path:
        """Run the command."""
        out = self.folder / name
        command = [sys.executable, "-m", "splatseg", "export", str(self.scene), "--what", what]
        command += ["--layer", self.layer, "-o", str(out), *more]
        if self.instances is not None:
            command += ["--instances", self.instances]
        begun = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        self.seconds = time.perf_counter() - begun
        if done.returncode:
            raise SystemExit(done.stderr)
        return out

    def say(self, what: str) -> None:
        """A line with what the last command took."""
        print(f"{what}; {self.seconds:.1f} s", flush=True)

    def labelled_ply(self) -> None:
        """Columns as they were, before and after splat-transform."""
        path = self.export("splat", "labelled.ply")
        ours = read_ply(path)
        check(np.array_equal(ours["class_id"], self.ids), "class_id is the layer's")
        check(bool(((ours["confidence"] >= 0) & (ours["confidence"] <= 1)).all()), "confidence")
        names = [name for name in ours.dtype.names or () if "id" in name or "confidence" in name]
        if self.instances is not None:
            same = np.array_equal(ours["instance_id"], layer_ids(self.scene, self.instances))
            check(same, "instance_id is the layer's")
        table = json.loads(path.with_suffix(".json").read_text())
        check(table["gaussians"] == len(ours), "the table counts the Gaussians")
        self.say(f"labelled PLY: {len(ours)} Gaussians with {', '.join(names)}")
        if self.tool is None:
            return
        again = self.folder / "again.ply"
        subprocess.run([self.tool, "-q", "-w", "-g", "cpu", path, again], check=True)
        theirs = read_ply(again)
        check(theirs.dtype.names == ours.dtype.names, "splat-transform keeps all columns")
        check(all(np.array_equal(ours[n], theirs[n]) for n in names), "and what they hold")
        print(f"  splat-transform opens it and writes {', '.join(names)} again, unchanged")

    def las(self) -> None:
        """Places, colours and labels by laspy."""
        cloud = read_ply(self.export("points", "cloud.ply"))
        path = self.export("points", "cloud.las")
        with laspy.open(path) as file:
            points = file.read()
            version, format = file.header.version, file.header.point_format.id
            steps = np.array(file.header.scales)
        places = np.stack([points.x, points.y, points.z], axis=1)
        want = np.stack([cloud[axis] for axis in "xyz"], axis=1).astype(np.float64)
        check(bool((np.abs(places - want) <= steps).all()), "LAS places are those of the PLY")
        check(np.array_equal(points["class_id"], cloud["class_id"]), "LAS class_id")
        classes = np.where(self.ids > 0, self.ids + 63, 0)
        kept = bool((self.ids <= 192).all())
        told = np.asarray(points.classification)
        check(np.array_equal(told, classes if kept else np.zeros_like(classes)), "classification")
        for axis in ("red", "green", "blue"):
            off = np.abs(np.asarray(points[axis]) / 257 - cloud[axis])
            check(bool((off <= 0.51).all()), f"LAS {axis}, half a step of a byte")
        self.say(f"LAS {version}, point format {format}: {len(points)} points by laspy")

    def coco(self) -> None:
        """What panopticapi asks for, and every area and box counted anew."""
        folder = self.export("coco", "coco")
        content = json.loads((folder / "panoptic.json").read_text())
        images = {row["id"]: row for row in content["images"]}
        categories = {row["id"]: row for row in content["categories"]}
        check(len(images) == len(content["images"]), "image ids are distinct")
        check(len(categories) == len(content["categories"]), "category ids are distinct")
        check({row["isthing"] for row in categories.values()} <= {0, 1}, "isthing is 0 or 1")
        segments = 0
        meaning: dict[int, int] = {}
        for row in content["annotations"]:
            image = images.pop(row["image_id"])
            picture = Image.open(folder / "panoptic" / row["file_name"])
            check(picture.mode == "RGB", f"{row['file_name']} is RGB")
            check(picture.size == (image["width"], image["height"]), "its size is the image's")
            rgb = np.asarray(picture).astype(np.int64)
            ids = rgb[..., 0] + 256 * rgb[..., 1] + 65536 * rgb[..., 2]
            present, counts = np.unique(ids[ids > 0], return_counts=True)
            infos = {info["id"]: info for info in row["segments_info"]}
            check(len(infos) == len(row["segments_info"]), "segment ids are distinct")
            check(set(present.tolist()) == set(infos), "PNG and segments_info have the same ids")
            for id, count in zip(present.tolist(), counts.tolist(), strict=True):
                info = infos[id]
                check(info["area"] == count, f"area of segment {id}")
                rows, columns = np.nonzero(ids == id)
                x, y = int(columns.min()), int(rows.min())
                box = [x, y, int(columns.max()) - x + 1, int(rows.max()) - y + 1]
                check(info["bbox"] == box, f"bbox of segment {id}")
                check(info["category_id"] in categories, f"category of segment {id}")
                check(info["iscrowd"] in (0, 1), f"iscrowd of segment {id}")
                same = meaning.setdefault(id, info["category_id"]) == info["category_id"]
                check(same, f"segment {id} is the same thing in all views")
            segments += len(infos)
        check(not images, "every image has its annotation")
        views = len(content["annotations"])
        self.say(f"COCO panoptic: {views} views, {segments} segments, every pixel counted")

    def tables(self) -> None:
        """CSV against JSON, cell by cell, and the counts against the layer."""
        as_json = json.loads(self.export("table", "objects.json").read_text())["objects"]
        with self.export("table", "objects.csv").open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.DictReader(file))
        check(len(rows) == len(as_json), "CSV and JSON have as many objects")
        cells = 0
        for row, object in zip(rows, as_json, strict=True):
            flat = _flat(object)
            check(set(flat) == set(row), "CSV and JSON have the same columns")
            for name, value in flat.items():
                cell = row[name]
                fits = cell == "" if value is None else cell.removeprefix("'") == str(value)
                check(fits, f"{name} of object {object['id']}: CSV {cell!r}, JSON {value!r}")
                cells += 1
        layer = self.instances or self.layer
        ids, counts = np.unique(layer_ids(self.scene, layer), return_counts=True)
        known = {i: n for i, n in zip(ids.tolist(), counts.tolist(), strict=True) if i}
        check({o["id"]: o["gaussians"] for o in as_json} == known, "counts are the layer's")
        self.say(f"CSV and JSON: {len(rows)} objects, {cells} cells agree")

    def objects(self) -> None:
        """One file an object: together the labelled Gaussians, each once."""
        folder = self.export("objects", "objects")
        listed = json.loads((folder / "objects.json").read_text())["objects"]
        whole = read_ply(self.scene / "gaussians.ply")
        ids = layer_ids(self.scene, self.instances or self.layer)
        for row in listed:
            part = read_ply(folder / row["file"])
            want = whole[ids == row["id"]]
            check(all(np.array_equal(part[n], want[n]) for n in "xyz"), row["file"])
        self.say(f"objects: {len(listed)} files, each with its own Gaussians in their order")


def _flat(object: dict[str, Any]) -> dict[str, Any]:
    """An object of the JSON by the columns of the CSV."""
    box = object["box"]
    groups = {
        "centroid_{}": ("xyz", object["centroid"]),
        "box_{}": ("xyz", box["centre"]),
        "size_{}": ("123", box["size"]),
        "rot_{}": ("wxyz", box["rotation"]),
        "{}": (("red", "green", "blue"), object["colour"]),
    }
    flat = {k: v for k, v in object.items() if k not in ("centroid", "box", "colour")}
    for pattern, (names, values) in groups.items():
        flat |= {pattern.format(n): v for n, v in zip(names, values, strict=True)}
    return flat


def main() -> None:
    """Check one scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--layer", default="labels_semantic")
    parser.add_argument("--instances")
    parser.add_argument("--tool", type=Path, help="splat-transform")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        exports = Exports(arguments, Path(temporary))
        exports.labelled_ply()
        exports.las()
        exports.tables()
        exports.objects()
        exports.coco()


if __name__ == "__main__":
    main()
