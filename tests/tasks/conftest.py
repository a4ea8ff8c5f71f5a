"""A generated room small enough to be fitted in every test."""

import shutil
from pathlib import Path

import pytest

from splatseg.core import Scene
from splatseg.io.scene import load_scene
from splatseg.synthetic import cameras, room, write_capture


@pytest.fixture(scope="session")
def small_room(tmp_path_factory) -> Path:
    """A capture of 64 x 48 pixels, with label maps."""
    folder = tmp_path_factory.mktemp("tasks") / "room"
    scene = room(seed=2)
    views = cameras(scene, train=5, test=2, width=64, height=48)
    write_capture(scene, folder, views=views, points=400, seed=2)
    return folder


@pytest.fixture(scope="session")
def made_room(small_room, tmp_path_factory) -> Path:
    """A scene of it, with a layer of its classes."""
    from splatseg.fit import FitOptions
    from splatseg.io.scene import save_scene_layer
    from splatseg.tasks import SegmentOptions, fit_capture, segment

    folder = tmp_path_factory.mktemp("made") / "scene"
    options = FitOptions(minutes=None, steps=30, max_gaussians=600)
    fit_capture(small_room, folder, fit_options=options, backend="cpu")
    asked = SegmentOptions(evidence="labels_semantic", layer="classes")
    made = segment(load_scene(folder), "uplift", options=asked, backend="cpu")
    save_scene_layer(made.layer, folder, "classes")
    return folder


@pytest.fixture
def made(made_room, tmp_path) -> Path:
    """A copy that a test may change."""
    return shutil.copytree(made_room, tmp_path / "scene")


@pytest.fixture
def scene(made) -> Scene:
    return load_scene(made)
