"""A splat without photographs: import, see, segment, and what its report calls a render."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Gaussians, InstanceTree, MaskSet, Scene
from splatseg.io.evidence import evidence_header, open_evidence, save_masks
from splatseg.io.scene import load_scene, load_scene_layer, save_scene
from splatseg.io.splats import write_splats
from splatseg.tasks import SeeOptions, see

SIZE = ("--max-views", 13, "--width", 64)
CLASSICAL = ("--model", "classical", "--evidence", "masks")


@pytest.fixture(scope="session")
def imported_template(small_template, tmp_path_factory) -> Path:
    """The wall of two colours as another program's file, imported without photographs."""
    from splatseg.cli import main

    folder = tmp_path_factory.mktemp("imported")
    write_splats(load_scene(small_template.scene).gaussians, folder / "wall.ply")
    words = ("import", folder / "wall.ply", "-o", folder / "wall", *SIZE)
    assert main([str(word) for word in words]) == 0
    return folder / "wall"


@pytest.fixture
def imported(imported_template, tmp_path) -> Path:
    shutil.copytree(imported_template, tmp_path / "wall")
    return tmp_path / "wall"


class Halves:
    """A model that keeps what it was shown, and finds the upper and the lower half."""

    name = "halves"
    note = ""

    def __init__(self, after: int | None = None) -> None:
        self.after = after
        self.settings: dict = {}
        self.shown: list[torch.Tensor] = []

    def masks(self, image) -> MaskSet:
        if len(self.shown) == self.after:
            raise KeyboardInterrupt
        self.shown.append(image)
        rows = torch.arange(image.shape[0])[:, None].expand(image.shape[:2])
        middle = image.shape[0] // 2
        return MaskSet.from_dense(torch.stack((rows < middle, rows >= middle)), scores=[0.5, 0.5])


def pictures(folder: Path) -> dict[str, np.ndarray]:
    return {p.stem: np.asarray(Image.open(p)) for p in sorted(folder.glob("*.png"))}


def test_the_three_lines_of_the_readme(imported, splatseg) -> None:
    """They begin with the import of `imported_template`."""
    status, out, err = splatseg("see", imported, *CLASSICAL)
    assert status == 0, err
    assert out.startswith("masks of 11 views by classical")
    folder = imported / "evidence" / "masks"
    assert "11 views that have no photograph were rendered" in err
    assert str(folder / "_renders") in err
    words = ("--method", "associate", "--evidence", "masks", "--export", "--report")
    status, _, err = splatseg("segment", imported, *words)
    assert status == 0, err
    layer = load_scene_layer(imported, "masks")
    assert isinstance(layer, InstanceTree)
    ids = layer.cut().ids
    red = load_scene(imported).gaussians.means[:, 0] < 0
    sides = [ids[side & (ids >= 0)].mode().values for side in (red, ~red)]
    assert sides[0] != sides[1], "the two colours are two things"
    page = (imported / "reports" / "masks.html").read_text()
    assert ">render<" in page
    assert "photograph" not in page
    assert (imported / "exports" / "masks" / "objects.csv").is_file()


def test_renders_are_kept_and_are_what_the_model_saw(imported) -> None:
    scene, model = load_scene(imported), Halves()
    seen = see(scene, model, "m")
    kept = pictures(seen.folder / "_renders")
    assert list(kept) == [view.name for view in scene.train_views]
    for shown, image in zip(model.shown, kept.values(), strict=True):
        assert shown.dtype == torch.uint8
        np.testing.assert_array_equal(shown.numpy(), image)
        assert image.std() > 10
    evidence = open_evidence(seen.folder)
    assert evidence.view_names == tuple(kept), "renders are no evidence themselves"
    assert evidence.render("virtual_0001") == seen.folder / "_renders" / "virtual_0001.png"
    assert evidence.render("virtual_0000") is None
    assert len(seen.notes) == 1
    assert evidence_header(seen.folder)["metadata"]["complete"] is True


def test_they_show_what_render_draws(imported, splatseg, tmp_path) -> None:
    """So that masks which another program made of `render`'s pictures fit the views."""
    words = ("--split", "train", "--what", "rgb,alpha", "-o", tmp_path / "out")
    assert splatseg("render", imported, *words)[0] == 0
    seen = see(load_scene(imported), Halves(), "m")
    drawn, alpha = pictures(tmp_path / "out" / "rgb"), pictures(tmp_path / "out" / "alpha")
    for name, image in pictures(seen.folder / "_renders").items():
        empty = (255.0 - alpha[name])[..., None]
        # Two roundings to 8 bits; the scene is red and blue, and what it lacks is black or white.
        over = [np.abs(image - drawn[name] - grey * empty).max() for grey in (0.0, 1.0)]
        assert min(over) < 2
        assert drawn[name].std() > 10


