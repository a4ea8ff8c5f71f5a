"""Rays against the unit solids: cases solved by hand, and against asking points."""

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, RangeError
from splatseg.synthetic.solids import SHAPES, Primitive, Texture, intersect, normals

INF = float("inf")


@pytest.mark.parametrize(
    ("shape", "taper", "origin", "direction", "expected"),
    [
        ("box", 1.0, (5, 0, 0), (-1, 0, 0), 4.0),
        ("box", 1.0, (5, 0.99, -0.99), (-1, 0, 0), 4.0),
        ("box", 1.0, (5, 1.01, 0), (-1, 0, 0), INF),
        ("box", 1.0, (5, 0, 0), (1, 0, 0), INF),
        ("box", 1.0, (0.25, 0, 0), (1, 0, 0), 0.75),  # from inside: where it leaves
        ("box", 1.0, (5, 0, 0), (-2, 0, 0), 2.0),  # t counts directions, not metres
        ("sphere", 1.0, (0, 0, 3), (0, 0, -1), 2.0),
        ("sphere", 1.0, (0.6, 0, 3), (0, 0, -1), 2.2),
        ("sphere", 1.0, (1.001, 0, 3), (0, 0, -1), INF),
        ("sphere", 1.0, (0, 0, 0), (0, 1, 0), 1.0),
        ("cylinder", 1.0, (4, 0, 0.5), (-1, 0, 0), 3.0),  # mantle
        ("cylinder", 1.0, (4, 0, 1.5), (-1, 0, 0), INF),  # over the cap
        ("cylinder", 1.0, (0.5, 0.5, 4), (0, 0, -1), 3.0),  # upper cap
        ("cylinder", 1.0, (0.5, 0.5, -4), (0, 0, 1), 3.0),  # lower cap
        ("cylinder", 0.5, (0.6, 0, 4), (0, 0, -1), 3.4),  # cap is 0.5 wide: r(0.6) = 0.6 there
        ("cylinder", 0.5, (0.4, 0, 4), (0, 0, -1), 3.0),
        ("cylinder", 0.0, (4, 0, 0), (-1, 0, 0), 3.5),  # a cone is half as wide half-way up
        ("cylinder", 0.0, (4, 0, 1.5), (-1, 0, 0), INF),  # and has no twin above its apex
        ("plane", 1.0, (0.5, -0.5, 2), (0, 0, -1), 2.0),
        ("plane", 1.0, (0.5, -0.5, -2), (0, 0, 1), 2.0),
        ("plane", 1.0, (1.5, 0, 2), (0, 0, -1), INF),
        ("plane", 1.0, (0, 0, 2), (1, 0, 0), INF),  # parallel to it
        ("plane", 1.0, (0, 0, 2), (0, 0, 1), INF),  # behind
    ],
)
def test_a_ray_meets_a_unit_solid_where_it_should(shape, taper, origin, direction, expected):
    o = torch.tensor([origin], dtype=torch.float64)
    d = torch.tensor([direction], dtype=torch.float64)
    assert float(intersect(shape, o, d, taper=taper)) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("shape", [name for name in SHAPES if name != "plane"])
