"""Evidence: recorded folders as they stand, our own round trips, and what is refused."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from splatseg.core import ClassInfo, ClassTable, DeepFeatures, FeatureMap, LabelMap, MaskSet
from splatseg.errors import FileFormatError, InputError, MissingFileError, RangeError, ShapeError
from splatseg.io.captures import read_capture
from splatseg.io.evidence import (
    FeatureEvidence,
    PanopticEvidence,
    TrackedEvidence,
    create_evidence,
    evidence_names,
    find_evidence,
    load_text_embeddings,
    open_evidence,
    save_features,
    save_label_map,
    save_masks,
)
from support.shared import generated_and


def png(path: Path, values, mode: str | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(np.asarray(values))
    (image.convert(mode) if mode else image).save(path)


# What others recorded


@generated_and("office", "toys", "frontal")
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("masks_sam", "masks"),
        ("labels_semantic", "labels"),
        ("labels_panoptic", "panoptic"),
        ("labels_tracked", "tracked"),
        ("features_dino", "features"),
        ("features_text", "features"),
    ],
)
def test_recorded_evidence_is_of_the_train_views(rich_capture, name, kind) -> None:
    capture = read_capture(rich_capture)
    evidence = open_evidence(find_evidence([capture.path], name))
    assert evidence.kind == kind
    assert evidence.view_names == tuple(view.name for view in capture.train_views)


@generated_and("office", "toys", "frontal")
@pytest.mark.parametrize("folder", ["masks_sam", "masks_nested"])
def test_recorded_masks(rich_capture, folder) -> None:
    """Areas and boxes in the files are those of the masks that were decoded."""
    if not (rich_capture / folder).is_dir():
        folder = "masks_sam"  # frontal has no nested ones
    evidence = open_evidence(rich_capture / folder)
    name = evidence.view_names[7]
    content = json.loads((rich_capture / folder / f"{name}.json").read_text())
    rows = content["masks"]
    masks = evidence.masks(name)
    assert len(masks) == len(rows) > 10
    for i, row in enumerate(rows):
        dense = masks.dense(i)
        assert dense.shape == (content["height"], content["width"])
        assert int(dense.sum()) == row["area"]
        assert list(masks.masks[i].bbox) == row["bbox"]
        assert float(masks.scores[i]) == pytest.approx(row["predicted_iou"])


@generated_and("office")
def test_recorded_semantic_labels(rich_capture) -> None:
    evidence = open_evidence(rich_capture / "labels_semantic")
    name = evidence.view_names[0]
    with Image.open(rich_capture / f"labels_semantic/{name}.png") as image:
        stored = np.asarray(image).astype(int)
    ids = evidence.label_map(name).ids
    np.testing.assert_array_equal(ids, np.where(stored == 0, -1, stored))
    assert ids.dtype == torch.int32
    assert evidence.classes.name_of(1) == "wall"
    masks = evidence.masks(name)
    present = [i for i in np.unique(stored) if i]
    assert len(masks) == len(present)
    for i, id in enumerate(present):
        np.testing.assert_array_equal(masks.dense(i), stored == id)


@generated_and("office")
def test_recorded_panoptic_segments(rich_capture) -> None:
    evidence = open_evidence(rich_capture / "labels_panoptic")
    assert isinstance(evidence, PanopticEvidence)
    table = json.loads((rich_capture / "labels_panoptic/segments.json").read_text())
    name = evidence.view_names[3]
    rows = {row["id"]: row for row in table[name]["segments_info"]}
    ids, categories = evidence.label_map(name), evidence.category_map(name)
    for segment in evidence.segments(name):
        row, where = rows[segment.id], ids.ids == segment.id
        assert int(where.sum()) == row["area"]
        assert (segment.category, segment.isthing) == (row["category_id"], row["isthing"])
        assert (categories.ids[where] == row["category_id"]).all()
        np.testing.assert_allclose(ids.confidence[where], row["score"], rtol=1e-6)
    assert ((ids.ids == -1) == (categories.ids == -1)).all()


@generated_and("office")
def test_recorded_tracks(rich_capture) -> None:
    evidence = open_evidence(rich_capture / "labels_tracked")
    assert isinstance(evidence, TrackedEvidence)
    table = json.loads((rich_capture / "labels_tracked/tracks.json").read_text())
    assert evidence.order == tuple(table["order"])
    assert [track.id for track in evidence.tracks] == sorted(map(int, table["tracks"]))
    for track in evidence.tracks:
        votes = table["tracks"][str(track.id)]["category_votes"]
        assert dict(track.votes) == votes
        assert track.category == max(votes, key=votes.__getitem__)
        assert evidence.classes.name_of(track.id) == f"{track.category} {track.id}"
    seen = {
        int(i) for name in evidence.view_names[:5] for i in evidence.label_map(name).ids.unique()
    }
    assert seen - {-1} <= {track.id for track in evidence.tracks}


@generated_and("office")
def test_recorded_dino_features(rich_capture) -> None:
    folder = rich_capture / "features_dino"
    camera = read_capture(rich_capture).train_views[0].camera
    evidence = open_evidence(folder)
    assert isinstance(evidence, FeatureEvidence)
    name = evidence.view_names[2]
    with np.load(folder / f"{name}.npz") as archive, np.load(folder / "quant.npz") as quant:
        codes, scale, offset = archive["f"], quant["scale"], quant["offset"]
    assert evidence.blocks == ("block3", "block6", "block9", "block12")
    for i, block in enumerate(evidence.blocks):
        features = evidence.block_features(name, block)
        size = (camera.height, camera.width)
        assert (features.stride, features.height, features.width) == (16, *size)
        for row, column, channel in ((0, 0, 0), (-1, -1, -1), (5, 9, 7)):
            expected = codes[i, row, column, channel] * scale[i, channel] + offset[i, channel]
            assert float(features.features[row, column, channel]) == pytest.approx(expected)
    last = evidence.features(name).features
    assert torch.equal(last, evidence.block_features(name, "block12").features)
    with pytest.raises(InputError, match="one of the blocks block3, .* got 'block4'"):
        evidence.block_features(name, "block4")
    with pytest.raises(InputError, match=r"expected features with basis.npz"):
        evidence.expand(last)


@generated_and("office")
def test_text_features_expand_to_unit_vectors_near_their_words(rich_capture) -> None:
    """A pixel's full vector is nearer to its class's word than to most others."""
    evidence = open_evidence(rich_capture / "features_text")
    words = load_text_embeddings(rich_capture)
    name = evidence.view_names[0]
    features = evidence.features(name)
    with np.load(evidence.folder / "basis.npz") as basis:
        channels, length = basis["basis"].shape
    rows, columns = -(-features.height // 8), -(-features.width // 8)
    assert features.features.shape == (rows, columns, channels)
    full = evidence.expand(features.features)
    assert full.shape == (rows, columns, length)
    np.testing.assert_allclose(full.norm(dim=-1), 1, atol=1e-5)
    with np.load(evidence.folder / f"{name}.npz") as archive:
        code = archive["f"][9, 13].astype(np.float64)
    with np.load(evidence.folder / "basis.npz") as basis:
        exact = (code * basis["scale"] + basis["offset"]) @ basis["basis"] + basis["mean"]
    np.testing.assert_allclose(full[9, 13], exact / np.linalg.norm(exact), atol=1e-6)
    labels = open_evidence(rich_capture / "labels_semantic").label_map(name).ids[4::8, 4::8]
    classes = [i for i, kind in enumerate(words.kinds) if kind == "class"]
    scores = full @ words.vectors[classes].T
    order = scores.argsort(dim=-1, descending=True)
    ids = torch.tensor([words.target_ids[i] for i in classes])
    rank = (ids[order] == labels[..., None]).float().argmax(dim=-1)
    assert float((rank < 5).float().mean()) > 0.6
    assert words.target_ids[words.labels.index("object")] == -1
    assert torch.equal(words.vector("wall"), words.vectors[0])
    with pytest.raises(InputError, match="recorded words .* got 'unicorn'"):
        words.vector("unicorn")


@pytest.mark.parametrize(
    ("path", "views"),
    [
        ("real/camvid/labels_semantic", 101),
        ("real/camvid/semantic", 101),
        ("real/replica_office0/sem_reference", 180),
        ("real/replica_office0/pano_reference", 180),
        ("real/dtu_scan37/masks", 49),
        ("office/semantic", 125),
        ("office/instance", 125),
        ("office/part", 125),
    ],
)
def test_other_label_maps(shared_data, path, views) -> None:
    evidence = open_evidence(shared_data / path)
    assert (evidence.kind, len(evidence.view_names)) == ("labels", views)
    assert int(evidence.label_map(evidence.view_names[-1]).ids.max()) > 0


@generated_and("office")
def test_names_belong_to_the_ids(rich_capture) -> None:
    """Instance ids are named after instances, not after the classes of the same number."""
    part = json.loads((rich_capture / "metadata.json").read_text())["parts"][0]
    assert open_evidence(rich_capture / "semantic").classes.name_of(2) == "floor"
    assert open_evidence(rich_capture / "instance").classes.name_of(1) == "walls"
    assert open_evidence(rich_capture / "part").classes.name_of(part["id"]) == part["name"]
    assert part["name"] != "walls"
    assert open_evidence(rich_capture / "depth").classes is None


TRUTH = {"semantic", "instance", "part", "depth", "images", "masks", "colmap"}


def test_names_of_evidence_leave_truth_out(tmp_path) -> None:
    seen = ("features_dino", "labels_tracked_hard", "masks_nested", "pano_reference")
    for name in (*seen, *TRUTH):
        (tmp_path / name).mkdir()
    (tmp_path / "labels_notes.txt").write_text("no folder")
    assert evidence_names([tmp_path]) == seen


@pytest.mark.parametrize(
    ("scene", "seen"),
    [
        ("office", {"masks_sam", "masks_nested", "labels_semantic_hard", "features_text"}),
        ("real/replica_office0", {"pano_reference", "sem_reference"}),
        ("real/dtu_scan37", set()),
    ],
)
def test_names_of_recorded_evidence_leave_truth_out(shared_data, scene, seen) -> None:
    """Whatever else is recorded there later: it opens as evidence, and no truth is among it."""
    names = evidence_names([shared_data / scene])
    assert seen <= set(names)
    assert TRUTH & {path.name for path in (shared_data / scene).iterdir()}
    assert not TRUTH & set(names)
    for name in names:
        assert open_evidence(shared_data / scene / name).view_names


# Label maps


@pytest.mark.parametrize("highest", [255, 256, 65535])
def test_label_maps_round_trip(tmp_path, rng, highest) -> None:
    ids = torch.from_numpy(rng.integers(1, highest + 1, (5, 7)))
    ids[0, 0], ids[0, 1] = -1, highest
    confidence = torch.from_numpy(rng.random((5, 7)))
    folder = create_evidence(tmp_path / "e", kind="labels")
    save_label_map(LabelMap(ids=ids, confidence=confidence), folder, "sub/a.jpg")
    evidence = open_evidence(folder)
    assert evidence.view_names == ("sub/a.jpg",)
    read = evidence.label_map("sub/a.jpg")
    assert torch.equal(read.ids, ids.int())
    np.testing.assert_allclose(read.confidence, confidence, atol=0.5 / 65535 + 1e-7)
    with Image.open(folder / "sub/a.jpg.png") as image:
        assert image.mode == ("L" if highest == 255 else "I;16")
    save_label_map(LabelMap(ids=ids), folder, "sub/a.jpg")
    before = sorted(folder.rglob("*"))
    save_label_map(LabelMap(ids=ids), folder, "other/b.jpg")
    made = set(folder.rglob("*")) - set(before)
    assert made == {folder / "other", folder / "other/b.jpg.png"}  # no folder of confidences
    assert open_evidence(folder).label_map("sub/a.jpg").confidence is None


def test_the_score_of_a_label_mask_is_its_mean_confidence(tmp_path) -> None:
    folder = create_evidence(tmp_path / "e", kind="labels")
    ids, confidence = torch.tensor([[2, 2, -1]]), torch.tensor([[0.5, 1.0, 0.0]])
    save_label_map(LabelMap(ids=ids, confidence=confidence), folder, "a")
    assert open_evidence(folder).masks("a").scores.tolist() == pytest.approx([0.75], abs=1e-4)


def test_a_source_whose_0_is_a_class(tmp_path) -> None:
    """Ids grow by one, 255 is void, and the way back is told."""
    table = ClassTable(rows=(ClassInfo(id=0, name="road"), ClassInfo(id=18, name="bicycle")))
    png(tmp_path / "e/a.png", np.array([[0, 18, 255]], np.uint8))
    (tmp_path / "metadata.json").write_text(
        json.dumps({"classes": [{"id": 1, "name": "x"}, {"id": 18, "name": "bicycle"}]})
    )
    evidence = open_evidence(tmp_path / "e", zero_is_class=True, void=255)
    assert evidence.label_map("a").ids.tolist() == [[1, 19, -1]]
    assert evidence.source_ids[1] == 0
    assert evidence.source_ids[19] == 18
    assert 256 not in evidence.source_ids
    assert evidence.classes.name_of(19) == "bicycle"
    plain = open_evidence(tmp_path / "e")
    assert plain.label_map("a").ids.tolist() == [[-1, 18, 255]]
    assert plain.source_ids is None
    assert open_evidence(tmp_path / "e", void=18).label_map("a").ids.tolist() == [[-1, -1, 255]]
    with pytest.raises(InputError, match="void: expected another id than 0"):
        open_evidence(tmp_path / "e", zero_is_class=True, void=0)
    assert table.name_of(0) == "road"


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA"])
def test_coloured_label_maps_are_refused_in_a_sentence(tmp_path, mode) -> None:
    png(tmp_path / "e/a.png", np.full((2, 2), 3, np.uint8), mode)
    with pytest.raises(FileFormatError, match=rf"a.png: expected one channel of ids, got {mode}"):
        open_evidence(tmp_path / "e").label_map("a")


def test_a_palette_gives_its_indices(tmp_path) -> None:
    image = Image.fromarray(np.array([[0, 1, 2]], np.uint8))
    image = image.convert("P")
    image.putdata([0, 1, 2])
    image.putpalette([9, 9, 9, 200, 0, 0, 0, 200, 0])
    (tmp_path / "e").mkdir()
    image.save(tmp_path / "e/a.png")
    assert open_evidence(tmp_path / "e").label_map("a").ids.tolist() == [[-1, 1, 2]]


@pytest.mark.parametrize(
    ("ids", "error", "message"),
    [
        (torch.tensor([[0]]), InputError, "ids from 1 on .* got 0"),
        (torch.tensor([[65536]]), RangeError, "ids up to 65535, got 65536"),
        (torch.zeros(0, 3), InputError, "at least one pixel"),
    ],
)
def test_label_maps_that_have_no_place_in_a_file(tmp_path, ids, error, message) -> None:
    with pytest.raises(error, match=message):
        save_label_map(LabelMap(ids=ids), tmp_path, "a")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["", "../a", "/a", "a//b", ".a", "a/../../b"])
def test_names_stay_inside_the_folder(tmp_path, name) -> None:
    with pytest.raises(InputError, match="expected a view.s name"):
        save_label_map(LabelMap(ids=torch.ones(1, 1)), tmp_path, name)


# Masks


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 4),
    height=st.integers(1, 9),
    width=st.integers(1, 9),
)
def test_masks_round_trip(tmp_path_factory, seed, count, height, width) -> None:
    generator = np.random.default_rng(seed)
    dense = torch.from_numpy(generator.random((count, height, width)) < generator.random())
    scores = generator.random(count).astype(np.float32).tolist()
    levels = generator.integers(0, 3, count).tolist()
    folder = create_evidence(tmp_path_factory.mktemp("m") / "e", kind="masks")
    masks = MaskSet.from_dense(dense, scores=scores, levels=levels)
    objectness = torch.from_numpy(generator.random(count).astype(np.float32))
    save_masks(masks, folder, "a")
    save_masks(replace(masks, objectness=objectness), folder, "b")
    known = open_evidence(folder).masks("b").objectness
    assert torch.equal(known, objectness) if count else known is None
    read = open_evidence(folder).masks("a")
    assert read.objectness is None
    assert (read.height, read.width, len(read)) == (height, width, count)
    assert read.scores.tolist() == scores
    assert read.levels.tolist() == levels
    for i in range(count):
        assert torch.equal(read.dense(i), dense[i])


def test_a_subset_of_masks_has_what_its_masks_have(rng) -> None:
    dense = torch.from_numpy(rng.random((3, 4, 5)) < 0.5)
    masks = MaskSet.from_dense(dense, scores=[0.1, 0.2, 0.3], levels=[2, 1, 0])
    masks = replace(masks, objectness=torch.tensor([0.5, 0.25, 0.75]))
    some = masks.subset([2, 0])
    assert torch.equal(some.dense(0), dense[2])
    assert torch.equal(some.dense(1), dense[0])
    assert some.scores.tolist() == pytest.approx([0.3, 0.1])
    assert repr(masks) == "MaskSet(3 masks of 5x4 pixels, 3 levels)"
    assert repr(masks.subset([1])) == "MaskSet(1 masks of 5x4 pixels)"
    assert some.levels.tolist() == [0, 2]
    assert some.objectness is not None
    assert some.objectness.tolist() == [0.75, 0.5]
    assert replace(masks, objectness=None).subset([1]).objectness is None
    with pytest.raises(ShapeError, match="objectness"):
        replace(masks, objectness=torch.ones(2))


MASKS = {"height": 2, "width": 2, "masks": [{"segmentation": {"size": [2, 2], "counts": [1, 3]}}]}


def test_uncompressed_runs_and_defaults(tmp_path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(MASKS))
    masks = open_evidence(tmp_path).masks("a")
    assert masks.dense(0).tolist() == [[False, True], [True, True]]
    assert (masks.scores.tolist(), masks.levels.tolist()) == ([1.0], [0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.pop("height"), "expected a field height"),
        (lambda m: m["masks"].append(3), r"masks\[1\]: expected an object"),
        (lambda m: m["masks"][0]["segmentation"].update(size=[2, 3]), r"run lengths of 2x2 pixels"),
        (lambda m: m["masks"][0]["segmentation"].update(counts=[1, 4]), "add up to 2 x 2"),
        (
            lambda m: m["masks"][0]["segmentation"].update(counts=[-1, 5]),
            r"counts\[0\]: ",
        ),
        (lambda m: m["masks"][0]["segmentation"].update(counts="~~"), "other characters"),
        (
            lambda m: m["masks"][0].update(score="high"),
            "score: expected a number or null, got .high.",
        ),
        (
            lambda m: m["masks"][0].update(level=2**31),
            "level: .* whole number .*, got 2147483648",
        ),
        (
            lambda m: m["masks"].append(m["masks"][0] | {"objectness": 0.5}),
            "objectness of all 2 masks or of none, got 1",
        ),
    ],
)
def test_masks_that_are_broken(tmp_path, change, message) -> None:
    content = json.loads(json.dumps(MASKS))
    change(content)
    (tmp_path / "a.json").write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match=rf"a\.json: .*{message}"):
        open_evidence(tmp_path, void=None).masks("a")


# Features


def test_features_round_trip_as_float16(tmp_path, rng) -> None:
    values = torch.from_numpy(rng.normal(size=(3, 4, 5))).float()
    folder = create_evidence(tmp_path / "e", kind="features", metadata={"model": "dino"})
    save_features(FeatureMap(features=values, stride=14, height=42, width=50), folder, "a")
    read = open_evidence(folder).features("a")
    assert (read.stride, read.height, read.width) == (14, 42, 50)
    assert read.features.dtype == torch.float32
    assert torch.equal(read.features, values.half().float())


@pytest.mark.parametrize("value", [float("nan"), 1e5])
def test_features_beyond_float16_are_refused(tmp_path, value) -> None:
    features = FeatureMap(features=torch.full((1, 1, 1), value), stride=1, height=1, width=1)
    with pytest.raises(RangeError, match="a: features"):
        save_features(features, tmp_path, "a")


def test_features_that_are_broken(tmp_path) -> None:
    np.savez(tmp_path / "b.npz", f=np.zeros(3))
    with pytest.raises(InputError, match="expected evidence"):
        open_evidence(tmp_path)
    create_evidence(tmp_path, kind="features")
    (tmp_path / "a.npz").write_bytes(b"PK")
    evidence = open_evidence(tmp_path)
    with pytest.raises(FileFormatError, match=r"a.npz: expected an npz"):
        evidence.features("a")
    with pytest.raises(FileFormatError, match=r"b.npz: expected an array 'features', got f"):
        evidence.features("b")


def deep(rng, *, token: bool = True, depths: int = 3) -> DeepFeatures:
    """Maps of several depths of an image of 50 x 42: the shallowest on smaller cells, wider."""
    strides = (7, 14, 14)[-depths:]
    maps = tuple(
        FeatureMap(
            features=torch.from_numpy(rng.normal(size=(-(-42 // s), -(-50 // s), 5 + i))).float(),
            stride=s, height=42, width=50,
        )
        for i, s in enumerate(strides)
    )  # fmt: skip
    return DeepFeatures(
        maps=maps,
        depths=tuple(f"block{i + 1}" for i in range(depths)),
        class_token=torch.from_numpy(rng.normal(size=7)).float() if token else None,
    )


@pytest.mark.parametrize("token", [False, True])
@pytest.mark.parametrize("depths", [1, 3])
def test_features_of_several_depths_round_trip(tmp_path, rng, token: bool, depths: int) -> None:
    folder = create_evidence(tmp_path / "e", kind="features")
    seen = {name: deep(rng, token=token, depths=depths) for name in ("b", "a/c")}
    for name, one in seen.items():
        save_features(one, folder, name)
    evidence = open_evidence(folder)
    assert isinstance(evidence, FeatureEvidence)
    several = depths > 1 or token
    assert evidence.blocks == (seen["b"].depths if several else ())
    for name, one in seen.items():
        for block, wanted in zip(one.depths, one.maps, strict=True):
            found = evidence.block_features(name, block if several else None)
            assert (found.stride, found.height, found.width) == (wanted.stride, 42, 50)
            assert torch.equal(found.features, wanted.features.half().float())
        last = evidence.features(name)
        assert torch.equal(last.features, one.maps[-1].features.half().float())
        assert torch.equal(evidence.block_features(name, None).features, last.features)
        found = evidence.class_token(name)
        assert (found is None) == (not token)
        whole = evidence.deep_features(name)
        assert whole.depths == (one.depths if several else ("last",))
        assert len(whole.maps) == depths
        if token:
            assert torch.equal(found, one.class_token.half().float())
            assert torch.equal(whole.class_token, found)
    wanted = "expected one of the blocks" if several else "expected no block, as it has none"
    with pytest.raises(InputError, match=rf"b.npz: {wanted}.*, got 'block9'"):
        evidence.block_features("b", "block9")


def test_one_map_is_written_as_ever(tmp_path, rng) -> None:
    """The encoder's embedding of SAM, say: the bytes of version 1."""
    one = deep(rng, token=False, depths=1)
    save_features(one, tmp_path, "deep")
    save_features(one.maps[0], tmp_path, "map")
    assert (tmp_path / "deep.npz").read_bytes() == (tmp_path / "map.npz").read_bytes()


