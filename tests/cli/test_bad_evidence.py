"""Evidence and layers that are not what they should be, as the shell meets them.

Whatever is wrong costs one sentence that says what was expected and what came, exit status 2, and
leaves the scene as it was.
"""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import FeatureMap, MaskSet, Segment, Track
from splatseg.errors import FileFormatError
from splatseg.io.evidence import (
    open_evidence,
    save_features,
    save_masks,
    save_segments,
    save_tracks,
)
from splatseg.io.scene import load_scene_layer

HEIGHT, WIDTH = 20, 28
TRAIN = ("train_0", "train_1", "train_3")
Spoil = Callable[[Path], None]


def everything(root: Path) -> dict[Path, bytes]:
    """What lies in a folder."""
    return {path: path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.fixture
def refused(small, splatseg):
    """Run a command on the small scene that must be refused; gives its sentence."""

    def invoke(command: str, *arguments: object) -> str:
        before = everything(small.scene)
        status, out, err = splatseg(command, small.scene, *arguments)
        assert (status, out) == (2, ""), err
        sentences = [line for line in err.splitlines() if line.startswith("error: ")]
        assert len(sentences) == 1
        assert err.rstrip().endswith(sentences[0]), "nothing comes after the sentence"
        assert sentences[0].endswith(".")
        assert "Traceback" not in err
        assert "Error:" not in err
        assert everything(small.scene) == before
        return sentences[0]

    return invoke


@pytest.fixture
def labels(small) -> Path:
    return small.capture / "labels_semantic"


@pytest.fixture
def masks(small) -> Path:
    """Two masks a view."""
    folder = small.capture / "masks_two"
    for name in TRAIN:
        save_masks(MaskSet.from_dense(two()), folder, name)
    return folder


@pytest.fixture
def segments(small) -> Path:
    """Two segments a view, without a table."""
    folder = small.capture / "labels_two"
    folder.mkdir()
    ids = (two()[0] + 2 * two()[1]).numpy().astype(np.uint8)
    for name in TRAIN:
        Image.fromarray(ids).save(folder / f"{name}.png")
    return folder


@pytest.fixture
def panoptic(segments) -> Path:
    rows = [Segment(id=i, category=i, isthing=True, score=0.9) for i in (1, 2)]
    save_segments(dict.fromkeys(TRAIN, rows), segments)
    return segments


@pytest.fixture
def tracked(segments) -> Path:
    save_tracks([Track(id=i, votes={"sky": 4}) for i in (1, 2)], segments, order=TRAIN)
    return segments


def two() -> torch.Tensor:
    dense = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    dense[0, 12:, :14] = True
    dense[1, 12:, 14:] = True
    return dense


def picture(value: float, dtype: type, *shape: int) -> Image.Image:
    return Image.fromarray(np.full(shape or (HEIGHT, WIDTH), value, dtype))


def halved(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def edited(path: Path, change: Callable[[dict], None]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


# Label maps


@pytest.mark.parametrize("method", ["uplift", "vote", "identity"])
@pytest.mark.parametrize(
    ("image", "words"),
    [
        (picture(1, np.uint8, 10, 10), "view train_1: expected a map of 28x20 .* got 10x10"),
        (picture(1, np.uint8, 40, 56), "view train_1: expected a map of 28x20 .* got 56x40"),
        (picture(1, np.uint8, 20, 29), "view train_1: expected a map of 28x20 .* got 29x20"),
        (picture(1, np.uint8, 20, 28, 3), r"train_1.png: expected one channel of ids, got RGB;"),
        (picture(1, np.uint8, 20, 28, 4), r"train_1.png: expected one channel of ids, got RGBA;"),
        (picture(70000, np.int32), r"train_1.png: expected ids in \[0, 65535\], got \[70000"),
        (picture(-1, np.int32), r"train_1.png: expected ids in \[0, 65535\], got \[-1"),
        (picture(1.5, np.float32), r"train_1.png: expected one channel of ids, got F"),
    ],
    ids=["small", "large", "wide", "rgb", "rgba", "overflow", "negative", "float"],
)
def test_label_maps(refused, labels, method, image, words) -> None:
    # TIFF holds what PNG does not; the reader goes by content.
    image.save(labels / "train_1.png", format="TIFF" if image.mode in "IF" else "PNG")
    sentence = refused("segment", "--method", method, "--evidence", labels.name)
    assert re.search(words, sentence), sentence


@pytest.mark.parametrize("content", [b"", b"hello", None], ids=["empty", "text", "half"])
def test_pictures_that_are_none(refused, labels, content) -> None:
    path = labels / "train_1.png"
    halved(path) if content is None else path.write_bytes(content)
    assert str(path) in refused("segment", "--method", "uplift", "--evidence", labels.name)


@pytest.mark.parametrize("method", ["uplift", "vote", "identity"])
def test_maps_without_a_label(refused, labels, method) -> None:
    for name in TRAIN:
        picture(0, np.uint8).save(labels / f"{name}.png")
    assert "found none" in refused("segment", "--method", method, "--evidence", labels.name)


def test_views_that_are_missing(refused, splatseg, small, labels) -> None:
    command = ("--method", "uplift", "--evidence", labels.name)
    (labels / "train_1.png").unlink()
    assert "train_1" in refused("segment", *command, "--views", "train_0,train_1")
    status, out, _ = splatseg("segment", small.scene, *command)
    assert status == 0
    assert "from 2 views" in out
    for name in ("train_0", "train_3"):
        (labels / f"{name}.png").rename(labels / f"other_{name}.png")
    assert "at least one of the 3 views" in refused("segment", *command)
    for path in labels.iterdir():
        path.unlink()
    assert "expected evidence" in refused("segment", *command)


def test_sixteen_bits_whose_zero_is_a_class(splatseg, small, labels) -> None:
    for name in TRAIN:
        picture(300, np.uint16).save(labels / f"{name}.png")
    command = ("segment", small.scene, "--method", "uplift", "--zero-is-class")
    assert splatseg(*command)[0] == 0
    layer = load_scene_layer(small.scene, labels.name)
    assert layer.info.source_ids == {301: 300}
    # The same through see, whose evidence tells what its ids were.
    see = ("see", small.scene, "--model", labels, "--evidence", "copy", "--zero-is-class")
    assert splatseg(*see)[0] == 0
    copy = open_evidence(small.scene / "evidence" / "copy")
    assert copy.source_ids is not None
    assert (len(copy.source_ids), copy.source_ids[301]) == (301, 300)
    assert splatseg(*command[:-1], "--evidence", "copy")[0] == 0
    assert load_scene_layer(small.scene, "copy").info.source_ids == {301: 300}


def test_ids_beyond_what_files_hold(splatseg, small, labels) -> None:
    for name in TRAIN:
        picture(65535, np.uint16).save(labels / f"{name}.png")
    status, _, err = splatseg(
        "see", small.scene, "--model", labels, "--evidence", "copy", "--zero-is-class"
    )
    assert status == 2
    assert "expected ids up to 65535, got 65536" in err


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ({"kind": "banana"}, "expected evidence"),
        ({"version": 9}, "version 2 or less, got version 9"),
        (
            {"classes": [{"id": 2**40, "name": "x"}]},
            "classes[0].id: expected a whole number of at most 2147483647",
        ),
        ({"source_ids": {"9": 3}}, "source_ids of all ids, got none of the id 1"),
        ({"source_ids": {"1": "x"}}, "source_ids[1]: expected a whole number, got 'x'"),
        ({"metadata": {"complete": False}}, "got 3 of work that was stopped"),
    ],
)
def test_headers(refused, labels, header, words) -> None:
    whole = {"format": "splatseg-evidence", "version": 1, "kind": "labels"} | header
    (labels / "evidence.json").write_text(json.dumps(whole))
    assert words in refused("segment", "--method", "uplift", "--evidence", labels.name)
    halved(labels / "evidence.json")
    sentence = refused("segment", "--method", "uplift", "--evidence", labels.name)
    assert "evidence.json: expected JSON" in sentence


@pytest.mark.parametrize("shape", [(9, 9), (HEIGHT, WIDTH, 3)])
def test_confidences(refused, labels, shape) -> None:
    (labels / "_confidence").mkdir()
    picture(1, np.uint8, *shape).save(labels / "_confidence" / "train_1.png")
    sentence = refused("segment", "--method", "uplift", "--evidence", labels.name)
    assert "_confidence/train_1.png: expected" in sentence


# Masks


def change_mask(**fields: object) -> Spoil:
    return lambda path: edited(path, lambda content: content["masks"][0].update(fields))


def change_runs(counts: object) -> Spoil:
    return lambda path: edited(
        path, lambda content: content["masks"][0]["segmentation"].update(counts=counts)
    )


@pytest.mark.parametrize("command", ["segment", "see"])
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (change_mask(level=2**40), "masks[0].level: expected a whole number of at most"),
        (
            change_mask(score=float("nan")),
            "masks[0].score: expected a finite number up to 1e+30, got nan",
        ),
        (change_mask(score="high"), "masks[0].score: expected a number or null, got 'high'"),
        (change_mask(segmentation=7), "masks[0].segmentation: expected an object, got 7"),
        (change_runs([1, 2]), "runs that add up to 20 x 28 = 560 pixels, got 3"),
        (change_runs([2**40]), "a whole number of at most 4294967295, got 1099511627776"),
        (change_runs([-1, 561]), "a whole number of at least 0, got -1"),
        (change_runs([0.5, 559.5]), "counts[0]: expected a whole number, got 0.5"),
        (change_runs([[560]]), "counts[0]: expected a whole number, got a list of 1"),
        (change_runs("zzz"), "expected a compressed COCO mask, got other characters"),
        (change_runs("\u00e9"), "expected a compressed COCO mask, got other characters"),
        (
            lambda p: edited(p, lambda c: c.update(height=0, masks=[])),
            "height: expected a whole number of at least 1, got 0",
        ),
        (
            lambda p: edited(p, lambda c: c.update(height=True)),
            "height: expected a whole number, got True",
        ),
        (lambda p: edited(p, lambda c: c.update(masks=[3])), "masks[0]: expected an object, got 3"),
        (halved, "expected JSON, but it cannot be parsed"),
        (lambda p: p.write_text(""), "expected JSON, but it cannot be parsed"),
        (lambda p: p.write_text("[]"), "masks in run lengths"),
        (lambda p: p.write_text("[" * 100_000), "expected JSON, but it cannot be parsed"),
    ],
)
def test_masks(small, splatseg, refused, masks, command, spoil, words) -> None:
    spoil(masks / "train_1.json")
    if command == "segment":
        sentence = refused("segment", "--method", "associate", "--evidence", masks.name)
    else:
        status, _, err = splatseg("see", small.scene, "--model", masks, "--evidence", "copy")
        assert status == 2
        sentence = err.splitlines()[-1]
        # What was copied before it failed is removed, so that nobody builds on it.
        assert not (small.scene / "evidence" / "copy").exists()
    assert f"{masks / 'train_1.json'}: " in sentence
    assert words in sentence