def coloured(imported, sh: float) -> Scene:
    """The imported scene in one grey."""
    scene = load_scene(imported)
    gaussians = scene.gaussians.replace(sh=torch.full_like(scene.gaussians.sh, sh))
    return replace(scene, gaussians=gaussians)


@pytest.mark.parametrize(("sh", "background"), [(-1.8, 255), (1.8, 0)])
def test_nothing_is_of_a_grey_that_the_scene_lacks(imported, sh, background) -> None:
    """A dark thing has an outline over white, a light one over black."""
    scene = coloured(imported, sh)
    seen = see(scene, Halves(), "m")
    for name, image in pictures(seen.folder / "_renders").items():
        alpha = open_alpha(scene, name)
        assert (image[alpha == 0] == background).all()


def open_alpha(scene: Scene, name: str) -> np.ndarray:
    from splatseg.render import render

    return render(scene.gaussians, scene.view(name).camera).alpha.numpy()


@pytest.mark.parametrize("after", [0, 4])
def test_what_was_stopped_goes_on_over_the_same_background(imported, after) -> None:
    scene = coloured(imported, -1.8)
    whole = pictures(see(scene, Halves(), "whole").folder / "_renders")
    with pytest.raises(KeyboardInterrupt):
        see(scene, Halves(after=after), "m")
    model = Halves()
    seen = see(scene, model, "m")
    assert (seen.kept, len(model.shown)) == (after, 11 - after)
    kept = pictures(seen.folder / "_renders")
    assert list(kept) == list(whole)
    for name, image in kept.items():
        np.testing.assert_array_equal(image, whole[name])


def test_overwriting_takes_the_renders_along(imported) -> None:
    scene = load_scene(imported)
    see(scene, Halves(), "m", options=SeeOptions(views=("all",)))
    folder = imported / "evidence" / "m" / "_renders"
    assert len(pictures(folder)) == 13
    see(scene, Halves(), "m", options=SeeOptions(overwrite=True))
    assert len(pictures(folder)) == 11


def test_masks_made_elsewhere_come_in_by_folder(imported, splatseg, tmp_path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    for view in load_scene(imported).train_views:
        mask = torch.zeros(1, 48, 64, dtype=torch.bool)
        mask[:, :, :32] = True
        save_masks(MaskSet.from_dense(mask, scores=[0.5]), folder, view.name)
    status, out, err = splatseg("see", imported, "--model", folder, "--evidence", "mine")
    assert status == 0, err
    assert out.startswith("masks of 11 views by mine")
    assert not (imported / "evidence" / "mine" / "_renders").exists(), "nobody looked"
    words = ("--method", "associate", "--evidence", "mine", "--report")
    assert splatseg("segment", imported, *words)[0] == 0
    assert ">render<" in (imported / "reports" / "mine.html").read_text()


def test_only_views_without_photographs_are_drawn(small) -> None:
    scene = load_scene(small.scene)
    views = tuple(replace(v, image=None) if v.name == "train_1" else v for v in scene.views)
    model = Halves()
    seen = see(replace(scene, views=views), model, "m")
    assert list(pictures(seen.folder / "_renders")) == ["train_1"]
    photograph = np.asarray(Image.open(small.capture / "images" / "train_0.png"))
    np.testing.assert_array_equal(model.shown[0].numpy(), photograph)
    assert seen.notes[-1].startswith("1 view that has no photograph was rendered")


def test_photographs_that_moved_are_no_views_without(small, splatseg) -> None:
    shutil.rmtree(small.capture / "images")
    status, _, err = splatseg("see", small.scene, *CLASSICAL)
    assert status == 2
    assert "--data" in err


def test_renders_beside_label_maps_are_none(imported, tmp_path) -> None:
    """`_renders` of an evidence of PNG files is not read as label maps of further views."""
    (tmp_path / "labels" / "_renders").mkdir(parents=True)
    for path in ("a.png", "_renders/a.png", "_renders/b.png"):
        Image.fromarray(np.ones((4, 4), np.uint8)).save(tmp_path / "labels" / path)
    assert open_evidence(tmp_path / "labels").view_names == ("a",)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_backend(imported, splatseg, monkeypatch, backend) -> None:
    asked: set[str] = set()

    class Field:
        def __init__(self, gaussians: Gaussians, layers: object, **options: str) -> None:
            asked.add(options["backend"])
            raise KeyboardInterrupt

    monkeypatch.setattr("splatseg.tasks.work.GaussianField", Field)
    splatseg("see", imported, *CLASSICAL, "--backend", backend)
    assert asked == {backend}


def test_a_scene_of_nothing_visible_is_shown_empty(imported) -> None:
    scene = load_scene(imported)
    faint = scene.gaussians.replace(opacities=torch.zeros(len(scene.gaussians)))
    save_scene(replace(scene, gaussians=faint), imported)
    seen = see(load_scene(imported), Halves(), "m")
    assert all(not image.any() for image in pictures(seen.folder / "_renders").values())
    assert json.loads((seen.folder / "evidence.json").read_text())["kind"] == "masks"