def test_depths_that_cannot_be_written(tmp_path, rng) -> None:
    good = deep(rng)
    with pytest.raises(RangeError, match="a: class token"):
        save_features(replace(good, class_token=torch.tensor([float("nan")])), tmp_path, "a")
    other = replace(good.maps[0], width=49)
    with pytest.raises(InputError, match="a: expected maps of one image of 50x42, got .* 49x42"):
        save_features(replace(good, maps=(other, *good.maps[1:])), tmp_path, "a")
    with pytest.raises(InputError, match="a: expected depths of different names, got x, x, y"):
        save_features(replace(good, depths=("x", "x", "y")), tmp_path, "a")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("features_0", np.zeros((2, 3), "f2"), r"expected features of shape \(rows, columns"),
        ("features_1", None, "expected an array 'features_1'"),
        ("stride_1", np.array(0), "expected stride as one whole number"),
        ("blocks", np.arange(3), "names of blocks of shape"),
        ("blocks", np.array(["a", "a", "b"]), "the same twice"),
        ("class_token", np.zeros((1, 2), "f2"), "class token of shape .* got float16"),
        ("class_token", np.array([np.nan], "f2"), "finite class token"),
    ],
)
def test_broken_files_of_several_depths(tmp_path, rng, name, value, words) -> None:
    folder = create_evidence(tmp_path / "e", kind="features")
    save_features(deep(rng), folder, "a")
    with np.load(folder / "a.npz") as archive:
        content = dict(archive)
    content |= {name: value}
    np.savez(folder / "a.npz", **{k: v for k, v in content.items() if v is not None})
    with pytest.raises(FileFormatError, match=rf"a.npz: .*{words}"):
        open_evidence(folder).deep_features("a")


