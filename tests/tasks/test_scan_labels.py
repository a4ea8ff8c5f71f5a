"""Labels of laser scans: by a field, by views of Gaussians, in the order of the scans' files."""

import json
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.core import Executor, Gaussians, Labels, LayerInfo, PointLabels, ScanSource, Scene
from splatseg.errors import InputError
from splatseg.io.captures import read_capture
from splatseg.io.scans import read_scans
from splatseg.lift.viewed_points import ViewedPointOptions
from splatseg.street.field import MeshField
from splatseg.tasks import ScanLabelOptions, label_scans, viewed_points
from support.analytic import BALL, FLOOR, BallOverFloor
from support.arrays import arrays_of
from support.elsewhere import Elsewhere
from support.mesh_fields import balls, told_field
from support.ply import write_ply


class Halves(BallOverFloor):
    """A field that labels points by their side, and says nothing far away."""

    layer_names = ("things",)

    def labels_at(self, points: torch.Tensor, layer: str) -> PointLabels:
        self.layer(layer)
        ids = torch.where(points[:, 1] > 0, BALL, FLOOR).int()
        far = points[:, 0] > 20
        return PointLabels(ids=torch.where(far, -1, ids).int(), confidence=torch.ones(len(ids)))


class AtOnce(Halves):
    """One that labels many scans in a way of its own."""

    def labels_of_scans(
        self, scans: ScanSource, layer: str, *, executor: Executor
    ) -> Iterator[tuple[str, PointLabels]]:
        for name in scans.scan_names:
            count = len(scans.scan(name))
            yield name, PointLabels(ids=torch.full((count,), 3), confidence=torch.ones(count))


def nothing() -> Gaussians:
    return Gaussians(
        means=torch.zeros(0, 3), rotations=torch.zeros(0, 4), scales=torch.zeros(0, 3),
        opacities=torch.zeros(0), sh=torch.zeros(0, 1, 3),
    )  # fmt: skip


@pytest.fixture
def scene(generated_drive) -> Scene:
    """Views of the drive, and no Gaussians."""
    capture = read_capture(generated_drive)
    return Scene(
        gaussians=nothing(), views=capture.views, classes=capture.classes, up=capture.up,
        metres_per_unit=capture.metres_per_unit, source=capture.path,
    )  # fmt: skip


@pytest.fixture
def labelled(scene, generated_drive) -> tuple[Scene, Labels]:
    """Gaussians where the lasers hit something, with their true labels."""
    scans = read_scans(generated_drive)
    found = [scans.scan(name) for name in scans.scan_names]
    means = torch.cat([scan.points for scan in found]).float()
    ids = torch.cat([scan.labels["semantic"] for scan in found])
    rotations = torch.zeros(len(means), 4)
    rotations[:, 0] = 1
    gaussians = Gaussians(
        means=means, rotations=rotations, scales=torch.full((len(means), 3), 0.15),
        opacities=torch.full((len(means),), 0.9), sh=torch.zeros(len(means), 1, 3),
    )  # fmt: skip
    names = {row.id: row.name for row in scene.classes.rows}
    layer = Labels(
        ids=ids.int(), confidence=torch.ones(len(ids)), info=LayerInfo(names=names, method="truth")
    )
    return replace(scene, gaussians=gaussians), layer


def test_a_field_labels_range_images_in_their_shape(scene, generated_drive, tmp_path) -> None:
    made = label_scans(scene, generated_drive, tmp_path / "out", field=Halves())
    assert (made.form, made.layer) == ("npz", "things")
    truth = arrays_of(generated_drive / "lidar.npz")
    with np.load(tmp_path / "out/labels.npz") as found:
        semantic, confidence = found["semantic"], found["confidence"]
    assert semantic.shape == truth["range_2mm"].shape
    nothing_came = truth["range_2mm"] == 0
    assert (semantic[nothing_came] == 0).all()
    assert (confidence[nothing_came] == 0).all()
    scans = read_scans(generated_drive)
    points = scans.scan("0001").points
    said = semantic[1][~nothing_came[1]]
    want = torch.where(points[:, 1] > 0, BALL, FLOOR)
    want[points[:, 0] > 20] = 0
    np.testing.assert_array_equal(said, want.numpy())
    record = json.loads((tmp_path / "out/labels.json").read_text())
    total = sum(len(scans.scan(name)) for name in scans.scan_names)
    assert record["points"] == made.counts.points == total
    assert record["unlabelled"] == int(((semantic == 0) & ~nothing_came).sum()) > 0
    assert record["names"] == {str(FLOOR): "floor", str(BALL): "ball"}
    assert record["points_by_id"][str(BALL)] == int((semantic == BALL).sum())


def test_labels_say_which_vertices_were_asked(scene, generated_drive, tmp_path) -> None:
    """And points that have none of them around are undefined, counted and written as 0."""
    points = read_scans(generated_drive).scan("0001").points
    near = points[points.norm(dim=1).argmin()]
    bare = told_field(balls([near.tolist()], radius=0.3), [0])
    seen = torch.zeros(len(bare.mesh.vertices))
    for rule, labelled in (("adjusted", 0), ("weighed", 1), ("all", 1)):
        field = MeshField(bare.mesh, bare.model, seen=seen, vertex_rule=rule)
        made = label_scans(scene, generated_drive, tmp_path / rule, field=field)
        record = json.loads((tmp_path / rule / "labels.json").read_text())
        assert record["vertex_rule"] == made.vertex_rule == rule
        assert (made.counts.unlabelled < made.counts.points) == bool(labelled)
        assert record["unlabelled"] == made.counts.unlabelled
    viewed = label_scans(
        scene, generated_drive, tmp_path / "views", field=viewed_points(scene, bare)
    )
    assert viewed.vertex_rule is None
    assert json.loads((tmp_path / "views/labels.json").read_text())["vertex_rule"] is None


