"""Scene folders: version 1 as it was written, round trips, photographs that moved."""

import importlib.util
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Camera, Gaussians, Labels, Scene, Selection, View
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.captures import read_capture
from splatseg.io.evidence import open_evidence
from splatseg.io.images import load_image
from splatseg.io.scene import (
    load_scene,
    load_scene_layer,
    save_scene,
    save_scene_layer,
    scene_layer_names,
)
from splatseg.io.scene_fields import (
    new_field_file,
    new_field_folder,
    remove_field_file,
    remove_field_folder,
    scene_field_names,
    scene_field_path,
)
from splatseg.io.scene_folder import is_scene


@pytest.fixture(scope="module")
def golden(project_root: Path):
    """The script that made the golden files, as a module."""
    path = project_root / "tests/golden/make_io.py"
    spec = importlib.util.spec_from_file_location("make_io", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def version_1(tmp_path: Path, project_root: Path) -> Path:
    return Path(shutil.copytree(project_root / "tests/golden/scene-v1", tmp_path / "scene"))


def same_gaussians(a: Gaussians, b: Gaussians) -> None:
    for name in ("means", "rotations", "sh"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name
    for name in ("scales", "opacities"):
        # Files hold logs and logits.
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-6)
    assert set(a.extra) == set(b.extra)
    for name, column in a.extra.items():
        assert torch.equal(column, b.extra[name])


def same_camera(a: Camera, b: Camera) -> None:
    for name in ("width", "height", "fx", "fy", "cx", "cy", "model", "distortion"):
        assert getattr(a, name) == getattr(b, name), name
    np.testing.assert_allclose(a.cam_from_world, b.cam_from_world, rtol=0, atol=4e-15)


def same_scene(a: Scene, b: Scene) -> None:
    same_gaussians(a.gaussians, b.gaussians)
    assert [(v.name, v.split) for v in a.views] == [(v.name, v.split) for v in b.views]
    for one, other in zip(a.views, b.views, strict=True):
        same_camera(one.camera, other.camera)
        assert (one.image is None) == (other.image is None)
    assert a.classes == b.classes
    assert (a.up, a.metres_per_unit) == (b.up, b.metres_per_unit)
    assert dict(a.provenance) == dict(b.provenance)


@pytest.mark.bits
def test_version_1_is_read(version_1, golden) -> None:
    scene = load_scene(version_1)
    same_scene(golden.golden_scene(), scene)
    assert scene.root == version_1
    assert scene_layer_names(version_1) == ("chosen", "features", "semantic")
    for name, layer in golden.golden_layers().items():
        read = load_scene_layer(version_1, name)
        assert type(read) is type(layer)
        assert read.info == layer.info
        for field in ("ids", "confidence", "candidates", "shares", "values", "weights", "mask"):
            if (expected := getattr(layer, field, None)) is not None:
                assert torch.equal(getattr(read, field), expected), field
        # A selection had no confidence before version 4.
        if isinstance(read, Selection):
            assert read.confidence is None
    labels, masks, features = golden.golden_evidence()
    read = open_evidence(version_1 / "evidence/labels")
    assert read.classes == golden.CLASSES
    assert torch.equal(read.label_map("left/1").ids, labels.ids)
    np.testing.assert_allclose(
        read.label_map("left/1").confidence, labels.confidence, atol=1 / 65535
    )
    read = open_evidence(version_1 / "evidence/masks").masks("left/1")
    assert (read.scores.tolist(), read.levels.tolist()) == ([0.75, 0.5], [2, 0])
    for i in range(2):
        assert torch.equal(read.dense(i), masks.dense(i))
    read = open_evidence(version_1 / "evidence/features").features("left/1")
    assert (read.stride, read.height, read.width) == (2, 6, 8)
    assert torch.equal(read.features, features.features)


@pytest.mark.bits
def test_version_1_is_written_as_it_was(golden, project_root, tmp_path, monkeypatch) -> None:
    """The script gives the committed bytes; a change of them needs a new version."""
    monkeypatch.setattr(golden, "ROOT", tmp_path / "scene-v1")
    later = Path("evidence/features/evidence.json")
    golden.main()
    committed = project_root / "tests/golden/scene-v1"
    files = [p.relative_to(committed) for p in committed.rglob("*") if p.is_file()]
    written = tmp_path / "scene-v1"
    assert sorted(files) == sorted(
        p.relative_to(written) for p in written.rglob("*") if p.is_file()
    )
    for file in files:
        # Compressed bytes are zlib's business; layers, and the header of features, are of a later
        # version than those of then.
        if file.suffix != ".png" and file.parts[0] != "layers" and file != later:
            assert (written / file).read_bytes() == (committed / file).read_bytes(), file


@pytest.fixture
def scene_of_capture(tmp_path, golden):
    """A scene of a small capture with photographs; gives its root and the capture's folder."""
    data = tmp_path / "data"
    frames = []
    for i, name in enumerate(["images/a.png", "images/sub/b.png"]):
        (data / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (8, 6), (10 * i, 0, 0)).save(data / name)
        matrix = np.eye(4)
        matrix[0, 3] = i
        frames.append({"file_path": name, "transform_matrix": matrix.tolist(), "mask_path": name})
    content = {"w": 8, "h": 6, "fl_x": 9, "frames": frames}
    (data / "transforms.json").write_text(json.dumps(content))
    capture = read_capture(data)
    scene = replace(golden.golden_scene(), views=capture.views, source=data)
    (tmp_path / "out").mkdir()
    return save_scene(scene, tmp_path / "out/scene"), data


def test_a_saved_scene_finds_its_photographs(scene_of_capture) -> None:
    saved, data = scene_of_capture
    scene = load_scene(saved.root)
    same_scene(saved, scene)
    assert scene.source.resolve() == data.resolve()
    for view, before in zip(scene.views, saved.views, strict=True):
        assert view.image.resolve() == before.image.resolve()
        assert view.mask.resolve() == before.mask.resolve()
    assert load_image(scene.view("b"))[0, 0, 0] == 10


def test_the_scene_and_its_capture_move_together(scene_of_capture, tmp_path) -> None:
    saved, data = scene_of_capture
    (tmp_path / "elsewhere/out").mkdir(parents=True)
    shutil.move(saved.root, tmp_path / "elsewhere/out/scene")
    shutil.move(data, tmp_path / "elsewhere/data")
    scene = load_scene(tmp_path / "elsewhere/out/scene")
    assert scene.source == tmp_path / "elsewhere/data"
    assert load_image(scene.view("b"))[0, 0, 0] == 10


def test_the_scene_alone_moves(scene_of_capture, tmp_path) -> None:
    saved, data = scene_of_capture
    (tmp_path / "a/b/c").mkdir(parents=True)
    shutil.move(saved.root, tmp_path / "a/b/c/scene")
    scene = load_scene(tmp_path / "a/b/c/scene")
    assert scene.source == data
    assert load_image(scene.view("b"))[0, 0, 0] == 10


def test_photographs_that_are_gone_fail_only_when_read(scene_of_capture, tmp_path) -> None:
    saved, data = scene_of_capture
    shutil.move(data, tmp_path / "moved")
    scene = load_scene(saved.root)
    assert len(scene.views) == 2
    with pytest.raises(MissingFileError, match=r"a.png: the photograph .* --data"):
        load_image(scene.view("a"))
    scene = load_scene(saved.root, data=tmp_path / "moved")
    assert scene.source == tmp_path / "moved"
    assert load_image(scene.view("b"))[0, 0, 0] == 10
    assert scene.view("b").mask == tmp_path / "moved/images/sub/b.png"


def test_data_must_have_the_photographs(scene_of_capture, tmp_path) -> None:
    saved, data = scene_of_capture
    (data / "images/a.png").unlink()
    with pytest.raises(MissingFileError, match=r"1 of 2 photographs .* \(images/a.png\)"):
        load_scene(saved.root, data=data)
    with pytest.raises(MissingFileError, match="gone: there is no such folder"):
        load_scene(saved.root, data=tmp_path / "gone")


def test_photographs_outside_the_capture_keep_their_place(scene_of_capture, tmp_path) -> None:
    saved, data = scene_of_capture
    (tmp_path / "far").mkdir()
    outside = shutil.copy(data / "images/sub/b.png", tmp_path / "far/c.png")
    views = (saved.views[0], replace(saved.views[1], image=Path(outside)))
    save_scene(replace(saved, views=views), saved.root)
    shutil.move(data, tmp_path / "moved")
    scene = load_scene(saved.root, data=tmp_path / "moved")
    assert scene.view("a").image == tmp_path / "moved/images/a.png"
    assert scene.view("b").image == tmp_path / "far/c.png"


def test_another_folder_at_the_old_place_is_not_the_capture(scene_of_capture, tmp_path) -> None:
    """Seen from the scene there is a folder of that name, but without its photographs."""
    saved, data = scene_of_capture
    (tmp_path / "new/out").mkdir(parents=True)
    (tmp_path / "new/data").mkdir()
    shutil.move(saved.root, tmp_path / "new/out/scene")
    assert load_scene(tmp_path / "new/out/scene").source == data


def test_a_scene_without_photographs(tmp_path, golden) -> None:
    bare = Scene(gaussians=golden.golden_scene().gaussians)
    save_scene(bare, tmp_path / "s")
    read = load_scene(tmp_path / "s")
    same_scene(bare, read)
    assert (read.source, read.classes, read.up) == (None, None, None)
    view = replace(golden.golden_scene().views[2], image=None)
    save_scene(replace(bare, views=(view,)), tmp_path / "s")
    assert load_scene(tmp_path / "s").views[0].image is None


def test_saving_again_keeps_layers_and_says_when_they_are_stale(tmp_path, golden) -> None:
    scene = golden.golden_scene()
    save_scene(scene, tmp_path / "s")
    save_scene_layer(Selection(mask=torch.ones(3).bool()), tmp_path / "s", "a.b-1")
    save_scene(replace(scene, up=(1.0, 0.0, 0.0)), tmp_path / "s")
    assert load_scene_layer(tmp_path / "s", "a.b-1").count == 3
    assert load_scene(tmp_path / "s").up == (1, 0, 0)
    save_scene(replace(scene, gaussians=scene.gaussians[:2]), tmp_path / "s")
    with pytest.raises(FileFormatError, match="expected 2 rows .* got 3; the layer is from before"):
        load_scene_layer(tmp_path / "s", "a.b-1")


def test_a_relative_root(tmp_path, monkeypatch, scene_of_capture) -> None:
    saved, _ = scene_of_capture
    monkeypatch.chdir(tmp_path)
    save_scene(saved, "relative")
    scene = load_scene("relative")
    assert load_image(scene.view("b"))[0, 0, 0] == 10
    monkeypatch.chdir(tmp_path / "relative")
    assert load_image(load_scene(".").view("b"))[0, 0, 0] == 10


def test_numbers_survive_to_the_last_bit(tmp_path, rng, golden) -> None:
    views = []
    for i in range(20):
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        pose = np.eye(4)
        pose[:3, :3] = q * np.sign(np.linalg.det(q))
        pose[:3, 3] = rng.normal(size=3)
        numbers = rng.uniform(1, 100, 4)
        camera = Camera(
            width=100,
            height=90,
            fx=numbers[0],
            fy=numbers[1],
            cx=numbers[2],
            cy=numbers[3],
            cam_from_world=torch.from_numpy(pose),
            model="opencv",
            distortion=tuple(rng.normal(size=8)),
        )
        views.append(View(name=f"{i:02d}", camera=camera, split="train"))
    scene = replace(golden.golden_scene(), views=tuple(views), source=None)
    save_scene(scene, tmp_path / "s")
    same_scene(scene, load_scene(tmp_path / "s"))


def test_nerfstudio_reads_the_cameras(scene_of_capture) -> None:
    """cameras/transforms.json is a transforms.json like any other."""
    saved, _ = scene_of_capture
    capture = read_capture(saved.root / "cameras")
    for view, before in zip(capture.views, saved.views, strict=True):
        same_camera(view.camera, before.camera)
        assert (view.name, view.split) == (before.name, before.split)


def _edit(path: Path, change) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(version=2), "version 1 or less, got version 2; a later splatseg"),
        (lambda c: c.update(format="x"), "expected a scene, got 'x'"),
        (lambda c: c.pop("gaussians"), "expected a field gaussians"),
        (lambda c: c.update(gaussians=4), "expected 4 Gaussians as scene.json says, got 3"),
        (lambda c: c["split"]["train"].pop(), "names each view of cameras/transforms.json once"),
        (lambda c: c["split"]["train"].append("right/1"), "names each view"),
        (lambda c: c.update(split=[1]), "split: expected an object"),
        (lambda c: c.update(up=[1, 2]), "up: expected .*length 3"),
        (lambda c: c.update(classes=[{"id": "a"}]), r"classes\[0\].*: expected"),
        (lambda c: c.update(source={"absolute": "\0"}), "scene.json: expected paths of the source"),
    ],
)
def test_a_scene_json_that_contradicts_itself(version_1, change, message) -> None:
    _edit(version_1 / "scene.json", change)
    with pytest.raises(FileFormatError, match=message):
        load_scene(version_1)


