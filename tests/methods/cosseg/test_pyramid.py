"""Random sampling: by hand on a line, against comparison of all pairs, and its errors."""

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.methods.cosseg.network import RandlaEncoder
from splatseg.methods.cosseg.pyramid import (
    PyramidOptions,
    RandlaConfig,
    point_pyramid,
)
from splatseg_bench.point_network import join_pyramids

from .point_scenes import pyramid_of, randomised, scene, small_config


def all_pairs(points: np.ndarray, queries: np.ndarray, k: int) -> np.ndarray:
    """The k nearest points of each query by sorting all, equal ones by index."""
    squared = ((queries[:, None] - points[None]) ** 2).sum(axis=-1)
    return np.argsort(squared, axis=1, kind="stable")[:, :k]


def test_points_on_a_line_by_hand() -> None:
    x = torch.tensor([0.0, 1, 3, 7, 15, 31])
    points = torch.stack((x, torch.zeros(6), torch.zeros(6)), dim=1)
    pyramid = point_pyramid(points, options=PyramidOptions(neighbours=2, ratios=(2, 3)), seed=0)
    assert pyramid.sizes == (6, 3, 1)
    assert pyramid.neighbours[0].tolist() == [[0, 1], [1, 0], [2, 1], [3, 2], [4, 3], [5, 4]]
    assert pyramid.kept[0].tolist() == [0, 1, 2, 3, 4, 5]
    # Which points are kept is drawn; what follows from it is not.
    first, second, third = pyramid.kept[1].tolist()
    assert first < second < third
    assert pyramid.pool[0].tolist() == [first, second, third]
    assert pyramid.kept[2].tolist() == [pyramid.kept[1][pyramid.pool[1]].item()]
    assert pyramid.neighbours[1].tolist() == [[0, 1], [1, 0], [2, 1]]
    assert pyramid.up[1].tolist() == [0, 0, 0]
    nearest = [
        int(np.argmin([abs(float(v) - float(x[j])) for j in (first, second, third)])) for v in x
    ]
    assert pyramid.up[0].tolist() == nearest


@pytest.mark.parametrize("kind", ["scattered", "ties"])
def test_every_level_is_that_of_all_pairs(kind: str, rng: np.random.Generator) -> None:
    points = rng.normal(size=(300, 3))
    if kind == "ties":
        points = rng.integers(0, 4, size=(300, 3)).astype(float)
    options = PyramidOptions(neighbours=5, ratios=(2, 4, 3))
    pyramid = point_pyramid(torch.from_numpy(points), options=options, seed=4)
    assert pyramid.sizes == (300, 150, 37, 12)
    for level, neighbours in enumerate(pyramid.neighbours):
        here = points[pyramid.kept[level].numpy()]
        after = points[pyramid.kept[level + 1].numpy()]
        assert neighbours.dtype == torch.int32
        assert np.array_equal(neighbours.numpy(), all_pairs(here, here, 5))
        assert np.array_equal(here[pyramid.pool[level].numpy()], after)
        assert np.array_equal(pyramid.up[level].numpy(), all_pairs(after, here, 1)[:, 0])


def test_a_point_is_its_own_nearest_neighbour() -> None:
    positions, _ = scene(80)
    pyramid = pyramid_of(positions, small_config())
    for neighbours in pyramid.neighbours:
        assert neighbours[:, 0].tolist() == list(range(len(neighbours)))


def test_the_seed_alone_decides() -> None:
    positions, _ = scene(120)
    config = small_config()
    before = torch.get_num_threads()
    try:
        found = []
        for threads, seed in ((1, 5), (2, 5), (1, 6)):
            torch.set_num_threads(threads)
            found.append(pyramid_of(positions, config, seed))
    finally:
        torch.set_num_threads(before)
    same, other = found[1:]
    for name in ("kept", "neighbours", "pool", "up"):
        for one, two in zip(getattr(found[0], name), getattr(same, name), strict=True):
            assert torch.equal(one, two)
    assert not torch.equal(found[0].kept[1], other.kept[1])


