r"""How near the meshes of objects are to the surfaces that are there.

    splatseg fit ../shared/data/toys -o SCENE
    splatseg segment SCENE --method uplift --evidence instance --layer things
    python benchmarks/meshes.py SCENE ../shared/data/toys [--picture FILE --things 52,31]

The layer is lifted from the true masks of the training views, so that figures are of the surfaces
and not of the segmentation. Of every thing (no wall, no floor) that has at least `--points` points
in `surface_points.npz`:

- completeness: share of the true points within 1 and 2 cm of the mesh.
- accuracy: share of points of the mesh within 1 and 2 cm of the true surface, of those parts only
  that a view sees (the column `seen` of the mesh): `surface_points.npz` has no other surfaces than
  training views see, so that of sides that nobody saw it says nothing. The true surface at a true
  point is its tangent plane as far as twice the distance to the sixth neighbour; points of the mesh
  that are farther from any count with the distance to the nearest one.
- closed: whether the mesh is watertight.

The mesh is sampled every 3 mm, large ones less finely.
"""

import argparse
import json
import resource
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from splatseg.io.export import TriangleMesh
from splatseg.io.ply import read_ply_header, read_ply_tables
from splatseg.io.scene import load_scene
from splatseg.io.surfaces import read_triangles
from splatseg.raycast import RayCaster
from splatseg.tasks import ExportOptions, export_scene

LAYER = "things"
TAUS = (0.01, 0.02)
SPACING, MOST = 0.003, 400_000
WELL_SEEN = 0.5

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Scored:
    """Figures of one thing; lengths in mm."""

    id: int
    name: str
    size: float
    """Longest side of its box, m."""

    seen: float
    complete: tuple[float, ...]
    accurate: tuple[float, ...]
    to_mesh: float
    """Median distance of true points to the mesh."""

    to_truth: float
    """Median distance of seen points of the mesh to the true surface."""

    closed: bool
    triangles: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--points", type=int, default=500)
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--things", default="", help="ids of the picture")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "meshes"
        if given.picture is not None:
            export(given.scene, out, "ply", given.resolution, tuple(given.things.split(",")))
            draw(out, given.picture)
            return
        started = time.monotonic()
        export(given.scene, out, "ply", given.resolution, ())
        seconds = time.monotonic() - started
        # Linux counts in KiB.
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
        table = json.loads((out / "meshes.json").read_text())
        tell(score(given, out, table), table, seconds=seconds, peak=peak)


def export(scene: Path, out: Path, format: str, resolution: int, only: tuple[str, ...]) -> None:
    options = ExportOptions(layer=LAYER, mesh_format=format, resolution=resolution, only=only)
    export_scene(load_scene(scene), out, "meshes", options=options)


def score(given: argparse.Namespace, out: Path, table: dict) -> list[Scored]:
    truth = np.load(given.data / "surface_points.npz")
    classes = load_scene(given.scene).classes
    things = {row.id for row in classes.rows if row.isthing}
    rows: list[Scored] = []
    for entry in table["objects"]:
        own = truth["instance"] == entry["id"]
        if own.sum() < given.points:
            continue
        ids, counts = np.unique(truth["semantic"][own], return_counts=True)
        if int(ids[counts.argmax()]) not in things:
            continue
        mesh, seen = read(out / entry["file"])
        normals = truth["normal"][own].astype(np.float64)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)
        rows.append(scored(entry, mesh, seen, truth["xyz"][own].astype(np.float64), normals))
    return rows


def read(path: Path) -> tuple[TriangleMesh, NDArray[np.bool_]]:
    columns = read_ply_tables(path, read_ply_header(path), ["vertex"])["vertex"].numbers
    vertices = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
    faces = read_triangles(path)
    return TriangleMesh(vertices=torch.from_numpy(vertices), faces=faces), columns["seen"] > 0


def scored(
    entry: dict, mesh: TriangleMesh, seen: NDArray[np.bool_], xyz: Array, normals: Array
) -> Scored:
    points, face = sample(mesh)
    to_mesh, _ = cKDTree(points).query(xyz)
    tree = cKDTree(xyz)
    on_seen = points[seen[mesh.faces.numpy()[face]].all(axis=1)]
    distance, nearest = tree.query(on_seen)
    reach = 2 * tree.query(xyz, k=7)[0][:, -1]
    plane = np.abs(((on_seen - xyz[nearest]) * normals[nearest]).sum(axis=1))
    to_truth = np.where(distance <= reach[nearest], plane, distance)
    empty = not len(to_truth)
    return Scored(
        id=entry["id"],
        name=entry["name"],
        size=max(entry["box"]["size"]),
        seen=entry["mesh"]["seen"],
        complete=tuple(float((to_mesh <= tau).mean()) for tau in TAUS),
        accurate=tuple(0.0 if empty else float((to_truth <= tau).mean()) for tau in TAUS),
        to_mesh=1000 * float(np.median(to_mesh)),
        to_truth=float("nan") if empty else 1000 * float(np.median(to_truth)),
        closed=mesh.is_watertight,
        triangles=len(mesh.faces),
    )


