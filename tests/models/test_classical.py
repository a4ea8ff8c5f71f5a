"""The stand-ins: regions of known images, nesting, determinism, GrabCut, descriptor."""

import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from splatseg.core import (
    AutomaticMasks,
    DenseFeatures,
    GroundedBoxes,
    MaskSet,
    MaskTracker,
    PanopticSegments,
    Prompt,
    PromptableMasks,
    SemanticLabels,
    TextFeatures,
)
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.models import _regions, classical, find_model
from splatseg.models._merge_tree import merge_tree, pixel_features
from splatseg.models._regions import enlarged
from splatseg.models.classical import (
    Classical,
    ClassicalOptions,
    colour_gradient_features,
    partition,
    region_masks,
)


def truth(shape: tuple[int, int], rows: slice, columns: slice) -> torch.Tensor:
    mask = torch.zeros(shape, dtype=torch.bool)
    mask[rows, columns] = True
    return mask


RED = truth((96, 128), slice(24, 72), slice(32, 96))
BLUE = truth((96, 128), slice(40, 56), slice(52, 76))


def iou(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a & b).sum() / (a | b).sum())


def best(masks: MaskSet, wanted: torch.Tensor) -> float:
    return max(iou(masks.dense(i), wanted) for i in range(len(masks)))


def same(a: MaskSet, b: MaskSet) -> bool:
    return (
        [m.counts.tolist() for m in a.masks] == [m.counts.tolist() for m in b.masks]
        and torch.equal(a.scores, b.scores)
        and torch.equal(a.levels, b.levels)
    )


# Regions


def test_regions_are_the_parts_of_a_simple_picture(squares) -> None:
    masks = region_masks(squares)
    assert best(masks, BLUE) > 0.85
    assert best(masks, RED & ~BLUE) > 0.85
    assert best(masks, ~RED) > 0.95


def test_a_level_merges_what_is_alike_before_what_is_not(squares) -> None:
    """Stripes of two near reds on blue: the stripes join before red and blue do."""
    image = torch.full((96, 128, 3), 0, dtype=torch.uint8)
    image[:] = torch.tensor([30, 60, 160], dtype=torch.uint8)
    image[20:76, 30:64] = torch.tensor([190, 60, 50], dtype=torch.uint8)
    image[20:76, 64:98] = torch.tensor([165, 60, 50], dtype=torch.uint8)
    both = truth((96, 128), slice(20, 76), slice(30, 98))
    left = truth((96, 128), slice(20, 76), slice(30, 64))
    masks = region_masks(image, ClassicalOptions(cuts=(0.3, 1.0)))
    level = {
        name: {
            int(masks.levels[i]) for i in range(len(masks)) if iou(masks.dense(i), wanted) > 0.85
        }
        for name, wanted in (("left", left), ("both", both))
    }
    assert level == {"left": {0}, "both": {1}}


def test_masks_are_nested_and_levels_come_back_as_partitions(squares) -> None:
    masks = region_masks(squares, ClassicalOptions(min_area=0.0, cuts=(0.03, 0.1, 0.3)))
    dense = [masks.dense(i) for i in range(len(masks))]
    for i, a in enumerate(dense):
        for b in dense[i + 1 :]:
            both = int((a & b).sum())
            assert both in (0, int(a.sum()), int(b.sum()))
    coarser = None
    for level in (2, 1, 0):
        ids = partition(masks, level).ids
        assert int(ids.min()) >= 1, "without a least area every pixel has a region"
        if coarser is not None:
            for id in torch.unique(ids).tolist():
                assert len(torch.unique(coarser[ids == id])) == 1
            assert len(torch.unique(ids)) > len(torch.unique(coarser))
        coarser = ids


def test_masks_keep_the_photographs_size_and_outline(squares, monkeypatch) -> None:
    """Worked on at half the size, masks are the image's own size and still fit."""
    monkeypatch.setattr(_regions, "WORKING_SIZE", 64)
    monkeypatch.setattr(_regions, "SUPERPIXEL_SIZE", 5)
    masks = region_masks(squares)
    assert (masks.height, masks.width) == (96, 128)
    assert best(masks, BLUE) > 0.75
    assert best(masks, RED & ~BLUE) > 0.8
    monkeypatch.setattr(_regions, "WORKING_SIZE", 50)
    monkeypatch.setattr(_regions, "SUPERPIXEL_SIZE", 9)
    odd = region_masks(squares[:95, :127])
    assert (odd.height, odd.width) == (95, 127)


