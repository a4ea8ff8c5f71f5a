"""Rays through a field: what they miss, what they are in, and how triangles stand in order."""

import math
from dataclasses import replace

import pytest
import torch

from splatseg.errors import RangeError, ShapeError
from splatseg.street.hits import MeshCaster
from splatseg.street.radiance import RadianceModel
from splatseg.street.radiance_rendering import (
    RayValues,
    Surface,
    depth_from_distance,
    render_rays,
    render_view,
)
from street import reference
from street.radiance.scene import IDS, SMALL, camera, two_balls

AHEAD = torch.tensor([[0.01, 0.02, 1.0]])


def model(*, bias: float = 0.0, **changes: object) -> RadianceModel:
    """With opacities of the logistic of `bias`, all over."""
    made = RadianceModel(two_balls(), IDS, replace(SMALL, **changes), seed=1)
    with torch.no_grad():
        made.opacity.weight.zero_()
        made.opacity.bias.fill_(bias)
    return made.requires_grad_(requires_grad=False)


def test_rays_that_meet_nothing_see_the_background() -> None:
    field = model()
    directions = torch.tensor([[0.0, 0, -2], [0, -3, -1]])
    seen = render_rays(field, MeshCaster(two_balls()), torch.tensor([0.0, 0, -5]), directions)
    colour, probabilities = field.background_of(torch.nn.functional.normalize(directions))
    assert torch.allclose(seen.colour, colour, atol=1e-6)
    assert torch.allclose(seen.probabilities, probabilities, atol=1e-6)
    for values in (seen.alpha, seen.distance, seen.median_distance):
        assert torch.equal(values, torch.zeros(2))


def test_opacities_of_a_half_by_hand() -> None:
    """Both balls are met twice: .5, .25, .125, .0625 and the rest."""
    caster, origin = MeshCaster(two_balls()), torch.tensor([0.0, 0, -5])
    seen = render_rays(model(), caster, origin, AHEAD)
    hits = caster.hits(origin, AHEAD)
    near = hits.distances[0, :4]
    weights = torch.tensor([0.5, 0.25, 0.125, 0.0625], dtype=torch.float64)
    assert float(seen.alpha) == pytest.approx(1 - 0.0625)
    assert float(seen.distance) == pytest.approx(float((weights * near).sum() / (1 - 0.0625)))
    assert float(seen.median_distance) == pytest.approx(float(near[0]), rel=1e-6)


@pytest.mark.parametrize("order", ["distance", "levels"])
def test_rays_are_the_readable_composite_of_the_fields_outputs(order: str) -> None:
    field, mesh = model(order=order), two_balls()
    with torch.no_grad():
        field.opacity.weight.normal_(generator=torch.Generator().manual_seed(2))
    caster = MeshCaster(mesh)
    # From behind: the coarse ball is nearer.
    origin, direction = torch.tensor([1.0, 0.1, 9.0]), torch.tensor([[-0.1, 0.0, -1.0]])
    hits = caster.hits(origin, direction, max_hits=6)
    count = int(hits.valid.sum())
    rows = list(range(count))
    if order == "levels":
        rows.sort(key=lambda i: int(hits.faces[0, i]) // 80)
    assert (rows != list(range(count))) == (order == "levels")
    samples = Surface(mesh).samples(hits.faces[0, rows], hits.weights[0, rows])
    unit = torch.nn.functional.normalize(direction)
    found = field.outputs(
        samples.positions,
        samples.interpolate(field.features),
        unit.expand(count, 3),
        samples.normals,
    )
    colour, probabilities = field.background_of(unit)
    seen = render_rays(field, caster, origin, direction)
    expected = reference.composite(found.opacity[None], found.colour[None], colour)
    assert torch.allclose(seen.colour.double(), expected, atol=1e-5)
    expected = reference.composite(found.opacity[None], found.probabilities[None], probabilities)
    assert torch.allclose(seen.probabilities.double(), expected, atol=1e-5)


def test_a_camera_inside_a_primitive_sees_its_wall() -> None:
    caster = MeshCaster(two_balls())
    seen = render_rays(model(bias=20.0), caster, torch.zeros(3), AHEAD)
    assert float(seen.alpha) == pytest.approx(1.0, abs=1e-6)
    assert 0.8 < float(seen.distance) <= 1.0


def test_a_camera_inside_a_primitive_whose_fronts_alone_are_met_sees_what_is_beyond() -> None:
    caster = MeshCaster(two_balls())
    seen = render_rays(model(bias=20.0, sides="front"), caster, torch.zeros(3), AHEAD)
    assert float(seen.distance) > 1.0


def test_views_are_rays_and_depths_are_along_the_axis() -> None:
    field, caster = model(bias=3.0), MeshCaster(two_balls())
    where = camera(1)
    seen = render_view(field, caster, where)
    origin, directions = where.rays()
    rays = render_rays(field, caster, origin, directions.reshape(-1, 3))
    assert seen.alpha.shape == (8, 12)
    assert seen.probabilities.shape == (8, 12, 3)
    assert torch.equal(seen.colour.reshape(-1, 3), rays.colour)
    depth = depth_from_distance(where, seen.median_distance)
    hit = seen.median_distance > 0
    points = origin + seen.median_distance[..., None].double() * directions
    assert torch.allclose(depth[hit].double(), where.project(points)[1][hit], atol=1e-4)
    assert bool((depth[~hit] == 0).all())


def test_colours_are_left_out_where_nobody_asks() -> None:
    caster, origin = MeshCaster(two_balls()), torch.tensor([0.0, 0, -5])
    one = render_rays(model(), caster, origin, AHEAD, colour=False)
    two = render_rays(model(), caster, origin, AHEAD)
    assert one.colour is None
    assert torch.equal(one.probabilities, two.probabilities)
    assert render_view(model(), caster, camera(0), colour=False).colour is None


@pytest.mark.bits
def test_bits_do_not_depend_on_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatseg.street.radiance_rendering._RAYS", 16)
    field, caster = model(), MeshCaster(two_balls())
    before, found = torch.get_num_threads(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            found.append(render_view(field, caster, camera(0)))
    finally:
        torch.set_num_threads(before)
    assert isinstance(found[0], RayValues)
    for name in ("alpha", "distance", "median_distance", "colour", "probabilities"):
        assert torch.equal(getattr(found[0], name), getattr(found[1], name))


def test_no_rays_give_nothing() -> None:
    seen = render_rays(model(), MeshCaster(two_balls()), torch.zeros(3), torch.zeros(0, 3))
    assert seen.colour.shape == (0, 3)
    assert seen.probabilities.shape == (0, 3)


def test_faults_are_named() -> None:
    caster = MeshCaster(two_balls())
    with pytest.raises(RangeError, match="directions"):
        render_rays(model(), caster, torch.zeros(3), torch.full((1, 3), math.nan))
    with pytest.raises(ShapeError, match="origins"):
        render_rays(model(), caster, torch.zeros(2, 3), torch.ones(3, 3))
    half = replace(two_balls(), vertices=two_balls().vertices[:42], levels=torch.zeros(1))
    with pytest.raises(ShapeError, match="caster"):
        render_rays(model(), MeshCaster(half), torch.zeros(3), torch.ones(3, 3))