def sample(mesh: TriangleMesh) -> tuple[Array, NDArray[np.int64]]:
    """Points evenly over the area, and the triangle of each."""
    a, b, c = (mesh.vertices.numpy()[mesh.faces.numpy()[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    rng = np.random.default_rng(0)
    count = int(np.clip(area.sum() / SPACING**2, 10_000, MOST))
    face = rng.choice(len(area), count, p=area / area.sum())
    along, across = rng.random((2, count, 1))
    along = np.sqrt(along)
    weights = (1 - along, along * (1 - across), along * across)
    return sum(w * corner[face] for w, corner in zip(weights, (a, b, c), strict=True)), face


def tell(rows: list[Scored], table: dict, *, seconds: float, peak: float) -> None:
    made = len(table["objects"])
    print(f"{made} meshes, {len(table['without_mesh'])} without, {seconds:.0f} s, {peak:.1f} GB")
    print("| things | complete 1 cm | 2 cm | accurate 1 cm | 2 cm | to mesh | to truth | closed |")
    print("|---|---|---|---|---|---|---|---|")
    groups = (
        ("all", rows),
        (f"at least {WELL_SEEN:.0%} seen", [row for row in rows if row.seen >= WELL_SEEN]),
        ("the others", [row for row in rows if row.seen < WELL_SEEN]),
    )
    for name, group in groups:
        if group:
            print(f"| {name} ({len(group)}) | {line(group)} |")
    print("\nby thing, the worst completeness first:")
    for row in sorted(rows, key=lambda row: row.complete[1]):
        closed = "closed" if row.closed else "open"
        print(
            f"{row.id:4d} {row.name[:34]:34s} {row.size:5.2f} m, seen {row.seen:4.0%}, "
            f"complete {row.complete[0]:4.0%} {row.complete[1]:4.0%}, accurate "
            f"{row.accurate[0]:4.0%} {row.accurate[1]:4.0%}, {row.to_mesh:5.1f} mm, "
            f"{row.to_truth:5.1f} mm, {row.triangles} triangles, {closed}"
        )


def line(rows: list[Scored]) -> str:
    """Means of shares, medians of distances."""
    shares = [statistics.mean(row.complete[i] for row in rows) for i in (0, 1)]
    shares += [statistics.mean(row.accurate[i] for row in rows) for i in (0, 1)]
    lengths = [
        np.nanmedian([getattr(row, name) for row in rows]) for name in ("to_mesh", "to_truth")
    ]
    closed = statistics.mean(row.closed for row in rows)
    words = [f"{share:.1%}" for share in shares] + [f"{length:.1f} mm" for length in lengths]
    return " | ".join([*words, f"{closed:.0%}"])


def draw(out: Path, picture: Path, *, side: int = 300) -> None:
    """Each mesh from two sides, its surface above and its colours below."""
    columns: list[NDArray[np.uint8]] = []
    for entry in json.loads((out / "meshes.json").read_text())["objects"]:
        mesh, _ = read(out / entry["file"])
        table = read_ply_tables(
            out / entry["file"], read_ply_header(out / entry["file"]), ["vertex"]
        )["vertex"].numbers
        colours = np.stack([table[name] for name in ("red", "green", "blue")], axis=1)
        sides = (shaded(mesh, colours, azimuth, side) for azimuth in (40.0, 220.0))
        columns.extend(np.concatenate(images) for images in sides)
    Image.fromarray(np.concatenate(columns, axis=1)).save(picture, optimize=True)


def shaded(
    mesh: TriangleMesh, colours: NDArray[np.uint8], azimuth: float, side: int
) -> list[NDArray[np.uint8]]:
    """The mesh in grey under a light, and with its colours, from above its horizon; z is up."""
    low, high = mesh.vertices.amin(0), mesh.vertices.amax(0)
    angle, tilt = np.radians(azimuth), np.radians(25.0)
    back = np.array([np.cos(angle) * np.cos(tilt), np.sin(angle) * np.cos(tilt), np.sin(tilt)])
    right = np.array([-np.sin(angle), np.cos(angle), 0.0])
    upwards = np.cross(back, right)
    radius = float((high - low).norm()) / 2
    steps = (np.arange(side) + 0.5) / side * 2 - 1
    eye = ((low + high) / 2).numpy() + back * radius * 3.2
    half = np.tan(np.radians(19.0))
    rays = -back + half * (steps[None, :, None] * right - steps[:, None, None] * upwards)
    rays = torch.from_numpy(rays.reshape(-1, 3))
    hits = RayCaster(mesh.vertices, mesh.faces).cast(torch.from_numpy(eye).expand_as(rays), rays)
    hit = (hits.faces >= 0).numpy()
    corners = mesh.faces[hits.faces[hit]].numpy()
    a, b, c = (mesh.vertices.numpy()[corners[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-12)
    light = back + np.array([0.4, -0.3, 0.85])
    grey = 0.35 + 0.65 * np.abs(normal @ light) / np.linalg.norm(light)
    images = [np.full((side * side, 3), 255, np.uint8) for _ in range(2)]
    images[0][hit] = grey[:, None] * np.array([200.0, 205, 215])
    images[1][hit] = np.einsum("nk,nkj->nj", hits.weights[hit].numpy(), colours[corners])
    return [image.reshape(side, side, 3) for image in images]


if __name__ == "__main__":
    main()
