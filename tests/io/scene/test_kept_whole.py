"""A scene is replaced as a whole, whatever moment a kill comes at, and nothing leads out of it."""

import os
import shutil
from pathlib import Path

import pytest
import torch

from splatseg.core import Camera, Gaussians, Labels, Scene, View
from splatseg.errors import FileFormatError, InputError
from splatseg.io.json_files import read_json, write_json
from splatseg.io.scene import (
    load_scene,
    load_scene_layer,
    save_scene,
    save_scene_layer,
    scene_layer_names,
)
from splatseg.io.scene_folder import PENDING, training_file, work_on_scene

CAMERA = Camera(
    width=8, height=6, fx=9.0, fy=9.0, cx=4.0, cy=3.0, cam_from_world=torch.eye(4).double()
)


def scene_of(count: int, *names: str) -> Scene:
    rotations = torch.zeros(count, 4)
    rotations[:, 0] = 1
    gaussians = Gaussians(
        means=torch.arange(3.0 * count).reshape(count, 3),
        rotations=rotations,
        scales=torch.ones(count, 3),
        opacities=torch.full((count,), 0.5),
        sh=torch.zeros(count, 1, 3),
    )
    return Scene(gaussians=gaussians, views=tuple(View(name=n, camera=CAMERA) for n in names))


class Killed(BaseException):
    """What a process that is killed does at this moment: nothing more."""


@pytest.mark.parametrize("moment", range(1, 8))
def test_a_kill_at_any_rename_leaves_the_old_scene_or_the_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: int
) -> None:
    root = tmp_path / "scene"
    save_scene(scene_of(2, "a"), root)
    replace, calls = os.replace, []

    def killed(source: object, target: object) -> None:
        calls.append(target)
        if len(calls) == moment:
            raise Killed
        replace(source, target)  # type: ignore[arg-type]

    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", killed)
        patched.setattr(shutil, "rmtree", lambda *args, **more: None)  # no tidying up either
        try:
            save_scene(scene_of(5, "b", "c"), root)
        except Killed:
            assert len(calls) == moment
    found = load_scene(root)
    assert (len(found.gaussians), [view.name for view in found.views]) in (
        (2, ["a"]),
        (5, ["b", "c"]),
    )
    with work_on_scene(root, "see"):
        pass
    again = load_scene(root)
    assert len(again.gaussians) == len(found.gaussians)
    assert not (root / PENDING).exists()
    if len(calls) < moment:
        assert len(again.gaussians) == 5, "no kill came"


def test_a_climbing_view_name_of_a_scene_file_is_refused(tmp_path: Path) -> None:
    root = tmp_path / "scene"
    save_scene(scene_of(2, "a"), root)
    for name in ("../../x", "/tmp/x", "a\nb"):
        for file in (root / "cameras" / "transforms.json",):
            content = read_json(file)
            content["frames"][0]["name"] = name
            write_json(content, file)
        with pytest.raises(FileFormatError, match=r"transforms.json: frames\[0\]: expected a view"):
            load_scene(root)


def test_no_layer_is_written_through_a_link_that_leads_out(tmp_path: Path) -> None:
    root, outside = tmp_path / "scene", tmp_path / "out"
    save_scene(scene_of(2, "a"), root)
    outside.mkdir()
    for name in ("layers", "training"):
        shutil.rmtree(root / name, ignore_errors=True)
        (root / name).symlink_to(outside)
    layer = Labels(ids=torch.ones(2, dtype=torch.int64), confidence=torch.ones(2))
    with pytest.raises(InputError, match="a link leads out"):
        save_scene_layer(layer, root, "classes")
    with pytest.raises(InputError, match="a link leads out"):
        training_file(root, "classes")
    assert not list(outside.iterdir())


def test_files_that_no_layer_is_called_like_are_none(tmp_path: Path) -> None:
    root = tmp_path / "scene"
    save_scene(scene_of(2, "a"), root)
    layer = Labels(ids=torch.ones(2, dtype=torch.int64), confidence=torch.ones(2))
    path = save_scene_layer(layer, root, "classes")
    shutil.copy(path, root / "layers" / "...npz")  # a layer called ".."
    assert scene_layer_names(root) == ("classes",)
    with pytest.raises(InputError, match="expected one of"):
        load_scene_layer(root, "..")
