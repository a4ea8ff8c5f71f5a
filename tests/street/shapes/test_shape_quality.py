"""What shapes are trained with and scored by."""

import math

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.street.shapes import ShapeConfig, chamfer, primitive_scale, template
from support import shape_quality as intersections
from support.shape_quality import (
    cut_patches,
    mesh_regularisers,
    new_shapes,
    sample_faces,
    score_shapes,
    self_intersections,
)

from . import reference


@pytest.mark.parametrize(("distance", "power"), [("squared", 2), ("euclidean", 1)])
def test_it_is_the_mean_of_least_distances_both_ways(
    distance: str, power: int, rng: np.random.Generator
) -> None:
    a, b = rng.normal(size=(3, 9, 3)), rng.normal(size=(3, 14, 3))
    wanted = [reference.chamfer(x, y, power=power) for x, y in zip(a, b, strict=True)]
    found = chamfer(torch.from_numpy(a), torch.from_numpy(b), distance=distance)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    single = chamfer(torch.from_numpy(a).float(), torch.from_numpy(b).float(), distance=distance)
    np.testing.assert_allclose(single, wanted, rtol=1e-4)


def test_by_hand() -> None:
    """One point at distances 3 and 4 of two others."""
    a = torch.tensor([[[0.0, 0, 0]]])
    b = torch.tensor([[[3.0, 0, 0], [0, 4, 0]]])
    assert chamfer(a, b).item() == 9 + (9 + 16) / 2
    assert chamfer(b, a, distance="euclidean").item() == 3 + (3 + 4) / 2


def test_its_gradient_is_that_of_differences(rng: np.random.Generator) -> None:
    a = torch.from_numpy(rng.normal(size=(2, 5, 3))).requires_grad_()
    b = torch.from_numpy(rng.normal(size=(2, 7, 3))).requires_grad_()
    for distance in ("squared", "euclidean"):
        assert torch.autograd.gradcheck(lambda x, y, d=distance: chamfer(x, y, distance=d), (a, b))


def test_points_on_faces_are_spread_by_area(rng: np.random.Generator) -> None:
    """A tall tetrahedron: shares of faces are shares of area, means are centroids."""
    corners = torch.tensor([[[0.0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 5]]], dtype=torch.float64)
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    count = 40_000
    drawn = sample_faces(corners, faces, count, torch.Generator().manual_seed(0))[0]
    areas = np.array([3.0, 7.5, 0.5 * math.sqrt(10**2 + 15**2 + 6**2), 5.0])
    on = torch.stack([*(drawn[:, axis] == 0 for axis in (2, 1, 0)), torch.ones(count) > 0])
    which = torch.tensor([0, 1, 3, 2])[on.double().argmax(dim=0)]
    shares = torch.bincount(which, minlength=4).double() / count
    np.testing.assert_allclose(shares, areas / areas.sum(), atol=0.01)
    slope = drawn[which == 2]
    np.testing.assert_allclose((slope / torch.tensor([3.0, 2, 5])).sum(dim=1), 1.0, atol=1e-6)
    for number, face in enumerate(faces):
        middle = drawn[which == number].mean(dim=0)
        np.testing.assert_allclose(middle, corners[0, face].mean(dim=0), atol=0.06)


def test_points_on_faces_follow_their_vertices() -> None:
    vertices, faces = template()
    moved = vertices[None].double().requires_grad_()

    def drawn(x: torch.Tensor) -> torch.Tensor:
        return sample_faces(x, faces, 5, torch.Generator().manual_seed(1))

    # Which faces are hit depends on areas, a little; weights do not.
    found = drawn(moved)
    found.sum().backward()
    assert moved.grad is not None
    # Weights of a point sum to 1 in each of x, y, z.
    assert float(moved.grad.sum()) == pytest.approx(15.0)
    torch.testing.assert_close(drawn(moved + 1), found + 1)
    torch.testing.assert_close(drawn(2 * moved), 2 * found)


