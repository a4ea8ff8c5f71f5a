"""Label maps as people have them: arrays of ids, soft maps, colours, names with an ending."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.errors import FileFormatError, InputError
from splatseg.io.evidence import open_evidence

IDS = np.array([[0, 1, 2], [7, 7, 0]])


def opened(folder: Path, **options) -> list[list[int]]:
    return open_evidence(folder, **options).label_map("a").ids.tolist()


@pytest.mark.parametrize("dtype", ["u1", "<i4", ">i8", "f4", "u8"])
def test_arrays_of_ids(tmp_path: Path, dtype: str) -> None:
    np.save(tmp_path / "a.npy", IDS.astype(dtype))
    evidence = open_evidence(tmp_path)
    assert evidence.kind == "labels"
    assert evidence.view_names == ("a",)
    assert opened(tmp_path) == [[-1, 1, 2], [7, 7, -1]]
    assert opened(tmp_path, zero_is_class=True, void=7) == [[1, 2, 3], [-1, -1, 1]]
    assert evidence.label_map("a").confidence is None


def test_minus_one_is_none(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", IDS - 1)
    assert opened(tmp_path) == [[-1, -1, 1], [6, 6, -1]]
    assert opened(tmp_path, zero_is_class=True) == [[-1, 1, 2], [7, 7, -1]]
    np.savez(tmp_path / "b.npz", ids=IDS[None])
    (tmp_path / "a.npy").unlink()
    assert open_evidence(tmp_path).label_map("b").ids.tolist() == [[-1, 1, 2], [7, 7, -1]]


@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_soft_maps(tmp_path: Path, rng: np.random.Generator, last: bool, suffix: str) -> None:
    """The most probable channel and its probability, from logits and from probabilities."""
    logits = rng.normal(0, 2, (4, 6, 9)).astype(np.float16)
    wide = logits.astype(np.float64)
    shares = np.exp(wide) / np.exp(wide).sum(axis=0)
    for name, scores in (("logits", logits), ("probabilities", shares.astype(np.float16))):
        scores = np.moveaxis(scores, 0, 2) if last else scores
        if suffix == ".npy":
            np.save(tmp_path / "a.npy", scores)
        else:
            np.savez(tmp_path / "a.npz", **{name: scores})
        evidence = open_evidence(tmp_path)
        assert evidence.kind == "labels"
        found = evidence.label_map("a")
        assert np.array_equal(found.ids.numpy(), wide.argmax(axis=0) + 1), "channel 0 is a class"
        assert evidence.source_ids is not None
        assert evidence.source_ids[1] == 0
        assert float((found.confidence - torch.from_numpy(shares.max(axis=0))).abs().max()) < 1e-3
        void = open_evidence(tmp_path, void=0).label_map("a").ids
        assert bool(((void == -1) == (found.ids == 1)).all())


def test_soft_maps_of_a_known_data_set(tmp_path: Path, rng: np.random.Generator) -> None:
    """More classes than pixels along a side: the table knows which axis they are."""
    scores = rng.normal(size=(150, 8, 12)).astype(np.float16)
    np.save(tmp_path / "a.npy", scores)
    for name in ("ade20k", "ade20k-train"):
        evidence = open_evidence(tmp_path, classes=name)
        found = evidence.label_map("a")
        assert np.array_equal(found.ids.numpy(), scores.argmax(axis=0) + 1)
        assert evidence.classes is not None
        assert evidence.classes.name_of(1) == "wall"
        assert evidence.classes.name_of(150) == "flag"
    with pytest.raises(FileFormatError, match="scores of 133 classes along the first or last axis"):
        open_evidence(tmp_path, classes="coco").label_map("a")


def table_file(folder: Path, names: dict[int, str]) -> str:
    """A class table of somebody's own."""
    rows = [{"id": id, "name": name} for id, name in names.items()]
    (folder / "mine.json").write_text(json.dumps({"classes": rows}))
    return str(folder / "mine.json")


@pytest.mark.parametrize(
    ("names", "ids", "known"),
    [
        # 0 is a class where the table calls it so, and the names move with the ids.
        ({0: "wall", 1: "floor", 7: "lamp"}, [[1, 2, 3], [8, 8, 1]], {1: "wall", 8: "lamp"}),
        ({0: "Background", 1: "floor", 7: "lamp"}, [[-1, 1, 2], [7, 7, -1]], {1: "floor"}),
        ({0: "unlabelled", 1: "floor"}, [[-1, 1, 2], [7, 7, -1]], {1: "floor"}),
        ({1: "floor", 7: "lamp"}, [[-1, 1, 2], [7, 7, -1]], {1: "floor", 7: "lamp"}),
    ],
)
def test_a_table_of_ones_own_says_what_zero_is(
    tmp_path: Path, names: dict[int, str], ids: list[list[int]], known: dict[int, str]
) -> None:
    table = table_file(tmp_path, names)
    np.save(tmp_path / "a.npy", IDS)
    evidence = open_evidence(tmp_path, classes=table)
    assert evidence.label_map("a").ids.tolist() == ids
    assert evidence.classes is not None
    assert {id: evidence.classes.name_of(id) for id in known} == known
    assert "background" not in {row.name.lower() for row in evidence.classes.rows}


