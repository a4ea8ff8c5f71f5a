"""Scans as depth maps and start points of a fit: the way from a file to the record of a scene."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.cli.fit import Command, _options
from splatseg.core import PointCloud, Scan
from splatseg.errors import InputError
from splatseg.fit import FitOptions
from splatseg.io.captures import read_capture
from splatseg.io.depths import load_depth
from splatseg.io.scene import load_scene
from splatseg.tasks import MakeSceneOptions, fit_capture
from splatseg.tasks.photographs import EVIDENCE, with_scans

FEW = FitOptions(minutes=None, steps=3, max_gaussians=500, prune_floaters=False)


@dataclass
class Scans:
    """Scans in memory."""

    points: Mapping[str, torch.Tensor]

    @property
    def scan_names(self):
        return tuple(self.points)

    def scan(self, name: str) -> Scan:
        return Scan(name=name, points=self.points[name])


@pytest.fixture(scope="module")
def walls(small_room: Path) -> torch.Tensor:
    """What the first training view's depth map shows, as a laser would: points of the world."""
    view = read_capture(small_room).train_views[0]
    steps = np.array(Image.open(small_room / "depth" / f"{view.name}.png"), np.float32)
    depth = torch.from_numpy(steps * 0.001)
    small = view.camera.resized(depth.shape[1], depth.shape[0])
    row, column = torch.nonzero(depth > 0.3, as_tuple=True)
    pixels = torch.stack((column, row), dim=1).double() + 0.5
    return small.unproject(pixels, depth[row, column].double())


def test_views_get_depths_and_the_capture_points(small_room, walls, tmp_path) -> None:
    given = read_capture(small_room)
    told: list[str] = []
    found = with_scans(given, Scans({"0": walls}), scene=tmp_path, report=told.append)
    first = found.train_views[0]
    assert first.depth == tmp_path / "evidence" / EVIDENCE / f"{first.name}.npz"
    known = load_depth(first)
    assert float((known > 0).double().mean()) > 0.1
    column = known[known > 0]
    z = first.camera.project(walls)[1]
    assert float(z.min()) - 0.01 <= float(column.min()) <= float(column.max()) <= z.max() + 0.01
    assert all(view.depth == given.view(view.name).depth for view in found.test_views)
    assert given.points is not None
    assert found.points is not None
    assert len(found.points) > len(given.points)
    assert torch.equal(found.points.points[: len(given.points)], given.points.points.float())
    new = found.points.points[len(given.points) :]
    nearest = torch.cdist(new[:50].double(), walls).min(dim=1).values
    assert float(nearest.median()) < 0.15
    assert "give" in told[0]


def test_cells_and_units_count(small_room, walls, tmp_path, monkeypatch) -> None:
    given = replace(read_capture(small_room), points=None)
    counts = []
    for cell in (0.12, 0.6):
        monkeypatch.setattr("splatseg.tasks.photographs._START_CELL", cell)
        found = with_scans(given, Scans({"0": walls}), scene=tmp_path, report=lambda _: None)
        assert found.points is not None
        counts.append(len(found.points))
    assert counts[1] < counts[0] / 4
    # A unit of two metres: maps are in metres, and come back in scene units.
    double = replace(given, metres_per_unit=2.0)
    found = with_scans(double, Scans({"0": walls}), scene=tmp_path, report=lambda _: None)
    assert found.train_views[0].depth_unit == 0.5
    z = found.train_views[0].camera.project(walls)[1]
    assert float(load_depth(found.train_views[0]).max()) <= float(z.max()) + 0.02


def test_points_without_colour_are_grey(small_room, walls, tmp_path) -> None:
    given = read_capture(small_room)
    plain = replace(given, points=PointCloud(points=torch.zeros(2, 3)))
    found = with_scans(plain, Scans({"0": walls}), scene=tmp_path, report=lambda _: None)
    assert found.points is not None
    assert found.points.colours is not None
    assert found.points.colours[:2].tolist() == [[128] * 3] * 2


def test_scans_of_elsewhere_are_refused(small_room, walls, tmp_path) -> None:
    given = read_capture(small_room)
    with pytest.raises(InputError, match=r"training views see, found none; are they in the world"):
        with_scans(given, Scans({"0": walls + 1e4}), scene=tmp_path, report=lambda _: None)


def test_a_fit_starts_at_scans_and_records_them(small_room, walls, tmp_path) -> None:
    np.savez(tmp_path / "scan.npz", points=walls.numpy())
    options = MakeSceneOptions(scans=tmp_path / "scan.npz")
    made = fit_capture(
        small_room, tmp_path / "scene", options=options, backend="cpu",
        fit_options=replace(FEW, depth="metric"),
    )  # fmt: skip
    scene = load_scene(made.folder)
    assert scene.provenance["scans"] == str(tmp_path / "scan.npz")
    depth = scene.train_views[0].depth
    assert depth is not None
    assert depth.parent.name == EVIDENCE
    assert depth.is_file()
    for words, fit_options in (
        ("depth: expected metric with scans, got off", FEW),
        ("depth_evidence: expected none with scans", replace(FEW, depth="metric")),
    ):
        asked = replace(options, depth_evidence="far" if "evidence" in words else None)
        if asked.depth_evidence is not None:
            asked = replace(asked, depth_evidence=str(depth.parent))
        with pytest.raises(InputError, match=words):
            fit_capture(
                small_room, tmp_path / "other", options=asked, backend="cpu",
                fit_options=fit_options,
            )  # fmt: skip


def test_the_flag_turns_depth_on() -> None:
    plain = Command(data=Path("d"), output=Path("o"))
    command = replace(plain, capture=replace(plain.capture, scans=Path("d")))
    assert _options(command).depth == "metric"
    assert _options(plain).depth == "off"
    assert _options(replace(command, depth="relative")).depth == "relative"