def test_enlarged_borders_are_straight_and_labels_stay_labels() -> None:
    """A diagonal at a quarter of the size stays within half a pixel of the line it stands for."""
    small = (np.arange(40)[:, None] < np.arange(40)[None]).astype(np.int32) * 7
    large = enlarged(small, 160, 160)
    assert set(np.unique(large).tolist()) == {0, 7}
    first = np.argmax(large == 7, axis=1)[20:140]
    steps = np.diff(first)
    assert set(steps.tolist()) <= {0, 1, 2}, "nearest would give 0, 0, 0, 4"
    ids = np.arange(12, dtype=np.int32).reshape(3, 4)
    assert np.array_equal(enlarged(ids, 3, 4), ids)
    assert np.array_equal(enlarged(ids, 9, 12)[1::3, 1::3], ids)


def test_small_masks_are_dropped(squares) -> None:
    everything = region_masks(squares, ClassicalOptions(min_area=0.0))
    share = 0.05
    kept = region_masks(squares, ClassicalOptions(min_area=share))
    areas = [m.area for m in everything.masks]
    assert min(m.area for m in kept.masks) >= share * 96 * 128
    assert len(kept) == sum(a >= share * 96 * 128 for a in areas) < len(everything)


def test_scores_rank_an_object_above_its_fragments(squares) -> None:
    masks = region_masks(squares, ClassicalOptions(cuts=(0.01, 0.3)))
    assert bool(((masks.scores >= 0) & (masks.scores <= 1)).all())
    score = {}
    for i in range(len(masks)):
        for name, wanted in (("blue", BLUE), ("ground", ~RED)):
            if iou(masks.dense(i), wanted) > 0.85:
                score[name] = float(masks.scores[i])
    fragments = masks.scores[masks.levels == 0]
    assert min(score.values()) > float(fragments.median())


@pytest.mark.bits
def test_the_same_picture_gives_the_same_masks_whatever_the_threads(squares) -> None:
    first = region_masks(squares)
    before = cv2.getNumThreads(), torch.get_num_threads()
    try:
        for threads in (1, 4):
            cv2.setNumThreads(threads)
            torch.set_num_threads(threads)
            assert same(region_masks(squares), first)
            assert cv2.getNumThreads() == threads, "the caller's setting is left as it was"
    finally:
        cv2.setNumThreads(before[0])
        torch.set_num_threads(before[1])


def test_another_process_gives_the_same_masks(squares, tmp_path) -> None:
    """Nothing depends on hash seeds, on sets, or on what ran before."""
    np.save(tmp_path / "image.npy", squares.numpy())
    code = (
        "import numpy, torch; from splatseg.models.classical import region_masks;"
        f"m = region_masks(torch.from_numpy(numpy.load(r'{tmp_path / 'image.npy'}')));"
        "print(len(m), sum(int(c) * (k + 1) for r in m.masks for k, c in enumerate(r.counts)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    m = region_masks(squares)
    own = sum(int(c) * (k + 1) for r in m.masks for k, c in enumerate(r.counts))
    assert done.stdout.split() == [str(len(m)), str(own)]


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (3, 3), (20, 20)])
@pytest.mark.parametrize("value", [0, 255])
def test_flat_and_tiny_images_have_no_masks_worth_naming(shape, value) -> None:
    masks = region_masks(torch.full((*shape, 3), value, dtype=torch.uint8))
    assert (masks.height, masks.width) == shape
    assert len(masks) == 0, "all of the image is no mask"


