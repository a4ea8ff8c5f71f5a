"""Training of the model `regions`: pictures with truth, crops, what merging learns from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.models._region_graph import Perceptron, described, merge, regions
from splatseg.models._region_masks import candidates
from splatseg_bench.region_merging import (
    Example,
    as_rendered,
    best_ious,
    counts,
    fit,
    node_rows,
    record_pairs,
)
from splatseg_bench.region_pictures import HEIGHT, WIDTH, Picture, draw_pictures, read_picture
from splatseg_bench.region_training import (
    Batches,
    Recipe,
    as_photograph,
    dense,
    noises,
    photographed,
    train,
    with_prints,
)
from splatseg_bench.worlds import clutter


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two pictures of a table."""
    folder = tmp_path_factory.mktemp("pictures")
    return draw_pictures(folder, "table", 0, 2)


def test_a_table_has_things_of_several_solids_and_is_drawn_by_its_seed() -> None:
    scene = clutter(3)
    assert clutter(3).primitives == scene.primitives != clutter(4).primitives
    solids = np.bincount([solid.instance for solid in scene.primitives])
    assert len(scene.objects) >= 10
    assert int(solids.max()) >= 5
    low, high = np.array(scene.bounds)
    centres = np.array([solid.centre for solid in scene.primitives])
    assert ((centres >= low - 1e-6) & (centres <= high + 0.6)).all()


def test_pictures_have_exact_truth_and_are_not_drawn_twice(drawn: list[Path]) -> None:
    picture = read_picture(drawn[0])
    assert picture.image.shape == (HEIGHT, WIDTH, 3)
    assert picture.thing.any()
    assert not picture.thing.all()
    scene = clutter(0)
    kinds = {row.id: row.isthing for row in scene.classes.rows}
    solids = [solid.instance for solid in scene.primitives]
    for part in np.unique(picture.part).tolist():
        inside = picture.part == part
        (instance,) = np.unique(picture.instance[inside])
        assert instance == solids[part - 1]
        assert (picture.thing[inside] == kinds[scene.objects[instance - 1].class_id]).all()
    assert (picture.depth > 0).all()
    assert draw_pictures(drawn[0].parent, "table", 0, 2) == []


def test_training_goes_on_as_if_it_had_not_stopped(drawn: list[Path], tmp_path) -> None:
    said: list[str] = []
    recipe = Recipe(steps=3, crops=2, printed=0.3)
    whole, parts = tmp_path / "whole.pt", tmp_path / "parts.pt"
    train(drawn, recipe, whole, said.append)
    train(drawn, recipe, parts, said.append, workers=2)
    state = torch.load(whole, weights_only=True)
    assert state["step"] == 3
    again = torch.load(parts, weights_only=True)
    assert all(torch.equal(one, again["network"][name]) for name, one in state["network"].items())
    state["step"] = 2
    torch.save(state, parts)
    train(drawn, recipe, parts, said.append)
    assert torch.load(parts, weights_only=True)["step"] == 3
    with pytest.raises(ValueError, match="of another recipe"):
        train(drawn, replace(recipe, rate=1e-4), parts, said.append)


def test_a_step_has_crops_of_its_own_number(drawn: list[Path]) -> None:
    recipe = Recipe(steps=4, crops=2, printed=0.5)
    at_once, later = (Batches(drawn, recipe, k, preloaded=k > 0) for k in (0, 2))
    assert (len(at_once), len(later)) == (4, 2)
    for one, other in zip(at_once[2], later[0], strict=True):
        assert torch.equal(one, other)
    assert not torch.equal(at_once[0][0], at_once[1][0])
    with pytest.raises(IndexError):
        at_once[4]


def test_ids_are_numbered_as_unique_numbers_them(rng) -> None:
    ids = rng.choice([0, 3, 4, 90], (20, 30)).astype(np.int32)
    values, labels = np.unique(ids, return_inverse=True)
    found, count = dense(ids)
    assert count == len(values)
    assert np.array_equal(found, labels.reshape(ids.shape))


def test_photographs_of_a_picture_change_its_colours_alone(drawn: list[Path], rng) -> None:
    picture = read_picture(drawn[0])
    found = as_photograph(drawn[0], drawn[1])
    assert found.shape == picture.image.shape
    assert np.array_equal(found, as_photograph(drawn[0], drawn[1]))
    assert np.abs(found.astype(float) - picture.image).mean() > 2
    bank = noises(0, count=3, side=64)
    np.testing.assert_allclose(bank.mean((1, 2)), 0, atol=1e-5)
    np.testing.assert_allclose(bank.std((1, 2)), 1, atol=1e-3)
    plain = np.full((30, 40, 3), 128, np.uint8)
    part = np.zeros((30, 40), np.int32)
    part[:, 20:] = 1
    other = rng.integers(0, 256, (30, 40, 3)).astype(np.uint8)
    assert with_prints(plain, part, other, rng, 0.0) is plain
    printed = with_prints(plain, part, other, np.random.default_rng(0), 1.0)
    assert printed.std() > 20
    assert float(photographed(plain, part, rng, noises(0), 1.0).min()) >= 0