@pytest.mark.parametrize("taper", [1.0, 0.4])
def test_rays_agree_with_asking_points_along_them(shape, taper):
    """The first point inside the solid, on a fine walk along the ray, lies just behind t."""
    rng = np.random.default_rng(1)
    solid = Primitive(
        shape=shape,
        centre=(0.2, -0.1, 0.3),
        half_size=(0.5, 0.3, 0.7),
        instance=1,
        yaw=0.7,
        tilt=-0.4,
        taper=taper,
    )
    matrix, offset = solid.unit_from_world
    origin = torch.from_numpy(rng.normal(size=(300, 3)) * 3)
    aim = torch.tensor(solid.centre) + torch.from_numpy(rng.normal(size=(300, 3)) * 0.5)
    way = torch.nn.functional.normalize(aim - origin, dim=-1)
    t = intersect(shape, origin @ matrix.T + offset, way @ matrix.T, taper=taper)
    walk = torch.arange(0, 12, 2e-3, dtype=torch.float64)
    points = origin[:, None] + walk[None, :, None] * way[:, None]
    inside = solid.contains(points.reshape(-1, 3), 0.0).reshape(300, -1)
    starts_inside = inside[:, 0]
    entered = inside.any(dim=1) & ~starts_inside
    first = walk[inside.int().argmax(dim=1)]
    assert entered.sum() > 50
    gap = (first - t)[entered]
    assert bool(((gap > -1e-9) & (gap < 2.1e-3)).all())
    # What the walk misses, the ray may at most graze.
    missed = torch.isfinite(t) & ~inside.any(dim=1)
    assert missed.sum() <= 3


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("taper", [1.0, 0.4])
def test_normals_are_perpendicular_to_the_surface_and_face_outwards(shape, taper):
    rng = np.random.default_rng(2)
    origin = torch.tensor([[0.3, -0.4, 5.0], [4.0, 1.0, 0.5], [1.0, -2.0, -4.0]]).double()
    origin = origin.repeat_interleave(200, dim=0)
    aim = torch.from_numpy(rng.uniform(-0.9, 0.9, size=(600, 3)))
    hits = []
    for shift in ((0, 0, 0), (1e-6, 0, 0), (0, 1e-6, 0), (0, 0, 1e-6)):
        way = torch.nn.functional.normalize(aim + torch.tensor(shift) - origin, dim=-1)
        hits.append(origin + intersect(shape, origin, way, taper=taper).unsqueeze(-1) * way)
    good = torch.isfinite(torch.stack(hits)).all(dim=-1).all(dim=0)
    # Neighbours across an edge have no common plane; leave them out.
    good &= torch.stack([(h - hits[0]).norm(dim=-1) < 1e-4 for h in hits[1:]]).all(dim=0)
    normal = torch.nn.functional.normalize(normals(shape, hits[0][good], taper=taper), dim=-1)
    assert good.sum() > 100
    for h in hits[1:]:
        step = (h - hits[0])[good]
        assert float(((step * normal).sum(-1)).abs().max()) < 1e-9
    if shape != "plane":
        way = (aim - origin)[good]
        assert bool(((way * normal).sum(-1) < 0).all())


def test_a_turned_box_stands_where_its_corners_say():
    """A quarter turn about z swaps the sides; world x then spans the solid's y."""
    box = Primitive(shape="box", centre=(1, 2, 3), half_size=(2, 1, 0.5), instance=1, yaw=np.pi / 2)
    near = torch.tensor([[1.0, 3.9, 3.0], [1.9, 2.0, 3.0], [1.0, 2.0, 3.4]])
    far = torch.tensor([[1.0, 4.1, 3.0], [2.1, 2.0, 3.0], [1.0, 2.0, 3.6]])
    assert box.contains(near, 0.0).tolist() == [True] * 3
    assert box.contains(far, 0.0).tolist() == [False] * 3
    assert box.contains(far, 0.2).tolist() == [True] * 3
    assert box.radius == pytest.approx((4 + 1 + 0.25) ** 0.5)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"half_size": (1, 0, 1)}, "half_size"),
        ({"instance": 0}, "instance"),
        ({"taper": 1.5}, "taper"),
        ({"shape": "torus"}, "shape"),
    ],
)
def test_an_impossible_solid_is_refused_by_name(change, named):
    values = {"shape": "box", "centre": (0, 0, 0), "half_size": (1, 1, 1), "instance": 1}
    with pytest.raises(InputError, match=f"^{named}"):
        Primitive(**(values | change))


def test_a_texture_needs_a_known_kind_and_a_size():
    with pytest.raises(InputError, match="^kind: expected one of .*wood"):
        Texture(kind="marble")
    with pytest.raises(RangeError, match="^scale"):
        Texture(scale=0.0)
