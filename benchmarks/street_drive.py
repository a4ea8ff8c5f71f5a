"""Memory of a long drive in blocks, by the kilometre: a generated drive, 20 km by default.

    nice python benchmarks/street_drive.py [--kilometres 20] [--threads 1] [--json FILE]

Generated streets of 200 m (`splatseg_bench.worlds.street`, six seeds by turns) are put end to end,
each or its mirror image, whichever keeps the road going on; a road that comes back is refused.
Along them a car takes a picture of 48x32 pixels and a scan of 16x90 rays every twenty metres, which
rays cast at the mesh of the street give when they are asked for. The drive is cut into blocks of
80 m with 20 m of overlap (`cut_drive`); each is fitted (primitives in voxels of 2 m, a short fit of
their shapes to the depth of its scans, a short training of colours and classes on true classes),
labels the points of its scans, and is dropped (`DriveField.labels_of_scans`). The fields are small
and hardly trained: accuracy shows that labels come from them, and is no measure of the method.

The table has a row a kilometre: blocks that were made, memory of the process now and at most so far
(VmRSS and ru_maxrss, MiB), accuracy of the labels of its points, and seconds of CPU since the
start. The last lines say how memory grows per kilometre by a line through all rows but the first
two kilometres, when everything was loaded, and how many fields there were at once at most.
"""

import argparse
import json
import math
import resource
import tempfile
import time
import weakref
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from splatseg.core import Camera, Capture, LabelledMesh, LayerInfo, Scan, View
from splatseg.io.evidence import open_evidence
from splatseg.raycast import RayCaster
from splatseg.street.block_field import DriveField, DriveScans, block_views
from splatseg.street.blocks import (
    DriveBlock,
    DriveBlockOptions,
    DriveBlocks,
    cut_drive,
    frame_centres,
)
from splatseg.street.depth_views import scan_views
from splatseg.street.field import MeshField
from splatseg.street.geometry import GeometryOptions, fit_geometry
from splatseg.street.method import scan_points
from splatseg.street.primitives import voxel_primitives
from splatseg.street.radiance import RadianceOptions
from splatseg.street.radiance_training import train_radiance
from splatseg.street.shape_files import load_shapes
from splatseg.street.shapes import ShapeAutoEncoder, sphere_code
from splatseg.synthetic import look_at
from splatseg_bench.worlds._classes import STREET_CLASSES
from splatseg_bench.worlds._recorded import scene_mesh
from splatseg_bench.worlds._streets import street

LAYER = "semantic"
PIECE = 200.0
SEEDS = (0, 1, 2, 3, 4, 5)
STEP = 20.0
RANGE = 80.0
MAX_WIDEST = 8
"""Blocks that may lie between the first and the last that label a scan: the road goes on."""

KEPT = 48
"""Scans and views that are kept when they were made."""
WIDTH, HEIGHT = 48, 32
BEAMS, COLUMNS = 16, 90
VOXEL = 2.0
GEOMETRY = GeometryOptions(iterations=10, rays=512, refresh=10, reuse=1, carve=0.5)
RADIANCE = RadianceOptions(
    feature_size=8,
    width=16,
    depth=1,
    semantic_width=16,
    colour_widths=(16,),
    fine_hits=3,
    coarse_hits=0,
    rays=256,
    iterations=60,
    rate=0.01,
    feature_rate=0.1,
)


@dataclass(frozen=True)
class Piece:
    """A street of 200 m from the origin along +x, and where and how its lane ends."""

    mesh: LabelledMesh
    lane: np.ndarray
    turn: float


