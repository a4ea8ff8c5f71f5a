"""Recorded evidence as models: by name and by content, prompts answered by the best fit."""

import json

import numpy as np
import pytest
import torch
from PIL import Image as Picture

from splatseg.core import (
    AutomaticMasks,
    DenseFeatures,
    FeatureMap,
    LabelMap,
    MaskSet,
    MaskTracker,
    Model,
    PanopticSegments,
    Prompt,
    PromptableMasks,
    Segment,
    SemanticLabels,
    TextFeatures,
    Track,
)
from splatseg.errors import FileFormatError, InputError, MissingFileError, RangeError, ShapeError
from splatseg.io.captures import read_capture
from splatseg.io.evidence import (
    create_evidence,
    open_evidence,
    save_features,
    save_label_map,
    save_masks,
    save_segments,
    save_tracks,
)
from splatseg.io.images import load_image
from splatseg.models import find_model, recorded_model
from support.shared import generated_and

H, W = 48, 64


def mask(rows: slice, columns: slice) -> torch.Tensor:
    out = torch.zeros(H, W, dtype=torch.bool)
    out[rows, columns] = True
    return out


TABLE, MUG, WALL = (
    mask(slice(20, 48), slice(0, 64)),
    mask(slice(24, 34), slice(10, 20)),
    mask(slice(0, 20), slice(0, 64)),
)


@pytest.fixture
def masks_folder(tmp_path, views):
    folder = create_evidence(tmp_path / "masks_x", kind="masks")
    for view in views[:2]:
        save_masks(
            MaskSet.from_dense(torch.stack((TABLE, MUG, WALL)), scores=[0.9, 0.9, 0.5]),
            folder,
            view.name,
        )
    return folder


def image() -> torch.Tensor:
    return torch.zeros(H, W, 3, dtype=torch.uint8)


def answer(model, prompt: Prompt) -> MaskSet:
    return model.prompted_masks(model.embed(image(), view="v0"), prompt)


