"""Evidence of features holds every depth that a model gives, and its class token."""

import json
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from PIL import Image as Picture

from splatseg.core import (
    FeatureMap,
    LabelMap,
    MaskSet,
    Model,
    Prompt,
    PromptableMasks,
    Segment,
)
from splatseg.core.models import DeepFeatures
from splatseg.errors import FileFormatError, InputError, MissingFileError, RangeError, ShapeError
from splatseg.io.evidence import (
    FeatureEvidence,
    create_evidence,
    open_evidence,
    save_features,
    save_label_map,
    save_masks,
    save_segments,
)
from splatseg.io.images import load_image
from splatseg.models import EvidenceRequest, find_model, record_evidence, recorded_model


class Pyramid:
    """Two depths, the shallower on finer cells, and the image's mean as the class token."""

    name, note = "pyramid", ""
    settings: ClassVar[dict[str, int]] = {}

    def __init__(self, *, shallow_width: int | None = None) -> None:
        self.calls = 0
        self._shallow_width = shallow_width

    def features(self, image) -> DeepFeatures:
        self.calls += 1
        height, width = (int(side) for side in image.shape[:2])
        values = image.float() / 256
        shallow = FeatureMap(
            features=values[::2, ::2], stride=2, height=height,
            width=self._shallow_width or width,
        )  # fmt: skip
        deep = FeatureMap(features=values[::8, ::8, :1], stride=8, height=height, width=width)
        token = values.mean(dim=(0, 1)) * 8
        return DeepFeatures(maps=(shallow, deep), depths=("block1", "block2"), class_token=token)


def check(evidence, views, model) -> None:
    """The evidence holds what the model gives, but for float16."""
    assert isinstance(evidence, FeatureEvidence)
    assert evidence.blocks == ("block1", "block2")
    from splatseg.io.images import load_image

    for view in views:
        wanted = model.features(load_image(view))
        for block, one in zip(wanted.depths, wanted.maps, strict=True):
            found = evidence.block_features(view.name, block)
            assert found.stride == one.stride
            assert torch.equal(found.features, one.features.half().float())
        deepest = evidence.features(view.name)
        assert deepest.channels == 1
        token = evidence.class_token(view.name)
        assert torch.equal(token, wanted.class_token.half().float())


def test_see_writes_all_depths_and_the_class_token(views, tmp_path) -> None:
    model = Pyramid()
    seen = record_evidence(model, views, tmp_path / "e")
    assert seen.kind == "features"
    check(open_evidence(tmp_path / "e"), views, model)


def test_recorded_evidence_is_copied_with_all_depths(views, tmp_path) -> None:
    record_evidence(Pyramid(), views, tmp_path / "e")
    recorded = find_model(tmp_path / "e")
    record_evidence(recorded, views, tmp_path / "copy")
    for view in views:
        first, second = (tmp_path / name / f"{view.name}.npz" for name in ("e", "copy"))
        assert first.read_bytes() == second.read_bytes()


def test_every_depth_must_be_of_the_photograph(views, tmp_path) -> None:
    with pytest.raises(ShapeError, match="view 'v0': expected 64x48 pixels .*, got 63x48"):
        record_evidence(Pyramid(shallow_width=63), views, tmp_path / "e")


def begun_by_an_earlier_one(folder: Path, *, complete: bool) -> None:
    """Evidence of two views as version 1 wrote it."""
    header = json.loads((folder / "evidence.json").read_text())
    header["version"] = 1
    header["metadata"]["complete"] = complete
    (folder / "evidence.json").write_text(json.dumps(header))
    for path in folder.glob("*.npz"):
        with np.load(path) as archive:
            old = {name: archive[name] for name in ("features", "stride", "size")}
        np.savez(path, **old)


def test_evidence_of_one_depth_is_read_and_not_mixed_with_others(views, tmp_path) -> None:
    folder = tmp_path / "e"
    record_evidence(Pyramid(), views, folder)
    begun_by_an_earlier_one(folder, complete=True)
    old = open_evidence(folder)
    assert old.blocks == ()
    assert old.class_token("v0") is None
    assert old.features("v0").channels == 1
    assert record_evidence(Pyramid(), views, folder).kept == 3, "it is complete"
    begun_by_an_earlier_one(folder, complete=False)
    (folder / "v2.npz").unlink()
    with pytest.raises(InputError, match="an earlier splatseg began this evidence"):
        record_evidence(Pyramid(), views, folder)
    assert record_evidence(Pyramid(), views, folder, EvidenceRequest(overwrite=True)).kept == 0
    check(open_evidence(folder), views, Pyramid())


def test_a_view_with_a_broken_depth_is_done_again(views, tmp_path) -> None:
    folder = tmp_path / "e"
    record_evidence(Pyramid(), views, folder)
    with np.load(folder / "v1.npz") as archive:
        cut = {name: archive[name] for name in archive.files if name != "features_0"}
    np.savez(folder / "v1.npz", **cut)
    assert record_evidence(Pyramid(), views, folder).kept == 2
    check(open_evidence(folder), views, Pyramid())


# Recorded evidence as models: by name and by content, prompts answered by the best fit.


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
    assert isinstance(model, PromptableMasks)
    assert model.embed(image(), view="v0").view == "v0"
    assert model.embed(load_image(views[1])).view == "v1"
    with pytest.raises(InputError, match="there is nothing of view 'v2'"):
        model.prompted_masks(model.embed(load_image(views[2])), Prompt(mask=MUG))
    with pytest.raises(InputError, match="photograph of one of 3 views"):
        model.embed(load_image(views[1]) // 2)
    with pytest.raises(InputError, match="name of the view"):
        recorded_model(masks_folder).embed(image())


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


def test_segments_of_label_maps_answer_prompts(tmp_path) -> None:
    ids = torch.full((H, W), -1, dtype=torch.int32)
    ids[MUG] = 4
    folder = create_evidence(tmp_path / "labels", kind="labels")
    save_label_map(LabelMap(ids=ids), folder, "v0")
    found = answer(find_model(folder), Prompt(points=torch.tensor([[15.0, 30.0]])))
    assert found.masks[0].area == int(MUG.sum())

    segments = (
        Segment(id=1, category=7, isthing=False, score=0.5),
        Segment(id=2, category=-1, isthing=True, score=1.0),
    )
    folder = create_evidence(tmp_path / "p", kind="panoptic")
    save_segments({"v0": segments}, folder)
    save_label_map(LabelMap(ids=torch.where(ids == 4, 2, 1).int()), folder, "v0")
    found = answer(find_model(folder), Prompt(points=torch.tensor([[15.0, 30.0]])))
    assert found.masks[0].area == int(MUG.sum())
    with pytest.raises(InputError, match="ids of their own"):
        save_segments({"v0": (segments[0], segments[0])}, folder)


def test_features_and_depth_answer_no_prompts(tmp_path) -> None:
    folder = create_evidence(tmp_path / "f", kind="features")
    save_features(
        FeatureMap(features=torch.ones(6, 8, 2), stride=8, height=H, width=W), folder, "v0"
    )
    model = find_model(folder)
    assert model.evidence.view_names == ("v0",)
    assert not isinstance(model, PromptableMasks)


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