def test_the_split_of_scene_json_counts(version_1) -> None:
    _edit(
        version_1 / "scene.json",
        lambda c: c.update(split={"train": ["right/1"], "test": ["left/1"], "extra": ["left/2"]}),
    )
    splits = {view.name: view.split for view in load_scene(version_1).views}
    assert splits == {"right/1": "train", "left/1": "test", "left/2": "extra"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("frames"), "expected a list of frames"),
        (lambda c: c["frames"][0].pop("name"), r"frames\[0\]: expected a field name"),
        (lambda c: c.pop("fl_x"), "expected a number fl_x, got none"),
        (lambda c: c["frames"][1]["transform_matrix"].pop(), "finite|last row|4 x 4|rotation"),
        (lambda c: c["frames"].__setitem__(0, 3), r"frames\[0\]: expected an object"),
    ],
)
def test_cameras_that_are_broken(version_1, change, message) -> None:
    path = version_1 / "cameras/transforms.json"
    if "rotation" in message:
        _edit(path, lambda c: c["frames"][1]["transform_matrix"][0].__setitem__(0, 5))
    else:
        _edit(path, change)
    with pytest.raises(InputError, match=message):
        load_scene(version_1)


def test_what_is_no_scene(tmp_path, golden) -> None:
    with pytest.raises(MissingFileError, match=r"expected a scene folder, got none"):
        load_scene(tmp_path)
    (tmp_path / "scene.json").write_text("{")
    assert is_scene(tmp_path)
    with pytest.raises(FileFormatError, match=r"scene.json: expected JSON"):
        load_scene(tmp_path)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/a.jpg").write_bytes(b"x")
    with pytest.raises(InputError, match="expected an empty folder or a scene"):
        save_scene(golden.golden_scene(), tmp_path / "photos")
    assert [p.name for p in (tmp_path / "photos").iterdir()] == ["a.jpg"]
    with pytest.raises(MissingFileError):
        save_scene(golden.golden_scene(), tmp_path / "no/parent")


