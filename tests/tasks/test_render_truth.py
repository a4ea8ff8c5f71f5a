"""True label maps of a capture's or scene's views from a labelled surface, as files."""

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.cli import main
from splatseg.core import Camera, Capture, ClassInfo, ClassTable, LabelledMesh, View
from splatseg.errors import InputError
from splatseg.evaluate import PointSurfaceOptions
from splatseg.tasks import EvaluationOptions, RenderingOptions, evaluate_scene, render_truth
from splatseg.tasks.work import scene_of_capture
from support.ply import write_ply

WIDTH, HEIGHT = 24, 18
LENS = {"model": "fisheye", "distortion": (0.02, -0.01)}
TRIANGLES = [(0, 1, 2), (0, 2, 3)]
SQUARE = [(-1.0, -1.0, 2.0), (1.0, -1.0, 2.0), (1.0, 1.0, 2.0), (-1.0, 1.0, 2.0)]


@pytest.fixture
def capture(tmp_path) -> Capture:
    """One train view and two test views of a fisheye; one of them turned away."""
    (tmp_path / "photographs").mkdir()
    views = []
    for i, split in enumerate(["train", "test", "test"]):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = -0.1 * i
        if i == 2:
            pose[0, 0] = pose[2, 2] = -1
        camera = Camera(
            width=WIDTH, height=HEIGHT, fx=14.0, fy=14.0, cx=12.0, cy=9.0, cam_from_world=pose,
            **LENS,
        )  # fmt: skip
        views.append(View(name=f"v{i}", camera=camera, split=split))
    classes = ClassTable(rows=(ClassInfo(id=3, name="door"), ClassInfo(id=4, name="wall")))
    return Capture(path=tmp_path / "photographs", format="test", views=views, classes=classes)


def vertices(*columns):
    axes = [("float", axis, [row[i] for row in SQUARE]) for i, axis in enumerate("xyz")]
    return [*axes, *columns]


@pytest.fixture
def mesh(tmp_path):
    """A square, its halves the instances 0 and 1; all vertices of class 3."""
    face = [("list uchar int", "vertex_indices", TRIANGLES), ("int", "instance", [0, 1])]
    label = ("ushort", "label", [3, 3, 3, 3])
    return write_ply({"vertex": vertices(label), "face": face}, tmp_path / "square.ply")


def ids(path):
    return np.asarray(Image.open(path)).astype(int)


def test_maps_are_written_as_render_writes_them(capture, mesh, tmp_path) -> None:
    done = render_truth(mesh, capture, tmp_path / "out")
    assert (done.views, done.entries) == (2, ("label", "instance"))
    label, instance = (ids(tmp_path / "out" / name / "v1.png") for name in done.entries)
    assert label.shape == (HEIGHT, WIDTH)
    assert set(np.unique(label)) == {0, 3}
    # Instance 0 is void, and both triangles are the same class.
    assert set(np.unique(instance)) == {0, 1}
    assert ((instance == 1) <= (label == 3)).all()
    assert 0.3 < (instance == 1).sum() / (label == 3).sum() < 0.7
    # In the pixels of the lens: rays of pixel centres against the square z = 2.
    camera = capture.view("v1").camera
    origin, directions = camera.rays()
    at = origin + directions * ((2 - origin[2]) / directions[..., 2:])
    inside = (at[..., :2].abs() <= 1).all(dim=-1)
    assert np.array_equal(label == 3, inside.numpy())
    assert not ids(tmp_path / "out" / "label" / "v2.png").any()
    legend = json.loads((tmp_path / "out" / "label" / "legend.json").read_text())
    assert legend["ids"]["3"]["name"] == "door"
    legend = json.loads((tmp_path / "out" / "instance" / "legend.json").read_text())
    assert legend["ids"]["1"]["name"] == "instance 1"


def test_ids_from_zero_grow_by_one_and_say_so(capture, mesh, tmp_path) -> None:
    options = RenderingOptions(what=("instance", "depth"), split="all")
    done = render_truth(
        mesh, scene_of_capture(capture), tmp_path / "out", options=options, zero_is_class=True
    )
    assert done.views == 3
    assert set(np.unique(ids(tmp_path / "out" / "instance" / "v1.png"))) == {0, 1, 2}
    legend = json.loads((tmp_path / "out" / "instance" / "legend.json").read_text())
    assert [legend["ids"][id]["source_id"] for id in ("1", "2")] == [0, 1]
    unit = json.loads((tmp_path / "out" / "depth" / "depth.json").read_text())["unit"]
    depth = ids(tmp_path / "out" / "depth" / "v1.png") * unit
    assert set(np.unique(depth.round(4))) == {0.0, 2.0}
    render_truth(mesh, capture, tmp_path / "void", void=3)
    assert not ids(tmp_path / "void" / "label" / "v1.png").any()