def test_a_score_beyond_floats_is_none(masks) -> None:
    change_mask(score=10**400)(masks / "train_1.json")
    with pytest.raises(FileFormatError, match="got a number of 1329 bits"):
        open_evidence(masks).masks("train_1")


@pytest.mark.parametrize(("height", "width"), [(10, 9), (40, 56), (2000, 2800)])
def test_masks_of_the_wrong_size(refused, masks, height, width) -> None:
    content = {"height": height, "width": width, "masks": []}
    (masks / "train_1.json").write_text(json.dumps(content))
    sentence = refused("segment", "--method", "associate", "--evidence", masks.name)
    assert f"view train_1: expected a map of 28x20 pixels as its photograph has, or fewer in "\
        f"proportion, got {width}x{height}." in sentence  # fmt: skip


@pytest.mark.parametrize("count", [0, 2])
def test_empty_masks(refused, splatseg, small, masks, count) -> None:
    nothing = MaskSet.from_dense(torch.zeros(count, HEIGHT, WIDTH, dtype=torch.bool))
    save_masks(nothing, masks, "train_1")
    command = ("--method", "associate", "--evidence", masks.name)
    assert splatseg("segment", small.scene, *command, "--layer", "rest")[0] == 0
    for name in TRAIN:
        save_masks(nothing, masks, name)
    assert "expected a segment in 3 views, found none" in refused("segment", *command)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"levels": [2**40, 0]}, "a whole number as level for each of 2"),
        ({"levels": [np.nan, 0]}, "finite levels"),
        ({"levels": [0.5, 0]}, "a whole number as level for each of 2"),
        ({"levels": ["a", "b"]}, "levels of shape (2,) in numbers"),
        ({"scores": ["a", "b"]}, "scores of shape (2,) in numbers"),
        ({"scores": [1j, 0]}, "expected an array of numbers or text"),
        ({"scores": [np.nan, 0]}, "finite scores"),
        ({"masks": two().numpy().astype(float)}, "in booleans or whole numbers, got float64"),
        ({"masks": np.zeros((2, 0, 0), bool)}, "got bool of (2, 0, 0)"),
        ({"masks": np.array([None, {}])}, "expected an array of numbers or text"),
    ],
)
def test_arrays_of_masks(refused, masks, arrays, words) -> None:
    for name in TRAIN:
        (masks / f"{name}.json").unlink()
        np.savez(masks / f"{name}.npz", **({"masks": two().numpy()} | arrays))
    sentence = refused("segment", "--method", "associate", "--evidence", masks.name)
    assert "train_0.npz: " in sentence
    assert words in sentence