def test_nothing_half_written_stays(tmp_path, golden) -> None:
    bad = replace(golden.golden_scene(), provenance={"when": object()})
    with pytest.raises(InputError, match=r"provenance.when: expected a value that JSON holds"):
        save_scene(bad, tmp_path / "s")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "-x", "a b"])
def test_layer_names_are_file_names(version_1, name) -> None:
    with pytest.raises(InputError, match="layer: expected a name of letters"):
        save_scene_layer(Selection(mask=torch.ones(3).bool()), version_1, name)


def test_layers_that_are_not_of_the_scene(version_1) -> None:
    with pytest.raises(InputError, match=r"\(chosen, features, semantic\), got 'gone'"):
        load_scene_layer(version_1, "gone")
    with pytest.raises(InputError, match="layer 'l': expected 3 rows .* got 2"):
        save_scene_layer(Labels(ids=torch.ones(2), confidence=torch.ones(2)), version_1, "l")


def test_evidence_appears_with_a_new_scene_or_not_at_all(tmp_path, golden, monkeypatch) -> None:
    evidence = tmp_path / "a" / "masks"
    (evidence / "deeper").mkdir(parents=True)
    (evidence / "deeper" / "v.png").write_bytes(b"123")
    scene = golden.golden_scene()
    saved = save_scene(scene, tmp_path / "with", evidence=[evidence])
    assert (saved.root / "evidence" / "masks" / "deeper" / "v.png").read_bytes() == b"123"
    with pytest.raises(InputError, match="expected a new folder to copy evidence to"):
        save_scene(scene, tmp_path / "with", evidence=[evidence])
    with pytest.raises(InputError, match="expected a folder of evidence, got none"):
        save_scene(scene, tmp_path / "without", evidence=[tmp_path / "none"])

    def stopped(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "copytree", stopped)
    with pytest.raises(KeyboardInterrupt):
        save_scene(scene, tmp_path / "stopped", evidence=[evidence])
    assert {path.name for path in tmp_path.iterdir()} == {"a", "with"}