def test_evidence_of_version_2_is_read_and_written_as_it_was(
    project_root, tmp_path, monkeypatch
) -> None:
    path = project_root / "tests/golden/make_io.py"
    spec = importlib.util.spec_from_file_location("make_io", path)
    golden = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(golden)
    committed = project_root / "tests/golden/evidence-v2"
    wanted = golden.golden_deep_features()
    found = open_evidence(committed / "features").deep_features("left/1")
    assert found.depths == wanted.depths
    assert torch.equal(found.class_token, wanted.class_token)
    for one, other in zip(found.maps, wanted.maps, strict=True):
        assert torch.equal(one.features, other.features)
        assert (one.stride, one.height, one.width) == (other.stride, other.height, other.width)
    monkeypatch.setattr(golden, "EVIDENCE", tmp_path / "evidence-v2")
    golden.main()
    for file in ("evidence.json", "left/1.npz"):
        written = (tmp_path / "evidence-v2/features" / file).read_bytes()
        assert written == (committed / "features" / file).read_bytes(), file


def test_other_kinds_stay_of_version_1(tmp_path) -> None:
    """Programs that know of no blocks go on reading them."""
    for kind, version in (("labels", 1), ("masks", 1), ("features", 2)):
        folder = create_evidence(tmp_path / kind, kind=kind)
        assert json.loads((folder / "evidence.json").read_text())["version"] == version


