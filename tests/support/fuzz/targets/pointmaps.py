"""Recorded pointmaps: the list of photographs, and the maps of a pair."""

from pathlib import Path

import torch

from splatseg.core import Pointmap
from splatseg.io.pointmaps import HEADER_FILE, create_pointmaps, open_pointmaps
from support.fuzz.targets.base import HEIGHT, WIDTH, Target, target


def _recorded(folder: Path) -> Path:
    kept = create_pointmaps(
        folder / "maps", photographs=["a.png", "b.png"], metadata={"model": "m"}
    )
    points = torch.arange(3.0 * WIDTH * HEIGHT).reshape(HEIGHT, WIDTH, 3)
    one = Pointmap(points=points, confidence=torch.full((HEIGHT, WIDTH), 2.0))
    kept.save("a.png", "b.png", (one, one))
    return kept.folder


@target("pointmaps.json")
def header(folder: Path) -> Target:
    """The list, and the pairs that it goes with."""
    maps = _recorded(folder)
    return Target(file=maps / HEADER_FILE, read=lambda: open_pointmaps(maps).pairs)


@target("pointmaps.npz")
def pair(folder: Path) -> Target:
    """The maps of one pair."""
    maps = _recorded(folder)
    kept = open_pointmaps(maps)
    return Target(file=maps / "0000_0001.npz", read=lambda: kept.pointmaps("a.png", "b.png"))