def test_faces_without_area_are_no_fault() -> None:
    """All in one point: so are the points drawn."""
    _, faces = template()
    drawn = sample_faces(torch.ones(2, 42, 3), faces, 8, torch.Generator().manual_seed(0))
    torch.testing.assert_close(drawn, torch.ones(2, 8, 3))


def test_bad_input_is_refused() -> None:
    sets = torch.zeros(2, 3, 3)
    with pytest.raises(ShapeError, match=r"b: expected shape \(2, any, 3\), got \(1, 3, 3\)"):
        chamfer(sets, sets[:1])
    with pytest.raises(ShapeError, match="a, b: expected points in each set"):
        chamfer(sets, sets[:, :0])
    with pytest.raises(InputError, match="distance: expected one of squared, euclidean"):
        chamfer(sets, sets, distance="cubic")  # type: ignore[arg-type]
    with pytest.raises(RangeError, match="count: expected a value in"):
        sample_faces(sets, torch.tensor([[0, 1, 2]]), 0, torch.Generator())


# Faces that go through each other, against exact arithmetic and by hand.


APART = torch.tensor([[0, 1, 2], [3, 4, 5]])
LYING = ((0.0, 0, 0), (4, 0, 0), (0, 4, 0))


def count(second: tuple[tuple[float, float, float], ...]) -> int:
    """Of the triangle LYING and another one."""
    return int(self_intersections(torch.tensor([[*LYING, *second]]), APART))


@pytest.mark.parametrize(
    ("second", "meets"),
    [
        (((1, 1, -1), (1, 1, 1), (9, 9, 1)), True),  # an edge of it goes through
        (((-1, 1, -1), (5, 1, -1), (2, 1, 9)), True),  # edges of the first go through it
        (((5, 5, -1), (5, 5, 1), (9, 9, 1)), False),  # through the plane, beside the triangle
        (((1, 1, 1), (1, 2, 1), (2, 1, 1)), False),  # parallel
        (((1, 1, 0), (1, 1, 5), (2, 2, 5)), True),  # touches with a corner
        (((4, 4, 0), (4, 4, 5), (2, 9, 5)), False),  # a corner in the plane, beside
        (((1, 1, 0), (2, 1, 0), (1, 2, 0)), True),  # in the plane, within
        (((-9, -9, 0), (30, -9, 0), (-9, 30, 0)), True),  # in the plane, around
        (((-1, 1, 0), (5, 1, 0), (2, 9, 0)), True),  # in the plane, across
        (((5, 5, 0), (6, 5, 0), (5, 6, 0)), False),  # in the plane, apart
        (((5, -1, 0), (7, -1, 0), (9, -1, 1)), False),  # an edge in the plane, apart
        (((-1, 1, 0), (5, 1, 0), (2, 2, 1)), True),  # an edge in the plane, across
        (((6, 0, 0), (8, 0, 0), (6, 0, 3)), False),  # on the line of an edge, apart
        (((3, 0, 0), (8, 0, 0), (6, 0, 3)), True),  # on the line of an edge, overlapping
    ],
)
def test_two_triangles_by_hand(second: tuple[tuple[float, float, float], ...], meets: bool) -> None:
    shapes = [tuple(map(float, corner)) for corner in second]
    assert count(tuple(shapes)) == meets  # type: ignore[arg-type]
    assert count(tuple(reversed(shapes))) == meets  # type: ignore[arg-type]
    exact = torch.tensor([*LYING, *shapes]).numpy()
    assert reference.self_intersections(exact, APART.numpy()) == meets
    # Seen along another axis.
    turned = torch.tensor([[*LYING, *shapes]])[:, :, [1, 2, 0]]
    assert bool(self_intersections(turned, APART)) == meets


def test_counts_are_those_of_exact_arithmetic(rng: np.random.Generator) -> None:
    vertices, faces = template()
    noise = np.array([0.1, 0.25, 0.4])[:, None, None] * rng.normal(size=(3, 42, 3))
    meshes = vertices + torch.from_numpy(noise).float()
    wanted = [reference.self_intersections(mesh.numpy(), faces.numpy()) for mesh in meshes]
    assert wanted[0] < wanted[1] < wanted[2]
    assert self_intersections(meshes, faces).tolist() == wanted