# Folders


def test_kinds_that_are_not_there_are_refused(generated_room) -> None:
    with pytest.raises(InputError, match="expected evidence of label maps, got masks"):
        open_evidence(generated_room / "masks_sam").label_map("train_0000")
    with pytest.raises(InputError, match="expected evidence of masks, got features"):
        open_evidence(generated_room / "features_dino").masks("train_0000")
    with pytest.raises(InputError, match="expected evidence of features, got tracked"):
        open_evidence(generated_room / "labels_tracked").features("train_0000")
    with pytest.raises(InputError, match=r"nothing of view 'test_0000' among 16 views"):
        open_evidence(generated_room / "labels_semantic").label_map("test_0000")


def test_evidence_of_a_scene_comes_before_that_of_its_capture(tmp_path) -> None:
    for folder in ("scene/evidence/labels_a", "data/labels_a", "data/labels_b", "data/semantic"):
        (tmp_path / folder).mkdir(parents=True)
    places = [tmp_path / "scene", tmp_path / "data"]
    assert find_evidence(places, "labels_a") == tmp_path / "scene/evidence/labels_a"
    assert find_evidence(places, "labels_b") == tmp_path / "data/labels_b"
    assert find_evidence(places, "semantic") == tmp_path / "data/semantic"
    assert evidence_names(places) == ("labels_a", "labels_b")
    with pytest.raises(InputError, match=r"at hand \(labels_a, labels_b\), got 'c'"):
        find_evidence(places, "c")


