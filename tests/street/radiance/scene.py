"""A red ball before a green one under a blue sky, seen by small cameras, with label maps."""

from pathlib import Path

import torch

from splatseg.core import Camera, ClassInfo, ClassTable, LabelMap, View
from splatseg.io.evidence import Evidence, create_evidence, open_evidence, save_label_map
from splatseg.street.hits import MeshCaster
from splatseg.street.primitives import PrimitiveMesh
from splatseg.street.radiance import RadianceOptions
from splatseg.street.shapes import FACES, template

WIDTH, HEIGHT = 12, 8
RED, GREEN, SKY = 4, 7, 9
IDS = (RED, GREEN, SKY)
COLOURS = torch.tensor([[0.8, 0.2, 0.2], [0.2, 0.8, 0.2], [0.2, 0.2, 0.8]])

SMALL = RadianceOptions(
    max_hits=6,
    fine_hits=4,
    coarse_hits=2,
    sides="both",
    feature_size=4,
    width=16,
    depth=2,
    semantic_width=8,
    colour_widths=(8,),
    background_widths=(8,),
    rays=64,
    iterations=6,
)


def two_balls() -> PrimitiveMesh:
    """A fine ball of radius 1 at the origin, a coarse one of radius 2 behind it along z."""
    vertices, _ = template()
    moved = torch.cat((vertices, 2 * vertices + torch.tensor([1.0, 0, 4])))
    return PrimitiveMesh(vertices=moved, levels=torch.tensor([0, 1]), sizes=(0.5, 1.0))


def camera(number: int, *, width: int = WIDTH, height: int = HEIGHT) -> Camera:
    """In front of the balls, a little to the side of the last."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.3 * number, 0.1 * number, 5.0])
    return Camera(
        width=width,
        height=height,
        fx=float(width),
        fy=float(width),
        cx=width / 2,
        cy=height / 2,
        cam_from_world=pose,
    )


def views(count: int = 3) -> tuple[View, ...]:
    """Views without photographs: `photograph` is what they would show."""
    return tuple(View(name=f"view{i}", camera=camera(i)) for i in range(count))


def truth(view: View) -> torch.Tensor:
    """Column of the class at each pixel's centre."""
    origin, directions = view.camera.rays()
    hits = MeshCaster(two_balls()).hits(origin, directions.reshape(-1, 3), max_hits=1)
    first = hits.faces[:, 0]
    column = torch.where(first < 0, 2, first // FACES)
    return column.view(view.camera.height, view.camera.width)


def photograph(view: View) -> torch.Tensor:
    """Flat colours."""
    return COLOURS[truth(view)]


def labels(folder: Path, seen: tuple[View, ...], *, unknown: bool = False) -> Evidence:
    """Label maps of the truth; with `unknown` without any id."""
    rows = tuple(
        ClassInfo(id=id, name=name) for id, name in zip(IDS, ("red", "green", "sky"), strict=True)
    )
    create_evidence(folder, kind="labels", classes=ClassTable(rows=rows))
    for view in seen:
        ids = torch.tensor(IDS)[truth(view)]
        ids = torch.full_like(ids, -1) if unknown else ids
        save_label_map(LabelMap(ids=ids), folder, view.name)
    return open_evidence(folder)
