"""True label maps of labelled surfaces against maps that are known to be true.

    benchmarks/truth_maps.py points ../shared/data/office      labelled points, option by option
    benchmarks/truth_maps.py room                              a generated room as a mesh
    benchmarks/truth_maps.py fused ../shared/data/office       a mesh of the train views' depth maps

Scores of points and fused are those of shared/score/score.py on the test views, in which no pixel
was used to make the surface; `none` is the share of pixels with a true class that got no label.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from splatseg.core import Capture, LabelledMesh, LabelledPoints, View
from splatseg.evaluate import PointSurfaceOptions, SurfaceField
from splatseg.io.captures import read_capture
from splatseg.io.surfaces import read_surface
from splatseg.synthetic import cameras, cast, room
from splatseg_bench.worlds import scene_mesh

SCORE = Path(__file__).resolve().parents[1] / ".." / "shared" / "score" / "score.py"
POINTS: tuple[tuple[str, dict], ...] = (
    ("default", {}),
    ("fill 0", {"fill": 0}),
    ("fill 1", {"fill": 1}),
    ("fill 6", {"fill": 6}),
    ("spread 0.45", {"spread": 0.45}),
    ("spread 0.8", {"spread": 0.8}),
    ("spread 1.2", {"spread": 1.2}),
    ("neighbours 4", {"neighbours": 4}),
    ("neighbours 12", {"neighbours": 12}),
    ("radius 0.02", {"radius": 0.02}),
    ("without normals", {}),
)
DEPTH_JUMP = 0.03
"""Triangles of a depth map whose corners differ by more, as a share of the depth, are cut."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("points", "room", "fused"))
    parser.add_argument("data", type=Path, nargs="?")
    parser.add_argument("--every", type=int, default=2, help="fused: of the train views")
    parser.add_argument("--only", nargs="*", help="points: rows by name")
    asked = parser.parse_args()
    if asked.what == "room":
        compare_room()
        return
    capture = read_capture(asked.data)
    if asked.what == "fused":
        began = time.monotonic()
        mesh = fused(capture, asked.data, every=asked.every)
        field = SurfaceField(mesh)
        print(f"{mesh}, made in {time.monotonic() - began:.1f} s")
        print_row("fused", field, capture, asked.data)
        return
    surface = read_surface(asked.data / "surface_points.npz")
    assert isinstance(surface, LabelledPoints)
    for name, options in POINTS:
        if asked.only and name not in asked.only:
            continue
        used = replace(surface, normals=None) if name == "without normals" else surface
        print_row(name, SurfaceField(used, points=PointSurfaceOptions(**options)), capture,
                  asked.data)  # fmt: skip


def print_row(name: str, field: SurfaceField, capture: Capture, data: Path) -> None:
    unit = json.loads((data / "metadata.json").read_text())["depth"]["unit_m"]
    errors, seconds = [], 0.0
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        nothing = known = 0
        for view in capture.test_views:
            began = time.monotonic()
            with field.view(view.camera) as seen:
                maps = {layer: seen.label_map(layer).ids for layer in ("semantic", "instance")}
                depth = seen.signals().depth
            seconds += time.monotonic() - began
            for layer, ids in maps.items():
                write(ids, work / layer / f"{view.name}.png")
            true = np.asarray(Image.open(data / "depth" / f"{view.name}.png")) * unit
            found = depth[::2, ::2].numpy()
            both = (true > 0) & (found > 0)
            errors.append(np.abs(found - true)[both])
            nothing += int(((maps["semantic"][::2, ::2].numpy() < 0) & (true > 0)).sum())
            known += int((true > 0).sum())
        classes = score("semantic", work / "semantic", data / "semantic")
        things = score("instances", work / "instance", data / "instance")
    error = np.concatenate(errors)
    print(
        f"{name:16} accuracy {classes['accuracy']:.4f}  mIoU {classes['mIoU']:.4f}  "
        f"instances {things['mIoU']:.4f}  none {nothing / known:.4f}  "
        f"depth {1000 * np.median(error):.2f} mm, within 5 cm {(error < 0.05).mean():.4f}  "
        f"{seconds / len(capture.test_views):.2f} s a view",
        flush=True,
    )