def example(picture: Picture | None = None) -> Example:
    """Two things of two parts each in four stripes; contours of parts are weaker."""
    width, height = 64, 24
    part = np.repeat(np.arange(4, dtype=np.int32)[None], height, 0).repeat(16, 1)
    contours = np.zeros((height, width, 3), np.float32)
    for column, strength in ((16, 0.3), (32, 0.9), (48, 0.3)):
        contours[:, column - 1 : column + 1] = strength
    noise = np.random.default_rng(0).random((height, width)).astype(np.float32)
    contours[..., 0] += 0.02 * noise
    image = (60 * part[..., None] + np.array([0, 20, 40])).astype(np.uint8)
    pixels = described(image, contours)
    return Example(
        regions=regions(pixels), basins=pixels.basins.astype(np.int32), part=part, thing=part // 2
    )


def test_merging_learns_what_is_one_part_and_one_thing() -> None:
    one = example()
    rows = record_pairs([one] * 4, None, seed=0, share=1.0)
    same_part, same_thing = rows.answers.T
    assert not (same_part & ~same_thing & (rows.weights > 0).all(1)).any()
    assert 0 < same_part.mean() < same_thing.mean() < 1
    assert float(rows.weights.max()) > 0
    pair = None
    met = []
    for turn in range(3):
        met.append(record_pairs([one] * 4, pair, seed=turn, share=1.0))
        pair = fit(
            *(np.concatenate([getattr(each, name) for each in met])
              for name in ("features", "answers", "weights")),
            hidden=(16,), steps=400, seed=0, report=lambda text: None, batch=512,
        )  # fmt: skip
    tree = merge(one.regions, pair, (0.0, 1.0))
    totals = counts(one.basins, one.thing)
    inside = np.eye(tree.leaves)
    for a, b in tree.merges:
        inside = np.concatenate((inside, inside[[a]] + inside[[b]]))
    shared = inside @ totals
    best = (shared / (tree.area[:, None] + totals.sum(0) - shared)).max(0)
    assert best.min() > 0.95, "each thing is a node"
    learned = record_pairs([one], pair, seed=1, share=1.0)
    assert learned.features.shape[1] == rows.features.shape[1]
    features, targets = node_rows([one], pair)
    assert targets.shape == (len(features), 4)
    np.testing.assert_allclose(targets[:, 2:], (2 * targets[:, :2] - 1).clip(0), atol=1e-6)
    assert float(targets[:, 1].max()) > 0.95
    rare = record_pairs([one], None, seed=0, share=0.2)
    assert len(rare.features) < 0.5 * len(rows.features) / 4


def test_what_is_smaller_than_any_candidate_counts_for_nothing(monkeypatch) -> None:
    one = example()
    tiny = one.part.copy()
    tiny[0, 0] = 9
    met = record_pairs([one], None, seed=0)
    pair = fit(
        met.features, met.answers, met.weights,
        hidden=(4,), steps=20, seed=0, report=lambda text: None, batch=64,
    )  # fmt: skip
    nodes = candidates(one.regions, pair)
    assert (best_ious(nodes, one.basins, tiny)[:, -1] > 0).any()
    monkeypatch.setattr("splatseg_bench.region_merging.SMALLEST", 2 / tiny.size)
    ious = best_ious(nodes, one.basins, tiny)
    assert (ious[:, -1] == 0).all()
    assert (ious[:, 0] > 0).any()


def test_depth_as_rendered_is_noisy_where_there_is_something() -> None:
    depth = np.full((40, 60), 2.0, np.float32)
    depth[:, 40:] = 0
    image = np.random.default_rng(0).integers(0, 256, (40, 60, 3)).astype(np.uint8)
    found = as_rendered(depth, image, np.random.default_rng(1))
    inside = found[:, :30]
    assert 0 < float(np.abs(inside / 2 - 1).max()) < 0.2
    assert float(found[:, 50:].max()) == 0
    assert np.isfinite(found).all()


def test_pictures_are_met_alone_and_by_whoever_maps_them() -> None:
    """What is kept of a picture depends on its number, not on what was met before it."""
    numbers: list[int] = []

    def backwards(one, those):
        numbers.extend(those)
        return [one(number) for number in those[::-1]][::-1]

    two = [example(), example()]
    plain, other = (record_pairs(two, None, seed=0, over=over) for over in (map, backwards))
    np.testing.assert_array_equal(other.features, plain.features)
    np.testing.assert_array_equal(other.answers, plain.answers)
    pair = Perceptron(
        scaling=np.stack((plain.features.mean(0), plain.features.std(0) + 1e-4)),
        layers=((np.ones((plain.features.shape[1], 2), np.float32), np.zeros(2, np.float32)),),
    )
    rows = [node_rows(two, pair, over=over) for over in (map, backwards)]
    for one, same in zip(*rows, strict=True):
        np.testing.assert_array_equal(one, same)
    assert numbers == [0, 1, 0, 1]