# Where the fields of a scene are: files, and folders of drives in blocks.


@pytest.fixture
def root(tmp_path) -> Path:
    """A scene with a field of each form, and with what is none."""
    new_field_file(tmp_path, "one").write_bytes(b"")
    folder = new_field_folder(tmp_path, "drive")
    for name in ("drive.json", "0000.safetensors", "0001.safetensors"):
        (folder / name).write_bytes(b"")
    (tmp_path / "fields/empty").mkdir()
    (tmp_path / "fields/odd.safetensors").mkdir()
    (tmp_path / "fields/.hidden").mkdir()
    (tmp_path / "fields/.hidden/drive.json").write_bytes(b"")
    (tmp_path / "fields/notes.txt").write_bytes(b"")
    return tmp_path


def test_files_and_folders_are_fields(root) -> None:
    assert scene_field_names(root) == ("drive", "one")
    assert scene_field_path(root, "one") == root / "fields/one.safetensors"
    assert scene_field_path(root, "drive") == root / "fields/drive"
    with pytest.raises(InputError, match=r"^field: expected one of .* \(drive, one\), got 'odd'"):
        scene_field_path(root, "odd")
    with pytest.raises(InputError, match="it has none; `splatseg street` makes one"):
        scene_field_path(root / "fields", "one")