def test_it_does_not_depend_on_blocks(rng: np.random.Generator, monkeypatch) -> None:
    vertices, faces = template()
    meshes = vertices + torch.from_numpy(0.4 * rng.normal(size=(5, 42, 3))).float()
    whole = self_intersections(meshes, faces)
    monkeypatch.setattr(intersections, "_PAIRS_AT_ONCE", 1)
    assert torch.equal(self_intersections(meshes, faces), whole)
    assert int(whole.min()) > 0


def test_flattened_meshes_meet_themselves_only_in_the_end(rng: np.random.Generator) -> None:
    vertices, faces = template()
    thin = vertices * torch.tensor([[[1, 1, 1e-3]], [[1, 1, 1e-12]]])
    assert self_intersections(thin, faces).tolist() == [0, 0]
    # Moved a little, so that no corner lies on another edge, where roundings would decide.
    flat = vertices + torch.from_numpy(0.01 * rng.normal(size=(42, 3))).float()
    flat[:, 2] = 0.25
    wanted = reference.self_intersections(flat.numpy(), faces.numpy())
    assert wanted > 100
    assert self_intersections(flat[None], faces).tolist() == [wanted]


def test_faces_with_a_common_vertex_are_not_counted() -> None:
    fan = torch.tensor([[0, 1, 2], [0, 3, 4]])
    vertices = torch.tensor([[(0.0, 0, 0), (4, 0, 0), (0, 4, 0), (1, 1, 1), (1, 1, -1)]])
    assert self_intersections(vertices, fan).tolist() == [0]
    assert self_intersections(torch.zeros(0, 5, 3), fan).tolist() == []


def test_vertices_that_are_no_numbers_are_refused() -> None:
    with pytest.raises(RangeError, match="vertices: 1 of 18 values are not finite"):
        self_intersections(torch.tensor([[*LYING, *LYING[:2], (0, float("nan"), 0)]]), APART)


# Patches of surfaces in the frames of their primitives.


