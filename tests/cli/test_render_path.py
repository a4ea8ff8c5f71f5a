"""render --split path and --video."""

import json
import subprocess
import sys

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Labels, Selection
from splatseg.io.captures import read_capture
from splatseg.io.scene import load_scene, save_scene_layer
from splatseg.render import render

CPU = ("--backend", "cpu")


def frames_of(path) -> np.ndarray:
    program = imageio_ffmpeg.get_ffmpeg_exe()
    words = [program, "-v", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(words, capture_output=True, check=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, 20, 28, 3)


@pytest.fixture
def layered(small):
    """With a layer of labels, left and right, and a selection, right."""
    means = load_scene(small.scene).gaussians.means
    ids = torch.where(means[:, 0] < 0, 2, 7).int()
    save_scene_layer(Labels(ids=ids, confidence=torch.ones(len(ids))), small.scene, "sides")
    save_scene_layer(Selection(mask=ids == 7), small.scene, "right")
    return small


def test_a_path_with_films(layered, splatseg, tmp_path) -> None:
    out = tmp_path / "out"
    words = ("--split", "path", "--frames", 5, "--what", "rgb,depth,alpha,sides,right", *CPU)
    status, text, err = splatseg("render", layered.scene, *words, "--video", "--fps", 5, "-o", out)
    assert status == 0, err
    assert "5 views of rgb, depth, alpha, sides, right" in text
    whats = ("rgb", "depth", "alpha", "sides", "right")
    names = [f"path_{i:04d}" for i in range(5)]
    for what in whats:
        assert [p.stem for p in sorted((out / what).glob("*.png"))] == names
    kept = {p.name for p in out.iterdir()}
    assert kept == {*whats, *(f"{w}.mp4" for w in whats), "transforms.json", "render.json"}

    scene = load_scene(layered.scene)
    capture = read_capture(out)
    assert [view.name for view in capture.views] == names
    camera = capture.views[1].camera
    assert camera.is_pinhole
    drawn = render(scene.gaussians, camera, backend="cpu")
    with Image.open(out / "rgb" / "path_0001.png") as image:
        pixels = np.array(image)
    assert np.abs(pixels.astype(int) - (255 * drawn.image.clamp(0, 1)).numpy()).max() <= 1
    xs = [float(view.camera.centre[0]) for view in capture.views]
    assert max(xs) - min(xs) > 0.1
    assert -0.31 < min(xs) < max(xs) < 0.31

    films = {what: frames_of(out / f"{what}.mp4") for what in whats}
    assert {film.shape for film in films.values()} == {(5, 20, 28, 3)}
    assert np.abs(films["rgb"][1].astype(int) - pixels).mean() < 12
    with Image.open(out / "sides" / "path_0001.png") as image:
        ids = np.array(image)
    inside = np.zeros_like(ids, bool)
    inside[12:18, 20:26] = True
    assert (ids[inside] == 7).all()
    assert np.abs(films["sides"][1][inside].astype(int) - [7, 0, 63]).mean() < 12
    assert films["right"][1][inside].mean() > 230
    assert films["alpha"][1][inside].mean() > 200
    assert films["alpha"][1][:4].mean() < 20
    assert films["depth"][1][inside].astype(int).sum(-1).mean() > 60, "not nothing's colour"

    again = splatseg("render", layered.scene, *words, "--video", "-o", out)
    assert again[0] == 0, "what render wrote, render replaces"


def test_pictures_without_a_film(small, splatseg, tmp_path) -> None:
    out = tmp_path / "out"
    words = ("--split", "path", "--frames", 3, "--what", "alpha")
    assert splatseg("render", small.scene, *words, "-o", out, *CPU)[0] == 0
    assert {p.name for p in out.iterdir()} == {"alpha", "transforms.json", "render.json"}
    content = json.loads((out / "transforms.json").read_text())
    assert len(content["frames"]) == 3
    assert "file_path" not in content["frames"][0]


def test_a_film_of_the_capture_itself(small, splatseg, tmp_path) -> None:
    words = ("--split", "all", "--video", "-o", tmp_path / "out", *CPU)
    assert splatseg("render", small.scene, *words)[0] == 0
    assert len(frames_of(tmp_path / "out" / "rgb.mp4")) == 4
    assert not (tmp_path / "out" / "transforms.json").exists()


def test_refusals(small, splatseg, tmp_path, monkeypatch) -> None:
    out = tmp_path / "out"
    path = ("--split", "path", "-o", out, *CPU)
    assert splatseg("render", small.scene, *path, "--frames", 0)[0] == 2
    status, _, err = splatseg("render", small.scene, *path, "--video", "--fps", 0)
    assert (status, "fps" in err) == (2, True)
    out.mkdir()
    (out / "transforms.json").write_text("{}")
    status, _, err = splatseg("render", small.scene, *path, "--frames", 2)
    assert (status, "transforms.json: expected no file" in err) == (2, True)
    assert (out / "transforms.json").read_text() == "{}"
    (out / "transforms.json").unlink()
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    status, _, err = splatseg("render", small.scene, *path, "--frames", 2, "--video")
    assert (status, "splatseg[video]" in err) == (1, True)
    assert not out.exists() or not any(out.iterdir()), "refused before the work"


def test_views_of_two_sizes_make_no_film(small, splatseg, tmp_path) -> None:
    cameras = small.scene / "cameras" / "transforms.json"
    content = json.loads(cameras.read_text())
    content["frames"][0] |= {"w": 14, "h": 10, "fl_x": 12, "fl_y": 12, "cx": 7, "cy": 5}
    cameras.write_text(json.dumps(content))
    words = ("--split", "all", "--video", "-o", tmp_path / "out", *CPU)
    status, _, err = splatseg("render", small.scene, *words)
    assert (status, "expected views of one size, got 14x10, 28x20" in err) == (2, True)