# Panoptic maps and tracks


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"id": 2**40}, "id: expected a whole number of at most 65535"),
        ({"id": "1"}, "id: expected a whole number, got"),
        ({"category_id": 2**40}, "category_id: expected a whole number of at most 65535"),
        ({"category_id": None}, "category_id: expected a whole number, got"),
        ({"score": "high"}, "segments_info[0].score: expected a number, got 'high'"),
        (
            {"score": float("nan")},
            "segments_info[0].score: expected a finite number up to 1e+30, got nan",
        ),
    ],
)
def test_segments(refused, panoptic, fields, words) -> None:
    edited(panoptic / "segments.json", lambda c: c["train_1"]["segments_info"][0].update(fields))
    sentence = refused("segment", "--method", "associate", "--evidence", panoptic.name)
    assert "segments.json: view 'train_1': " in sentence
    assert words in sentence


def test_a_table_without_a_view(refused, panoptic) -> None:
    edited(panoptic / "segments.json", lambda content: content.pop("train_1"))
    command = ("--method", "associate", "--evidence", panoptic.name)
    assert "expected segments_info of view 'train_1'" in refused("segment", *command)
    halved(panoptic / "segments.json")
    assert "segments.json: expected JSON" in refused("segment", *command)


@pytest.mark.parametrize(
    ("tracks", "words"),
    [
        ({"99999999999999": {}}, "expected tracks by id up to 65535"),
        ({"9" * 5000: {}}, "expected tracks by id up to 65535"),
        ({"\u0661": {}}, "expected tracks by id up to 65535"),
        ({"1": {"category_votes": {"sky": "many"}}}, "sky: expected a whole number, got 'many'"),
        ({"1": {"category_votes": {"sky": None}}}, "sky: expected a whole number, got None"),
        ({"1": {"category_votes": {"sky": float("nan")}}}, "sky: expected a whole number, got nan"),
        (None, "tracks: expected an object"),
    ],
)
def test_tracks(refused, tracked, tracks, words) -> None:
    (tracked / "tracks.json").write_text(json.dumps({} if tracks is None else {"tracks": tracks}))
    sentence = refused("segment", "--method", "associate", "--evidence", tracked.name)
    assert "tracks.json: " in sentence
    assert words in sentence


