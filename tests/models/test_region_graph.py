"""Regions: what is summed over them, how they are merged, against the readable twin."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg import _native
from splatseg.models._region_graph import Perceptron, Pixels, described, merge, regions
from splatseg.models._region_masks import (
    SMALLEST,
    Candidates,
    candidates,
    depth_contours,
    select,
    with_hed,
)
from splatseg.models._regions import encoded
from support.region_reference import Merging


def picture(rng, height: int, width: int, predicted: bool, contours: int = 3) -> Pixels:
    """Noise that is smooth enough to have some dozens of basins."""
    import cv2

    def smooth(channels: int, sigma: float) -> np.ndarray:
        noise = rng.random((height, width, channels)).astype(np.float32)
        found = cv2.GaussianBlur(noise, (0, 0), sigma).reshape(height, width, channels)
        return (found - found.min()) / (found.max() - found.min())

    image = (255 * smooth(3, 2)).astype(np.uint8)
    boxes = np.concatenate(
        [smooth(1, 3)]
        + [smooth(1, 4) * side * 0.6 + k * side * 0.4
           for _ in range(2) for k, side in ((0, width), (0, height), (1, width), (1, height))],
        axis=2,
    )  # fmt: skip
    return described(image, smooth(contours, 2), boxes if predicted else None)


def perceptron(
    rng, features: int, hidden: tuple[int, ...] = (9, 5), outputs: int = 2
) -> Perceptron:
    sizes = (features, *hidden, outputs)
    layers = [
        (rng.normal(0, 0.6, (a, b)).astype(np.float32), rng.normal(0, 0.3, b).astype(np.float32))
        for a, b in itertools.pairwise(sizes)
    ]
    scaling = np.stack((rng.normal(0, 0.3, features), rng.uniform(0.5, 2, features)))
    return Perceptron(scaling=scaling.astype(np.float32), layers=tuple(layers))


@pytest.mark.parametrize("predicted", [False, True])
@pytest.mark.parametrize("learned", [False, True])
def test_merging_is_that_of_the_readable_twin(rng, predicted: bool, learned: bool) -> None:
    found = regions(picture(rng, 60, 80, predicted))
    count = found.borders.shape[1] - 1 + 35 + (23 if predicted else 0)
    pair = perceptron(rng, count) if learned else None
    blend = (0.3, 0.7)
    tree = merge(found, pair, blend, record=True)
    twin = Merging(found, pair, blend)
    assert tree.leaves > 25
    assert tree.questions is not None
    pairs, features = tree.questions
    assert [tuple(pair) for pair in pairs.tolist()] == twin.questions
    np.testing.assert_allclose(features, np.stack(twin.features), rtol=2e-5, atol=2e-6)
    assert len(np.unique(features[:, 0])) > 20
    assert tree.merges.tolist() == [[a, b] for a, b, _ in twin.merges]
    np.testing.assert_allclose(tree.costs, [cost for *_, cost in twin.merges], atol=1e-6)
    for ours, theirs in (
        (tree.sums, twin.sums), (tree.boxes, twin.boxes), (tree.rim, twin.rim),
        (tree.outlines, twin.outline),
    ):  # fmt: skip
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_allclose(tree.height, twin.height, atol=1e-6)
    assert merge(found, pair, blend).questions is None


def test_each_weight_and_the_blend_count(rng) -> None:
    found = regions(picture(rng, 40, 50, predicted=True))
    count = found.borders.shape[1] - 1 + 35 + 23
    pair = perceptron(rng, count)
    by_part, by_thing = (merge(found, pair, blend) for blend in ((1.0, 0.0), (0.0, 1.0)))
    assert by_part.costs.tolist() != by_thing.costs.tolist()
    thing = Merging(found, pair, (0.0, 1.0))
    np.testing.assert_allclose(by_thing.costs, [cost for *_, cost in thing.merges], atol=1e-6)


def test_regions_are_sums_over_their_pixels(rng) -> None:
    pixels = picture(rng, 30, 44, predicted=True)
    found = regions(pixels)
    labels = pixels.basins
    for k in range(len(found.sums)):
        inside = labels == k
        np.testing.assert_allclose(found.sums[k], pixels.sums[inside].sum(0), rtol=1e-5)
        rows, columns = np.nonzero(inside)
        box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        assert found.boxes[k].tolist() == box
        rim = inside[0].sum() + inside[-1].sum() + inside[:, 0].sum() + inside[:, -1].sum()
        assert found.rim[k] == rim
    between: dict[tuple[int, int], np.ndarray] = {}
    steps = np.array([0.05, 0.1, 0.2, 0.35, 0.5, 0.7], np.float32)
    for dy, dx in ((0, 1), (1, 0)):
        for y in range(30 - dy):
            for x in range(44 - dx):
                a, b = sorted((labels[y, x], labels[y + dy, x + dx]))
                if a != b:
                    high = np.maximum(pixels.channels[y, x], pixels.channels[y + dy, x + dx])
                    row = np.concatenate(([1], high, high[0] > steps))
                    between[a, b] = between.get((a, b), 0) + row
    assert found.pairs.tolist() == [list(pair) for pair in sorted(between)]
    np.testing.assert_allclose(
        found.borders, [between[pair] for pair in sorted(between)], rtol=1e-5
    )
    assert found.pixels == 30 * 44


def test_nodes_of_a_tree_by_hand() -> None:
    """Three stripes of 2, 2 and 4 columns; the border of the last two is weaker."""
    contours = np.zeros((6, 8, 1), np.float32)
    contours[:, 1:3], contours[:, 3:5] = 0.9, 0.3
    image = np.zeros((6, 8, 3), np.uint8)
    basins = np.repeat([[0, 0, 1, 1, 2, 2, 2, 2]], 6, axis=0).astype(np.int64)
    pixels = described(image, contours)
    tree = merge(regions(Pixels(channels=pixels.channels, sums=pixels.sums, basins=basins)), None)
    assert tree.merges.tolist() == [[1, 2], [0, 3]]
    np.testing.assert_allclose(tree.costs, [0.3, 0.9], atol=1e-6)
    assert tree.area.tolist() == [12, 12, 24, 36, 48]
    first, below = tree.spans()
    assert below.tolist() == [1, 1, 1, 2, 3]
    assert first[4] == first[0] == 0
    assert first[3] == first[1] == 1
    assert first[2] == 2
    features = tree.node_features()
    height, death, cost, of_parent = features[:, :4].T
    np.testing.assert_allclose(height, [0, 0, 0, 0.3, 0.9], atol=1e-6)
    np.testing.assert_allclose(death, [0.9, 0.3, 0.3, 0.9, 1.2], atol=1e-6)
    np.testing.assert_allclose(cost, height)
    np.testing.assert_allclose(of_parent, death)
    # Of node 3 two borders: 6 pairs with 0, in the outline of which 0.9 is the mean.
    assert tree.outlines[3, 0] == 6
    np.testing.assert_allclose(tree.outlines[3, 1] / 6, 0.9, atol=1e-6)
    assert tree.boxes[3].tolist() == [2, 0, 8, 6]


def test_a_picture_of_one_region_is_one_node() -> None:
    image = np.full((5, 7, 3), 90, np.uint8)
    tree = merge(regions(described(image, np.zeros((5, 7, 2), np.float32))), None)
    assert tree.leaves == 1
    assert len(tree.merges) == 0
    assert np.isfinite(tree.node_features()).all()


def test_wrong_arrays_do_not_reach_foreign_memory(rng) -> None:
    found = regions(picture(rng, 30, 40, predicted=False))
    n = len(found.sums)
    right = {
        "leaves": n, "pixels": 1200.0, "sums": np.zeros((2 * n - 1, 58)), "predicted": False,
        "outlines": np.zeros((2 * n - 1, found.borders.shape[1])),
        "boxes": np.zeros((2 * n - 1, 4)), "rim": np.zeros(2 * n - 1),
        "height": np.zeros(2 * n - 1), "pairs": found.pairs, "borders": found.borders,
        "layers": [], "scaling": None, "blend": np.zeros(2, np.float32),
        "merges": np.zeros((n - 1, 2), np.int64), "costs": np.zeros(n - 1), "record": False,
    }  # fmt: skip
    layer = (np.zeros((5, 2), np.float32), np.zeros(2, np.float32))
    for name, wrong in (
        ("leaves", 0), ("leaves", n + 1), ("sums", np.zeros((2 * n - 1, 57))),
        ("predicted", True), ("outlines", np.zeros((2 * n, found.borders.shape[1]))),
        ("borders", found.borders[1:]), ("pairs", found.pairs + n), ("pairs", found.pairs[:, ::-1]),
        ("merges", np.zeros((n, 2), np.int64)), ("costs", np.zeros(n)), ("layers", [layer]),
        ("boxes", np.zeros((2 * n - 1, 3))), ("rim", np.zeros(n)), ("height", np.zeros(n)),
    ):  # fmt: skip
        with pytest.raises(ValueError, match="merge_regions"):
            _native.merge_regions(**{**right, name: np.ascontiguousarray(wrong)
                                     if isinstance(wrong, np.ndarray) else wrong})  # fmt: skip


def test_a_perceptron_is_its_layers(rng) -> None:
    model = perceptron(rng, 4, (3,))
    features = rng.normal(0, 1, (6, 4)).astype(np.float32)
    features[0] = 1e6
    scaled = np.clip((features - model.scaling[0]) / model.scaling[1], -8, 8)
    (first, bias), (second, other) = model.layers
    wanted = 1 / (1 + np.exp(-(np.maximum(scaled @ first + bias, 0) @ second + other)))
    np.testing.assert_allclose(model(features), wanted, rtol=1e-5)
    kept = {f"x.{name}": torch.from_numpy(one) for name, one in model.tensors().items()}
    again = Perceptron.of({**kept, "y.weights0": torch.zeros(1)}, "x.")
    np.testing.assert_array_equal(again(features), model(features))


def test_candidates_are_nodes_of_three_trees_and_how_well_they_agree(rng) -> None:
    found = regions(picture(rng, 60, 80, predicted=True))
    pair = perceptron(rng, found.borders.shape[1] - 1 + 35 + 23)
    nodes = candidates(found, pair)
    assert set(nodes.tree.tolist()) == {0, 1, 2}
    areas = found.sums[:, 0]
    inside = nodes.members(np.arange(len(nodes.areas)))
    np.testing.assert_array_equal(nodes.areas, inside @ areas)
    assert float(nodes.areas.min()) >= SMALLEST * 60 * 80
    trees = [merge(found, pair, (0, 1)), merge(found, pair, (1, 0)), merge(found, None)]
    assert len(nodes.areas) == sum(int((t.area >= SMALLEST * 60 * 80).sum()) for t in trees)
    sets = [frozenset(np.flatnonzero(one).tolist()) for one in inside]
    for i in range(0, len(sets), 7):
        own = [float(v) for v in nodes.features[i, -5:-2]]
        assert own == [float(k == nodes.tree[i]) for k in range(3)]
        for column, other in enumerate(k for k in range(3) if k != nodes.tree[i]):
            best = max(
                sum(areas[list(sets[i] & sets[j])]) / sum(areas[list(sets[i] | sets[j])])
                for j in np.flatnonzero(nodes.tree == other).tolist()
            )
            assert nodes.features[i, -2 + column] == pytest.approx(best, rel=1e-5)


def test_selection_takes_the_best_that_repeat_nothing() -> None:
    """Basins of 10, 10, 4 and 3 pixels; candidates of two trees."""
    found = Candidates(
        features=np.zeros((4, 1), np.float32), areas=np.array([20, 24, 4, 3], np.float32),
        tree=np.array([0, 0, 1, 1]), spans=np.array([[0, 2], [0, 3], [0, 1], [1, 2]]),
        places=np.array([[0, 1, 2, 3], [3, 2, 0, 1]]),
        basin_areas=np.array([10, 10, 4, 3], np.float32),
    )  # fmt: skip
    inside = [[1, 1, 0, 0], [1, 1, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert found.members(np.arange(4)).astype(int).tolist() == inside
    scores = np.array([0.5, 0.9, 0.2, 0.8])
    # 20 of 24 pixels are shared by the first two.
    assert select(found, scores, most=9, least=0).tolist() == [1, 3, 2]
    assert select(found, scores, most=2, least=0).tolist() == [1, 3]
    assert select(found, scores, most=9, least=4).tolist() == [1, 2]
    assert select(found, -scores, most=9, least=0).tolist() == [2, 0, 3]
    # Of 24 pixels the second is all of the image: what is in it is asked for.
    alone = replace(found, basin_areas=np.array([10, 10, 4, 0], np.float32))
    assert select(alone, scores, most=9, least=0).tolist()[:2] == [3, 0]


def test_masks_are_runs_of_their_regions(rng) -> None:
    labels = rng.integers(0, 5, (7, 9)).astype(np.int32)
    members = rng.random((6, 5)) < 0.5
    members[0], members[1] = True, False
    for mask, inside in zip(encoded(labels, members), members, strict=True):
        np.testing.assert_array_equal(mask.decode().numpy(), inside[labels])


def test_contours_of_both_networks_begin_with_their_mean(rng) -> None:
    own, hed = rng.random((3, 4, 6)).astype(np.float32), rng.random((3, 4, 9)).astype(np.float32)
    both = with_hed(own, hed)
    assert both.shape == (3, 4, 16)
    np.testing.assert_allclose(both[..., 0], (own[..., 0] + hed[..., 0]) / 2)
    np.testing.assert_array_equal(both[..., 1:7], own)
    np.testing.assert_array_equal(both[..., 7:], hed)


def plane(height: int, width: int, focal: float, normal: tuple[float, float, float]) -> np.ndarray:
    """z-depth of a plane at distance 1 along its normal."""
    y, x = np.mgrid[:height, :width] + 0.5
    return 1 / (
        normal[0] * (x - width / 2) / focal + normal[1] * (y - height / 2) / focal + normal[2]
    )


def test_planes_have_no_contours_and_steps_and_folds_do() -> None:
    focal = 80.0
    leaning = plane(40, 60, focal, (0.5, 0.2, 0.8)).astype(np.float32)
    inside = np.s_[12:-12, 12:-12]
    assert float(depth_contours(leaning, focal)[inside].max()) < 2e-3
    step = leaning.copy()
    step[:, 30:] *= 1.3
    found = depth_contours(step, focal)[12:-12]
    assert float(found[:, 29:31, 0].min()) > 0.6
    assert float(found[:, 12:20, 0].max()) < 2e-3
    # The depth of two walls that meet in a corner, seen from inside: of each pixel the nearer.
    fold = np.minimum(plane(40, 60, focal, (0.6, 0.0, 0.8)), plane(40, 60, focal, (-0.6, 0.0, 0.8)))
    found = depth_contours(fold.astype(np.float32), focal)[12:-12]
    assert float(found[:, 29:31, 1].min()) > 0.35
    assert float(found[:, 12:20, 1].max()) < 0.02
    other = depth_contours(fold.astype(np.float32), 4 * focal)[12:-12]
    assert not np.allclose(other, found, atol=1e-3), "folds depend on the focal length"
    nothing = depth_contours(np.zeros((9, 9), np.float32), focal)
    assert np.isfinite(nothing).all()
    assert float(nothing.max()) == 0
