"""Time and peak memory of lifting, each part in a process of its own.

    python benchmarks/lift.py [features | masks | labels] [--views N] [--gaussians N] [--ids N]
    python benchmarks/lift.py nested SCENE EVIDENCE [--views N]

`features`: 64-d features of 100 views at 512x384 onto 200 000 Gaussians; cells of 16 pixels,
read between their centres. Goal: under 60 s and 2 GB on two cores.
`labels`: label maps with 500 ids in each of 1 000 views and other ids in each view, 500 000 ids
in all, into the table of slots. Goal: under 3 GB.
`masks`: 500 overlapping masks of each of 1 000 views, each a disc or a union of stripes, onto the
Gaussians. Goal: under 3 GB.
`nested`: association of masks that lie in each other, of a fitted scene and a folder of evidence of
its training views. Goals: `masks_nested` of `toys` (80
views, 160 masks each) under 2 GB and 60 s of CPU, `classical` masks of `replica_office0` (157
views, 119 masks each) under 4 GB and 240 s.

Other evidence is made when it is asked for and kept nowhere, so what is measured is the lifting.
Memory is the peak of the whole process.
"""

import argparse
import math
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
from memory import room

from splatseg.core import Camera, FeatureMap, LabelMap, MaskSet, Rle, View
from splatseg.io.evidence import open_evidence
from splatseg.io.scene import load_scene
from splatseg.lift import UpliftOptions, uplift
from splatseg.lift.segments import EvidenceSegments
from splatseg.lift.voting.features import uplift_features
from splatseg.lift.voting.segment_masses import view_masses
from splatseg.methods.associate import associate
from splatseg.render.cpu import threads

WIDTH, HEIGHT = 512, 384
GAUSSIANS, IDS = 200_000, 500
"""On which, and masks of a view: by default."""


def camera(index: int) -> Camera:
    """From a round through the middle of the room, outwards, 61 degrees further each time."""
    angle = math.radians(61 * index)
    eye = np.array([3 + math.cos(angle), 2.5 + math.sin(angle), 1.4])
    z = np.array([math.cos(angle), math.sin(angle), -0.1 * math.cos(index)])
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0, 1])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return Camera(
        width=WIDTH, height=HEIGHT, fx=333, fy=333, cx=WIDTH / 2, cy=HEIGHT / 2,
        cam_from_world=torch.from_numpy(pose),
    )  # fmt: skip


