"""Scans, labelled surfaces, and boxes of moving things."""

import math

import pytest
import torch

from splatseg.core import Camera, LabelledMesh, LabelledPoints
from splatseg.core.scans import MovingBox, Scan, boxes_at, inside_boxes, pixels_of_boxes
from splatseg.core.scene import frame_number
from splatseg.errors import InputError, RangeError, ShapeError

POINTS = torch.eye(3)


def test_positions_are_double_and_labels_have_32_bits() -> None:
    scan = Scan(
        name="a",
        points=POINTS,
        origin=torch.zeros(3),
        intensity=torch.ones(3, dtype=torch.float64),
        labels={"semantic": torch.tensor([1, -1, 2])},
    )
    assert scan.points.dtype == torch.float64
    assert scan.origin is not None
    assert scan.origin.dtype == torch.float64
    assert scan.intensity is not None
    assert scan.intensity.dtype == torch.float32
    assert scan.labels["semantic"].dtype == torch.int32
    assert repr(scan) == "Scan('a', 3 points, labels: semantic)"


def test_labels_go_back_into_the_order_of_the_file() -> None:
    scan = Scan(name="a", points=POINTS, rows=torch.tensor([1, 2, 4]), recorded=6)
    assert scan.recorded_labels(torch.tensor([7, 8, 9])).tolist() == [-1, 7, 8, -1, 9, -1]
    assert scan.recorded_labels(torch.tensor([7, 8, 9]), missing=0).tolist() == [0, 7, 8, 0, 9, 0]
    whole = Scan(name="a", points=POINTS)
    assert whole.recorded_labels(torch.tensor([7, 8, 9])).tolist() == [7, 8, 9]
    with pytest.raises(ShapeError, match="ids"):
        scan.recorded_labels(torch.tensor([7]))


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"points": POINTS * math.nan}, RangeError, "points: .* not finite"),
        ({"points": POINTS[:, :2]}, ShapeError, "points: expected shape"),
        ({"origin": torch.zeros(2)}, ShapeError, "origin"),
        ({"origin": torch.full((3,), math.inf)}, RangeError, "origin"),
        ({"intensity": torch.zeros(2)}, ShapeError, "intensity"),
        ({"rows": torch.zeros(2)}, ShapeError, "rows"),
        ({"labels": {"a": torch.tensor([1, 2])}}, ShapeError, r"labels\['a'\]"),
        ({"labels": {"a": torch.tensor([1, 2, -2])}}, RangeError, "ids from -1"),
    ],
)
def test_refusals(change, error, words) -> None:
    with pytest.raises(error, match=words):
        Scan(**{"name": "a", "points": POINTS, **change})


# Boxes around moving things, solved by hand.


UPRIGHT = (1.0, 0.0, 0.0, 0.0)
QUARTER = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
"""A quarter turn about z: the box's x is the world's y."""


def box(centre=(0.0, 0, 0), size=(4.0, 2, 1), rotation=UPRIGHT, **rest) -> MovingBox:
    return MovingBox(centre=torch.tensor(centre), size=size, rotation=rotation, **rest)


def camera(**rest) -> Camera:
    """Ten pixels a unit at depth 1; the ray of pixel (column, row) is ((c - 4.5) / 10, ...)."""
    values = {"width": 10, "height": 8, "fx": 10, "fy": 10, "cx": 5, "cy": 4}
    return Camera(**(values | {"cam_from_world": torch.eye(4)} | rest))


def test_points_in_a_box_with_its_faces():
    points = torch.tensor(
        [[2.0, 1, 0.5], [2.01, 0, 0], [-1.9, -0.9, 0.4], [0, 1.1, 0], [0, 0, 0.6]]
    )
    assert inside_boxes(points, [box()]).tolist() == [True, False, True, False, False]
    assert inside_boxes(points, [box()], margin=0.11).tolist() == [True] * 5
    assert inside_boxes(points, []).tolist() == [False] * 5


def test_a_turned_box_is_long_along_y():
    points = torch.tensor([[0.0, 1.9, 0], [1.9, 0, 0], [0, -1.9, 0]])
    assert inside_boxes(points, [box(rotation=QUARTER)]).tolist() == [True, False, True]
    eighth = (math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8))
    ahead = torch.tensor([[1.3, 1.3, 0], [1.3, -1.3, 0]])
    assert inside_boxes(ahead, [box(rotation=eighth)]).tolist() == [True, False]


def test_points_in_any_of_many_boxes():
    points = torch.tensor([[0.0, 0, 0], [10, 0, 0], [5, 0, 0]])
    both = [box(), box(centre=(10.0, 0, 0))]
    assert inside_boxes(points, both).tolist() == [True, True, False]


