"""Primitives, and what becomes of a mesh."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.street.primitives import (
    PrimitiveMesh,
    Primitives,
    primitive_faces,
    voxel_primitives,
    world_vertices,
)
from splatseg.street.shapes import (
    ShapeConfig,
    primitive_scale,
    sphere_code,
    template,
)
from support.primitives import shipped, sphere, spheres
from support.shape_quality import new_shapes


def voxels(points: torch.Tensor, **options: Any) -> Primitives:
    return voxel_primitives(points, shapes=shipped(), sphere=sphere(), **options)


def cloud(rng: np.random.Generator, count: int = 400) -> torch.Tensor:
    return torch.from_numpy(rng.uniform(-2, 2, size=(count, 3)))


def test_each_voxel_with_a_point_has_one_primitive_a_level(rng: np.random.Generator) -> None:
    points = cloud(rng)
    made = voxels(points)
    for level, size in enumerate((0.5, 1.0)):
        held: dict[tuple[float, ...], list[np.ndarray]] = {}
        for point in points.numpy():
            held.setdefault(tuple(np.floor(point / size)), []).append(point)
        wanted = np.array([np.mean(held[cell], axis=0) for cell in sorted(held)])
        mine = made.levels == level
        # Positions are rounded to a 4096th of a voxel, so that no order of points matters.
        np.testing.assert_allclose(made.centres[mine], wanted, atol=size / 4096)
        assert made.scales[mine].tolist() == pytest.approx([primitive_scale(size)] * len(held))
    torch.testing.assert_close(made.codes, sphere().expand(len(made), -1))
    assert made.sizes == (0.5, 1.0)


def test_the_order_of_points_is_free(rng: np.random.Generator) -> None:
    points = cloud(rng)
    one = voxels(points)
    two = voxels(points[torch.from_numpy(rng.permutation(len(points)))])
    assert torch.equal(one.centres, two.centres)
    assert torch.equal(one.codes, two.codes)


def test_blocks_that_meet_at_a_voxel_have_the_primitives_of_the_whole(
    rng: np.random.Generator,
) -> None:
    points = cloud(rng)
    left, right = (voxels(points[side]) for side in (points[:, 0] < 1, points[:, 0] >= 1))
    both = torch.cat((left.centres, right.centres)).tolist()
    assert sorted(both) == sorted(voxels(points).centres.tolist())


def test_sizes_are_metres() -> None:
    made = voxels(torch.tensor([[0.1, 0.1, 0.1], [0.9, 0.1, 0.1]]), metres_per_unit=0.25)
    assert made.sizes == (2.0, 4.0)
    assert made.levels.tolist() == [0, 1]
    assert voxels(torch.zeros(1, 3), sizes=(3.0, 0.5, 1.0)).sizes == (0.5, 1.0, 3.0)


def test_points_all_in_one_voxel_have_one_primitive_a_level() -> None:
    made = voxels(torch.full((5, 3), 0.2))
    assert made.levels.tolist() == [0, 1]
    torch.testing.assert_close(made.centres, torch.full((2, 3), 0.2), atol=1e-3, rtol=0)


def test_the_sphere_is_searched_for_where_none_is_given() -> None:
    shapes = new_shapes(ShapeConfig(code_size=3, encoder_widths=(4,), decoder_widths=(4,)), seed=0)
    made = voxel_primitives(torch.zeros(1, 3), shapes=shapes, sizes=(1.0,))
    torch.testing.assert_close(made.codes[0], sphere_code(shapes))


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        (torch.zeros(0, 3), {}, "points: expected at least one point"),
        (torch.full((1, 3), torch.nan), {}, "points: .* not finite"),
        (torch.full((1, 3), 1e9), {}, "points: expected coordinates within 1048576 voxels"),
        (torch.zeros(2, 2), {}, "points: expected shape"),
        (torch.zeros(2, 3), {"sizes": (0.5, 0.0)}, "sizes: expected positive"),
        (torch.zeros(2, 3), {"sizes": ()}, "sizes: expected positive"),
        (torch.zeros(2, 3), {"metres_per_unit": 0.0}, "metres_per_unit: expected a positive"),
    ],
)
def test_bad_points_and_options_are_refused(
    points: torch.Tensor, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        voxels(points, **options)


def test_vertices_are_decoded_scaled_and_moved() -> None:
    made = spheres(torch.tensor([[1.0, 2, 3], [4, 5, 6]]), scale=2.0, levels=[0, 1])
    mesh = made.mesh(shipped())
    shape = shipped().decode(sphere()[None])[0]
    torch.testing.assert_close(mesh.vertices[42:], 2.0 * shape + torch.tensor([4.0, 5, 6]))
    assert mesh.levels.tolist() == [0, 1]
    assert mesh.sizes == (0.5, 1.0)
    assert not mesh.vertices.requires_grad


def test_vertices_have_the_gradients_of_differences(rng: np.random.Generator) -> None:
    shapes = new_shapes(
        ShapeConfig(code_size=3, encoder_widths=(4,), decoder_widths=(6,)), seed=1
    ).double()
    codes = torch.from_numpy(rng.normal(size=(2, 3))).requires_grad_()
    centres = torch.from_numpy(rng.normal(size=(2, 3))).requires_grad_()
    scales = torch.from_numpy(rng.uniform(1, 2, size=2)).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda z, c, s: world_vertices(shapes, z, c, s), (codes, centres, scales)
    )


def test_a_subset_keeps_the_sizes_of_all_levels() -> None:
    made = spheres(torch.eye(3), levels=[0, 1, 1])
    for rows in (torch.tensor([2]), torch.tensor([False, False, True])):
        one = made.subset(rows)
        assert one.centres.tolist() == [[0, 0, 1]]
        assert one.sizes == (0.5, 1.0)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"codes": torch.ones(1, 8)}, RangeError, "codes: expected codes of length 1"),
        ({"codes": torch.full((1, 8), torch.nan)}, RangeError, "codes: .* not finite"),
        ({"centres": torch.zeros(2, 3)}, ShapeError, "centres: expected shape"),
        ({"scales": torch.zeros(1)}, RangeError, "scales: expected positive"),
        ({"levels": torch.tensor([2])}, RangeError, "levels: expected levels of 2 sizes"),
        ({"sizes": (1.0, 0.5)}, RangeError, "sizes: expected positive lengths, ascending"),
    ],
)
def test_poisoned_primitives_are_refused(
    change: dict[str, Any], error: type[InputError], message: str
) -> None:
    with pytest.raises(error, match=message):
        replace(spheres(torch.zeros(1, 3)), **change)


def test_no_primitives_are_primitives() -> None:
    none = spheres(torch.zeros(0, 3))
    assert len(none) == 0
    assert len(none.mesh(shipped())) == 0


# Primitives as one mesh: vertices and faces in the order of primitives.


def two() -> dict[str, Any]:
    vertices, _ = template()
    return {
        "vertices": torch.cat((vertices, vertices + 5)),
        "levels": torch.tensor([0, 1]),
        "sizes": (0.5, 1.0),
    }


def test_faces_of_a_primitive_have_its_own_vertices() -> None:
    mesh = PrimitiveMesh(**two())
    _, faces = template()
    assert len(mesh) == 2
    assert torch.equal(mesh.faces, torch.cat((faces, faces + 42)))
    assert mesh.vertices.dtype == torch.float32
    assert mesh.levels.dtype == torch.int64


def test_faces_look_outwards() -> None:
    mesh = PrimitiveMesh(**two())
    a, b, c = mesh.vertices[mesh.faces].unbind(dim=1)
    middles = torch.tensor([0.0, 5.0]).repeat_interleave(80)[:, None]
    assert bool(((torch.linalg.cross(b - a, c - a) * (a - middles)).sum(1) > 0).all())


def test_no_primitives_have_no_faces() -> None:
    assert primitive_faces(0).shape == (0, 3)
    mesh = PrimitiveMesh(
        vertices=torch.zeros(0, 3), levels=torch.zeros(0, dtype=torch.int64), sizes=(1.0,)
    )
    assert len(mesh) == 0


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"vertices": torch.zeros(83, 3)}, ShapeError, "vertices: expected shape"),
        ({"vertices": torch.full((84, 3), torch.nan)}, RangeError, "vertices: .* not finite"),
        ({"levels": torch.tensor([0, 2])}, RangeError, "levels: expected levels of 2 sizes"),
        ({"levels": torch.tensor([-1, 0])}, RangeError, "levels: expected levels of 2 sizes"),
        ({"sizes": (1.0, 0.5)}, RangeError, "sizes: expected positive lengths, ascending"),
        ({"sizes": (0.0, 0.5)}, RangeError, "sizes: expected positive lengths"),
    ],
)
def test_poisoned_meshes_are_refused(
    change: dict[str, Any], error: type[InputError], message: str
) -> None:
    with pytest.raises(error, match=message):
        PrimitiveMesh(**(two() | change))