@pytest.mark.parametrize(
    ("names", "void"),
    [
        ({0: "wall", 1: "floor", 2: "lamp"}, False),
        ({0: "void", 1: "floor", 2: "lamp"}, True),
        ({1: "wall", 2: "floor", 3: "lamp"}, False),  # counted from 1
    ],
)
def test_a_table_of_ones_own_names_the_channels_of_soft_maps(
    tmp_path: Path, rng: np.random.Generator, names: dict[int, str], void: bool
) -> None:
    scores = rng.normal(size=(3, 4, 6)).astype(np.float32)
    np.save(tmp_path / "a.npy", scores)
    evidence = open_evidence(tmp_path, classes=table_file(tmp_path, names))
    wanted = scores.argmax(axis=0) + 1
    if void:
        wanted[wanted == 1] = -1
    assert np.array_equal(evidence.label_map("a").ids.numpy(), wanted)
    assert evidence.classes is not None
    found = {row.id: row.name for row in evidence.classes.rows}
    assert found == ({} if void else {1: "wall"}) | {2: "floor", 3: "lamp"}


def test_colours_of_a_table(tmp_path: Path) -> None:
    """Road, car and none in the colours of Cityscapes, and by their two kinds of ids."""
    pixels = np.array([[(128, 64, 128), (0, 0, 142), (0, 0, 0)]], np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert opened(tmp_path, classes="cityscapes") == [[7, 26, -1]]
    assert opened(tmp_path, classes="cityscapes-train") == [[1, 14, -1]]
    evidence = open_evidence(tmp_path, classes="cityscapes-train")
    assert evidence.classes is not None
    assert [evidence.classes.name_of(id) for id in (1, 14)] == ["road", "car"]
    with pytest.raises(FileFormatError, match="needs a class table with its colours"):
        open_evidence(tmp_path).label_map("a")
    pixels[0, 0] = (1, 2, 3)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    with pytest.raises(FileFormatError, match=r"got \(1, 2, 3\) in 1 pixels, .* no class"):
        opened(tmp_path, classes="cityscapes")
    pixels[0, 0] = (153, 153, 153)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    with pytest.raises(FileFormatError, match="that of pole and polegroup"):
        opened(tmp_path, classes="cityscapes")
    assert opened(tmp_path, classes="cityscapes-train")[0][0] == 6, "of these only pole is trained"


def test_palette_pictures_give_their_indices(tmp_path: Path) -> None:
    image = Image.fromarray(IDS.astype(np.uint8), mode="P")
    image.putpalette([v for i in range(256) for v in (i, 255 - i, 0)])
    image.save(tmp_path / "a.png")
    assert opened(tmp_path) == [[-1, 1, 2], [7, 7, -1]]
    assert opened(tmp_path, classes="ade20k") == [[-1, 1, 2], [7, 7, -1]]
    assert opened(tmp_path, classes="ade20k-train") == [[1, 2, 3], [8, 8, 1]]


def test_ids_of_training_have_255_for_void(tmp_path: Path) -> None:
    Image.fromarray(np.array([[0, 18, 255]], np.uint8)).save(tmp_path / "a.png")
    assert opened(tmp_path, classes="cityscapes-train") == [[1, 19, -1]]
    assert opened(tmp_path, classes="cityscapes-train", void=18) == [[1, -1, 256]]


def test_names_with_an_ending(tmp_path: Path) -> None:
    """a_pred.png is of view a; what stands beside it without the ending is of none."""
    np.save(tmp_path / "a_pred.npy", IDS)
    np.save(tmp_path / "a.npy", IDS * 0 + 3)
    np.save(tmp_path / "sub_pred.txt.npy", IDS)
    evidence = open_evidence(tmp_path, suffix="_pred")
    assert evidence.view_names == ("a",)
    assert opened(tmp_path, suffix="_pred") == [[-1, 1, 2], [7, 7, -1]]
    with pytest.raises(InputError, match="expected evidence"):
        open_evidence(tmp_path, suffix="_none")


def test_a_table_from_a_file(tmp_path: Path) -> None:
    folder = tmp_path / "maps"
    folder.mkdir()
    Image.fromarray(np.array([[(9, 9, 9), (0, 0, 0)]], np.uint8)).save(folder / "a.png")
    table = tmp_path / "table.json"
    table.write_text(json.dumps({"classes": [{"id": 4, "name": "cup", "colour": [9, 9, 9]}]}))
    evidence = open_evidence(folder, classes=str(table))
    assert evidence.label_map("a").ids.tolist() == [[4, -1]]
    assert evidence.classes is not None
    assert evidence.classes.name_of(4) == "cup"
    with pytest.raises(InputError, match=r"expected one of ade20k, .* or a JSON file, got 'adee'"):
        open_evidence(folder, classes="adee")
    table.write_text("[]")
    with pytest.raises(FileFormatError):
        open_evidence(folder, classes=str(table))


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (IDS + 0.5, "whole numbers"),
        (np.where(IDS == 2, np.nan, IDS), r"ids in \[-1, 65535\]"),
        (IDS - 100, r"ids in \[-1, 65535\], got \[-100, -93\]"),
        (IDS.astype("u8") + 2**63, r"ids in \[-1, 65535\]"),
        (IDS[0], r"got int64 of shape \(3,\)"),
        (np.zeros((0, 4)), r"of shape \(0, 4\)"),
        (np.zeros((2, 3, 4), int), r"got int64 of shape \(2, 3, 4\)"),
        (np.full((2, 5, 6), np.nan), "expected finite scores"),
        (np.zeros((5, 4, 5)), "fewer classes than pixels"),
        (np.array([["a", "b"]]), "expected ids"),
    ],
)
def test_arrays_that_are_no_label_maps(tmp_path: Path, array: np.ndarray, message: str) -> None:
    path = tmp_path / "a.npy"
    np.save(path, array)
    with pytest.raises(FileFormatError, match=message) as caught:
        open_evidence(tmp_path).label_map("a")
    assert str(caught.value).startswith(f"{path}: ")


def test_tables_go_with_label_maps(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", features=np.zeros((2, 2, 3), np.float32), stride=np.int64(4))
    with pytest.raises((InputError, FileFormatError)):
        open_evidence(tmp_path, classes="coco")
