"""The page of a drive: of a field that was made, of blocks, and of points that were labelled."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Camera, ClassInfo, ClassTable, LayerInfo, RenderableLayer, Scene, View
from splatseg.errors import InputError
from splatseg.io.scans import read_scans
from splatseg.report.maps import LabelledPoints
from splatseg.report.words import spread
from splatseg.street.build import DnmpOptions
from splatseg.street.field import MeshField
from splatseg.tasks import ScanLabelOptions, StreetOptions, label_scans, open_drive, street_field
from splatseg.tasks.street_report import (
    LabelledScans,
    point_scores,
    report_street,
    true_ids,
    visibility_of_points,
)
from support.analytic import BallOverFloor
from support.mesh_fields import balls, told_field

QUICK = DnmpOptions(voxels=(2.0, 4.0), geometry_iterations=4, iterations=3, rays=64)


@pytest.fixture(scope="module")
def drive(generated_drive, tmp_path_factory) -> Scene:
    return open_drive(generated_drive, new_scene=tmp_path_factory.mktemp("drive") / "scene")


@pytest.fixture(scope="module")
def made(drive, generated_drive):
    options = StreetOptions(evidence="labels_semantic", scans=generated_drive, layer="classes")
    return street_field(drive, options=options, field_options=QUICK)


@pytest.fixture
def scene(drive, tmp_path) -> Scene:
    """Its scene in a folder of the test."""
    return replace(drive, root=Path(shutil.copytree(drive.root, tmp_path / "scene")))


def test_a_field_and_its_points(made, scene, generated_drive, tmp_path) -> None:
    kept = LabelledPoints()
    labels = label_scans(
        scene, generated_drive, tmp_path / "labels", field=made.field,
        seen=lambda scan, found: kept.add(scan.points, found.ids),
    )  # fmt: skip
    assert len(kept.ids) == labels.counts.points
    assert int((kept.ids < 0).sum()) == labels.counts.unlabelled
    path = report_street(
        scene, made.field, layer="classes", made=made, command="splatseg street x --report",
        scans=LabelledScans(made=labels, by="mesh", points=kept),
    )  # fmt: skip
    assert path == scene.root / "reports/street.html"
    page = path.read_text()
    for words in (
        "Training views", "Labelled points from above", "Points by class", "Primitives",
        "Error of depth", "How it went", "Squared error of colours", "road",
        "splatseg street x", "points of scans",
    ):  # fmt: skip
        assert words in page, words
    record = json.loads((scene.root / "reports/street.json").read_text())
    assert record["field"] == "street"
    assert [row["kept"] for row in record["levels"]] == made.facts["primitives_by_level"]
    assert [row["side"] for row in record["levels"]] == [2.0, 4.0]
    assert all(row["started"] >= row["kept"] > 0 for row in record["levels"])
    assert record["depth_error"]["last"] < record["depth_error"]["first"]
    assert set(record["psnr"]) <= {view.name for view in scene.train_views}
    assert len(record["psnr"]) == min(4, len(scene.train_views))
    assert record["points"]["points"] == labels.counts.points
    assert record["training"][-1]["iteration"] == 3


def test_points_are_scored_apart_by_whether_a_camera_saw_them() -> None:
    """Two classes; the seen points are right but for one without a label, the unseen are wrong."""
    ids = torch.tensor([1, 1, 2, -1, 1, 1, -1])
    truth = torch.tensor([1, 1, 2, 2, 2, 2, -1])
    seen = torch.tensor([True, True, True, True, False, False, True])
    whole, near, far = point_scores(ids, truth, seen)
    assert (whole.points, whole.count, near.count, far.count) == ("all", 6, 4, 2)
    assert near.miou == pytest.approx((1 + 1 / 2) / 2)
    assert whole.miou == pytest.approx((2 / 4 + 1 / 4) / 2)
    assert (far.miou, far.accuracy, far.undefined) == (0.0, 0.0, 0.0)
    assert (near.undefined, near.accuracy) == (0.25, 0.75)
    assert whole.undefined == pytest.approx(1 / 6)
    none = point_scores(ids, truth, torch.ones(7, dtype=torch.bool))[2]
    assert (none.count, none.miou, none.undefined) == (0, None, None)


def test_whose_views_and_depth_say_what_was_seen(made, scene, tmp_path) -> None:
    """Maps of the capture where all views have one, else the field; only views it learned from."""
    cloud = torch.tensor([[0.0, 0, 3.0], [0, 0, 3.05], [0, 0, 9.0]], dtype=torch.float64)
    view = replace(scene.train_views[0], camera=camera(0.0))
    steps = np.full((30, 40), 3000, np.uint16)
    Image.fromarray(steps).save(tmp_path / "a.png")
    mapped = replace(view, depth=tmp_path / "a.png", depth_unit=0.001)
    other = replace(scene.train_views[1], camera=camera(0.0), depth=None)
    known = replace(scene, views=(mapped, other))
    field = balls_field(views=(mapped.name,))
    seen, whose = visibility_of_points(known, field, "semantic", cloud)
    assert (seen.tolist(), whose) == ([True, True, False], "the capture's depth maps")
    field = balls_field(views=(mapped.name, other.name))
    seen, whose = visibility_of_points(known, field, "semantic", cloud)
    assert whose == "the depth that the field shows"
    assert seen.tolist() == [False, False, False], "its ball stands before them"


def test_true_classes_are_matched_by_name() -> None:
    table = ClassTable(rows=tuple(ClassInfo(id=i, name=n) for i, n in ((4, "sign"), (5, "tram"))))
    layer = RenderableLayer(ids=(1, 9), info=LayerInfo(names={1: "road", 9: "traffic sign"}))
    truth = torch.tensor([4, 5, -1])
    assert true_ids(truth, table, layer).tolist() == [9, -1, -1]
    assert true_ids(truth, None, layer).tolist() == [4, 5, -1]


def balls_field(*, views: tuple[str, ...]) -> MeshField:
    """A ball one before a camera at the origin."""
    field = told_field(balls([[0, 0, 1]]), [0])
    return field.with_layer(info=LayerInfo(views=views))


def test_a_field_that_was_there(made, scene) -> None:
    path = report_street(scene, made.field, layer="classes", name="other")
    record = json.loads(path.with_suffix(".json").read_text())
    assert path.name == "other.html"
    assert (record["field"], record["levels"], record["depth_error"]) == (None, [], None)
    assert record["psnr"]


def test_views_without_photographs_are_not_shown(made, scene) -> None:
    bare = replace(scene, views=tuple(replace(view, image=None) for view in scene.views))
    path = report_street(bare, made.field, layer="classes", made=made)
    assert "Training views" not in path.read_text()
    assert json.loads(path.with_suffix(".json").read_text())["psnr"] == {}


def test_what_cannot_be_told(made, scene) -> None:
    with pytest.raises(InputError, match="scene: expected one with a folder"):
        report_street(replace(scene, root=None), made.field, layer="classes")
    with pytest.raises(InputError, match="layer: expected classes"):
        report_street(scene, made.field, layer="other")


def test_a_scan_is_told_once_and_labels_are_the_same(scene, generated_drive, tmp_path) -> None:
    field = BallOverFloor()
    asked = ScanLabelOptions(layer=field.layer_names[0])
    told: list[str] = []
    label_scans(
        scene, generated_drive, tmp_path / "a", field=field, options=asked,
        seen=lambda scan, _: told.append(scan.name),
    )  # fmt: skip
    label_scans(scene, generated_drive, tmp_path / "b", field=field, options=asked)
    assert told == list(read_scans(generated_drive).scan_names)
    for path in (tmp_path / "a").glob("*.npz"):
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def camera(x: float) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(width=40, height=30, fx=40.0, fy=40.0, cx=20, cy=15, cam_from_world=pose)


def test_views_are_spread() -> None:
    views = [View(name=str(i), camera=camera(i)) for i in range(10)]
    assert [view.name for view in spread(views, 4)] == ["0", "2", "5", "7"]
    assert len(spread(views[:2], 4)) == 2
    assert spread([], 4) == ()
