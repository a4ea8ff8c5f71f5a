"""The demo, much smaller than it is by default: what it leaves, and what it does not touch."""

import json
import re
import shutil
from pathlib import Path

import pytest
import torch

from splatseg.cli import main
from splatseg.core import InstanceTree, Labels, Layer
from splatseg.io.captures import read_capture
from splatseg.io.scene import load_scene, load_scene_layer, scene_layer_names
from splatseg.io.splats import read_splats
from splatseg.tasks import demo as demo_task

SMALL = ["--steps", "40", "--train-views", "6", "--width", "64", "--max-gaussians", "3000"]


def rows_of(layer: Layer) -> torch.Tensor:
    """The id, or the deepest node, of every Gaussian."""
    labels = layer.labels if isinstance(layer, InstanceTree) else layer
    assert isinstance(labels, Labels)
    return labels.ids


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "out"
    assert main(["demo", "-o", str(folder), *SMALL]) == 0
    return folder


@pytest.fixture
def earlier(finished: Path, tmp_path: Path) -> Path:
    """A finished demo that a test may spoil."""
    return shutil.copytree(finished, tmp_path / "out")


def test_everything_is_there_and_opens(finished: Path):
    names = {path.name for path in finished.iterdir()}
    assert names == {
        "capture",
        "scene",
        "render",
        "labelled.ply",
        "labelled.json",
        "demo.json",
    }
    capture = read_capture(finished / "capture")
    assert (len(capture.train_views), len(capture.test_views)) == (6, 1)
    scene = load_scene(finished / "scene")
    assert scene_layer_names(finished / "scene") == ("objects", "semantic")
    assert (finished / "scene" / "reports" / "objects.html").is_file()
    tree = load_scene_layer(finished / "scene", "objects")
    assert isinstance(tree, InstanceTree), "masks overlap"
    objects = tree.cut()
    assert len(list((finished / "scene" / "exports" / "objects" / "objects").glob("*.ply"))) == len(
        set(objects.ids.tolist()) - {-1}
    )
    labelled = read_splats(finished / "labelled.ply")
    assert len(labelled) == len(scene.gaussians)
    assert set(labelled.extra["class_id"].unique().tolist()) <= set(range(17))


def test_the_record_holds_the_figures_and_pages_show_the_truth(finished: Path):
    record = json.loads((finished / "demo.json").read_text())
    assert record["finished"] is True
    assert 0 < record["miou_lifted_test"] < 1
    assert 0 < record["miou_labels_as_they_came_train"] < 1
    assert 0 <= record["miou_objects_test"] < 1
    assert 3 < record["psnr_test"] < 50
    assert sum(record["seconds"].values()) == pytest.approx(record["seconds_total"], abs=1.0)
    assert list(record["seconds"]) == [
        "generate", "fit", "segment semantic", "see", "segment objects", "render",
        "evaluate semantic, train", "evaluate semantic, test", "evaluate objects, test",
        "export",
    ]  # fmt: skip
    for layer, method in (("semantic", "uplift"), ("objects", "associate")):
        page = (finished / "scene" / "reports" / f"{layer}.html").read_text(encoding="utf-8")
        (made_by,) = re.findall(r"Made by <code>(.*?)</code>", page)
        made_by = re.sub(r"</?span[^>]*>", "", made_by)
        assert made_by in [line.replace("&", "&amp;") for line in record["commands"]]
        assert f"--method {method}" in made_by
        assert page.count("data:image/") >= 10
        assert "errors in red" in page
        assert not re.search(r"(src|href)=\"(?!data:|#)", page)


def test_what_is_printed_makes_the_same(finished: Path, earlier: Path):
    """The printed lines, typed into a terminal in another folder, give the same files."""
    lines = json.loads((finished / "demo.json").read_text())["commands"]
    assert [line.split()[1] for line in lines] == [
        "fit",
        "segment",
        "see",
        "segment",
        "render",
        "evaluate",
        "evaluate",
        "evaluate",
        "export",
    ]
    for name in ("scene", "render"):
        shutil.rmtree(earlier / name)
    (earlier / "labelled.ply").unlink()
    for line in lines:
        assert main(line.replace(str(finished), str(earlier)).split()[1:]) == 0, line
    for name in ("gaussians.ply", "exports/objects/labelled.ply"):
        assert (earlier / "scene" / name).read_bytes() == (finished / "scene" / name).read_bytes()
    for name in ("semantic", "objects"):
        again, first = (load_scene_layer(at / "scene", name) for at in (earlier, finished))
        assert rows_of(again).equal(rows_of(first))
    assert (earlier / "labelled.ply").read_bytes() == (finished / "labelled.ply").read_bytes()
    drawn = sorted((finished / "render").rglob("*.png"))
    assert drawn
    for path in drawn:
        other = earlier / path.relative_to(finished)
        assert other.read_bytes() == path.read_bytes(), path


def test_a_second_run_replaces_what_the_first_wrote_and_nothing_else(
    earlier: Path, capsys: pytest.CaptureFixture[str]
):
    (earlier / "notes.txt").write_text("mine")
    (earlier / "capture" / "images" / "stray.jpg").write_text("from before")
    (earlier / "labelled.json").write_text("from before")
    assert main(["demo", "-o", str(earlier), *SMALL, "--seed", "1"]) == 0
    assert "Replacing the earlier demo" in capsys.readouterr().out
    assert (earlier / "notes.txt").read_text() == "mine"
    assert not (earlier / "capture" / "images" / "stray.jpg").exists()
    assert "from before" not in (earlier / "labelled.json").read_text(encoding="utf-8")


def test_after_ctrl_c_a_second_run_works(
    earlier: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def stop(*_, **__) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(demo_task, "export_scene", stop)
        assert main(["demo", "-o", str(earlier), *SMALL]) == 1
    assert "interrupted" in capsys.readouterr().err
    assert json.loads((earlier / "demo.json").read_text())["finished"] is False
    assert not (earlier / "labelled.ply").exists()
    assert main(["demo", "-o", str(earlier), *SMALL]) == 0
    assert json.loads((earlier / "demo.json").read_text())["finished"] is True


def test_ctrl_c_while_photographing_leaves_only_the_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def stop(*_) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("splatseg.synthetic.capture.render_truth", stop)
    assert main(["demo", "-o", str(tmp_path / "out"), *SMALL]) == 1
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["demo.json"]


def test_somebody_elses_folder_is_refused_and_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "precious.jpg").write_text("mine")
    assert main(["demo", "-o", str(tmp_path), *SMALL]) == 2
    assert "an earlier demo made" in capsys.readouterr().err
    (tmp_path / "demo.json").write_text('{"made_by": "somebody"}')
    assert main(["demo", "-o", str(tmp_path), *SMALL]) == 2
    assert (tmp_path / "capture" / "precious.jpg").read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-o", "a/b"], "a/b: expected a place"),
        (["-o", "file"], "file: expected a folder"),
        (["--train-views", "2"], "--train-views: expected at least 4"),
        (["--width", "8"], "--width: expected at least 32"),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence(
    words: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    assert main(["demo", *words]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
