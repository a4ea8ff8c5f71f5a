"""Fusion: solids on a table from maps in closed form; what nobody sees is closed."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.errors import InputError
from splatseg.io.export import TriangleMesh
from splatseg.mesh import Grid, fuse_object, pixel_size
from support.mesh_maps import OBJECT, TABLE, ball, box, grid, ring, seen

BALL = ((-0.3, -0.3, 0.0), (0.3, 0.3, 0.6))
BOX = ((-0.3, -0.2, 0.0), (0.3, 0.2, 0.4))


@pytest.fixture(scope="module")
def maps_of_box():
    return seen(box(*BOX), ring((0.0, 0.0, 0.2)))


@pytest.fixture(scope="module")
def mesh_of_box(maps_of_box) -> TriangleMesh:
    made = fuse_object(maps_of_box, OBJECT, grid(*BOX, resolution=48))
    assert made is not None
    return made


def test_a_ball_that_is_seen_from_above_is_whole() -> None:
    maps = seen(ball((0.0, 0.0, 0.3), 0.3), ring((0.0, 0.0, 0.3)))
    made = fuse_object(maps, OBJECT, grid(*BALL, resolution=48))
    assert made is not None
    assert made.is_watertight
    assert made.volume == pytest.approx(4 / 3 * math.pi * 0.3**3, rel=0.04)
    # What views see is on the sphere, to a voxel; below nobody looks.
    above = made.vertices[made.vertices[:, 2] > 0.25]
    distance = (above - torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64)).norm(dim=1) - 0.3
    assert float(distance.abs().quantile(0.95)) < 0.6 / 48


def test_a_box_on_a_table_is_closed_below(mesh_of_box) -> None:
    assert mesh_of_box.is_watertight
    assert mesh_of_box.volume == pytest.approx(0.6 * 0.4 * 0.4, rel=0.05)
    # The bottom is at the table, though every view sees it from above.
    assert abs(float(mesh_of_box.vertices[:, 2].min())) < 3 * 0.6 / 48
    low, high = mesh_of_box.vertices.amin(0), mesh_of_box.vertices.amax(0)
    expected = torch.tensor(BOX, dtype=torch.float64)
    assert torch.allclose(torch.stack((low, high)), expected, atol=3 * 0.6 / 48)


def test_triangles_turn_outwards(mesh_of_box) -> None:
    turned = replace(mesh_of_box, faces=mesh_of_box.faces.flip(1))
    assert mesh_of_box.volume > 0
    assert turned.volume == pytest.approx(-mesh_of_box.volume)


def test_a_missing_triangle_is_noticed(mesh_of_box) -> None:
    assert not replace(mesh_of_box, faces=mesh_of_box.faces[1:]).is_watertight
    twisted = mesh_of_box.faces.clone()
    twisted[0] = twisted[0].flip(0)
    assert not replace(mesh_of_box, faces=twisted).is_watertight


def test_the_surface_moves_with_the_world(maps_of_box, mesh_of_box) -> None:
    """A grid that is turned against the world finds the same box."""
    angle = math.radians(30)
    turn = torch.eye(3, dtype=torch.float64)
    turn[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)],
                                 [math.sin(angle), math.cos(angle)]])  # fmt: skip
    size = torch.tensor([0.75, 0.7, 0.4], dtype=torch.float64)
    centre = torch.tensor([0.0, 0.0, 0.2], dtype=torch.float64)
    turned = Grid.about(centre, size, turn, resolution=60)
    made = fuse_object(maps_of_box, OBJECT, turned)
    assert made is not None
    assert made.volume == pytest.approx(mesh_of_box.volume, rel=0.04)
    assert torch.allclose(made.vertices.amax(0), mesh_of_box.vertices.amax(0), atol=0.03)


def test_the_same_maps_give_the_same_bits(maps_of_box, mesh_of_box) -> None:
    again = fuse_object(maps_of_box, OBJECT, grid(*BOX, resolution=48))
    assert again is not None
    assert torch.equal(again.vertices, mesh_of_box.vertices)
    assert torch.equal(again.faces, mesh_of_box.faces)


def test_small_pieces_are_left_out() -> None:
    """Two balls, of which the smaller has a hundredth of the other's volume."""
    large, small = ball((0.0, 0.0, 0.3), 0.3), ball((0.0, 0.4, 0.05), 0.05)

    def both(origin, directions):
        (one, colour), (two, other) = large(origin, directions), small(origin, directions)
        return np.minimum(one, two), np.where((one < two)[..., None], colour, other)

    whole = grid((-0.3, -0.3, 0.0), (0.3, 0.5, 0.6), resolution=48)
    made = fuse_object(seen(both, ring((0.0, 0.0, 0.3))), OBJECT, whole)
    assert made is not None
    assert float(made.vertices[:, 1].max()) < 0.33


def test_a_sheet_on_the_table_has_a_surface() -> None:
    """It has no thickness that a voxel could show, and is made a few voxels thick."""
    low, high = (-0.3, -0.2, 0.0), (0.3, 0.2, 0.001)
    made = fuse_object(seen(box(low, high), ring((0.0, 0.0, 0.0))), OBJECT,
                       grid(low, high, resolution=48))  # fmt: skip
    assert made is not None
    assert made.is_watertight
    size = made.vertices.amax(0) - made.vertices.amin(0)
    assert torch.allclose(size[:2], torch.tensor([0.6, 0.4]).double(), atol=3 * 0.6 / 48)
    assert float(made.vertices[:, 2].max()) < 0.6 / 48
    assert float(size[2]) < 4 * 0.6 / 48


def test_an_object_that_no_pixel_shows_has_no_surface(maps_of_box) -> None:
    assert fuse_object(maps_of_box, 99, grid(*BOX, resolution=20)) is None
    assert fuse_object([], OBJECT, grid(*BOX, resolution=20)) is None
    assert pixel_size(maps_of_box, 99) == 0


def test_voxels_are_no_smaller_than_asked() -> None:
    centre, turn = torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    size = torch.tensor([1.0, 0.5, 0.25], dtype=torch.float64)
    assert Grid.about(centre, size, turn, resolution=128).voxel == 1 / 128
    assert Grid.about(centre, size, turn, resolution=128, min_voxel=0.02).voxel == 1 / 50
    assert Grid.about(centre, size, turn, resolution=128, min_voxel=10).voxel == 1 / 16
    with pytest.raises(InputError, match="extent"):
        Grid.about(centre, 0 * size, turn, resolution=128)


def test_a_pixel_covers_depth_over_focal_length(maps_of_box) -> None:
    one = maps_of_box[0]
    depth = one.depth[one.ids == OBJECT].median()
    assert pixel_size([one], OBJECT) == pytest.approx(float(depth) / one.camera.fx)
    assert pixel_size(maps_of_box, TABLE) > pixel_size(maps_of_box, OBJECT)


def test_maps_of_another_size_are_refused(maps_of_box) -> None:
    with pytest.raises(InputError, match="depth"):
        replace(maps_of_box[0], depth=maps_of_box[0].depth[1:])
