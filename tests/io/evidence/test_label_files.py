"""Label maps as people have them: arrays of ids, soft maps, colours, names with an ending."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.errors import FileFormatError, InputError
from splatseg.io.evidence import check_map_sizes, open_evidence
from splatseg.io.label_tables import label_table
from support.annotations import views_of

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


@pytest.mark.parametrize("dtype", ["u1", "u2", "i4", "f4"])
@pytest.mark.parametrize("suffix", [".tif", ".tiff"])
def test_tiffs_of_ids(tmp_path: Path, dtype: str, suffix: str) -> None:
    """Whole numbers or floats; -1 is none where the type has it."""
    ids = IDS - 1 if dtype in ("i4", "f4") else IDS
    Image.fromarray(ids.astype(dtype)).save(tmp_path / f"a{suffix}")
    evidence = open_evidence(tmp_path)
    assert (evidence.kind, evidence.view_names) == ("labels", ("a",))
    assert opened(tmp_path) == np.where(ids > 0, ids, -1).tolist()


@pytest.mark.parametrize(
    ("ids", "message"),
    [
        (np.full((2, 3), 70000, np.int32), r"ids in \[-1, 65535\], got \[70000, 70000\]"),
        (np.full((2, 3), 1.5, np.float32), "whole numbers as ids, got fractions"),
        (np.full((2, 3), np.nan, np.float32), r"ids in \[-1, 65535\]"),
    ],
)
def test_tiffs_that_are_no_ids(tmp_path: Path, ids: np.ndarray, message: str) -> None:
    Image.fromarray(ids).save(tmp_path / "a.tif")
    with pytest.raises(FileFormatError, match=rf"a\.tif: expected .*{message}"):
        opened(tmp_path)


def test_a_tiff_of_several_pages_is_refused(tmp_path: Path) -> None:
    page = Image.fromarray(IDS.astype(np.uint8))
    page.save(tmp_path / "a.tif", save_all=True, append_images=[page])
    with pytest.raises(FileFormatError, match="one picture of ids, got 2 pages"):
        opened(tmp_path)


def test_large_tiffs_are_held_against_the_photograph(tmp_path: Path) -> None:
    Image.fromarray(np.ones((40, 40), np.int32)).save(tmp_path / "a.tif")
    evidence = open_evidence(tmp_path)
    view = views_of("a")[0]
    check_map_sizes(evidence, [view])
    Image.fromarray(np.ones((200, 200), np.int32)).save(tmp_path / "a.tif")
    with pytest.raises(FileFormatError, match="a label map of 64x48 pixels .* got 200x200"):
        check_map_sizes(evidence, [view])


MASKS = np.array([[[1, 0, 1], [0, 0, 1]], [[0, 0, 0], [1, 1, 0]]])


@pytest.mark.parametrize(
    ("arrays", "scores"),
    [
        ({"masks": MASKS, "scores": np.array([0.5, 0.25])}, [0.5, 0.25]),
        ({"segmentation": MASKS > 0, "predicted_iou": np.array([0.5, 0.25])}, [0.5, 0.25]),
        ({"segmentations": MASKS}, [1, 1]),
        ({"arr_0": MASKS}, [1, 1]),
        (None, [1, 1]),
    ],
)
def test_stacks_of_masks(
    tmp_path: Path, arrays: dict[str, np.ndarray] | None, scores: list[float]
) -> None:
    if arrays is None:
        np.save(tmp_path / "a.npy", MASKS > 0)
    else:
        np.savez(tmp_path / "a.npz", **arrays)
    evidence = open_evidence(tmp_path)
    assert (evidence.kind, evidence.view_names) == ("masks", ("a",))
    masks = evidence.masks("a")
    assert [masks.dense(k).tolist() for k in (0, 1)] == (MASKS > 0).tolist()
    assert masks.scores.tolist() == scores
    assert masks.levels.tolist() == [0, 0]


def test_an_array_without_a_name_counts_where_it_is_alone(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", MASKS, MASKS)
    with pytest.raises(InputError, match="expected evidence"):
        open_evidence(tmp_path)


def test_numbers_are_masks_where_one_says_so(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", MASKS)
    assert len(open_evidence(tmp_path, kind="masks").masks("a")) == 2
    np.save(tmp_path / "a.npy", np.array([{}]), allow_pickle=True)
    with pytest.raises(FileFormatError, match="got objects, and nothing is unpickled"):
        open_evidence(tmp_path, kind="masks").masks("a")


def text_table(folder: Path, text: str) -> str:
    (folder / "labelmap.txt").write_text(text)
    return str(folder / "labelmap.txt")


@pytest.mark.parametrize(
    ("text", "known"),
    [
        ("# label:color_rgb:parts:actions\nbackground:0,0,0::\ncar:1,2,3::\n", {1: "car"}),
        ("car:1,2,3::\nwall: 4, 5, 6:x,y:z\n".replace(": 4, 5", ":4, 5"), {1: "car", 2: "wall"}),
        ("0 0 0 void\n1\t2\t3\ta car\n", {1: "a car"}),
        ("1 2 3 car\n4 5 6 wall\n", {1: "car", 2: "wall"}),
    ],
)
def test_tables_of_colours_as_text(tmp_path: Path, text: str, known: dict[int, str]) -> None:
    (tmp_path / "maps").mkdir()
    pixels = np.array([[(1, 2, 3), (0, 0, 0)]], np.uint8)
    Image.fromarray(pixels).save(tmp_path / "maps" / "a.png")
    evidence = open_evidence(tmp_path / "maps", classes=text_table(tmp_path, text))
    assert evidence.classes is not None
    assert {row.id: row.name for row in evidence.classes.rows} == known
    if "0 0 0" in text or "0,0,0" in text:
        assert evidence.label_map("a").ids.tolist() == [[1, -1]]


@pytest.mark.parametrize("line", ["car", "car:1,2", "1 2 car", "car:256,0,0::", "car:1,2,-3::"])
def test_tables_of_colours_that_are_broken(tmp_path: Path, line: str) -> None:
    with pytest.raises(FileFormatError, match=r"labelmap\.txt: .*(a line|colour)"):
        label_table(text_table(tmp_path, line))


def test_pascal_voc(tmp_path: Path) -> None:
    """Indices of a palette, or its colours; 255, the border, is none."""
    palette = [0] * 768
    palette[3:6], palette[21:24], palette[765:] = (128, 0, 0), (128, 128, 128), (224, 224, 192)
    picture = Image.fromarray(np.array([[0, 1, 7, 255]], np.uint8), mode="P")
    picture.putpalette(palette)
    for one in (picture, picture.convert("RGB")):
        one.save(tmp_path / "a.png")
        assert opened(tmp_path, classes="voc") == [[-1, 1, 7, -1]]
        evidence = open_evidence(tmp_path, classes="voc")
        assert evidence.classes is not None
        assert evidence.classes.name_of(7) == "car"
    assert label_table("voc-train").classes.name_of(20) == "tvmonitor"
    assert not label_table("voc-train").zero_is_class