def cut(points: torch.Tensor, size: float = 1.0, **rest: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(rest.pop("seed", 0))
    settings = {"count": 40, "min_points": 10} | rest
    return cut_patches(points, voxel_size=size, generator=generator, **settings)


def plane(count: int, rng: np.random.Generator, side: float = 6.0) -> torch.Tensor:
    points = rng.uniform(0, side, size=(count, 3))
    points[:, 2] = 1.7
    return torch.from_numpy(points).float()


def test_a_plane_falls_into_squares_of_the_size_of_voxels(rng: np.random.Generator) -> None:
    points = plane(40_000, rng)
    for size in (0.5, 1.0):
        found = cut(points, size)
        assert found.shape[1:] == (40, 3)
        # Squares that the border cuts have fewer cells; most of them are whole.
        whole = (6 / size) ** 2
        assert 0.9 * whole <= len(found) <= (6 / size + 1) ** 2
        # In units: half a diagonal of a voxel. Sizes of voxels do not show.
        np.testing.assert_allclose(found[..., 2], np.zeros(found.shape[:2]), atol=1e-5)
        spread = (found.amax(dim=1) - found.amin(dim=1))[:, :2].median(dim=0).values
        side = 1 / (0.5 * math.sqrt(3))
        assert bool((spread > 0.85 * side).all())
        assert bool((spread < side + 1e-4).all())


def test_the_origin_is_the_mean_of_what_is_in_the_voxel(rng: np.random.Generator) -> None:
    """All points of each voxel are drawn where as many are asked for as it can hold."""
    points = plane(3000, rng, side=0.9)
    whole = cut(points, 40.0, count=5000, min_points=3)
    distinct = [torch.unique(patch, dim=0) for patch in whole]
    for patch in distinct:
        np.testing.assert_allclose(patch.mean(dim=0), np.zeros(3), atol=1e-5)


def test_thinning_forgets_how_dense_points_were(rng: np.random.Generator) -> None:
    """Left of 2 there are a 50th of the points, still many a cell; patches do not lean right."""
    some = plane(400_000, rng, side=4.0)
    kept = (some[:, 0] > 2.0) | (torch.from_numpy(rng.random(len(some))) < 0.02)
    patches = torch.cat([cut(some[kept], 8.0, count=500, min_points=4, seed=i) for i in range(9)])
    low, high = patches[..., 0].amin(dim=1), patches[..., 0].amax(dim=1)
    whole = (high - low) * primitive_scale(8.0) > 3.5
    assert int(whole.sum()) > 3
    left = patches[whole][..., 0] < ((low + high) / 2)[whole][:, None]
    assert float(left.double().mean()) == pytest.approx(0.5, abs=0.1)


def test_voxels_with_few_points_are_left_out(rng: np.random.Generator) -> None:
    lone = torch.tensor([[100.0, 100, 100]])
    assert cut(lone).shape == (0, 40, 3)
    assert cut(torch.zeros(0, 3)).shape == (0, 40, 3)
    # One cell keeps one point, however many it had.
    same = lone + 1e-6 * torch.rand(500, 3, generator=torch.Generator().manual_seed(1))
    assert len(cut(same, min_points=9)) == 0
    assert cut(same, min_points=1).shape == (1, 40, 3)


def test_the_seed_decides(rng: np.random.Generator) -> None:
    points = plane(5000, rng)
    assert torch.equal(cut(points, seed=3), cut(points, seed=3))
    assert not torch.equal(cut(points, seed=3)[:9], cut(points, seed=4)[:9])


def test_scale_is_the_published_one() -> None:
    assert primitive_scale(0.5) == pytest.approx(0.5 * 0.5 * 3**0.5)


def test_bad_patches_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"points: expected shape \(any, 3\)"):
        cut(torch.zeros(4, 2))
    with pytest.raises(RangeError, match="points: 1 of 6 values are not finite"):
        cut(torch.tensor([[0.0, 0, 0], [0, 0, math.inf]]))
    with pytest.raises(RangeError, match="voxel_size: expected a positive length, got 0"):
        cut(torch.zeros(4, 3), 0.0)
    with pytest.raises(RangeError, match="count: expected a value in"):
        cut(torch.zeros(4, 3), count=0)
    with pytest.raises(RangeError, match="min_points: expected a value in"):
        cut(torch.zeros(4, 3), min_points=0)


# Smoothness of meshes against one mesh at a time, by hand, and by differences.


TETRAHEDRON = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def rough(rng: np.random.Generator, count: int) -> torch.Tensor:
    vertices, _ = template()
    return vertices.double() + torch.from_numpy(0.2 * rng.normal(size=(count, 42, 3)))


def test_each_mesh_has_the_numbers_of_its_twin(rng: np.random.Generator) -> None:
    _, faces = template()
    vertices = rough(rng, 3)
    found = mesh_regularisers(vertices, faces)
    for i in range(3):
        wanted = reference.regularisers(vertices[i].numpy(), faces.numpy())
        got = (found.normal[i], found.laplacian[i], found.edge[i])
        np.testing.assert_allclose(got, wanted, rtol=1e-9)


def test_of_a_regular_tetrahedron_by_hand() -> None:
    """Edges of length sqrt(8); outward normals have a cosine of -1/3; neighbours' mean is
    opposite, at a third of the radius sqrt(3)."""
    corners = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    found = mesh_regularisers(corners[None], TETRAHEDRON)
    assert found.normal.item() == pytest.approx(4 / 3)
    assert found.laplacian.item() == pytest.approx(4 / 3 * 3**0.5)
    assert found.edge.item() == pytest.approx(8.0)


@pytest.mark.parametrize("name", ["normal", "laplacian", "edge"])
def test_gradients_are_those_of_differences(name: str, rng: np.random.Generator) -> None:
    _, faces = template()
    vertices = rough(rng, 1).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: getattr(mesh_regularisers(x, faces), name), (vertices,)
    )