class Road:
    """Streets end to end. Meshes of a few seeds are held, and three placed ones."""

    def __init__(self, count: int) -> None:
        # Each street and its mirror image, so that bends can bring the road back to +x.
        self.pieces = [piece for seed in SEEDS for piece in self._both(seed)]
        self.placed: OrderedDict[int, tuple[RayCaster, Tensor]] = OrderedDict()
        self.poses = [(0, 0.0, np.zeros(2))]
        for i in range(1, count):
            kind, heading, start = self.poses[-1]
            there = self.pieces[kind]
            end = start + turned(heading) @ (there.lane[-1] - there.lane[0])
            heading += there.turn
            two = (2 * (i % len(SEEDS)), 2 * (i % len(SEEDS)) + 1)
            self.poses.append((min(two, key=lambda k: self._off(k, heading)), heading, end))

    def _off(self, kind: int, heading: float) -> float:
        """How far from +x the road is after a street."""
        return abs(heading + self.pieces[kind].turn)

    @staticmethod
    def _both(seed: int) -> tuple[Piece, Piece]:
        scene = street(seed, length=PIECE)
        lane = np.array(scene.drive)[:, :2]
        first, last = lane[1] - lane[0], lane[-1] - lane[-2]
        turn = math.atan2(last[1], last[0]) - math.atan2(first[1], first[0])
        mesh = scene_mesh(scene, segments=8)
        mirror = np.array([1.0, -1.0])
        vertices = mesh.vertices * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
        turned_over = replace(mesh, vertices=vertices)
        return (
            Piece(mesh=mesh, lane=lane, turn=turn),
            Piece(mesh=turned_over, lane=lane * mirror, turn=-turn),
        )

    def place(self, along: float) -> tuple[np.ndarray, float]:
        """Where the lane is at a length, and its heading."""
        piece = min(int(along // PIECE), len(self.poses) - 1)
        kind, heading, start = self.poses[piece]
        lane = self.pieces[kind].lane
        lengths = np.concatenate(([0.0], np.linalg.norm(np.diff(lane, axis=0), axis=1).cumsum()))
        at = min(max((along - piece * PIECE) / PIECE, 0.0), 1.0) * lengths[-1]
        place = np.array([np.interp(at, lengths, lane[:, k]) for k in range(2)])
        i = min(int(np.searchsorted(lengths, at, side="right")), len(lane) - 1)
        ahead = lane[i] - lane[i - 1]
        yaw = heading + math.atan2(ahead[1], ahead[0])
        return start + turned(heading) @ (place - lane[0]), yaw

    def cast(self, along: float, origin: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
        """The first surface of the streets in range: distance and class, -1 none."""
        piece = min(int(along // PIECE), len(self.poses) - 1)
        distance = torch.full((len(rays),), math.inf, dtype=torch.float64)
        classes = torch.full((len(rays),), -1, dtype=torch.int32)
        into = along - piece * PIECE
        reached = {piece, piece - (into < RANGE), piece + (into > PIECE - RANGE)}
        for index in sorted(reached & set(range(len(self.poses)))):
            caster, labels = self._caster(index)
            hits = caster.cast(origin, rays)
            nearer = hits.distances < distance
            distance = torch.where(nearer, hits.distances, distance)
            classes = torch.where(nearer, labels[hits.faces], classes)
        return distance, classes

    def _caster(self, index: int) -> tuple[RayCaster, Tensor]:
        if index in self.placed:
            self.placed.move_to_end(index)
            return self.placed[index]
        while len(self.placed) >= 3:
            self.placed.popitem(last=False)
        kind, heading, start = self.poses[index]
        piece = self.pieces[kind]
        vertices = piece.mesh.vertices.clone()
        plane = vertices[:, :2].numpy() - piece.lane[0]
        vertices[:, :2] = torch.from_numpy(plane @ turned(heading).T + start)
        made = RayCaster(vertices, piece.mesh.faces), piece.mesh.face_labels["semantic"]
        self.placed[index] = made
        return made


def turned(angle: float) -> np.ndarray:
    """A rotation in the plane."""
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


class Recorder:
    """What a car on the road records, made when it is asked for: a `core.ScanSource` and photos."""

    def __init__(self, road: Road, length: float) -> None:
        self.road = road
        self.along = np.arange(0.0, length + 1e-6, STEP)
        self.scan_names = tuple(f"{i:06d}" for i in range(len(self.along)))
        elevation = np.deg2rad(np.linspace(2.0, -24.8, BEAMS))
        azimuth = np.linspace(-math.pi, math.pi, COLUMNS, endpoint=False)
        e, a = (grid.reshape(-1) for grid in np.meshgrid(elevation, azimuth, indexing="ij"))
        self.rays = np.stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), axis=1)
        self.scan = lru_cache(KEPT)(self._scan)
        self.classes = lru_cache(KEPT)(self._classes)

    def _scan(self, name: str) -> Scan:
        """What the laser measures, with true classes."""
        along = float(self.along[int(name)])
        place, yaw = self.road.place(along)
        rotation = np.eye(3)
        rotation[:2, :2] = turned(yaw)
        origin = torch.tensor([*place, 1.73], dtype=torch.float64)
        rays = torch.from_numpy(self.rays @ rotation.T)
        distance, classes = self.road.cast(along, origin, rays)
        seen = distance < RANGE
        points = origin + distance[seen, None] * rays[seen]
        return Scan(
            name=name, points=points, origin=origin, labels={"semantic": classes[seen]},
            time=float(int(name)),
        )  # fmt: skip

    def views(self) -> tuple[View, ...]:
        """All views, without photographs."""
        made = []
        for i, along in enumerate(self.along):
            place, yaw = self.road.place(float(along))
            eye = [*place, 1.55]
            ahead = [place[0] + 14 * math.cos(yaw), place[1] + 14 * math.sin(yaw), 1.2]
            camera = look_at(eye, ahead, width=WIDTH, height=HEIGHT, field_of_view=90.0)
            made.append(View(name=f"{i:06d}", camera=camera))
        return tuple(made)

    def _classes(self, view: View) -> Tensor:
        """True classes of a view's pixels, -1 the sky."""
        origin, rays = view.camera.rays()
        _, classes = self.road.cast(float(self.along[int(view.name)]), origin, rays.reshape(-1, 3))
        return classes.reshape(view.camera.height, view.camera.width)


class Maker:
    """Makes the field of a block: what `splatseg street` does of a drive, in small."""

    def __init__(
        self, drive: DriveBlocks, capture: Capture, scans: DriveScans, road: Recorder
    ) -> None:
        self.drive, self.capture, self.scans, self.recorder = drive, capture, scans, road
        self.shapes: ShapeAutoEncoder = load_shapes()
        self.sphere = sphere_code(self.shapes)
        self.palette = torch.full((64, 3), 0.6)
        for row in STREET_CLASSES.rows:
            self.palette[row.id] = torch.tensor(row.colour or (128, 128, 128)) / 255
        self.made, self.most = 0, 0
        self.live: weakref.WeakSet[MeshField] = weakref.WeakSet()

    def __call__(self, block: DriveBlock) -> MeshField:
        own_views = block_views(self.capture.views, self.drive, block)
        views = [view for view in own_views if view.split == "train"]
        own = self.scans.of(block)
        start = voxel_primitives(
            scan_points(own, 0.25), shapes=self.shapes, sizes=(VOXEL,), sphere=self.sphere
        )
        cameras: Sequence[Camera] = [view.camera for view in views]
        fitted = fit_geometry(start, self.shapes, scan_views(own, cameras), options=GEOMETRY)
        mesh = fitted.primitives.mesh(self.shapes)
        with tempfile.TemporaryDirectory() as folder:
            for view in views:
                ids = self.recorder.classes(view).clamp_min(0).numpy().astype(np.uint8)
                Image.fromarray(ids).save(Path(folder) / f"{view.name}.png")
            trained = train_radiance(
                mesh,
                views,
                open_evidence(folder),
                ids=[row.id for row in STREET_CLASSES.rows],
                options=RADIANCE,
                read=lambda view: self.palette[self.recorder.classes(view).long()],
            )
        names = {row.id: row.name for row in STREET_CLASSES.rows}
        field = MeshField(mesh, trained.model, layer=LAYER, info=LayerInfo(names=names))
        self.live.add(field)
        self.made, self.most = self.made + 1, max(self.most, len(self.live))
        return field


def memory() -> tuple[float, float]:
    """Resident memory now and at most so far, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    now = pages * resource.getpagesize() / 2**20
    return now, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Parse the command line and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kilometres", type=float, default=20.0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write all rows here")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    length = 1000.0 * arguments.kilometres
    recorder = Recorder(Road(math.ceil(length / PIECE)), length)
    views = recorder.views()
    drive = cut_drive(frame_centres(views), options=DriveBlockOptions(reach=40.0))
    scans = DriveScans(recorder, drive)
    widest = max(max(b) - min(b) for b in map(scans.labelled_by, scans.scan_names) if b)
    if widest > MAX_WIDEST:
        raise SystemExit(f"the road comes back: a scan is labelled by blocks {widest} apart")
    print(
        f"{length / 1000:g} km, {len(views)} views, {len(views)} scans, {len(drive)} blocks; "
        f"{time.process_time():.0f} s of CPU to look at the scans, {memory()[0]:.0f} MiB",
        flush=True,
    )
    with tempfile.TemporaryDirectory() as folder:
        capture = Capture(path=Path(folder), format="generated", views=views)
        maker = Maker(drive, capture, scans, recorder)
        field = DriveField(drive, maker, max_open=1)
        rows = []
        hit = points = 0
        print("| km | blocks | MiB now | MiB at most | accuracy | s of CPU |")
        print("|" + " --- |" * 6)
        a_kilometre = int(1000 / STEP)
        for done, (name, labels) in enumerate(field.labels_of_scans(scans, LAYER), start=1):
            truth = recorder.scan(name).labels["semantic"]
            hit, points = hit + int((labels.ids == truth).sum()), points + len(truth)
            if done % a_kilometre == 0:
                now, most = memory()
                row = {
                    "km": done * STEP / 1000,
                    "blocks": maker.made,
                    "now": now,
                    "most": most,
                    "accuracy": hit / max(points, 1),
                    "cpu": time.process_time(),
                }
                rows.append(row)
                print(
                    f"| {row['km']:.1f} | {row['blocks']} | {now:.0f} | {most:.0f} | "
                    f"{row['accuracy']:.3f} | {row['cpu']:.0f} |",
                    flush=True,
                )
                hit = points = 0
    later = [row for row in rows if row["km"] > 2]
    if len(later) > 1:
        slope = {
            key: float(np.polyfit([r["km"] for r in later], [r[key] for r in later], 1)[0])
            for key in ("now", "most")
        }
        print(
            f"after 2 km: {slope['now']:+.2f} MiB a km now, {slope['most']:+.2f} at most; "
            f"{maker.most} field at once"
        )
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
