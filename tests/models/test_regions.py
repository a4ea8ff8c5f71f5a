"""The model `regions`: its network, its masks with and without depth, through `see`."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.core import MaskSet
from splatseg.core.models import AutomaticMasks, DepthAwareMasks, Prompt, PromptableMasks
from splatseg.errors import InputError, ShapeError
from splatseg.models import find_model
from splatseg.models._best_masks import embedded_masks
from splatseg.models._region_masks import KINDS
from splatseg.models._region_network import (
    CONTOURS,
    WEIGHTS,
    RegionNetwork,
    contours_and_boxes,
    region_network,
    weights,
)
from splatseg.models.regions import RegionOptions, Regions, learned_masks


def best(masks: MaskSet, wanted: torch.Tensor) -> float:
    dense = [masks.dense(i) for i in range(len(masks))]
    return max(float((one & wanted).sum() / (one | wanted).sum()) for one in dense)


def same(a: MaskSet, b: MaskSet) -> bool:
    counts = [[mask.counts.tolist() for mask in one.masks] for one in (a, b)]
    return counts[0] == counts[1] and torch.equal(a.scores, b.scores)


def test_the_weights_are_small_and_complete() -> None:
    assert WEIGHTS.stat().st_size < 4_000_000
    assert sum(one.numel() for one in RegionNetwork().parameters()) < 2_000_000
    names = {name.split(".")[0] for name in weights()}
    assert names == {"network", *KINDS}
    assert all(bool(torch.isfinite(one.float()).all()) for one in weights().values())


def test_a_trained_network_and_the_one_with_its_norms_in_the_kernels_agree(rng) -> None:
    bench = pytest.importorskip("splatseg_bench.region_training")
    torch.manual_seed(0)
    trained = RegionNetwork(normalised=True)
    for module in trained.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.2)
            module.running_var.uniform_(0.5, 2)
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.normal_(module.bias, 0, 0.2)
    trained.eval()
    plain = RegionNetwork().eval()
    plain.load_state_dict(bench.folded(trained))
    pixels = torch.from_numpy(rng.normal(0, 1, (1, 3, 64, 96)).astype(np.float32))
    with torch.no_grad():
        wanted, coarse = trained(pixels)
        found, none = plain(pixels)
    assert none is None
    assert coarse.shape == (1, 12, 8, 12)
    assert found.shape == (1, 12, 32, 48)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("size", [(64, 96), (37, 50), (1, 1)])
def test_a_mirrored_image_has_mirrored_contours_and_boxes(rng, size) -> None:
    image = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
    contours, found = contours_and_boxes(region_network(), image)
    assert contours.shape == (*size, CONTOURS)
    assert found.shape == (*size, 9)
    height, width = size
    assert (found[..., 1::4] <= found[..., 3::4]).all()
    assert (found[..., 2::4] <= found[..., 4::4]).all()
    assert float(found[..., 1:].min()) >= 0
    assert float(found[..., 3::4].max()) <= width
    assert float(found[..., 4::4].max()) <= height
    if size != (64, 96):  # what is added to make multiples of 32 is at the right
        return
    other, theirs = contours_and_boxes(region_network(), image[:, ::-1].copy())
    np.testing.assert_allclose(other[:, ::-1], contours, atol=2e-3)
    np.testing.assert_allclose(theirs[:, ::-1, 2], found[..., 2], atol=0.5)
    np.testing.assert_allclose(width - theirs[:, ::-1, 3], found[..., 1], atol=0.5)
    wanted = (contours[..., 1:3].sum(2) + contours[..., 4:6].sum(2)) / 4
    np.testing.assert_allclose(contours[..., 0], wanted, atol=1e-6)


def test_masks_are_things_and_the_same_again(squares) -> None:
    model = find_model("regions")
    assert isinstance(model, Regions)
    assert isinstance(model, AutomaticMasks)
    assert isinstance(model, DepthAwareMasks)
    masks = model.masks(squares)
    red = torch.zeros(96, 128, dtype=torch.bool)
    red[24:72, 32:96] = True
    assert best(masks, red) > 0.85
    assert float(masks.scores.min()) > 0
    assert float(masks.scores.max()) <= 1
    assert not masks.levels.any()
    dense = [masks.dense(i) for i in range(len(masks))]
    ious = torch.tensor([float((one & red).sum() / (one | red).sum()) for one in dense])
    assert masks.objectness is not None
    assert float(masks.objectness[ious.argmax()]) > 0.5
    assert 0 <= float(masks.objectness.min()) <= float(masks.objectness.max()) <= 1
    before = torch.get_num_threads()
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            assert same(model.masks(squares), masks)
    finally:
        torch.set_num_threads(before)


def test_options_say_how_many_masks_and_how_small(squares) -> None:
    everything = learned_masks(squares, RegionOptions(max_masks=400, min_area=0.0, min_score=0.0))
    few = learned_masks(squares, RegionOptions(max_masks=3, min_area=0.0, min_score=0.0))
    assert len(few) == 3 < len(everything)
    first = [mask.counts.tolist() for mask in everything.masks[:3]]
    assert [mask.counts.tolist() for mask in few.masks] == first
    sure = learned_masks(squares, RegionOptions(max_masks=400, min_area=0.0, min_score=0.5))
    assert 0 < len(sure) == int((everything.scores >= 0.5).sum()) < len(everything)
    large = learned_masks(squares, RegionOptions(min_area=0.05, min_score=0.0))
    assert min(mask.area for mask in large.masks) >= 0.04 * 96 * 128
    assert min(mask.area for mask in everything.masks) < 0.05 * 96 * 128
    with pytest.raises(InputError, match="max_masks"):
        RegionOptions(max_masks=0)
    model = Regions(regions=RegionOptions(max_masks=3))
    assert model.settings != model.default_settings == Regions().settings
    assert "no photograph" in model.note


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (33, 2), (700, 900)])
@pytest.mark.parametrize("value", [0, 255])
def test_plain_images_of_any_size(shape, value: int) -> None:
    masks = learned_masks(torch.full((*shape, 3), value, dtype=torch.uint8))
    assert (masks.height, masks.width) == shape
    assert bool(torch.isfinite(masks.scores).all())


def test_a_small_photograph_is_seen_enlarged(rng, monkeypatch) -> None:
    image = torch.from_numpy(rng.integers(90, 110, (30, 40, 3)).astype(np.uint8))
    thing = torch.zeros(30, 40, dtype=torch.bool)
    thing[10:19, 14:24] = True
    image[thing] = torch.tensor([200, 40, 40], dtype=torch.uint8)
    every = RegionOptions(max_masks=400, min_area=0.0, min_score=0.0)
    masks = learned_masks(image, every)
    assert best(masks, thing) > 0.85
    assert min(mask.area for mask in masks.masks) > 0
    monkeypatch.setattr("splatseg.models.regions.SMALL_SIDE", 1)
    assert best(learned_masks(image, every), thing) < best(masks, thing)


def test_depth_shows_what_colours_hide() -> None:
    """A box before a wall of its colour: it is seen by its depth alone."""
    grey = torch.full((96, 128, 3), 128, dtype=torch.uint8)
    wanted = torch.zeros(96, 128, dtype=torch.bool)
    wanted[30:70, 40:90] = True
    depth = torch.where(wanted, 1.0, 2.0)
    without = learned_masks(grey)
    found = learned_masks(grey, depth=depth, focal=100.0)
    assert best(found, wanted) > 0.7
    assert not len(without) or best(without, wanted) < 0.7
    small = learned_masks(
        grey.repeat_interleave(8, 0).repeat_interleave(8, 1),
        depth=depth.repeat_interleave(8, 0).repeat_interleave(8, 1), focal=800.0,
    )  # fmt: skip
    assert (small.height, small.width) == (768, 1024)
    large = wanted.repeat_interleave(8, 0).repeat_interleave(8, 1)
    assert best(small, large) > 0.7, "depth is reduced as the image is"
    with pytest.raises(ShapeError, match="depth: expected shape \\(96, 128\\), got \\(95, 128\\)"):
        learned_masks(grey, depth=depth[1:], focal=100.0)
    with pytest.raises(InputError, match="focal"):
        learned_masks(grey, depth=depth)
    with pytest.raises(ShapeError, match="hed: expected"):
        learned_masks(grey, hed=np.zeros((95, 128, 9), np.float32))


def test_hed_s_contours_count() -> None:
    every = RegionOptions(min_score=0.0)
    grey = torch.full((96, 128, 3), 128, dtype=torch.uint8)
    hed = np.zeros((96, 128, 9), np.float32)
    hed[28:32, 38:92] = hed[68:72, 38:92] = hed[28:72, 38:42] = hed[28:72, 88:92] = 0.9
    wanted = torch.zeros(96, 128, dtype=torch.bool)
    wanted[30:70, 40:90] = True
    assert best(learned_masks(grey, every, hed=hed), wanted) > 0.7
    depth = torch.where(wanted, 1.0, 2.0)
    both = learned_masks(grey, every, hed=hed, depth=depth, focal=100.0)
    assert best(both, wanted) > 0.7
    assert not same(both, learned_masks(grey, every, hed=hed))


def test_prompts_choose_of_the_masks(squares) -> None:
    model = Regions()
    assert isinstance(model, PromptableMasks)
    embedding = model.embed(squares)
    every = model.masks(squares)
    box = torch.tensor(every.masks[0].bbox).float()
    box[2:] += box[:2]
    found = model.prompted_masks(embedding, Prompt(box=box))
    assert torch.equal(found.dense(0), every.dense(0))
    rows, columns = every.dense(1).nonzero(as_tuple=True)
    point = torch.tensor([[float(columns[0]) + 0.5, float(rows[0]) + 0.5]])
    found = model.prompted_masks(embedding, Prompt(points=point))
    assert 1 <= len(found) <= 3
    assert all(bool(found.dense(i)[rows[0], columns[0]]) for i in range(len(found)))
    other = Regions(regions=RegionOptions(max_masks=1))
    assert len(other.embed(squares).arrays["lengths"]) == 1
    with pytest.raises(InputError, match="embedding: expected one of model 'regions'"):
        model.prompted_masks(replace(embedding, model="sam"), Prompt(points=point))


def test_no_mask_is_no_answer() -> None:
    plain = torch.full((40, 60, 3), 128, dtype=torch.uint8)
    model = Regions()
    found = model.prompted_masks(
        embedded_masks(model.name, model.masks(plain).subset([])),
        Prompt(points=torch.tensor([[5.0, 5.0]])),
    )
    assert len(found) == 0