# Features and what was stopped


def test_features_that_are_nan(small, splatseg, refused) -> None:
    folder = small.capture / "features_x"
    grid = FeatureMap(features=torch.ones(3, 4, 2), stride=8, height=HEIGHT, width=WIDTH)
    for name in TRAIN:
        save_features(grid, folder, name)
    values = np.ones((3, 4, 2), np.float16)
    values[1, 2, 0] = np.nan
    np.savez(folder / "train_1.npz", features=values, stride=8, size=[HEIGHT, WIDTH])
    status, _, err = splatseg("see", small.scene, "--model", folder, "--evidence", "copy")
    assert status == 2
    assert f"{folder / 'train_1.npz'}: expected finite features, got 1 of 24" in err
    halved(folder / "train_1.npz")
    status, _, err = splatseg("see", small.scene, "--model", folder, "--evidence", "again")
    assert status == 2
    assert f"{folder / 'train_1.npz'}: expected an npz" in err
    sentence = refused("segment", "--method", "uplift", "--evidence", folder.name)
    assert "takes evidence of labels or tracked" in sentence


def test_evidence_that_was_stopped(small, splatseg, refused) -> None:
    see = ("see", small.scene, "--model", "classical", "--evidence", "m")
    assert splatseg(*see)[0] == 0
    folder = small.scene / "evidence" / "m"
    before = (folder / "train_3.json").read_bytes()
    (folder / "train_3.json").unlink()
    edited(folder / "evidence.json", lambda header: header["metadata"].update(complete=False))
    sentence = refused("segment", "--method", "associate", "--evidence", "m")
    assert f"{folder}: expected all its views, got 2 of work that was stopped" in sentence
    status, out, _ = splatseg("info", folder)
    assert status == 0
    assert "masks" in out
    assert splatseg(*see)[0] == 0
    assert (folder / "train_3.json").read_bytes() == before
    assert splatseg("segment", small.scene, "--method", "associate", "--evidence", "m")[0] == 0