def test_a_field_may_label_all_scans_in_its_own_way(scene, generated_drive, tmp_path) -> None:
    made = label_scans(scene, generated_drive, tmp_path / "out", field=AtOnce())
    assert made.counts.ids == {3: made.counts.points}


@pytest.mark.parametrize("by", ["gaussians", "mesh", "vertices"])
def test_scans_that_are_labelled_elsewhere_have_the_same_bytes(
    labelled, generated_drive, tmp_path, by
) -> None:
    scene, layer = labelled
    given: dict[str, object] = {"backend": "cpu"}
    if by == "gaussians":
        given |= {"layers": {"classes": layer}, "points": ViewedPointOptions(window=1)}
    else:
        points = read_scans(generated_drive).scan("0001").points
        field = told_field(balls([points[0].tolist()], radius=0.3), [0])
        options = ViewedPointOptions(window=1)
        given["field"] = field if by == "vertices" else viewed_points(scene, field, options=options)
    label_scans(scene, generated_drive, tmp_path / "here", **given)
    executor = Elsewhere()
    label_scans(scene, generated_drive, tmp_path / "there", executor=executor, **given)
    scans = list(read_scans(generated_drive).scan_names)
    # Windows are asked twice, once for what shapes are learnt from.
    numbers = list(range(len(scans)))
    assert executor.items == (scans if by == "vertices" else numbers * 2)
    for name in ("labels.npz", "labels.json"):
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "there" / name).read_bytes()


def test_gaussians_label_points_by_what_views_show(labelled, generated_drive, tmp_path) -> None:
    scene, layer = labelled
    plain = ViewedPointOptions(shapes=False, smoothing_steps=0)
    made = label_scans(
        scene, generated_drive, tmp_path / "out", layers={"classes": layer}, points=plain,
        backend="cpu",
    )  # fmt: skip
    assert made.layer == "classes"
    with np.load(tmp_path / "out/labels.npz") as found:
        semantic = found["semantic"]
    truth = arrays_of(generated_drive / "lidar.npz")["semantic"]
    said = (semantic > 0) & (truth > 0)
    assert said.mean() > 0.2
    assert (semantic[said] == truth[said]).mean() > 0.8
    assert made.counts.unlabelled == int(((semantic == 0) & (truth > 0)).sum())
    # What is shaped alike is called alike: nothing is left out, and options count.
    again = label_scans(
        scene, generated_drive, tmp_path / "more", layers={"classes": layer}, backend="cpu",
        points=ViewedPointOptions(window=64),
    )  # fmt: skip
    assert again.counts.unlabelled == 0 < made.counts.unlabelled


def test_the_form_is_that_of_the_scans_unless_one_is_asked_for(scene, tmp_path) -> None:
    columns = [("double", axis, [1.0, 2.0]) for axis in "xyz"]
    write_ply({"vertex": columns}, tmp_path / "cloud.ply")
    made = label_scans(scene, tmp_path / "cloud.ply", tmp_path / "out", field=Halves())
    assert made.form == "ply"
    assert (tmp_path / "out/cloud.ply").is_file()
    made = label_scans(
        scene, tmp_path / "cloud.ply", tmp_path / "out", field=Halves(),
        options=ScanLabelOptions(form="label"),
    )  # fmt: skip
    assert (tmp_path / "out/cloud.label").read_bytes() == np.array([BALL] * 2, "<u4").tobytes()
    with pytest.raises(InputError, match="expected .*las"):
        label_scans(
            scene, tmp_path / "cloud.ply", tmp_path / "las", field=Halves(),
            options=ScanLabelOptions(scan_format="las"),
        )  # fmt: skip
    with pytest.raises(InputError, match="^form: expected one of"):
        ScanLabelOptions(form="txt")  # pyright: ignore[reportArgumentType]


def test_what_is_refused(labelled, scene, generated_drive, tmp_path) -> None:
    out = tmp_path / "out"
    with pytest.raises(InputError, match=r"^by: expected mesh for a scene without Gaussians"):
        label_scans(scene, generated_drive, out, layers={"a": labelled[1]})
    with pytest.raises(InputError, match=r"^layer: expected a name, the scene has no folder"):
        label_scans(scene, generated_drive, out)
    two = {"a": labelled[1], "b": labelled[1]}
    with pytest.raises(InputError, match=r"^layer: expected the name .* several \(a, b\)"):
        label_scans(labelled[0], generated_drive, out, layers=two)
    with pytest.raises(InputError, match=r"^layer: expected labels, 'marks' holds features"):
        label_scans(
            scene, generated_drive, out, field=BallOverFloor(),
            options=ScanLabelOptions(layer="marks"),
        )  # fmt: skip
    with pytest.raises(InputError, match="^points: expected none with a field"):
        label_scans(scene, generated_drive, out, field=Halves(), points=ViewedPointOptions())
    with pytest.raises(InputError, match="there is no such folder or file of scans"):
        label_scans(scene, tmp_path / "none", out, field=Halves())
    assert not out.exists()


def test_damaged_scans_leave_nothing_behind(scene, generated_drive, tmp_path) -> None:
    with np.load(generated_drive / "lidar.npz") as found:
        arrays = dict(found)
    ranges = arrays.pop("range_2mm").astype(np.float32) * 0.002
    ranges[1, 3, 5] = np.nan
    np.savez(tmp_path / "lidar.npz", range=ranges, **arrays)
    with pytest.raises(InputError, match=r"scan 1: expected finite positions, got 1 of"):
        label_scans(scene, tmp_path, tmp_path / "out", field=Halves())
    assert not (tmp_path / "out").exists()