def test_the_header_tells_kind_classes_and_version(tmp_path) -> None:
    table = ClassTable(rows=(ClassInfo(id=3, name="door", colour=(1, 2, 3)),))
    folder = create_evidence(tmp_path / "e", kind="labels", classes=table, source_ids={3: 0})
    evidence = open_evidence(folder)
    assert (evidence.kind, evidence.view_names, evidence.classes) == ("labels", (), table)
    header = json.loads((folder / "evidence.json").read_text())
    assert header["source_ids"] == {"3": 0}
    assert evidence.source_ids == {3: 0}
    (folder / "evidence.json").write_text(json.dumps(header | {"source_ids": {"a": 1}}))
    with pytest.raises(FileFormatError, match="source_ids: expected integers by integer"):
        open_evidence(folder)
    (folder / "evidence.json").write_text(json.dumps(header | {"version": 3}))
    with pytest.raises(FileFormatError, match="version 2 or less, got version 3"):
        open_evidence(folder)
    with pytest.raises(InputError, match="kind: expected one of labels, panoptic, tracked, masks"):
        create_evidence(tmp_path / "f", kind="sound")
    with pytest.raises(InputError, match="metadata"):
        create_evidence(tmp_path / "f", kind="labels", metadata={"a": object()})
    assert not (tmp_path / "f").exists()


