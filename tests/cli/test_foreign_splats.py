"""Splat files of other programs, as the commands that read such files deal with them."""

import struct
from pathlib import Path

import pytest
import torch

from splatseg.core import Labels, PointCloud
from splatseg.errors import InputError
from splatseg.fit import FitOptions
from splatseg.io.scene import load_scene, load_scene_layer, save_scene_layer
from splatseg.io.splats import read_splats, write_splats
from splatseg.tasks import SILENT, MakeSceneOptions
from splatseg.tasks.make_scene import _capture

ROW = 3
OPACITIES = torch.linspace(0.1, 0.9, 160)


@pytest.fixture
def broken(small, tmp_path) -> Path:
    """The small scene's Gaussians, one of whose rows has no position."""
    path = tmp_path / "broken.ply"
    write_splats(load_scene(small.scene).gaussians, path)
    data = bytearray(path.read_bytes())
    start = data.index(b"end_header\n") + 11
    size = (len(data) - start) // len(load_scene(small.scene).gaussians)
    struct.pack_into("<f", data, start + ROW * size, float("nan"))
    path.write_bytes(data)
    return path


@pytest.fixture
def linear(small, tmp_path) -> Path:
    """The same with scales and opacities as they are: what is written is the log of their exp."""
    gaussians = load_scene(small.scene).gaussians.replace(opacities=OPACITIES)
    path = tmp_path / "linear.ply"
    write_splats(
        gaussians.replace(scales=gaussians.scales.exp(), opacities=gaussians.opacities.sigmoid()),
        path,
    )
    return path


def commands(file: Path, small, tmp_path: Path) -> list[tuple[object, ...]]:
    n = len(load_scene(small.scene).gaussians)
    ids = torch.arange(n, dtype=torch.int32) % 3 + 1
    save_scene_layer(Labels(ids=ids, confidence=torch.ones(n)), small.scene, "thirds")
    return [
        ("info", file),
        ("import", file, "-o", tmp_path / "s", "--data", small.scene / "cameras", "--as-is"),
        ("attach", small.scene, file, "-o", tmp_path / "a"),
        ("attach", small.scene, file, "--layer", "thirds", "-o", tmp_path / "a.ply"),
    ]


def test_rows_are_left_out_and_said_or_refused(small, broken, splatseg, tmp_path) -> None:
    for words in commands(broken, small, tmp_path):
        status, _, err = splatseg(*words, "--strict")
        assert status == 2, words
        assert "1 of 160 Gaussians hold values that are NaN or infinite" in err
        status, out, err = splatseg(*words)
        assert status == 0, err
        assert "1 of 160 Gaussians hold values" in out + err
        assert "left out" in out + err
    kept = [i for i in range(160) if i != ROW]
    for folder in (tmp_path / "s", tmp_path / "a"):
        scene = load_scene(folder)
        assert scene.gaussians.extra["source_row"].tolist() == kept
    layer = load_scene_layer(tmp_path / "a", "thirds")
    assert layer.ids.tolist() == [i % 3 + 1 for i in kept], "labels follow their Gaussians"
    assert splatseg("export", tmp_path / "s", "--what", "splat", "-o", tmp_path / "o.ply")[0] == 0
    assert read_splats(tmp_path / "o.ply").extra["source_row"].tolist() == kept


def test_values_that_are_no_logs(small, linear, splatseg, tmp_path) -> None:
    want = load_scene(small.scene).gaussians
    for words in commands(linear, small, tmp_path)[:3]:
        status, out, err = splatseg(*words, "--linear", "scales", "opacities")
        assert status == 0, err
        assert "never" not in out + err
    for folder in (tmp_path / "s", tmp_path / "a"):
        found = load_scene(folder).gaussians
        assert torch.allclose(found.scales, want.scales, rtol=1e-5)
        assert torch.allclose(found.opacities, OPACITIES, rtol=1e-5)
    said = splatseg("info", linear)[1]
    assert "all scales are positive, as if they were never logs" in said
    assert "`--linear scales opacities` reads them so" in said


def test_a_scene_whose_file_an_editor_broke_is_refused(small, broken, splatseg) -> None:
    """Its layers go by rows: none may be left out."""
    (small.scene / "gaussians.ply").write_bytes(broken.read_bytes())
    status, _, err = splatseg("info", small.scene)
    assert status == 2
    assert "1 of 160 Gaussians hold values" in err


def test_a_folder_that_3dgs_trained_in(small, splatseg, tmp_path) -> None:
    folder = tmp_path / "model" / "point_cloud" / "iteration_30000"
    folder.mkdir(parents=True)
    write_splats(load_scene(small.scene).gaussians, folder / "point_cloud.ply")
    (tmp_path / "model" / "cameras.json").write_text("[]")
    status, out, err = splatseg("info", tmp_path / "model")
    assert status == 0, err
    assert "ply splats, 160 Gaussians" in out
    assert "iteration_30000/point_cloud.ply was read" in out
    words = ("import", tmp_path / "model", "-o", tmp_path / "s", "--data", small.scene / "cameras")
    assert splatseg(*words, "--as-is")[0] == 0
    assert len(load_scene(tmp_path / "s").gaussians) == 160


def write_points(path: Path) -> Path:
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
    path.write_text(head + "property float z\nend_header\n0 0 1\n1 2 3\n")
    return path


def test_a_point_cloud_says_what_it_is_good_for(splatseg, tmp_path) -> None:
    points = write_points(tmp_path / "points.ply")
    status, _, err = splatseg("import", points, "-o", tmp_path / "s")
    assert status == 2
    assert "got points, no Gaussians (found 'x, y, z')" in err
    assert "`splatseg fit CAPTURE --points points.ply`" in err


def test_a_fit_starts_at_points(small, tmp_path) -> None:
    points = write_points(tmp_path / "points.ply")

    def capture_of(**more: object):
        options = MakeSceneOptions(points=points, **more)
        return _capture(small.scene / "cameras", tmp_path / "s", options, FitOptions(), SILENT)[0]

    found = capture_of().points
    assert isinstance(found, PointCloud)
    assert found.points.tolist() == [[0, 0, 1], [1, 2, 3]]
    with pytest.raises(InputError, match=r"points: expected none with scans"):
        capture_of(scans=points)
    points.write_text(points.read_text().replace("0 0 1", "0 nan 1"))
    assert capture_of().points.points.tolist() == [[1, 2, 3]]
    assert "1 of 2 start points are not finite and are left out" in capture_of().notes
    with pytest.raises(InputError, match=r"points.ply: 1 of 2 start points are not finite"):
        capture_of(strict=True)


def test_fit_has_the_option(splatseg, small, tmp_path) -> None:
    words = ("fit", small.scene / "cameras", "-o", tmp_path / "s", "--points", tmp_path / "no.ply")
    status, _, err = splatseg(*words)
    assert status == 2
    assert "no.ply: there is no such file" in err