def test_all_points_are_kept_equally_often() -> None:
    positions, _ = scene(24)
    options = PyramidOptions(neighbours=1, ratios=(3, 2))
    counts = np.zeros((3, 24))
    for seed in range(600):
        for level, kept in enumerate(point_pyramid(positions, options=options, seed=seed).kept):
            counts[level, kept.numpy()] += 1
    assert (counts[0] == 600).all()
    for level, share in ((1, 1 / 3), (2, 1 / 6)):
        spread = (600 * share * (1 - share)) ** 0.5
        assert np.abs(counts[level] - 600 * share).max() < 4 * spread


@pytest.mark.parametrize(("count", "sizes"), [(11, "11, 5, 1"), (15, "15, 7, 2")])
def test_too_few_points_are_told(count: int, sizes: str) -> None:
    options = PyramidOptions(neighbours=8, ratios=(2, 3))
    with pytest.raises(InputError) as caught:
        point_pyramid(torch.rand(count, 3), options=options, seed=0)
    assert str(caught.value) == (
        "positions: expected at least 16 points, so that each of 2 levels has 8 neighbours, "
        f"got {count}, of which the levels have {sizes}."
    )
    assert point_pyramid(torch.rand(16, 3), options=options, seed=0).sizes == (16, 8, 2)


def test_the_last_level_needs_a_point() -> None:
    options = PyramidOptions(neighbours=2, ratios=(2, 5))
    with pytest.raises(InputError, match="at least 10 points"):
        point_pyramid(torch.rand(9, 3), options=options, seed=0)
    assert point_pyramid(torch.rand(10, 3), options=options, seed=0).sizes == (10, 5, 1)


def test_wrong_points_and_options() -> None:
    options = PyramidOptions(neighbours=2, ratios=(2,))
    points = torch.rand(8, 3)
    with pytest.raises(ShapeError, match=r"positions: expected shape \(any, 3\), got \(8, 2\)"):
        point_pyramid(points[:, :2], options=options, seed=0)
    points[3, 1] = torch.nan
    with pytest.raises(RangeError, match=r"positions: 1 of 24 values are not finite"):
        point_pyramid(points, options=options, seed=0)
    with pytest.raises(RangeError, match="seed: expected 0 or more"):
        point_pyramid(torch.rand(8, 3), options=options, seed=-1)
    for fields, message in (
        ({"neighbours": 0}, r"neighbours: expected a value in \[1, 4096\], got 0"),
        ({"ratios": ()}, "ratios: expected at least one level"),
        ({"ratios": (2, 0)}, r"ratios\[1\]: expected a value in \[1, 4096\]"),
    ):
        with pytest.raises(RangeError, match=message):
            PyramidOptions(**fields)


def test_a_batch_is_its_scenes() -> None:
    """No point of a batch sees another scene, so frozen features are those of each by itself."""
    config = small_config(inputs=3)
    encoder = randomised(RandlaEncoder(config))
    scenes = [scene(count, seed)[0] for count, seed in ((40, 1), (31, 2), (28, 3))]
    pyramids = [pyramid_of(points, config, seed=9) for points in scenes]
    joined = join_pyramids(pyramids)
    assert joined.sizes == tuple(map(sum, zip(*(one.sizes for one in pyramids), strict=True)))
    apart = [encoder(one, points) for one, points in zip(pyramids, scenes, strict=True)]
    together = encoder(joined, torch.cat(scenes))
    for level, found in enumerate(together):
        assert torch.allclose(found, torch.cat([one[level] for one in apart]), atol=1e-6)
    ups = joined.positions[joined.kept[1]][joined.up[0]]
    wanted = torch.cat([p.positions[p.kept[1]][p.up[0]] for p in pyramids])
    assert torch.equal(ups, wanted)


def test_batches_that_do_not_fit() -> None:
    points, _ = scene(40)
    one = pyramid_of(points, small_config())
    two = pyramid_of(points, RandlaConfig(widths=(4,), neighbours=4, ratios=(2,)))
    with pytest.raises(InputError, match="pyramids: expected at least one, got none"):
        join_pyramids([])
    three = pyramid_of(points, RandlaConfig(widths=(4,), neighbours=3, ratios=(2,)))
    with pytest.raises(InputError, match=r"got neighbours \[4\] and \[4, 4, 4\]"):
        join_pyramids([one, two])
    with pytest.raises(InputError, match=r"got neighbours \[3\] and \[4\]"):
        join_pyramids([two, three])