def test_a_box_is_there_in_its_span():
    boxes = [box(start=1.0, end=2.0, name="a"), box(start=2.0, end=3.0, name="b"), box(name="c")]
    found = {t: "".join(b.name for b in boxes_at(boxes, t)) for t in (0.9, 1.0, 2.0, 3.0, 3.1)}
    assert found == {0.9: "c", 1.0: "ac", 2.0: "abc", 3.0: "bc", 3.1: "c"}
    with pytest.raises(RangeError, match="time"):
        boxes_at(boxes, math.nan)


def test_pixels_of_a_box_before_the_camera():
    """A box from z = 10 to 12 spans x from -2 to 2 at its front: rays up to |x / z| = 0.2."""
    shown = pixels_of_boxes(camera(), [box(centre=(0.0, 0, 11), size=(4.0, 2.0, 2.0))])
    # Rays of columns are at -0.45, -0.35, ..., 0.45; of rows at -0.35, ..., 0.35.
    expected = torch.zeros(8, 10, dtype=torch.bool)
    expected[3:5, 3:7] = True
    assert torch.equal(shown, expected)
    wider = pixels_of_boxes(camera(), [box(centre=(0.0, 0, 11), size=(4.0, 2.0, 2.0))], margin=1.6)
    expected[1:7, 1:9] = True
    assert torch.equal(wider, expected)


def test_a_box_behind_the_camera_shows_nowhere():
    assert not pixels_of_boxes(camera(), [box(centre=(0.0, 0, -11), size=(4.0, 2, 2))]).any()
    assert not pixels_of_boxes(camera(), []).any()


def test_a_box_around_the_camera_is_everything():
    assert pixels_of_boxes(camera(), [box(size=(4.0, 4, 4))]).all()


def test_a_box_beside_the_camera_reaches_into_the_view():
    """From x = 1 on, and from z = -5 to 5: its near face is met by rays of x / z of 1 / 5 on."""
    shown = pixels_of_boxes(camera(), [box(centre=(11.0, 0, 0), size=(20.0, 20, 10))])
    assert shown.all(dim=0).tolist() == [False] * 7 + [True] * 3
    assert not shown[:, :7].any()


def test_rays_along_a_face_meet_what_they_run_within():
    straight = camera(width=1, height=1, cx=0.5, cy=0.5)
    inside = box(centre=(0.0, 0, 5), size=(2.0, 2, 2))
    edge = box(centre=(1.0, 0, 5), size=(2.0, 2, 2))
    outside = box(centre=(1.1, 0, 5), size=(2.0, 2, 2))
    assert pixels_of_boxes(straight, [inside]).item()
    assert pixels_of_boxes(straight, [edge]).item()
    assert not pixels_of_boxes(straight, [outside]).item()


@pytest.mark.parametrize("model", ["pinhole", "opencv", "fisheye"])
def test_pixels_are_those_of_points_in_the_box(model, rng):
    """A pixel is shown exactly where samples along its ray lie in the box, whatever the lens."""
    bent = {"opencv": (-0.2, 0.05), "fisheye": (0.05, -0.01)}.get(model, ())
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.3, -0.2, 0.5])
    view = camera(model=model, distortion=bent, cam_from_world=pose)
    turned = torch.from_numpy(rng.normal(size=4))
    one = box(centre=(0.5, 0.2, 6.0), size=(3.0, 2, 1.5), rotation=turned)
    origin, rays = view.rays()
    along = torch.linspace(0, 12, 4001, dtype=torch.float64)[:, None, None, None]
    samples = origin + along * rays
    inside = inside_boxes(samples.reshape(-1, 3), [one]).reshape(samples.shape[:3]).any(dim=0)
    assert torch.equal(pixels_of_boxes(view, [one]), inside)
    assert 3 < int(inside.sum()) < 70


def test_many_boxes_are_the_union():
    boxes = [box(centre=(x, 0.0, 9), size=(1.0, 1, 1)) for x in (-2.0, 0.0, 2.0)]
    each = torch.stack([pixels_of_boxes(camera(), [one]) for one in boxes]).any(dim=0)
    assert torch.equal(pixels_of_boxes(camera(), boxes), each)


@pytest.mark.parametrize(
    ("values", "error", "words"),
    [
        ({"centre": (0.0, math.nan, 0)}, RangeError, "centre"),
        ({"centre": (0.0, 0)}, ShapeError, "centre"),
        ({"size": (1.0, 0.0, 1.0)}, RangeError, r"size\[1\]: expected more than 0"),
        ({"size": (1.0, math.inf, 1.0)}, RangeError, "size"),
        ({"rotation": (0.0, 0, 0, 0)}, RangeError, "quaternions"),
        ({"start": 2.0, "end": 1.0}, RangeError, "start, end: expected a span of time, got 2 to 1"),
        ({"start": math.nan}, RangeError, "start, end"),
    ],
)
def test_what_is_no_box_is_refused(values, error, words):
    with pytest.raises(error, match=words):
        box(**values)