class Made:
    """Gaussians, and evidence that is made when it is asked for.

    Args:
        views: Of the views.
        gaussians: On the walls of a room.
        ids: Masks, or patches, of each view.
    """

    def __init__(self, views: int, gaussians: int, ids: int) -> None:
        self.count, self.ids = gaussians, ids
        self.views = [View(name=f"view_{i:04d}", camera=camera(i)) for i in range(views)]
        self.view_names = tuple(view.name for view in self.views)
        self._coarse = math.ceil(math.sqrt(ids))

    def features(self, name: str) -> FeatureMap:
        """64 channels in cells of 16 pixels."""
        rng = np.random.default_rng(int(name[-4:]))
        values = rng.normal(size=(HEIGHT // 16, WIDTH // 16, 64)).astype(np.float32)
        return FeatureMap(features=torch.from_numpy(values), stride=16, height=HEIGHT, width=WIDTH)

    def label_map(self, name: str) -> LabelMap:
        """Patches, whose ids are used in no other view."""
        rows = torch.arange(HEIGHT) * self._coarse // HEIGHT
        columns = torch.arange(WIDTH) * self._coarse // WIDTH
        patch = (rows[:, None] * self._coarse + columns[None]) % self.ids
        return LabelMap(ids=patch + 1 + self.ids * int(name[-4:]))

    def masks(self, name: str) -> MaskSet:
        """Discs of 1 to 60 pixels radius; each covers a hundredth of the image on average."""
        rng = np.random.default_rng(int(name[-4:]))
        y, x = np.mgrid[:HEIGHT, :WIDTH]
        masks: list[Rle] = []
        for _ in range(self.ids):
            u, v, radius = rng.random() * WIDTH, rng.random() * HEIGHT, 60 * rng.random() ** 2 + 1
            masks.append(Rle.encode(torch.from_numpy((x - u) ** 2 + (y - v) ** 2 < radius**2)))
        return MaskSet(
            height=HEIGHT, width=WIDTH, masks=tuple(masks),
            scores=torch.ones(self.ids), levels=torch.zeros(self.ids, dtype=torch.int32),
        )  # fmt: skip


def features(made: Made) -> str:
    """64-d features."""
    found = uplift_features(room(made.count, 0), made.views, made)
    seen = int((found.weights > 0).sum())
    return f"{found.values.shape[1]}-d features onto {made.count} Gaussians, {seen} seen"


def labels(made: Made) -> str:
    """More ids than any table holds."""
    options = UpliftOptions(table_memory=1 << 28, candidates=4)
    found = uplift(room(made.count, 0), made.views, made, options=options)
    seen = int((found.ids >= 0).sum())
    return f"{made.ids * len(made.views)} ids onto {made.count} Gaussians, {seen} labelled"


def masks(made: Made) -> str:
    """Overlapping masks, one view after the other."""
    gaussians, entries = room(made.count, 0), 0
    for view in made.views:
        entries += len(view_masses(gaussians, view.camera, made.masks(view.name)).weight)
    return f"{made.ids * len(made.views)} masks, {entries} masses on {made.count} Gaussians"


def nested(scene: Path, evidence: Path, views: int | None) -> str:
    """Segments of all views, and the instances that they make."""
    loaded = load_scene(scene)
    gaussians, train = loaded.gaussians, loaded.train_views[:views]
    segments = EvidenceSegments(evidence=open_evidence(evidence))
    read: list[float] = []
    wall, cpu = time.perf_counter(), time.process_time()
    labels = associate(
        gaussians, train, segments, progress=lambda done, total: read.append(time.process_time())
    )
    wall, done = time.perf_counter() - wall, time.process_time()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    account = labels.info.details["associate"]
    return (
        f"nested: {len(train)} views, {account['segments']} masks onto {len(gaussians)} Gaussians, "
        f"{account['instances']} instances: {wall:.1f} s ({done - cpu:.1f} s of CPU, of which "
        f"{read[-1] - cpu:.1f} s for the masses of masks, {threads()} threads), peak {peak:.2f} GB"
    )


PARTS = {"features": (features, 100), "labels": (labels, 1000), "masks": (masks, 1000)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", nargs="?", choices=[*PARTS, "nested"])
    parser.add_argument("scene", nargs="?", type=Path)
    parser.add_argument("evidence", nargs="?", type=Path)
    parser.add_argument("--views", type=int)
    parser.add_argument("--gaussians", type=int, default=GAUSSIANS)
    parser.add_argument("--ids", type=int, default=IDS)
    args = parser.parse_args()
    if (args.part == "nested") != (args.scene is not None) or bool(args.scene) != bool(
        args.evidence
    ):
        parser.error("nested takes a scene and a folder of evidence, the others take none")
    if args.part == "nested":
        print(nested(args.scene, args.evidence, args.views))
        return
    if args.part is None:
        for part in PARTS:
            subprocess.run([sys.executable, __file__, part, *sys.argv[1:]], check=True)
        return
    measure, usual = PARTS[args.part]
    made = Made(args.views or usual, args.gaussians, args.ids)
    started, worked = time.perf_counter(), time.process_time()
    what = measure(made)
    wall, cpu = time.perf_counter() - started, time.process_time() - worked
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"{args.part}: {len(made.views)} views at {WIDTH}x{HEIGHT}, {what}: {wall:.1f} s "
        f"({cpu:.1f} s of CPU, {threads()} threads), peak {peak:.2f} GB"
    )


if __name__ == "__main__":
    main()