# Layers


def changed_layer(path: Path, **arrays: np.ndarray) -> None:
    with np.load(path, allow_pickle=False) as archive:
        whole = {name: archive[name] for name in archive.files}
    np.savez(path, **(whole | arrays))


@pytest.mark.parametrize("what", ["splat", "objects", "points", "coco", "table"])
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (halved, "expected a layer, but it cannot be read"),
        (lambda p: p.write_bytes(b""), "expected a layer, but it cannot be read"),
        (lambda p: changed_layer(p, ids=np.ones(3, np.int32)), "of type i4 and shape (160)"),
        (lambda p: changed_layer(p, ids=np.full(160, 2**40)), "got int64 of (160,)"),
        (
            lambda p: changed_layer(p, ids=np.full(160, -7, np.int32)),
            "expected 'ids' of 0 (none) or more, got -7",
        ),
        (
            lambda p: changed_layer(p, confidence=np.full(160, np.nan, np.float32)),
            "expected finite 'confidence', got 160 of 160 values",
        ),
    ],
    ids=["half", "empty", "short", "overflow", "negative", "nan"],
)
def test_layers_are_not_exported(small, splatseg, refused, tmp_path, what, spoil, words) -> None:
    assert splatseg("segment", small.scene, "--method", "uplift", "--layer", "x")[0] == 0
    spoil(small.scene / "layers" / "x.npz")
    out = tmp_path / "out"
    out.mkdir()
    suffix = {"splat": ".ply", "points": ".ply", "table": ".csv"}.get(what, "")
    sentence = refused("export", "--layer", "x", "--what", what, "-o", out / f"labelled{suffix}")
    assert str(small.scene / "layers" / "x.npz") in sentence
    assert words in sentence
    assert not list(out.iterdir())


@pytest.mark.parametrize("name", ["gaussians.ply", "scene.json"])
def test_half_a_scene(small, refused, tmp_path, name) -> None:
    halved(small.scene / name)
    out = tmp_path / "o.ply"
    assert str(small.scene / name) in refused("export", "-o", out)
    assert str(small.scene / name) in refused("segment", "--method", "uplift")
    assert not out.exists()