def test_of_two_forms_of_a_name_the_file_counts(root) -> None:
    new_field_file(root, "drive").write_bytes(b"")
    assert scene_field_names(root) == ("drive", "one")
    assert scene_field_path(root, "drive").is_file()


def test_what_is_removed_is_the_field_and_nothing_else(root) -> None:
    kept = root / "fields/drive/notes.txt"
    kept.write_text("mine")
    remove_field_folder(root, "drive")
    assert scene_field_names(root) == ("one",)
    assert list(kept.parent.iterdir()) == [kept]
    kept.unlink()
    remove_field_folder(root, "drive")
    assert not kept.parent.exists()
    remove_field_folder(root, "drive")
    remove_field_file(root, "one")
    remove_field_file(root, "one")
    assert scene_field_names(root) == ()


def test_nothing_is_written_or_removed_outside(tmp_path) -> None:
    outside, root = tmp_path / "outside", tmp_path / "scene"
    outside.mkdir()
    (outside / "drive.json").write_bytes(b"")
    (root / "fields").mkdir(parents=True)
    (root / "fields/drive").symlink_to(outside)
    for work in (new_field_folder, remove_field_folder):
        with pytest.raises(InputError, match="a link leads out of it"):
            work(root, "drive")
        with pytest.raises(InputError, match="^field: expected a name of letters"):
            work(root, "../outside")
    assert (outside / "drive.json").is_file()
