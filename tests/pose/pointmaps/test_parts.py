"""Focal lengths, resection, averaging: each against what was put in, or solved by hand."""

import math

import numpy as np
import pytest
import torch

from splatseg.core import Pointmap
from splatseg.core.rigid import best_similarity
from splatseg.errors import InputError
from splatseg.pose._pointmap_align import Aligned
from splatseg.pose._pointmap_pixels import PairSamples, PhotographSize
from splatseg.pose._pointmap_start import (
    agreement,
    average,
    geman_mcclure,
    graph_solve,
    lens_focals,
    pair_geometry,
    ray_directions,
    resect,
    rotation_angle,
    rotation_of_vector,
    rotation_vector,
    spanning_tree,
    tree_world,
    weiszfeld_focal,
)
from splatseg.pose.pointmaps import read_depth_maps
from splatseg_bench.worlds import PointmapErrors
from support.pointmaps import complete, window


def _scene(rng, count: int, focal: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Offsets of pixels and points that project onto them."""
    offsets = torch.from_numpy(rng.uniform(-200, 200, size=(count, 2)))
    depth = torch.from_numpy(rng.uniform(1, 9, size=count))
    return offsets, depth[:, None] * ray_directions(offsets[None], torch.tensor([focal]).double())[
        0
    ]


def test_weiszfeld_finds_the_focal_length_and_shrugs_off_wrong_points(rng) -> None:
    offsets, points = _scene(rng, 400, 321.0)
    weights = torch.ones(400)
    assert float(weiszfeld_focal(offsets, points, weights)) == pytest.approx(321.0, rel=1e-9)
    points[:100] = points[torch.from_numpy(rng.permutation(100))]
    assert float(weiszfeld_focal(offsets, points, weights)) == pytest.approx(321.0, rel=1e-3)
    least_squares = float(
        ((points[:, :2] / points[:, 2:]) * offsets).sum()
        / (points[:, :2] / points[:, 2:]).square().sum()
    )
    assert abs(least_squares - 321.0) > 30  # what the absolute value in eq. 4 is for


def test_weiszfeld_minimises_eq_4(rng) -> None:
    offsets, points = _scene(rng, 200, 300.0)
    points = points * torch.from_numpy(1 + 0.2 * rng.normal(size=(200, 3)))
    weights = torch.from_numpy(rng.uniform(1, 5, size=200))

    def cost(focal: float) -> float:
        plane = points[:, :2] / points[:, 2:]
        return float((weights * (offsets - focal * plane).norm(dim=1)).sum())

    found = float(weiszfeld_focal(offsets, points, weights))
    assert cost(found) < min(cost(0.995 * found), cost(1.005 * found))


def test_points_behind_the_camera_tell_no_focal_length(rng) -> None:
    offsets, points = _scene(rng, 50, 250.0)
    behind = torch.cat((points, -points[:20]))
    both = torch.cat((offsets, 3 * offsets[:20]))
    assert float(weiszfeld_focal(both, behind, torch.ones(70))) == pytest.approx(250.0, rel=1e-9)
    assert math.isnan(float(weiszfeld_focal(offsets, -points, torch.ones(50))))


@pytest.mark.parametrize("wrong", [0, 60])
def test_a_camera_is_found_from_points_and_their_pixels(rng, wrong: int) -> None:
    """Any turn, any place, a fifth of the points wrong."""
    batch, count = 20, 300
    vectors = torch.from_numpy(rng.normal(size=(batch, 3)))
    rotation = rotation_of_vector(3 * vectors / vectors.norm(dim=1, keepdim=True))
    translation = torch.from_numpy(rng.normal(size=(batch, 3)))
    rays = ray_directions(
        torch.from_numpy(rng.uniform(-0.7, 0.7, size=(batch, count, 2))), torch.ones(batch).double()
    )
    local = torch.from_numpy(rng.uniform(2, 9, size=(batch, count, 1))) * rays
    points = (local - translation[:, None]) @ rotation
    points[:, :wrong] += torch.from_numpy(rng.normal(size=(batch, wrong, 3)))
    found, shift = resect(points, rays, torch.ones(batch, count).double())
    angles = torch.rad2deg(rotation_angle(found @ rotation.transpose(1, 2)))
    assert float(angles.max()) < (0.05 if wrong else 1e-4)
    assert float((shift - translation).norm(dim=1).max()) < (0.01 if wrong else 1e-5)


def test_similarity_is_found_exactly(rng) -> None:
    source = torch.from_numpy(rng.normal(size=(3, 20, 3)))
    turn = rotation_of_vector(torch.from_numpy(rng.normal(size=(3, 3))))
    target = 2.5 * source @ turn.transpose(1, 2) + 1
    weights = torch.from_numpy(rng.uniform(1, 2, size=(3, 20)))
    scale, rotation, shift = best_similarity(source, target, weights)
    torch.testing.assert_close(scale, torch.full((3,), 2.5).double())
    torch.testing.assert_close(rotation, turn)
    torch.testing.assert_close(shift, torch.ones(3, 3).double())


def test_rotations_and_vectors_are_inverse(rng) -> None:
    vectors = torch.from_numpy(rng.normal(size=(50, 3)))
    vectors = vectors / vectors.norm(dim=1, keepdim=True) * torch.linspace(1e-6, 3.1, 50)[:, None]
    torch.testing.assert_close(rotation_vector(rotation_of_vector(vectors)), vectors)
    assert float(rotation_angle(torch.eye(3).double())) == 0
    half = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    assert float(rotation_angle(half)) == pytest.approx(math.pi)


def test_a_graph_is_solved_by_hand() -> None:
    """Two ways from 0 to 2: 1 + 1 by way of 1, and 5 with a quarter of the weight."""
    found = graph_solve(
        torch.tensor([0, 1, 0]),
        torch.tensor([1, 2, 2]),
        torch.tensor([[1.0], [1.0], [5.0]]).double(),
        torch.tensor([1.0, 1.0, 0.25]).double(),
        3,
    )[:, 0]
    # The two steps in a row weigh 1/2 together: (2 / 2 + 5 / 4) / (1/2 + 1/4) = 3.
    torch.testing.assert_close(found - found[0], torch.tensor([0, 1.5, 3.0]).double())
    assert float(found.sum()) == pytest.approx(0, abs=1e-9)


def test_weights_fall_to_a_quarter() -> None:
    weights = geman_mcclure(torch.tensor([1.0, 1.0, 1.0, 0.0, 3.0]).double(), 0.1)
    torch.testing.assert_close(weights[3:], torch.tensor([1.0, 0.25]).double())


@pytest.mark.parametrize("pairs", [complete(8), window(8, 1)])
def test_exact_pairs_give_exact_worlds_along_the_tree_and_on_average(photographed, pairs) -> None:
    samples = photographed.samples(pairs)
    focal = lens_focals(samples)
    true = [photographed.cameras[name] for name in photographed.names]
    assert float(focal[0]) == pytest.approx(true[0].fx, rel=1e-6)
    geometry = pair_geometry(samples, focal)
    world = tree_world(samples, geometry, spanning_tree(samples, agreement(samples, geometry)))
    for found in (world, average(samples, geometry, world)):
        turn = true[0].world_from_cam[:3, :3] @ found.rotation[0].T
        for i, camera in enumerate(true):
            off = rotation_angle(turn @ found.rotation[i] @ camera.cam_from_world[:3, :3])
            assert math.degrees(float(off)) < 0.05
        ours, theirs = found.centre, torch.stack([camera.centre for camera in true])
        scale, turned, shift = best_similarity(ours[None], theirs[None], torch.ones(1, 8).double())
        moved = scale * ours @ turned[0].T + shift
        assert float((moved - theirs).norm(dim=1).max()) < 2e-3 * float(theirs.std(dim=0).norm())


def test_pairs_that_contradict_others_are_not_in_the_tree(photographed) -> None:
    """However sure the network is of them."""
    pairs = complete(8)
    errors = PointmapErrors(outliers=0.2, noise=0.01, warp=0.01)
    wrong = photographed.answers(pairs, errors).outliers
    named = [(photographed.names[i], photographed.names[j]) for i, j in pairs]
    samples = photographed.samples(pairs, errors)
    bad = torch.tensor([pair in wrong for pair in named])
    samples.weights[bad] += 1
    geometry = pair_geometry(samples, lens_focals(samples))
    assert not bad[spanning_tree(samples, agreement(samples, geometry))].any()


def test_a_tree_reaches_every_photograph_once(photographed) -> None:
    samples = photographed.samples(window(8, 2))
    tree = spanning_tree(samples, torch.from_numpy(np.random.default_rng(0).uniform(size=26)))
    assert len(tree) == 7
    assert {int(i) for e in tree for i in samples.views[e]} == set(range(8))


def test_a_lens_that_is_first_of_no_pair_has_no_focal_length(photographed) -> None:
    samples = photographed.samples([(0, 1), (1, 0), (0, 2)] + [(0, i) for i in range(3, 8)])
    assert len(set(lens_focals(samples).tolist())) == 1
    alone = samples.lenses.clone()
    alone[2] = 2
    object.__setattr__(samples, "lenses", alone)
    with pytest.raises(InputError, match="a pair with photograph 3 of 8"):
        lens_focals(samples)


# Depth maps of photographs from their pairs, solved by hand.


SIZES = ((2, 3), (2, 3))
PHOTOGRAPHS = [PhotographSize(name=name, width=6, height=4) for name in ("a", "b")]


class Flat:
    """Walls that face the camera, at a depth of each pair; e times as sure as not at all."""

    def __init__(self, depths: dict[tuple[str, str], float]) -> None:
        self.depths = depths
        self.asked: list[tuple[str, str]] = []

    def pointmaps(self, first: str, second: str) -> tuple[Pointmap, Pointmap]:
        self.asked.append((first, second))
        points = torch.zeros(*SIZES[0], 3)
        points[..., 2] = self.depths[first, second]
        one = Pointmap(points=points, confidence=torch.full(SIZES[0], math.e))
        return one, one


def _aligned(weight: list[float], scale: list[float]) -> Aligned:
    """Cameras and pairs all in the same place, directed alike."""
    count = len(weight)
    return Aligned(
        rotation=torch.eye(3).double().repeat(2, 1, 1),
        centre=torch.zeros(2, 3).double(),
        focal=torch.full((2,), 5.0).double(),
        depth=torch.ones(2, 1).double(),
        scale=torch.tensor(scale).double(),
        pair_rotation=torch.eye(3).double().repeat(count, 1, 1),
        pair_translation=torch.zeros(count, 3).double(),
        residual=torch.zeros(count).double(),
        weight=torch.tensor(weight).double(),
    )


def test_depths_are_means_of_logarithms_weighted_by_how_much_pairs_are_believed() -> None:
    """Depths 2 with weight 1 and 2 x 2 with 0.5; a third pair, 100 away, is not even read."""
    pairs = torch.tensor([0, 1, 0]), torch.tensor([1, 0, 1])
    samples = PairSamples(
        first=pairs[0],
        second=pairs[1],
        points=torch.zeros(3, 2, 1, 3),
        weights=torch.ones(3, 2, 1),
        offsets=torch.zeros(2, 1, 2).double(),
        lenses=torch.zeros(2, dtype=torch.int64),
        sizes=SIZES,
    )
    source = Flat({("a", "b"): 2.0, ("b", "a"): 2.0})
    world = _aligned([1.0, 0.5, 0.2], [1.0, 2.0, 50.0])
    maps = read_depth_maps(PHOTOGRAPHS, samples, world, source, progress=lambda done, total: None)
    assert source.asked == [("a", "b"), ("b", "a")]
    mean = (1.0 * math.log(2) + 0.5 * math.log(4)) / 1.5
    spread = (1.0 * math.log(2) ** 2 + 0.5 * math.log(4) ** 2) / 1.5 - mean**2
    for depth, sure in zip(maps.depth, maps.sure, strict=True):
        torch.testing.assert_close(depth, torch.full(SIZES[0], math.exp(mean)))
        assert float(sure[0, 0]) == pytest.approx(1.5 / (1 + spread / 0.05**2), rel=1e-4)