def test_the_view_is_told_by_name_or_found_by_content(masks_folder, views) -> None:
    model = recorded_model(masks_folder, views=views)
    assert isinstance(model, AutomaticMasks)
    assert isinstance(model, PromptableMasks)
    assert len(model.masks(image(), view="v0")) == 3
    assert len(model.masks(load_image(views[1]))) == 3
    assert model.embed(load_image(views[1])).view == "v1"
    with pytest.raises(InputError, match="there is nothing of view 'v2'"):
        model.masks(load_image(views[2]))
    with pytest.raises(InputError, match="photograph of one of 3 views"):
        model.masks(load_image(views[1]) // 2)
    with pytest.raises(InputError, match="name of the view"):
        recorded_model(masks_folder).masks(image())


def test_a_mask_of_another_size_than_the_image_is_refused(masks_folder) -> None:
    model = recorded_model(masks_folder)
    with pytest.raises(FileFormatError, match="view 'v0': expected 32x24 pixels .* got 64x48"):
        model.masks(torch.zeros(24, 32, 3, dtype=torch.uint8), view="v0")


def test_a_point_means_the_smaller_thing_that_holds_it(masks_folder) -> None:
    model = recorded_model(masks_folder)
    found = answer(model, Prompt(points=torch.tensor([[15.0, 30.0]])))
    assert [int(m.area) for m in found.masks] == [int(MUG.sum()), int(TABLE.sum())]
    assert found.scores.tolist() == pytest.approx([0.9, 0.9])


def test_a_negative_point_rules_masks_out(masks_folder) -> None:
    model = recorded_model(masks_folder)
    points = torch.tensor([[40.0, 40.0], [15.0, 30.0]])
    found = answer(model, Prompt(points=points, positive=torch.tensor([True, False])))
    assert len(found) == 0
    points = torch.tensor([[15.0, 30.0], [40.0, 40.0]])
    found = answer(model, Prompt(points=points, positive=torch.tensor([True, False])))
    assert [m.area for m in found.masks] == [int(MUG.sum())]


def test_a_box_means_the_mask_whose_own_box_it_is(masks_folder) -> None:
    model = recorded_model(masks_folder)
    found = answer(model, Prompt(box=torch.tensor([9.0, 23.0, 20.0, 34.0])))
    assert found.masks[0].area == int(MUG.sum())
    assert float(found.scores[0]) == pytest.approx(0.9 * 100 / 121)
    found = answer(model, Prompt(box=torch.tensor([0.0, 18.0, 64.0, 48.0])))
    assert found.masks[0].area == int(TABLE.sum())


def test_a_rough_mask_means_the_one_it_covers_best(masks_folder) -> None:
    model = recorded_model(masks_folder)
    rough = mask(slice(0, 18), slice(0, 64))
    found = answer(model, Prompt(mask=rough))
    assert found.masks[0].area == int(WALL.sum())
    assert float(found.scores[0]) == pytest.approx(0.5 * 18 / 20)


def test_where_nothing_fits_there_is_no_mask(masks_folder) -> None:
    model = recorded_model(masks_folder)
    points = torch.tensor([[15.0, 30.0], [15.0, 5.0]])
    assert len(answer(model, Prompt(points=points))) == 0
    with pytest.raises(RangeError, match="64x48"):
        answer(model, Prompt(points=torch.tensor([[70.0, 5.0]])))


def test_an_embedding_of_another_model_is_refused(masks_folder) -> None:
    embedding = find_model("classical").embed(image())
    with pytest.raises(InputError, match="of model 'masks_x', got 'classical'"):
        recorded_model(masks_folder).prompted_masks(embedding, Prompt(mask=MUG))


def test_label_maps_are_a_semantic_model(tmp_path) -> None:
    ids = torch.full((H, W), -1, dtype=torch.int32)
    ids[MUG] = 4
    folder = create_evidence(tmp_path / "labels", kind="labels")
    save_label_map(LabelMap(ids=ids), folder, "v0")
    model = find_model(folder)
    assert isinstance(model, SemanticLabels)
    assert not isinstance(model, PanopticSegments)
    assert torch.equal(model.label_map(image(), view="v0").ids, ids)
    found = answer(model, Prompt(points=torch.tensor([[15.0, 30.0]])))
    assert found.masks[0].area == int(MUG.sum())


def test_panoptic_and_tracked_folders_are_written_read_and_asked(tmp_path) -> None:
    ids = torch.full((H, W), 1, dtype=torch.int32)
    ids[MUG] = 2
    segments = (
        Segment(id=1, category=7, isthing=False, score=0.5),
        Segment(id=2, category=-1, isthing=True, score=1.0),
    )
    folder = create_evidence(tmp_path / "p", kind="panoptic")
    save_segments({"v0": segments}, folder)
    save_label_map(LabelMap(ids=ids), folder, "v0")
    model = find_model(folder)
    assert isinstance(model, PanopticSegments)
    given = model.panoptic(image(), view="v0")
    assert given.segments == segments
    assert torch.equal(given.ids.ids, ids)
    with pytest.raises(InputError, match="ids of their own"):
        save_segments({"v0": (segments[0], segments[0])}, folder)

    folder = create_evidence(tmp_path / "t", kind="tracked")
    save_tracks((Track(id=1, votes={"wall": 3}), Track(id=2, votes={})), folder, order=("v1", "v0"))
    for name in ("v0", "v1"):
        save_label_map(LabelMap(ids=ids), folder, name)
    model = find_model(folder)
    assert isinstance(model, MaskTracker)
    frames = iter([("v1", image()), ("v0", image())])
    tracked = model.track(frames, {})
    assert next(tracked)[0] == "v1"
    assert next(frames)[0] == "v0", "frames are taken one at a time"
    with pytest.raises(InputError, match="seeds"):
        list(model.track([("v1", image())], {"v1": LabelMap(ids=ids)}))


@generated_and("office")
def test_recorded_features_of_other_programs(rich_capture) -> None:
    view = read_capture(rich_capture).train_views[0]
    rows, columns = view.camera.height // 16, view.camera.width // 16
    photograph = load_image(view)
    dino = find_model(rich_capture / "features_dino")
    assert isinstance(dino, DenseFeatures)
    assert not isinstance(dino, TextFeatures)
    deep = dino.features(photograph, view=view.name)
    assert deep.depths == ("block3", "block6", "block9", "block12")
    assert [m.features.shape[:2] for m in deep.maps] == [(rows, columns)] * 4
    assert not torch.equal(deep.maps[0].features, deep.maps[3].features)

    text = find_model(rich_capture / "features_text")
    assert isinstance(text, TextFeatures)
    dense = text.text_features(photograph, view=view.name)
    words = text.encode_text(["floor", "wall"])
    assert words.shape == (2, dense.channels)
    for vectors in (dense.features, words):
        assert torch.allclose(vectors.norm(dim=-1), torch.ones(vectors.shape[:-1]), atol=1e-4)
    assert text.encode_text([]).shape == (0, dense.channels)
    with pytest.raises(InputError, match="recorded words .* got 'zebra crossing'"):
        text.encode_text(["zebra crossing"])
    with pytest.raises(FileFormatError, match="cover a photograph of 100x100"):
        text.text_features(torch.zeros(100, 100, 3, dtype=torch.uint8), view=view.name)


def test_words_of_another_width_than_the_features_are_refused(tmp_path, rng) -> None:
    folder = tmp_path / "features_text"
    folder.mkdir()
    np.savez(folder / "v0.npz", f=rng.integers(-9, 9, (6, 8, 3), dtype=np.int8))
    np.savez(
        folder / "basis.npz",
        scale=np.ones(3),
        offset=np.zeros(3),
        stride=8,
        basis=rng.normal(size=(3, 5)),
        mean=np.zeros(5),
    )
    words = {"labels": ["a"], "vectors": np.ones((1, 4)), "kind": ["class"], "target_id": [1]}
    np.savez(tmp_path / "text_embeddings.npz", **words)
    with pytest.raises(ShapeError, match="vectors of 5 numbers as the features have, got 4"):
        find_model(folder)
    np.savez(folder / "text_embeddings.npz", **(words | {"vectors": np.ones((1, 5))}))
    model = find_model(folder)
    assert isinstance(model, TextFeatures), "words in the folder come before those beside it"
    assert model.evidence.view_names == ("v0",)


def test_own_features_with_words_of_their_width_are_text_features(tmp_path) -> None:
    folder = create_evidence(tmp_path / "f", kind="features")
    cells = torch.zeros(6, 8, 2)
    cells[..., 0] = 3.0
    save_features(FeatureMap(features=cells, stride=8, height=H, width=W), folder, "v0")
    assert isinstance(find_model(folder), DenseFeatures)
    words = {"labels": ["a"], "vectors": np.eye(2)[:1], "kind": ["class"], "target_id": [1]}
    np.savez(folder / "text_embeddings.npz", **words)
    model = find_model(folder)
    assert isinstance(model, TextFeatures)
    given = model.text_features(image(), view="v0").features
    assert torch.equal(given[..., 0], torch.ones(6, 8))


# Files that others write


def test_masks_in_an_npz(tmp_path) -> None:
    folder = tmp_path / "masks_npz"
    folder.mkdir()
    dense = torch.stack((MUG, WALL)).numpy()
    np.savez(folder / "v0.npz", masks=dense.astype(np.uint8), scores=[0.25, 1.5], levels=[1, 0])
    np.savez_compressed(folder / "v1.npz", masks=dense)
    evidence = open_evidence(folder)
    assert (evidence.kind, evidence.view_names) == ("masks", ("v0", "v1"))
    masks = evidence.masks("v0")
    assert torch.equal(masks.dense(0), MUG)
    assert (masks.scores.tolist(), masks.levels.tolist()) == ([0.25, 1.0], [1, 0])
    assert evidence.masks("v1").scores.tolist() == [1.0, 1.0]
    for wrong, words in [
        ({"masks": dense[0]}, "shape \\(masks, height, width\\)"),
        ({"masks": dense.astype(np.float32)}, "booleans"),
        ({"masks": -dense.astype(np.int8)}, "booleans"),
        ({"masks": dense, "scores": [0.5]}, r"scores of shape \(2,\)"),
        ({"masks": dense, "levels": [1]}, r"levels of shape \(2,\)"),
        ({"masks": dense, "levels": [1, 2**31]}, "level for each of 2"),
        ({"masks": dense, "levels": [1, np.nan]}, "finite levels"),
        ({"masks": dense, "scores": [0.5, np.nan]}, "finite scores"),
        ({"other": dense}, "expected an array 'masks', got other"),
    ]:
        np.savez(folder / "v0.npz", **wrong)
        with pytest.raises(FileFormatError, match=words):
            evidence.masks("v0")
    (folder / "v0.npz").write_bytes((folder / "v1.npz").read_bytes()[:200])
    with pytest.raises(FileFormatError, match="cannot be read"):
        evidence.masks("v0")


def test_masks_as_folders_of_pictures_that_sams_tool_writes(tmp_path) -> None:
    folder = tmp_path / "masks_png"
    for name in ("v0", "sub/v1"):
        (folder / name).mkdir(parents=True)
        for number, dense in enumerate((MUG, WALL, TABLE)):
            picture = Picture.fromarray((dense.numpy() * 255).astype(np.uint8))
            picture.save(folder / name / f"{number + 8}.png")
        (folder / name / "metadata.csv").write_text(
            "id,area,predicted_iou,stability_score\n8,1,0.9,1\n9,1,0.8,1\n10,1,0.7,1\n"
        )
    evidence = open_evidence(folder)
    assert (evidence.kind, evidence.view_names) == ("masks", ("sub/v1", "v0"))
    masks = evidence.masks("v0")
    assert [torch.equal(masks.dense(i), m) for i, m in enumerate((MUG, WALL, TABLE))] == [True] * 3
    assert masks.scores.tolist() == pytest.approx([0.9, 0.8, 0.7])

    (folder / "v0" / "metadata.csv").write_text("id,area\n8,1\n")
    with pytest.raises(FileFormatError, match="columns id and predicted_iou"):
        evidence.masks("v0")
    (folder / "v0" / "metadata.csv").unlink()
    assert evidence.masks("v0").scores.tolist() == [1.0, 1.0, 1.0]
    Picture.fromarray(np.zeros((4, 4), np.uint8)).save(folder / "v0" / "9.png")
    with pytest.raises(FileFormatError, match="64x48 pixels as 8.png has, got 4x4"):
        evidence.masks("v0")
    for path in folder.rglob("*.csv"):
        path.unlink()
    assert open_evidence(folder).kind == "labels", "without the table they could be label maps"
    assert open_evidence(folder, kind="masks").view_names == ("sub/v1", "v0")


def test_the_kind_that_is_asked_for_must_be_the_headers(masks_folder) -> None:
    with pytest.raises(InputError, match="expected evidence of labels, got masks"):
        open_evidence(masks_folder, kind="labels")


def test_features_that_are_not_finite_are_refused(tmp_path) -> None:
    folder = create_evidence(tmp_path / "f", kind="features")
    values = np.zeros((6, 8, 3), np.float16)
    values[1, 2, 0] = np.nan
    np.savez(folder / "v0.npz", features=values, stride=8, size=[H, W])
    with pytest.raises(FileFormatError, match="v0.npz: expected finite features, got 1 of 144"):
        open_evidence(folder).features("v0")
    other = tmp_path / "features_q"
    other.mkdir()
    np.savez(other / "v0.npz", f=np.zeros((1, 6, 8, 2), np.int8))
    shared = {"scale": np.array([[1, np.inf]]), "offset": np.zeros((1, 2)), "stride": 8}
    np.savez(other / "quant.npz", **shared, blocks=["a"])
    with pytest.raises(FileFormatError, match="quant.npz: expected finite scale"):
        open_evidence(other)


def test_what_cannot_be_a_recorded_model(tmp_path) -> None:
    with pytest.raises(MissingFileError, match="no such file or folder"):
        recorded_model(tmp_path / "gone")
    empty = create_evidence(tmp_path / "e", kind="masks")
    with pytest.raises(InputError, match="at least one view, got none"):
        recorded_model(empty)
    (tmp_path / "c" / "sub").mkdir(parents=True)
    with pytest.raises(InputError, match="expected evidence"):
        find_model(tmp_path / "c")


def test_recorded_models_say_what_they_are(masks_folder) -> None:
    model = find_model(masks_folder)
    assert isinstance(model, Model)
    assert (model.name, model.settings["kind"]) == ("masks_x", "masks")
    assert "recorded" in model.note
    json.dumps(model.settings)