def score(command: str, predicted: Path, truth: Path) -> Mapping[str, float]:
    words = [sys.executable, str(SCORE), command, "--pred", str(predicted), "--truth", str(truth)]
    done = subprocess.run([*words, "--views", "test_*"], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def write(ids: torch.Tensor, path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(ids.clamp_min(0).numpy().astype(np.uint16)).save(path)


def fused(capture: Capture, data: Path, *, every: int) -> LabelledMesh:
    """Each depth map as a sheet of triangles, labelled at its vertices."""
    unit = json.loads((data / "metadata.json").read_text())["depth"]["unit_m"]
    sheets = [sheet(view, data, unit) for view in capture.train_views[::every]]
    starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in sheets)])
    return LabelledMesh(
        vertices=torch.cat([vertices for vertices, _, _ in sheets]),
        faces=torch.cat(
            [faces + int(start) for (_, faces, _), start in zip(sheets, starts, strict=False)]
        ),
        vertex_labels={
            name: torch.cat([labels[name] for _, _, labels in sheets])
            for name in ("semantic", "instance")
        },
    )


def sheet(view: View, data: Path, unit: float):
    depth = torch.from_numpy(np.asarray(Image.open(data / "depth" / f"{view.name}.png")) * unit)
    rows, columns = depth.shape
    index = torch.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = torch.stack((torch.stack((a, b, c), -1), torch.stack((a, c, d), -1))).reshape(-1, 3)
    corners = depth.reshape(-1)[faces]
    near, far = corners.amin(dim=1), corners.amax(dim=1)
    faces = faces[(near > 0) & (far - near < DEPTH_JUMP * near)]
    used, faces = torch.unique(faces, return_inverse=True)
    pixels = view.camera.pixel_centres()[::2, ::2].reshape(-1, 2)[used]
    labels = {}
    for name in ("semantic", "instance"):
        ids = np.asarray(Image.open(data / name / f"{view.name}.png"))[::2, ::2].astype(np.int32)
        ids = torch.from_numpy(ids.reshape(-1))[used]
        labels[name] = torch.where(ids == 0, -1, ids)
    return view.camera.unproject(pixels, depth.reshape(-1)[used]), faces.reshape(-1, 3), labels


def compare_room() -> None:
    """Pixels of a generated room that differ from its own ray caster's, lens by lens."""
    whole = room(seed=3)
    flat = tuple(item for item in whole.primitives if item.shape in ("box", "plane"))
    lenses = {
        "pinhole": {},
        "opencv": {"model": "opencv", "distortion": (-0.2, 0.05, 0.001, -0.002, 0.01)},
        "fisheye": {"model": "fisheye", "distortion": (0.02, -0.01, 0.003, 0.0)},
    }
    for kind, scene in (("boxes and planes", replace(whole, primitives=flat)), ("all", whole)):
        field = SurfaceField(scene_mesh(scene))
        instances = torch.tensor([item.instance for item in scene.primitives])
        for lens, changes in lenses.items():
            wrong = pixels = 0
            worst = 0.0
            for view in cameras(scene, train=4, test=0):
                at = replace(view.camera, **changes)
                origin, directions = at.rays()
                distance, which = cast(scene, origin, directions.reshape(-1, 3))
                true = torch.where(which >= 0, instances[which], -1).reshape(at.height, at.width)
                z = distance.reshape(true.shape) * (directions @ at.cam_from_world[2, :3])
                with field.view(at) as seen:
                    same = seen.label_map("instance").ids == true
                    off = (seen.signals().depth - z)[same & (true >= 0)].abs()
                wrong += int((~same).sum())
                pixels += same.numel()
                worst = max(worst, float(off.quantile(0.999)))
            print(
                f"{kind:16} {lens:8} {wrong} of {pixels} pixels differ, depth off by "
                f"{1000 * worst:.4f} mm in the worst view (99.9 %)",
                flush=True,
            )


if __name__ == "__main__":
    main()
