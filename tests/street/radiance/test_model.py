"""The field: encodings by hand, shapes, its state, and what it refuses."""

import math
from dataclasses import replace

import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.street.radiance import (
    PUBLISHED_RADIANCE,
    RadianceModel,
    RadianceOptions,
    encode,
    encoded_size,
)
from splatseg.street.radiance_rendering import Surface
from street.radiance.scene import IDS, SMALL, two_balls


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
