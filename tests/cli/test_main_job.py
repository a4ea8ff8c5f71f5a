"""segment, render, evaluate, export: the main job after a fit, as the shell runs it."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Features, Labels, Selection, layer_info_to_json
from splatseg.io.scene import load_scene, load_scene_layer, save_scene_layer
from splatseg.io.splats import read_splats
from splatseg.lift import label_map

SEGMENT = ("--method", "uplift", "--evidence", "labels_semantic", "--backend", "cpu")


@pytest.fixture
def segmented(small, splatseg):
    status, out, err = splatseg("segment", small.scene, *SEGMENT, "--layer", "semantic")
    assert (status, err.strip()) == (0, ""), err
    assert "3 ids" in out or "2 ids" in out
    return small


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def test_segment_writes_a_layer_that_tells_how(segmented) -> None:
    layer = load_scene_layer(segmented.scene, "semantic")
    assert isinstance(layer, Labels)
    assert layer.background == 1
    means = load_scene(segmented.scene).gaussians.means
    clear = means[:, 0].abs() > 0.4
    clear &= (means[:, 0].abs() < 0.9) & (means[:, 1] > 0.2) & (means[:, 1] < 0.7)
    expected = torch.where(means[:, 0] < 0, 2, 7)
    assert torch.equal(layer.ids[clear], expected[clear].int())
    info = layer.info
    assert info.method == "uplift"
    assert info.evidence == "labels_semantic"
    assert info.views == ("train_0", "train_1", "train_3")
    assert (info.views_asked, info.seed) == ("train", 0)
    assert info.names == {1: "sky", 2: "left wall", 7: "right wall"}
    assert set(info.versions) == {"splatseg", "torch"}


def test_segment_views(small, splatseg) -> None:
    def views(asked: str) -> list[str]:
        assert splatseg("segment", small.scene, *SEGMENT, "--views", asked)[0] == 0
        layer = load_scene_layer(small.scene, "labels_semantic")
        assert layer.info.views_asked == asked
        return list(layer.info.views)

    assert views("train_1,train_3") == ["train_1", "train_3"]
    assert views("all") == ["train_0", "train_1", "train_3"]
    truth = small.capture / "semantic" / "test_2.png"
    (small.capture / "labels_semantic" / "test_2.png").write_bytes(truth.read_bytes())
    assert views("train") == ["train_0", "train_1", "train_3"]
    assert views("all") == ["test_2", "train_0", "train_1", "train_3"]
    status, out, _ = splatseg(
        "evaluate", small.scene, "--layer", "labels_semantic", "--truth",
        small.capture / "semantic", "--backend", "cpu",
    )  # fmt: skip
    assert status == 0
    assert "made from 1 of these views" in out


def test_a_source_whose_zero_is_a_class(small, splatseg, tmp_path) -> None:
    """Ids one lower in the files: sky is 0, and 255 is void."""
    for folder, other in (("labels_semantic", "labels_zero"), ("semantic", "truth_zero")):
        (small.capture / other).mkdir()
        for path in (small.capture / folder).glob("*.png"):
            ids = pixels(path)
            lower = np.where(ids == 0, 255, ids - 1).astype(np.uint8)
            Image.fromarray(lower).save(small.capture / other / path.name)
    rule = ("--zero-is-class", "--void", 255, "--backend", "cpu")
    status, _, err = splatseg(
        "segment", small.scene, "--method", "uplift", "--evidence", "labels_zero", *rule
    )
    assert status == 0, err
    layer = load_scene_layer(small.scene, "labels_zero")
    assert layer.background == 1
    assert layer.info.source_ids == {1: 0, 2: 1, 7: 6}
    arguments = ("--layer", "labels_zero", "--truth", small.capture / "truth_zero", "--json")
    status, text, err = splatseg("evaluate", small.scene, *arguments, *rule)
    assert status == 0, err
    assert set(json.loads(text)["per_class"]) == {"1", "2", "7"}
    assert json.loads(text)["mIoU"] > 0.7
    arguments = ("--what", "labels_zero", "-o", tmp_path / "out", "--backend", "cpu")
    assert splatseg("render", small.scene, *arguments)[0] == 0
    legend = json.loads((tmp_path / "out" / "labels_zero" / "legend.json").read_text())
    assert {k: v["source_id"] for k, v in legend["ids"].items()} == {"1": 0, "2": 1, "7": 6}


@pytest.mark.bits
def test_segment_is_repeatable(small, splatseg) -> None:
    path = small.scene / "layers" / "a.npz"
    for _ in range(2):
        assert splatseg("segment", small.scene, *SEGMENT, "--layer", "a", "--seed", 5)[0] == 0
        first, second = path.read_bytes(), path.read_bytes()
    assert first == second
    assert load_scene_layer(small.scene, "a").info.seed == 5


def test_render_writes_what_was_asked(segmented, splatseg, tmp_path) -> None:
    out = tmp_path / "out"
    status, text, err = splatseg(
        "render", segmented.scene, "--split", "all", "--what", "rgb,depth,alpha,semantic",
        "--coloured", "-o", out, "--backend", "cpu",
    )  # fmt: skip
    assert status == 0, err
    assert "4 views" in text
    names = ["test_2", "train_0", "train_1", "train_3"]
    for what in ("rgb", "depth", "alpha", "semantic", "semantic_coloured"):
        assert [p.stem for p in sorted((out / what).glob("*.png"))] == names
    assert not list(out.rglob(".*"))

    photograph = pixels(segmented.capture / "images" / "train_1.png")
    assert np.array_equal(pixels(out / "rgb" / "train_1.png"), photograph)

    scene = load_scene(segmented.scene)
    layer = load_scene_layer(segmented.scene, "semantic")
    shown = label_map(
        scene.gaussians, scene.view("test_2").camera, layer, backend="cpu"
    ).ids.numpy()
    drawn = pixels(out / "semantic" / "test_2.png")
    assert drawn.dtype in (np.uint16, np.int32)
    assert np.array_equal(drawn, np.where(shown < 0, 0, shown))
    assert set(np.unique(drawn)) == {1, 2, 7}

    legend = json.loads((out / "semantic" / "legend.json").read_text())
    assert legend["background"] == 1
    assert legend["ids"]["7"] == {"name": "right wall", "colour": [7, 0, 63]}
    colours = pixels(out / "semantic_coloured" / "test_2.png")
    assert np.array_equal(colours[drawn == 7], np.tile([7, 0, 63], ((drawn == 7).sum(), 1)))

    unit = json.loads((out / "depth" / "depth.json").read_text())["unit"]
    depth = pixels(out / "depth" / "test_2.png")
    alpha = pixels(out / "alpha" / "test_2.png")
    assert depth.dtype in (np.uint16, np.int32)
    assert np.all(depth[alpha < 120] == 0)
    assert np.allclose(depth[alpha > 135] * unit, 2.0, atol=0.01)
    assert (alpha > 135).any()
    assert (alpha < 120).any()
    assert depth.max() > 65535 / 10, "16 bits are there to be used"


def test_render_draws_a_selection_as_a_mask(small, splatseg, tmp_path) -> None:
    scene = load_scene(small.scene)
    save_scene_layer(Selection(mask=scene.gaussians.means[:, 0] > 0), small.scene, "blue")
    arguments = ("--what", "blue", "-o", tmp_path / "out", "--backend", "cpu")
    assert splatseg("render", small.scene, *arguments)[0] == 0
    mask = pixels(tmp_path / "out" / "blue" / "test_2.png")
    assert mask.dtype == np.uint8
    assert set(np.unique(mask)) == {0, 255}
    rgb = pixels(small.capture / "images" / "test_2.png").astype(int)
    assert np.all(mask[rgb[..., 2] > 180] == 255)
    assert np.all(mask[rgb[..., 0] > 180] == 0)


def test_render_replaces_its_own_folders_and_no_others(segmented, splatseg, tmp_path) -> None:
    def draw(split: str, output: Path, what: str = "semantic") -> tuple[int, str, str]:
        return splatseg(
            "render", segmented.scene, "--split", split, "--what", what, "-o", output,
            "--backend", "cpu",
        )  # fmt: skip

    out = tmp_path / "out"
    assert draw("test", out)[0] == 0
    assert draw("train", out)[0] == 0
    assert len(list((out / "semantic").glob("*.png"))) == 3
    assert draw("test", out, "alpha")[0] == 0
    assert (out / "semantic").is_dir()
    # A capture's truth goes by the same name as the layer.
    before = (segmented.capture / "semantic" / "test_2.png").read_bytes()
    status, _, err = draw("test", segmented.capture)
    assert status == 2
    assert "choose another output folder" in err
    assert (segmented.capture / "semantic" / "test_2.png").read_bytes() == before


def test_an_interrupted_render_leaves_nothing(small, splatseg, tmp_path, monkeypatch) -> None:
    from splatseg.tasks import render as module

    calls = []

    def interrupted(*arguments, **options):
        if calls:
            raise KeyboardInterrupt
        calls.append(1)
        return original(*arguments, **options)

    original = module._draw_pictures
    monkeypatch.setattr(module, "_draw_pictures", interrupted)
    out = tmp_path / "out"
    status, _, err = splatseg(
        "render", small.scene, "--split", "all", "--what", "rgb,depth", "-o", out,
        "--backend", "cpu",
    )  # fmt: skip
    assert status == 1
    assert "Traceback" not in err
    assert not out.exists()


def test_an_interrupted_segment_leaves_the_layer_as_it_was(
    segmented, splatseg, monkeypatch
) -> None:
    import importlib

    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    before = {p: p.read_bytes() for p in segmented.scene.rglob("*") if p.is_file()}
    # The package's function of the same name hides the module from an import statement.
    monkeypatch.setattr(
        importlib.import_module("splatseg.lift.voting.uplift"), "prepare", interrupted
    )
    assert splatseg("segment", segmented.scene, *SEGMENT, "--layer", "semantic")[0] == 1
    after = {p: p.read_bytes() for p in segmented.scene.rglob("*") if p.is_file()}
    assert after == before


def test_evaluate_agrees_with_the_scorer(segmented, splatseg, score, tmp_path) -> None:
    truth = segmented.capture / "semantic"
    status, text, err = splatseg(
        "evaluate", segmented.scene, "--layer", "semantic", "--truth", truth, "--split", "test",
        "--json", "--backend", "cpu",
    )  # fmt: skip
    assert status == 0, err
    ours = json.loads(text)
    out = tmp_path / "out"
    assert (
        splatseg(
            "render", segmented.scene, "--what", "rgb,semantic", "-o", out,
            "--backend", "cpu",
        )[0]
        == 0
    )  # fmt: skip
    theirs = score("semantic", "--pred", out / "semantic", "--truth", truth, "--views", "test_*")
    for key in ("mIoU", "fwIoU", "accuracy", "mAcc"):
        assert ours[key] == pytest.approx(theirs[key], abs=1e-9)
    assert {k: round(v, 4) for k, v in ours["per_class"].items()} == theirs["per_class"]
    assert ours["mIoU_per_image"] == pytest.approx(ours["mIoU"])
    assert (ours["views"], ours["learned_from"]) == (1, 0)
    assert ours["mIoU"] > 0.7
    pictures = score(
        "image", "--pred", out / "rgb", "--truth", segmented.capture / "images",
        "--views", "test_*",
    )  # fmt: skip
    for key in ("PSNR", "SSIM", "PSNR_min"):
        assert ours[key] == pytest.approx(pictures[key], abs=1e-6)


def test_evaluate_prints_a_table(segmented, splatseg) -> None:
    status, text, _ = splatseg(
        "evaluate", segmented.scene, "--layer", "semantic", "--truth",
        segmented.capture / "semantic", "--backend", "cpu",
    )  # fmt: skip
    assert status == 0
    for word in ("mIoU", "fwIoU", "mIoU_per_image", "PSNR", "right wall"):
        assert word in text
    status, text, _ = splatseg("evaluate", segmented.scene, "--json", "--backend", "cpu")
    assert status == 0
    assert "mIoU" not in json.loads(text)
    assert json.loads(text)["PSNR"] > 50


def test_evaluate_binary(segmented, splatseg) -> None:
    truth = segmented.capture / "semantic"
    arguments = ("--truth", truth, "--metric", "binary", "--json", "--backend", "cpu")
    status, text, err = splatseg(
        "evaluate", segmented.scene, "--layer", "semantic", "--id", 7, *arguments
    )
    assert status == 0, err
    one = json.loads(text)
    assert one["IoU_pooled"] > 0.7
    scene = load_scene(segmented.scene)
    layer = load_scene_layer(segmented.scene, "semantic")
    save_scene_layer(Selection(mask=layer.ids == 7), segmented.scene, "right")
    assert len(scene.gaussians) == len(layer)
    status, text, err = splatseg(
        "evaluate", segmented.scene, "--layer", "right", "--id", 7, *arguments
    )
    assert status == 0, err
    assert json.loads(text)["IoU_pooled"] == pytest.approx(one["IoU_pooled"], abs=0.1)
    status, _, err = splatseg(
        "evaluate", segmented.scene, "--layer", "right", "--truth", truth, "--backend", "cpu"
    )
    assert status == 2
    assert "expected the metric binary" in err


def test_export_writes_columns_and_a_table(segmented, splatseg, tmp_path) -> None:
    output = tmp_path / "labelled.ply"
    status, _, err = splatseg(
        "export", segmented.scene, "--layer", "semantic", "--instances", "semantic", "-o", output
    )
    assert status == 0, err
    layer = load_scene_layer(segmented.scene, "semantic")
    back = read_splats(output)
    assert back.extra["class_id"].dtype == torch.int32
    assert back.extra["confidence"].dtype == torch.float32
    expected = torch.where(layer.ids < 0, 0, layer.ids)
    assert torch.equal(back.extra["class_id"].reshape(-1), expected)
    assert torch.equal(back.extra["instance_id"].reshape(-1), expected)
    assert torch.equal(back.extra["confidence"].reshape(-1), layer.confidence)
    table = json.loads((tmp_path / "labelled.json").read_text())
    entry = table["columns"]["class_id"]
    assert entry["none"] == 0
    assert entry["background"] == 1
    assert entry["ids"]["7"]["name"] == "right wall"
    assert entry["ids"]["7"]["gaussians"] == int((layer.ids == 7).sum())
    assert entry["made"] == layer_info_to_json(layer.info)
    assert entry["made"]["evidence"] == "labels_semantic"
    # The header says int and float in so many words, for readers that go by it.
    header = output.read_bytes().split(b"end_header")[0].decode()
    assert "property int class_id" in header
    assert "property float confidence" in header


def test_export_of_a_selection_and_without_a_layer(small, splatseg, tmp_path) -> None:
    scene = load_scene(small.scene)
    save_scene_layer(Selection(mask=scene.gaussians.means[:, 0] > 0), small.scene, "blue")
    assert splatseg("export", small.scene, "--layer", "blue", "-o", tmp_path / "b.ply")[0] == 0
    selected = read_splats(tmp_path / "b.ply").extra["selected"].reshape(-1)
    assert torch.equal(selected.bool(), scene.gaussians.means[:, 0] > 0)
    assert splatseg("export", small.scene, "-o", tmp_path / "plain.spz")[0] == 0
    assert not (tmp_path / "plain.json").exists()
    assert len(read_splats(tmp_path / "plain.spz")) == len(scene.gaussians)


def test_mistakes_get_one_sentence(segmented, splatseg, tmp_path) -> None:
    """Status 2, a sentence that names what is there, no traceback and nothing written."""
    scene, truth = segmented.scene, segmented.capture / "semantic"
    save_scene_layer(
        Features(values=torch.zeros(len(load_scene(scene).gaussians), 2)), scene, "vectors"
    )
    stretched = tmp_path / "stretched"
    stretched.mkdir()
    Image.fromarray(np.ones((9, 9), np.uint8)).save(stretched / "test_2.png")
    out = ("-o", tmp_path / "out")
    uplift = ("segment", scene, "--method", "uplift")
    cases = [
        (("segment", tmp_path / "no", *SEGMENT), "scene"),
        (("segment", scene, "--method", "magic"), "uplift"),
        ((*uplift, "--evidence", "nothing"), "labels_semantic"),
        ((*uplift, "--evidence", "labels_semantic", "--layer", "../x"), "--layer"),
        ((*uplift, "--evidence", "labels_semantic", "--views", "train_9"), "train_9"),
        ((*uplift, "--evidence", "labels_semantic", "--views", "test_2"), "test_2"),
        (("render", scene, "--what", "sematnic", *out), "semantic"),
        (("render", scene, "--what", "vectors", *out), "features"),
        (
            ("render", scene, "--what", ",", *out),
            "--what: expected rgb, depth, alpha",
        ),
        (("render", scene, "--split", "holiday", *out), "test, train"),
        (("evaluate", scene, "--layer", "semantic"), "--truth"),
        (("evaluate", scene, "--layer", "vectors", "--truth", truth), "features"),
        (("evaluate", scene, "--layer", "nothing", "--truth", truth), "semantic"),
        (("evaluate", scene, "--layer", "semantic", "--truth", tmp_path / "no"), "no"),
        (("evaluate", scene, "--layer", "semantic", "--truth", stretched), "got 9x9"),
        (("export", scene, "--layer", "semantic", "-o", tmp_path / "x.spz"), ".ply"),
        (("export", scene, "--layer", "vectors", "-o", tmp_path / "x.ply"), "features"),
        (("export", scene, "--layer", "semantic", "-o", tmp_path / "no" / "x.ply"), "folder"),
    ]
    before = sorted(p for p in tmp_path.rglob("*"))
    for arguments, word in cases:
        status, _, err = splatseg(*arguments)
        assert status == 2, (arguments, err)
        assert word in err, (arguments, err)
        assert "Traceback" not in err
    assert sorted(p for p in tmp_path.rglob("*")) == before


def test_only_what_needs_photographs_fails_without_them(segmented, splatseg, tmp_path) -> None:
    (segmented.capture / "images").rename(tmp_path / "moved")
    arguments = ("--what", "rgb", "-o", tmp_path / "out", "--backend", "cpu")
    assert splatseg("render", segmented.scene, *arguments)[0] == 0
    evaluate = (
        "evaluate", segmented.scene, "--layer", "semantic",
        "--truth", segmented.capture / "semantic", "--json", "--backend", "cpu",
    )  # fmt: skip
    status, text, _ = splatseg(*evaluate)
    assert status == 0
    assert "PSNR" not in json.loads(text)
    capture = tmp_path / "elsewhere"
    capture.mkdir()
    (tmp_path / "moved").rename(capture / "images")
    status, text, err = splatseg(*evaluate, "--data", capture)
    assert status == 0, err
    assert "PSNR" in json.loads(text)