def test_the_tree_merges_everything_and_counts_every_pixel_once(squares) -> None:
    labels = (
        ((torch.arange(96)[:, None] // 12) * 8 + torch.arange(128)[None] // 16)
        .numpy()
        .astype(np.int32)
    )
    tree = merge_tree(labels, pixel_features(squares.numpy()))
    assert (tree.leaves, len(tree.cost), tree.nodes) == (64, 63, 127)
    assert int(tree.area[-1]) == 96 * 128
    assert (np.diff(tree.cost) >= 0).all()
    members = tree.members(range(tree.nodes))
    assert sorted(members[126].tolist()) == list(range(64))
    for k, (left, right) in enumerate(zip(tree.left, tree.right, strict=True)):
        joined = sorted([*members[left].tolist(), *members[right].tolist()])
        assert joined == sorted(members[64 + k].tolist())
        assert tree.area[64 + k] == tree.area[left] + tree.area[right]
        assert int(np.isin(labels, members[64 + k]).sum()) == tree.area[64 + k]
    assert np.isinf(tree.death()[126])


def test_the_cost_of_two_regions_is_the_formula_of_the_docstring() -> None:
    """Two halves without a gradient between them: only the area and the colours count."""
    image = np.zeros((20, 30, 3), np.uint8)
    image[:, 10:] = 255
    labels = np.zeros((20, 30), np.int32)
    labels[:, 10:] = 1
    f = pixel_features(image)
    tree = merge_tree(labels, f)
    border = np.maximum(f.strength[:, 9], f.strength[:, 10]).astype(np.float64).mean()
    means = [
        [
            x[:, :10].reshape(-1, x.shape[2]).mean(0, dtype=np.float64),
            x[:, 10:].reshape(-1, x.shape[2]).mean(0, dtype=np.float64),
        ]
        for x in (f.bins, f.lab, f.texture)
    ]
    hellinger = np.sqrt(1 - np.sqrt(means[0][0] * means[0][1]).sum() / 3)
    colour = min(np.linalg.norm(means[1][0] - means[1][1]) / 25, 2)
    grain = np.linalg.norm(means[2][0] - means[2][1])
    expected = (border + 0.5 * (hellinger + colour + grain)) * (1 / 3) ** 0.25
    assert tree.cost[0] == pytest.approx(expected, rel=1e-5)
    assert tree.contrast[:2] == pytest.approx([border, border])


@pytest.mark.parametrize(
    "wrong",
    [
        {"working_size": 8},
        {"superpixel_size": 1},
        {"cuts": ()},
        {"cuts": (0.3, 0.2)},
        {"cuts": (0.0, 0.2)},
        {"min_area": 1.5},
        {"min_area": float("nan")},
    ],
)
def test_settings_of_regions_that_make_no_sense(wrong) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        ClassicalOptions(**wrong)


# GrabCut


@pytest.fixture
def embedded(squares):
    model = Classical()
    return model, model.embed(squares)


def test_a_box_gives_the_thing_inside(embedded) -> None:
    model, embedding = embedded
    found = model.prompted_masks(embedding, Prompt(box=torch.tensor([48.0, 36.0, 80.0, 60.0])))
    assert len(found) == 1
    assert iou(found.dense(0), BLUE) > 0.9


def test_a_point_gives_the_thing_under_it_and_a_negative_one_keeps_off(embedded) -> None:
    model, embedding = embedded
    point = torch.tensor([[64.0, 48.0]])
    found = model.prompted_masks(embedding, Prompt(points=point))
    assert bool(found.dense(0)[48, 64])
    assert iou(found.dense(0), BLUE) > 0.8
    points = torch.tensor([[40.0, 30.0], [64.0, 48.0]])
    both = Prompt(
        points=points, positive=torch.tensor([True, False]), box=torch.tensor([28.0, 20, 100, 76])
    )
    ring = model.prompted_masks(embedding, both).dense(0)
    assert bool(ring[30, 40])
    assert not bool(ring[48, 64])
    assert iou(ring, RED & ~BLUE) > 0.85


def test_a_rough_mask_is_refined(embedded) -> None:
    model, embedding = embedded
    rough = truth((96, 128), slice(44, 60), slice(48, 72))
    found = model.prompted_masks(embedding, Prompt(mask=rough)).dense(0)
    assert iou(found, BLUE) > max(0.85, iou(rough, BLUE))


def test_prompts_refer_to_the_photographs_pixels(squares, monkeypatch) -> None:
    """Worked on at half the size, the same box means the same thing."""
    monkeypatch.setattr(classical, "WORKING_SIZE", 64)
    model = Classical()
    embedding = model.embed(squares)
    assert embedding.arrays["image"].shape == (48, 64, 3)
    found = model.prompted_masks(embedding, Prompt(box=torch.tensor([48.0, 36.0, 80.0, 60.0])))
    assert (found.height, found.width) == (96, 128)
    assert iou(found.dense(0), BLUE) > 0.8


def test_prompts_one_after_the_other_do_not_change_each_other(embedded) -> None:
    model, embedding = embedded
    kept = embedding.arrays["image"].clone()
    box = Prompt(box=torch.tensor([48.0, 36.0, 80.0, 60.0]))
    first = model.prompted_masks(embedding, box)
    model.prompted_masks(embedding, Prompt(points=torch.tensor([[10.0, 10.0]])))
    assert same(model.prompted_masks(embedding, box), first)
    assert torch.equal(embedding.arrays["image"], kept)


def test_a_prompt_that_leaves_nothing_to_decide_gives_no_mask(embedded) -> None:
    model, embedding = embedded
    everything = torch.tensor([-5.0, -5.0, 200.0, 200.0])
    assert len(model.prompted_masks(embedding, Prompt(box=everything))) == 0


def test_prompts_that_make_no_sense(embedded) -> None:
    model, embedding = embedded
    with pytest.raises(InputError, match="a positive point, a box or a mask"):
        Prompt()
    with pytest.raises(InputError, match="a positive point"):
        Prompt(points=torch.tensor([[1.0, 1.0]]), positive=torch.tensor([False]))
    with pytest.raises(RangeError, match="x0 < x1"):
        Prompt(box=torch.tensor([5.0, 5.0, 5.0, 9.0]))
    with pytest.raises(RangeError, match="points"):
        Prompt(points=torch.tensor([[float("nan"), 1.0]]))
    with pytest.raises(ShapeError, match="positive"):
        Prompt(points=torch.tensor([[1.0, 1.0]]), positive=torch.tensor([True, True]))
    with pytest.raises(RangeError, match="image of 128x96, got \\(200, 5\\)"):
        model.prompted_masks(embedding, Prompt(points=torch.tensor([[200.0, 5.0]])))
    with pytest.raises(RangeError, match="meets the image"):
        model.prompted_masks(embedding, Prompt(box=torch.tensor([300.0, 5.0, 400.0, 9.0])))
    with pytest.raises(ShapeError, match="mask"):
        model.prompted_masks(embedding, Prompt(mask=torch.ones(4, 4, dtype=torch.bool)))


# Descriptor


def test_like_surfaces_have_like_features(squares) -> None:
    deep = colour_gradient_features(squares)
    assert deep.depths == ("reach1", "reach3")
    fine = deep.maps[0]
    assert (fine.stride, fine.height, fine.width) == (8, 96, 128)
    assert fine.features.shape == (12, 16, 14)
    ground, other_ground = fine.features[0, 0], fine.features[11, 15]
    red, blue = fine.features[4, 5], fine.features[5, 7]
    alike = float((ground - other_ground).norm())
    assert alike < 0.2 * min(float((ground - red).norm()), float((red - blue).norm()))
    assert deep.class_token is not None
    assert torch.allclose(deep.class_token, deep.maps[-1].features.mean((0, 1)), atol=1e-5)
    assert float(fine.features.abs().max()) <= 2


def test_features_tell_the_direction_of_a_texture() -> None:
    rows = torch.arange(64)[:, None, None].expand(64, 64, 3)
    stripes = ((rows // 2 % 2) * 255).to(torch.uint8).contiguous()
    across = colour_gradient_features(stripes).maps[0].features[4, 4, 6:]
    along = (
        colour_gradient_features(stripes.transpose(0, 1).contiguous()).maps[0].features[4, 4, 6:]
    )
    assert across.argmax() == 4, "horizontal stripes change downwards: the fifth of 8 directions"
    assert along.argmax() == 0
    assert torch.allclose(across.roll(4), along, atol=1e-5)


def test_cells_cover_images_of_any_size(squares) -> None:
    deep = colour_gradient_features(squares[:93, :50])
    fine = deep.maps[0]
    assert fine.features.shape[:2] == (12, 7)
    assert (fine.height, fine.width) == (93, 50)
    assert bool(torch.isfinite(fine.features).all())
    whole = colour_gradient_features(squares[:, :56])
    assert torch.allclose(fine.features[:10, :5], whole.maps[0].features[:10, :5], atol=0.05)


# The model


def test_the_model_of_the_name_classical_says_what_it_is() -> None:
    model = find_model("classical")
    assert isinstance(model, Classical)
    assert model.name == "classical"
    assert "stand-in" in model.note
    for protocol in (AutomaticMasks, PromptableMasks, DenseFeatures):
        assert isinstance(model, protocol)
    for protocol in (SemanticLabels, PanopticSegments, TextFeatures, GroundedBoxes, MaskTracker):
        assert not isinstance(model, protocol)


def test_settings_change_with_every_option_and_are_those_of_earlier_versions() -> None:
    settings = Classical().settings
    assert Classical(regions=ClassicalOptions(min_area=0.01)).settings != settings
    assert settings == {
        "algorithm": 1,
        "regions": {
            "working_size": 640, "superpixel_size": 9, "cuts": [0.16, 0.25, 0.36, 0.5],
            "min_area": 0.0005,
        },
        "cut": {"cut_rounds": 5, "point_radius": 0.012},
        "descriptor": {"cell_size": 8, "reaches": [1.0, 3.0]},
    }  # fmt: skip