def test_what_is_no_evidence(tmp_path) -> None:
    with pytest.raises(MissingFileError, match="no such folder of evidence"):
        open_evidence(tmp_path / "gone")
    with pytest.raises(InputError, match="expected evidence"):
        open_evidence(tmp_path)
    with pytest.raises(MissingFileError):
        load_text_embeddings(tmp_path)


def test_where_there_is_no_evidence_the_command_that_makes_some_is_named(tmp_path) -> None:
    with pytest.raises(InputError, match=r"\(there is none; `splatseg see` makes some\), got 'm'"):
        find_evidence([tmp_path], "m")


@pytest.mark.parametrize("category", [True, 1.5, "1", -2, 2**31, None])
def test_a_category_that_is_no_id_is_refused(tmp_path, category) -> None:
    Image.fromarray(np.ones((2, 3), np.uint8)).save(tmp_path / "a.png")
    row = {"id": 1, "category_id": 2}
    for value in (2, -1, category):
        table = {"a": {"segments_info": [row | {"category_id": value}]}}
        (tmp_path / "segments.json").write_text(json.dumps(table))
        evidence = open_evidence(tmp_path)
        if value is not category:
            assert [one.category for one in evidence.segments("a")] == [value]
    with pytest.raises(
        FileFormatError,
        match=r"segments\.json: view 'a': .*category_id: expected",
    ):
        evidence.segments("a")