def test_a_mesh_in_one_point_has_finite_gradients() -> None:
    _, faces = template()
    vertices = torch.zeros(1, 42, 3, requires_grad=True)
    found = mesh_regularisers(vertices, faces)
    (found.normal + found.laplacian + found.edge).sum().backward()
    assert vertices.grad is not None
    assert bool(torch.isfinite(vertices.grad).all())


def test_bad_edges_are_refused() -> None:
    with pytest.raises(ShapeError, match="vertices: expected shape"):
        mesh_regularisers(torch.zeros(4, 3), TETRAHEDRON)
    with pytest.raises(InputError, match="watertight mesh of 4 vertices"):
        mesh_regularisers(torch.zeros(1, 4, 3), TETRAHEDRON[:3])


# Scores of auto-encoders.


SMALL = ShapeConfig(code_size=4, encoder_widths=(8,), decoder_widths=(8,))


def test_an_untrained_one_scores_as_the_sphere() -> None:
    shapes = new_shapes(SMALL, seed=0)
    with torch.no_grad():
        for parameter in shapes.decoder.layers[-1].parameters():
            parameter.zero_()
    vertices, faces = template()
    generator = torch.Generator().manual_seed(1)
    patches = sample_faces(vertices[None].expand(70, -1, -1), faces, 50, generator)
    patches[:, :, 2] = 0
    found = score_shapes(shapes, patches, pairs=9)
    # The same up to the points that are drawn.
    assert found.chamfer == pytest.approx(found.sphere, rel=0.01)
    assert found.chamfer_squared == pytest.approx(found.sphere_squared, rel=0.01)
    balls = sample_faces(vertices[None].expand(70, -1, -1), faces, 4000, generator)
    assert found.sphere_squared == pytest.approx(chamfer(balls, patches).mean().item(), rel=0.02)
    far = chamfer(balls, patches, distance="euclidean").mean().item()
    assert found.sphere == pytest.approx(far, rel=0.02)
    assert (found.intact_shapes, found.intact_pairs) == (1.0, 1.0)
    assert found.sphere_deviation == pytest.approx(0, abs=1e-6)
    assert score_shapes(shapes, patches, pairs=9) == found
    other = score_shapes(shapes, patches, pairs=9, seed=1)
    assert other != found


def test_a_shape_on_the_way_spoils_a_pair() -> None:
    """Two sets of points: one is coded as a sphere, the other as a mesh turned inside out."""
    shapes = new_shapes(ShapeConfig(code_size=2, encoder_widths=(2,), decoder_widths=(4,)), seed=0)
    vertices, _ = template()
    with torch.no_grad():
        lift, out = shapes.encoder.layers
        lift.weight.copy_(torch.tensor([[1.0, 0, 0], [-1, 0, 0]]))
        out.weight.copy_(torch.eye(2))
        first, last = shapes.decoder.layers
        first.weight.copy_(torch.tensor([[1.0, 0], [0, 1], [0, 0], [0, 0]]))
        # Vertices go through the middle, each at its own pace: at (1, 0) the mesh is the template,
        # at (0, 1) a bumpy sphere inside out, and between them some have passed and some not.
        pace = torch.linspace(1.6, 2.4, 42)[torch.arange(42) * 5 % 42]
        last.weight.zero_()
        last.weight[:, 1] = -(vertices * pace[:, None]).flatten()
        for layer in (lift, out, first, last):
            layer.bias.zero_()
    right = torch.tensor([[[1.0, 0, 0]]]).expand(3, 5, 3)
    both = torch.cat((right, -right))
    alone = score_shapes(shapes, right, pairs=30)
    assert (alone.intact_shapes, alone.intact_pairs) == (1.0, 1.0)
    mixed = score_shapes(shapes, both, pairs=300)
    assert mixed.intact_shapes == 1.0
    assert 0.2 < mixed.intact_pairs < 1.0


def test_two_patches_are_needed() -> None:
    with pytest.raises(ShapeError, match="patches: expected two or more, got 1"):
        score_shapes(new_shapes(SMALL, seed=0), torch.zeros(1, 5, 3))