def test_what_was_drawn_is_a_truth_to_evaluate_with(capture, mesh, tmp_path) -> None:
    from splatseg.evaluate import SurfaceField
    from splatseg.io.surfaces import read_surface

    render_truth(mesh, capture, tmp_path / "out", options=RenderingOptions(what=("label",)))
    scores = evaluate_scene(
        scene_of_capture(capture),
        options=EvaluationOptions(layer="label", truth=tmp_path / "out" / "label"),
        field=SurfaceField(read_surface(mesh)),
    )
    assert scores["mIoU"] == 1
    assert scores["views"] == 2


def test_points_take_their_options(capture, tmp_path) -> None:
    line = np.linspace(-1, 1, 21)
    xyz = np.stack([*(part.ravel() for part in np.meshgrid(line, line)), np.full(441, 2.0)], -1)
    np.savez(tmp_path / "a.npz", xyz=xyz, semantic=np.full(441, 4))
    shares = []
    for radius in (0.01, 0.2):
        options = PointSurfaceOptions(radius=radius, fill=0)
        render_truth(tmp_path / "a.npz", capture, tmp_path / "out", points=options)
        shares.append((ids(tmp_path / "out" / "semantic" / "v1.png") == 4).mean())
    assert shares[0] < 0.1 * shares[1]


def test_a_surface_has_no_colours_and_only_its_labels(capture, tmp_path) -> None:
    surface = LabelledMesh(
        vertices=torch.eye(3),
        faces=torch.tensor([[0, 1, 2]]),
        face_labels={"label": torch.tensor([1])},
    )
    for what, words in (("rgb", "a field with colours"), ("semantic", "'semantic'")):
        with pytest.raises(InputError, match=words):
            render_truth(surface, capture, tmp_path / "out", options=RenderingOptions(what=(what,)))
        assert not (tmp_path / "out").exists()


@pytest.fixture
def folder(capture, tmp_path):
    """The capture as a nerfstudio folder, with photographs."""
    root = tmp_path / "capture"
    (root / "images").mkdir(parents=True)
    flip = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
    frames = []
    for view in capture.views:
        Image.new("RGB", (WIDTH, HEIGHT)).save(root / "images" / f"{view.name}.png")
        pose = (view.camera.world_from_cam @ flip).tolist()
        frames.append({"file_path": f"images/{view.name}.png", "transform_matrix": pose})
    content = {
        "camera_model": "OPENCV_FISHEYE", "fl_x": 14.0, "fl_y": 14.0, "cx": 12.0, "cy": 9.0,
        "w": WIDTH, "h": HEIGHT, "k1": 0.02, "k2": -0.01, "frames": frames,
        "train_filenames": ["images/v0.png"], "test_filenames": ["images/v1.png", "images/v2.png"],
    }  # fmt: skip
    (root / "transforms.json").write_text(json.dumps(content))
    return root


def test_the_command_takes_a_capture(folder, capture, mesh, tmp_path, capsys) -> None:
    words = ["render", folder, "-o", tmp_path / "out", "--surface", mesh, "--json"]
    assert main([*map(str, words), "--zero-is-class", "--void", "3", "--coloured"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["views"] == 2
    assert said["entries"] == ["label", "instance", "label_coloured", "instance_coloured"]
    render_truth(mesh, capture, tmp_path / "same", zero_is_class=True, void=3)
    for name in ("label", "instance"):
        drawn, expected = (ids(tmp_path / at / name / "v1.png") for at in ("out", "same"))
        assert np.array_equal(drawn, expected)


def test_the_command_says_which_flags_belong_together(folder, mesh, tmp_path, capsys) -> None:
    out = ["-o", str(tmp_path / "out")]
    for flags in (["--void", "3"], ["--zero-is-class"], ["--radius", "1"], ["--fill", "9"]):
        assert main(["render", str(folder), *out, *flags]) == 2
        assert "--zero-is-class, --void, --radius, --fill: expected" in capsys.readouterr().err
    line = np.linspace(-1, 1, 21)
    xyz = np.stack([*(part.ravel() for part in np.meshgrid(line, line)), np.full(441, 2.0)], -1)
    np.savez(tmp_path / "a.npz", xyz=xyz, semantic=np.full(441, 4))
    shares = []
    for flags in (["--radius", "0.01", "--fill", "0"], ["--radius", "0.2"]):
        words = ["render", str(folder), *out, "--surface", str(tmp_path / "a.npz"), *flags]
        assert main([*words, "--quiet"]) == 0
        shares.append((ids(tmp_path / "out" / "semantic" / "v1.png") == 4).mean())
    assert 0 < shares[1] < 1
    assert shares[0] < 0.1 * shares[1]
    assert not math.isnan(shares[0])