def test_margins_and_points_that_are_none_are_refused():
    with pytest.raises(RangeError, match="margin: expected at least 0, got -1"):
        inside_boxes(torch.zeros(2, 3), [box()], margin=-1.0)
    with pytest.raises(RangeError, match="margin"):
        pixels_of_boxes(camera(), [box()], margin=math.nan)
    with pytest.raises(ShapeError, match="points"):
        inside_boxes(torch.zeros(2, 2), [box()])
    assert len(inside_boxes(torch.zeros(0, 3), [box()])) == 0


def test_a_scan_of_some_of_its_points_knows_the_values_of_the_file():
    scan = Scan(
        name="a",
        points=torch.arange(12.0).reshape(4, 3),
        rows=torch.tensor([1, 2, 5, 7]),
        recorded=9,
        origin=torch.zeros(3),
        intensity=torch.arange(4.0),
        labels={"semantic": torch.tensor([3, 4, 5, 6])},
        time=2.5,
    )
    some = scan.take(torch.tensor([0, 3]))
    assert some.points[:, 0].tolist() == [0, 9]
    assert some.labels["semantic"].tolist() == [3, 6]
    assert some.intensity is not None
    assert some.intensity.tolist() == [0, 3]
    assert (some.name, some.time, some.origin is not None) == ("a", 2.5, True)
    assert some.recorded_labels(torch.tensor([8, 9])).tolist() == [-1, 8, -1, -1, -1, -1, -1, 9, -1]
    whole = Scan(name="b", points=torch.zeros(3, 3)).take(torch.tensor([2]))
    assert whole.recorded_labels(torch.tensor([4])).tolist() == [-1, -1, 4]


def test_numbers_of_frames():
    assert frame_number("image_00/0000000012") == ("image_00/", 12)
    assert frame_number("0001TP_006690") == ("0001TP_", 6690)
    assert frame_number("3_left2b") == ("3_leftb", 2)
    assert frame_number("left") is None
    assert frame_number("1" * 19) is None


# Labelled surfaces: what they refuse, and what they keep.


VERTICES = torch.eye(3)
FACES = torch.tensor([[0, 1, 2]])


def test_a_mesh_keeps_positions_in_double_and_ids_in_32_bits() -> None:
    mesh = LabelledMesh(
        vertices=VERTICES,
        faces=FACES.int(),
        vertex_labels={"label": torch.tensor([1, -1, 2])},
        face_labels={"object": torch.tensor([5])},
    )
    assert mesh.vertices.dtype == torch.float64
    assert mesh.faces.dtype == torch.int64
    assert {name: ids.dtype for name, ids in mesh.labels.items()} == {
        "label": torch.int32, "object": torch.int32,
    }  # fmt: skip
    assert repr(mesh) == "LabelledMesh(3 vertices, 1 faces, labels: label, object)"


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"faces": FACES[:0]}, InputError, "at least one triangle"),
        ({"faces": FACES + 1}, RangeError, r"indices of 3 vertices, in \[0, 3\), got \[1, 3\]"),
        ({"vertices": VERTICES * math.inf}, RangeError, "vertices: .* not finite"),
        ({"vertices": VERTICES[:, :2]}, ShapeError, "vertices: expected shape"),
        ({"vertex_labels": {"a": torch.tensor([1, 2])}}, ShapeError, r"vertex_labels\['a'\]"),
        ({"face_labels": {"a": torch.tensor([1, 2])}}, ShapeError, r"face_labels\['a'\]"),
        ({"face_labels": {"a": torch.tensor([-2])}}, RangeError, r"ids from -1"),
        (
            {"face_labels": {"a": FACES[0, :1]}, "vertex_labels": {"a": FACES[0]}},
            InputError,
            "names that vertex_labels has not, got 'a'",
        ),
    ],
)
def test_meshes_that_cannot_be(change, error, words) -> None:
    with pytest.raises(error, match=words):
        LabelledMesh(**{"vertices": VERTICES, "faces": FACES} | change)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"points": VERTICES[:0], "labels": {}}, InputError, "at least one point"),
        ({"points": VERTICES * math.nan}, RangeError, "points: .* not finite"),
        ({"labels": {"a": torch.tensor([1])}}, ShapeError, r"labels\['a'\]: expected shape \(3\)"),
        ({"normals": VERTICES[:2]}, ShapeError, "normals: expected shape"),
    ],
)
def test_points_that_cannot_be(change, error, words) -> None:
    with pytest.raises(error, match=words):
        LabelledPoints(**{"points": VERTICES, "labels": {"a": torch.arange(3)}} | change)
