"""Colours and classes of primitives: the network, compositing and images."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.street.hits import MeshCaster
from splatseg.street.radiance import (
    PUBLISHED_RADIANCE,
    RadianceModel,
    RadianceOptions,
    encode,
    encoded_size,
    ray_weights,
)
from splatseg.street.radiance_rendering import (
    RayValues,
    Surface,
    depth_from_distance,
    render_rays,
    render_view,
)
from street import reference
from street.radiance.scene import IDS, SMALL, camera, two_balls


def model(**changes: object) -> RadianceModel:
    return RadianceModel(two_balls(), IDS, replace(SMALL, **changes), seed=3)


def points(count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(0)
    unit = [torch.nn.functional.normalize(torch.randn(count, 3, generator=rng)) for _ in range(2)]
    places = torch.randn(count, 3, generator=rng)
    return places, torch.randn(count, SMALL.feature_size, generator=rng), unit[0], unit[1]


def test_encoding_by_hand() -> None:
    value = torch.tensor([[0.5]])
    expected = [0.5, math.sin(0.5), math.sin(1.0), math.cos(0.5), math.cos(1.0)]
    assert encode(value, 2).flatten().tolist() == pytest.approx(expected)
    assert torch.equal(encode(value, 0), value)
    assert encode(torch.zeros(2, 3), 6).shape == (2, encoded_size(3, 6))


def test_outputs_are_opacities_colours_and_distributions() -> None:
    with torch.no_grad():
        found = model().outputs(*points(40))
    assert found.opacity.shape == (40,)
    assert found.colour.shape == (40, 3)
    assert found.probabilities.shape == (40, len(IDS))
    assert 0 <= float(found.opacity.min()) <= float(found.opacity.max()) <= 1
    assert torch.allclose(found.probabilities.sum(dim=1), torch.ones(40), atol=1e-6)


def test_opacity_and_classes_do_not_know_the_view() -> None:
    field = model()
    places, features, directions, normals = points(10)
    one = field.outputs(places, features, directions, normals)
    two = field.outputs(places, features, -directions, normals)
    assert torch.equal(one.opacity, two.opacity)
    assert torch.equal(one.probabilities, two.probabilities)
    assert not torch.equal(one.colour, two.colour)
    turned = field.outputs(places, features, directions, -normals)
    assert not torch.equal(one.colour, turned.colour)


def test_the_background_is_of_the_direction() -> None:
    field = model()
    colour, probabilities = field.background_of(points(6)[2])
    assert colour.shape == (6, 3)
    assert torch.allclose(probabilities.sum(dim=1), torch.ones(6), atol=1e-6)
    assert not bool((colour == colour[:1]).all())


def test_vertices_have_what_points_on_them_have() -> None:
    field, mesh = model(), two_balls()
    opacity, probabilities = field.vertex_outputs(mesh)
    faces = torch.arange(len(mesh.faces))
    weights = torch.tensor([1.0, 0, 0]).expand(len(faces), 3)
    samples = Surface(mesh).samples(faces, weights)
    with torch.no_grad():
        hidden = field.hidden(samples.positions, samples.interpolate(field.features))
        first = mesh.faces[:, 0]
        assert torch.allclose(field.opacity_of(hidden), opacity[first], atol=1e-6)
        assert torch.allclose(field.probabilities_of(hidden), probabilities[first], atol=1e-6)
    assert not opacity.requires_grad
    with pytest.raises(ShapeError, match=r"mesh\.vertices"):
        field.vertex_outputs(replace(mesh, vertices=mesh.vertices[:42], levels=mesh.levels[:1]))


def test_vertices_do_not_depend_on_portions(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = model().vertex_outputs(two_balls())
    monkeypatch.setattr("splatseg.street.radiance._VERTICES", 16)
    parts = model().vertex_outputs(two_balls())
    assert torch.allclose(whole[0], parts[0], atol=1e-6)
    assert torch.allclose(whole[1], parts[1], atol=1e-6)


def test_samples_lie_on_their_triangles_with_normals_outwards() -> None:
    mesh = two_balls()
    faces = torch.arange(len(mesh.faces))
    samples = Surface(mesh).samples(faces, torch.full((len(faces), 3), 1 / 3))
    middles = mesh.vertices[mesh.faces].mean(dim=1)
    assert torch.allclose(samples.positions, middles, atol=1e-6)
    centres = torch.tensor([[0.0, 0, 0], [1, 0, 4]])[faces // 80]
    assert bool(((middles - centres) * samples.normals > -1e-3).all(dim=1).any())
    assert bool((((middles - centres) * samples.normals).sum(dim=1) > 0).all())
    corners = samples.interpolate(mesh.vertices)
    assert torch.allclose(corners, middles, atol=1e-6)


def test_state_makes_the_same_field_again() -> None:
    field = model()
    other = RadianceModel.with_state(two_balls(), IDS, SMALL, field.state)
    places = points(5)
    assert torch.equal(field.outputs(*places).colour, other.outputs(*places).colour)
    assert other.ids == IDS
    assert other.options == SMALL


def test_states_that_do_not_fit_are_refused() -> None:
    state = model().state
    less = {name: value for name, value in state.items() if name != "features"}
    with pytest.raises(InputError, match="features"):
        RadianceModel.with_state(two_balls(), IDS, SMALL, less)
    wrong = state | {"features": state["features"][:-1]}
    with pytest.raises(ShapeError, match="features"):
        RadianceModel.with_state(two_balls(), IDS, SMALL, wrong)
    broken = state | {"features": state["features"] * math.nan}
    with pytest.raises(RangeError, match="features"):
        RadianceModel.with_state(two_balls(), IDS, SMALL, broken)


@pytest.mark.parametrize("ids", [(), (1, 1), (-1, 2)])
def test_ids_that_cannot_be_are_refused(ids: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="distinct ids"):
        RadianceModel(two_balls(), ids, SMALL)


def test_the_published_field_has_the_published_sizes() -> None:
    field = RadianceModel(two_balls(), IDS, PUBLISHED_RADIANCE)
    sizes = [layer.in_features for layer in field.trunk.layers]
    assert sizes == [60, 256, 256, 256, 316, 256, 256, 256]
    assert (PUBLISHED_RADIANCE.rays, PUBLISHED_RADIANCE.iterations) == (4096, 50_000)


@pytest.mark.parametrize(
    "changes",
    [
        {"feature_size": 0},
        {"position_frequencies": -1},
        {"view_frequencies": 17},
        {"width": 0},
        {"depth": 0},
        {"skip": 4, "depth": 3},
        {"semantic_width": -1},
        {"colour_widths": (0,)},
        {"background_widths": (8,) * 33},
        {"view_encoding": "view"},
        {"background": "constant"},
        {"order": "depth"},
        {"sides": "back"},
        {"max_hits": 0},
        {"fine_hits": 65},
        {"fine_hits": 0, "coarse_hits": 0},
        {"rays": 0},
        {"iterations": 0},
        {"rate": math.nan},
        {"feature_rate": math.inf},
        {"semantic_weight": -0.1},
        {"cache_memory": 1},
    ],
)
def test_options_that_cannot_be_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(InputError):
        RadianceOptions(**changes)


# Compositing: eq. 5 by hand, against its readable twin, and by finite differences.


def composite(opacity: Tensor, values: Tensor, background: Tensor) -> Tensor:
    weights, passed = ray_weights(opacity)
    return torch.einsum("nl,nlc->nc", weights, values) + passed[:, None] * background


def test_two_samples_and_a_background_by_hand() -> None:
    """.5 of 1, then .25 of what is left of 10, then the rest of 100."""
    opacity = torch.tensor([[0.5, 0.25]])
    values = torch.tensor([[[1.0], [10.0]]])
    shown = composite(opacity, values, torch.tensor([[100.0]]))
    assert shown.item() == pytest.approx(0.5 * 1 + 0.5 * 0.25 * 10 + 0.5 * 0.75 * 100)


def test_nothing_shows_through_what_is_opaque() -> None:
    opacity = torch.tensor([[0.0, 1.0, 0.7]], requires_grad=True)
    values = torch.tensor([[[3.0], [5.0], [1e6]]])
    shown = composite(opacity, values, torch.tensor([[1e6]]))
    shown.sum().backward()
    assert shown.item() == 5.0
    assert opacity.grad is not None
    assert opacity.grad[0, 2].item() == 0.0
    assert opacity.grad[0, 0].item() == 3.0 - 5.0


def test_without_samples_it_is_the_background() -> None:
    shown = composite(torch.zeros(2, 3), torch.ones(2, 3, 4), torch.full((2, 4), 7.0))
    assert torch.equal(shown, torch.full((2, 4), 7.0))


@pytest.mark.parametrize("hits", [1, 2, 6])
def test_it_is_the_readable_twin(hits: int) -> None:
    rng = torch.Generator().manual_seed(hits)
    opacity = torch.rand(20, hits, generator=rng)
    values = torch.randn(20, hits, 5, generator=rng)
    behind = torch.randn(20, 5, generator=rng)
    fast = composite(opacity, values, behind)
    assert torch.allclose(fast.double(), reference.composite(opacity, values, behind), atol=1e-6)


def test_weights_and_what_passes_add_up_to_one() -> None:
    opacity = torch.rand(50, 6, generator=torch.Generator().manual_seed(0))
    weights, passed = ray_weights(opacity)
    assert torch.allclose(weights.sum(dim=1) + passed, torch.ones(50), atol=1e-6)


def test_gradients_are_finite_differences() -> None:
    rng = torch.Generator().manual_seed(1)

    def leaf(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=rng, dtype=torch.float64).requires_grad_()

    assert torch.autograd.gradcheck(composite, (leaf(3, 4), leaf(3, 4, 2), leaf(3, 2)))


# Rays through a field: what they miss, what they are in, and how triangles stand in order.


AHEAD = torch.tensor([[0.01, 0.02, 1.0]])


def drawn_model(*, bias: float = 0.0, **changes: object) -> RadianceModel:
    """With opacities of the logistic of `bias`, all over."""
    made = RadianceModel(two_balls(), IDS, replace(SMALL, **changes), seed=1)
    with torch.no_grad():
        made.opacity.weight.zero_()
        made.opacity.bias.fill_(bias)
    return made.requires_grad_(requires_grad=False)


def test_rays_that_meet_nothing_see_the_background() -> None:
    field = drawn_model()
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
    seen = render_rays(drawn_model(), caster, origin, AHEAD)
    hits = caster.hits(origin, AHEAD)
    near = hits.distances[0, :4]
    weights = torch.tensor([0.5, 0.25, 0.125, 0.0625], dtype=torch.float64)
    assert float(seen.alpha) == pytest.approx(1 - 0.0625)
    assert float(seen.distance) == pytest.approx(float((weights * near).sum() / (1 - 0.0625)))
    assert float(seen.median_distance) == pytest.approx(float(near[0]), rel=1e-6)


@pytest.mark.parametrize("order", ["distance", "levels"])
def test_rays_are_the_readable_composite_of_the_fields_outputs(order: str) -> None:
    field, mesh = drawn_model(order=order), two_balls()
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
    seen = render_rays(drawn_model(bias=20.0), caster, torch.zeros(3), AHEAD)
    assert float(seen.alpha) == pytest.approx(1.0, abs=1e-6)
    assert 0.8 < float(seen.distance) <= 1.0


def test_a_camera_inside_a_primitive_whose_fronts_alone_are_met_sees_what_is_beyond() -> None:
    caster = MeshCaster(two_balls())
    seen = render_rays(drawn_model(bias=20.0, sides="front"), caster, torch.zeros(3), AHEAD)
    assert float(seen.distance) > 1.0


def test_views_are_rays_and_depths_are_along_the_axis() -> None:
    field, caster = drawn_model(bias=3.0), MeshCaster(two_balls())
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
    one = render_rays(drawn_model(), caster, origin, AHEAD, colour=False)
    two = render_rays(drawn_model(), caster, origin, AHEAD)
    assert one.colour is None
    assert torch.equal(one.probabilities, two.probabilities)
    assert render_view(drawn_model(), caster, camera(0), colour=False).colour is None


@pytest.mark.bits
def test_bits_do_not_depend_on_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatseg.street.radiance_rendering._RAYS", 16)
    field, caster = drawn_model(), MeshCaster(two_balls())
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
    seen = render_rays(drawn_model(), MeshCaster(two_balls()), torch.zeros(3), torch.zeros(0, 3))
    assert seen.colour.shape == (0, 3)
    assert seen.probabilities.shape == (0, 3)


def test_faults_are_named() -> None:
    caster = MeshCaster(two_balls())
    with pytest.raises(RangeError, match="directions"):
        render_rays(drawn_model(), caster, torch.zeros(3), torch.full((1, 3), math.nan))
    with pytest.raises(ShapeError, match="origins"):
        render_rays(drawn_model(), caster, torch.zeros(2, 3), torch.ones(3, 3))
    half = replace(two_balls(), vertices=two_balls().vertices[:42], levels=torch.zeros(1))
    with pytest.raises(ShapeError, match="caster"):
        render_rays(drawn_model(), MeshCaster(half), torch.zeros(3), torch.ones(3, 3))
