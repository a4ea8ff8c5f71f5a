"""A mesh field as something to be looked at: by hand, through lenses, at points."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from splatseg import _native
from splatseg.core import Camera, LayerInfo, Renderable, RenderableView
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.street.field import BallQuery, MeshField
from splatseg.street.radiance import RadianceModel
from street import reference
from street.reference import mesh_hits
from support.mesh_fields import IDS, SMALL, balls, random_field, told_field

CAR, SKY = 8, 5


def camera(**lens: object) -> Camera:
    return Camera(
        width=41, height=31, fx=40.0, fy=40.0, cx=20.5, cy=15.5,
        cam_from_world=torch.eye(4, dtype=torch.float64), **lens,
    )  # fmt: skip


def first_hits(field: MeshField, seen: Camera) -> torch.Tensor:
    """Distances of the first hits of all pixels, infinite where there is none, by trying all."""
    origin, directions = seen.rays()
    hits = mesh_hits(field.mesh, origin, directions.reshape(-1, 3), max_hits=1)
    return hits.distances[:, 0].view(seen.height, seen.width)


def test_it_is_a_renderable() -> None:
    field = random_field()
    assert isinstance(field, Renderable)
    assert isinstance(field.view(camera()), RenderableView)
    assert field.layer_names == ("classes",)
    summary = field.layer("classes")
    assert (summary.kind, summary.ids, summary.background) == ("labels", (3, 5, 8), -1)
    assert summary.info.names[CAR] == "car"


def test_an_opaque_ball_before_the_sky() -> None:
    """Its first surface is 1.5 ahead; behind and around it is the sky, which has no depth."""
    field = told_field(balls([[0.013, 0.007, 2]]), [1])
    seen = camera()
    hit = torch.isfinite(first_hits(field, seen))
    assert 0.1 < hit.float().mean() < 0.5
    with field.view(seen) as view:
        signals = view.signals()
        shown = view.label_map("semantic")
        sure = view.confidence("semantic")
    torch.testing.assert_close(signals.alpha, hit.float(), atol=1e-5, rtol=0)
    assert torch.equal(shown.ids, torch.where(hit, CAR, SKY).int())
    torch.testing.assert_close(sure, torch.ones_like(sure), atol=1e-5, rtol=0)
    assert float(signals.depth[15, 20]) == pytest.approx(1.5, abs=0.05)
    assert bool((signals.depth[~hit] == 0).all())
    assert bool((signals.median_depth[~hit] == 0).all())
    want = torch.zeros(*hit.shape, 3)
    want[hit, 1], want[~hit, 2] = 1, 1
    torch.testing.assert_close(signals.colour, want, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    "lens", [{}, {"model": "opencv", "distortion": (-0.2, 0.03)}], ids=["pinhole", "lens"]
)
def test_depth_is_along_the_axis_through_the_cameras_own_lens(lens) -> None:
    field = told_field(balls([[0.4, 0.1, 2.2], [-0.5, 0.2, 1.7]]), [1, 0])
    seen = camera(**lens)
    _, directions = seen.rays()
    distances = first_hits(field, seen)
    want = torch.where(distances < math.inf, distances * directions[..., 2], 0.0).float()
    signals = field.view(seen).signals(colour=False)
    assert signals.colour is None
    torch.testing.assert_close(signals.depth, want, atol=1e-4, rtol=0)
    torch.testing.assert_close(signals.median_depth, want, atol=1e-4, rtol=0)


def test_half_transparent_surfaces_are_composited_front_to_back() -> None:
    """sigma is 1/2 at each of the two faces of a ball: a quarter passes to the sky."""
    field = told_field(balls([[0.013, 0.007, 2]]), [1], opaque=0.0)
    seen = camera()
    hit = torch.isfinite(first_hits(field, seen))
    with field.view(seen) as view:
        signals = view.signals()
        shown = view.label_map("semantic")
    # Rays along an edge of the outline may meet it in a point, whose weight is the same.
    torch.testing.assert_close(signals.alpha[hit], torch.full_like(signals.alpha[hit], 0.75))
    torch.testing.assert_close(signals.colour[hit][:, 1], signals.alpha[hit], atol=1e-5, rtol=0)
    torch.testing.assert_close(shown.confidence[hit], signals.alpha[hit], atol=1e-5, rtol=0)
    assert bool((shown.ids[hit] == CAR).all())
    near = float(signals.median_depth[15, 20])
    far = near + 2 * (2 - near)
    assert near == pytest.approx(1.5, abs=0.05)
    assert float(signals.depth[15, 20]) == pytest.approx((0.5 * near + 0.25 * far) / 0.75, abs=1e-3)


def test_what_is_asked_first_does_not_matter() -> None:
    field = random_field()
    with field.view(camera()) as view:
        ids, colour = view.label_map("classes").ids, view.signals().colour
    with field.view(camera()) as view:
        again, labels = view.signals().colour, view.label_map("classes").ids
    assert torch.equal(colour, again)
    assert torch.equal(ids, labels)


def test_points_take_the_vertices_around_them() -> None:
    field = told_field(balls([[0, 0, 2], [3, 0, 2]]), [1, 0])
    points = torch.tensor([[0.5, 0, 2], [2.6, 0, 2], [1.5, 0, 2], [0, 0, 40]])
    labels = field.labels_at(points, "semantic")
    assert labels.ids.tolist() == [8, 3, -1, -1]
    assert labels.ids.dtype == torch.int32
    torch.testing.assert_close(labels.confidence, torch.tensor([1.0, 1, 0, 0]))
    wide = MeshField(field.mesh, field.model, radius=1.2)
    assert wide.labels_at(points, "semantic").ids[2] != -1


def test_points_are_eq_9_of_the_fields_outputs() -> None:
    field = random_field()
    opacity, probabilities = field.model.vertex_outputs(field.mesh)
    points = field.mesh.vertices[::7] + 0.05
    want = reference.point_columns(
        field.mesh.vertices, opacity, probabilities, points, radius=field.radius
    )
    found = field.labels_at(points, "classes").ids
    assert found.tolist() == [IDS[column] for column in want.tolist()]


def test_empty_primitives_show_the_background() -> None:
    field = random_field(balls([]))
    signals = field.view(camera()).signals()
    assert bool((signals.alpha == 0).all())
    assert field.labels_at(torch.zeros(2, 3), "classes").ids.tolist() == [-1, -1]


def test_what_is_refused() -> None:
    mesh = balls([[0.013, 0.007, 2]])
    model = RadianceModel(mesh, IDS, SMALL)
    field = MeshField(mesh, model)
    for ask in (field.layer, field.view(camera()).label_map, field.view(camera()).confidence):
        with pytest.raises(InputError, match="^layer: expected semantic, got 'other'"):
            ask("other")
    with pytest.raises(InputError, match="^layer: expected semantic, got 'other'"):
        field.labels_at(torch.zeros(1, 3), "other")
    with pytest.raises(InputError, match="expected features, got labels"):
        field.view(camera()).features("semantic")
    with pytest.raises(RangeError, match="^points: "):
        field.labels_at(torch.full((1, 3), math.nan), "semantic")
    with pytest.raises(ShapeError, match="^model.features: "):
        MeshField(balls([[0, 0, 2], [1, 0, 2]]), model)
    with pytest.raises(InputError, match="^model.ids: expected ids of 1 and more, got 0"):
        MeshField(mesh, RadianceModel(mesh, (0, 1), SMALL))
    for radius in (0.0, math.nan, math.inf, -1.0):
        with pytest.raises(RangeError, match="^radius: expected a positive length"):
            MeshField(mesh, model, radius=radius)
    for name in ("", "a@part"):
        with pytest.raises(InputError, match="^layer: expected a name without @"):
            MeshField(mesh, model, layer=name)
    with pytest.raises(InputError, match="^info: "):
        MeshField(mesh, model, info="mine")  # pyright: ignore[reportArgumentType]
    assert LayerInfo() == field.info


def test_vertices_that_no_ray_saw_count_a_hundredth() -> None:
    field = random_field()
    opacity, probabilities = field.model.vertex_outputs(field.mesh)
    seen = torch.linspace(0, 1, len(opacity))
    weighed = MeshField(field.mesh, field.model, seen=seen, radius=field.radius)
    points = field.mesh.vertices[::7] + 0.01
    expected = BallQuery(
        field.mesh.vertices, opacity * seen.clamp_min(0.01), probabilities, radius=field.radius
    )
    assert torch.equal(weighed.query.scores(points), expected.scores(points))
    assert not torch.equal(weighed.query.scores(points), field.query.scores(points))
    with pytest.raises(ShapeError, match="seen"):
        MeshField(field.mesh, field.model, seen=seen[1:])
    with pytest.raises(RangeError, match="seen"):
        MeshField(field.mesh, field.model, seen=seen * 2)


def two_balls() -> tuple[MeshField, torch.Tensor, torch.Tensor]:
    """A car that training adjusted but for its inside, beside a larger road that no ray met.

    Three points: between the two and nearer to the road, within the road's reach alone, far away.
    """
    mesh = balls([[0, 0, 0], [1.2, 0, 0]], radius=0.5)
    field = told_field(mesh, [1, 0])
    seen = torch.zeros(len(mesh.vertices))
    outside = mesh.vertices[:42, 0] > 0
    seen[:42][outside] = 1e-4
    points = torch.tensor([[0.65, 0, 0], [1.9, 0, 0], [9.0, 0, 0]])
    return field, seen, points


def test_eq_9_as_published_asks_only_vertices_that_training_adjusted() -> None:
    """V_b: "vertices whose features f_i have been adjusted during training" (paper, section 3.2).

    A point that has only untouched vertices around it is undefined; one that has both takes the
    label of the touched, however near the others are and however little rays saw.
    """
    field, seen, points = two_balls()
    road, car = field.model.ids[0], field.model.ids[1]
    asked = {
        rule: MeshField(field.mesh, field.model, seen=seen, radius=0.4, vertex_rule=rule)
        for rule in ("adjusted", "weighed", "all")
    }
    ids = {rule: one.labels_at(points, "semantic").ids.tolist() for rule, one in asked.items()}
    assert ids["all"] == [road, road, -1], "the wrong reading of the paper"
    assert ids["adjusted"] == [car, -1, -1]
    assert ids["weighed"] == [road, road, -1], "a hundredth of all is more than what rays saw"
    well_seen = MeshField(field.mesh, field.model, seen=seen.sign(), radius=0.4)
    assert well_seen.vertex_rule == "weighed"
    assert well_seen.labels_at(points, "semantic").ids.tolist() == [car, road, -1]
    opacity, probabilities = field.model.vertex_outputs(field.mesh)
    kept = seen > 0
    want = reference.point_columns(
        field.mesh.vertices[kept], opacity[kept], probabilities[kept], points, radius=0.4
    )
    assert torch.equal(asked["adjusted"].query.columns(points)[0], want)


def test_a_rule_needs_to_know_what_rays_saw() -> None:
    field, seen, points = two_balls()
    assert field.vertex_rule == "all"
    for rule in ("adjusted", "weighed"):
        with pytest.raises(InputError, match=f"^vertex_rule: expected all for a field .* {rule}"):
            field.with_layer(vertex_rule=rule)
    with pytest.raises(InputError, match="^vertex_rule: expected one of adjusted, weighed, all"):
        MeshField(field.mesh, field.model, seen=seen, vertex_rule="some")  # pyright: ignore[reportArgumentType]
    known = MeshField(field.mesh, field.model, seen=seen, radius=0.4)
    changed = known.with_layer(vertex_rule="adjusted")
    assert changed.info.options["vertex_rule"] == "adjusted"
    assert changed.with_layer("street").vertex_rule == "adjusted"
    assert changed.labels_at(points, "semantic").ids.tolist()[1] == -1


def test_another_name_and_record_leave_the_rest() -> None:
    made = random_field()
    seen = torch.linspace(0, 1, len(made.mesh.vertices))
    field = MeshField(made.mesh, made.model, seen=seen, radius=0.7, layer="classes", info=made.info)
    renamed = field.with_layer("street")
    assert (renamed.layer_names, renamed.info, renamed.radius) == (("street",), made.info, 0.7)
    assert renamed.seen is not None
    assert torch.equal(renamed.seen, seen)
    told = field.with_layer(info=LayerInfo(evidence="maps"))
    assert (told.layer_names, told.info.evidence, told.radius) == (("classes",), "maps", 0.7)
    points = field.mesh.vertices[::7] + 0.05
    assert torch.equal(
        renamed.labels_at(points, "street").ids, field.labels_at(points, "classes").ids
    )
    with pytest.raises(InputError, match="^layer: expected a name without @"):
        field.with_layer("a@part")


# Eq. 9: against ten lines, by hand, in any order, and what is refused.


def field(count: int, classes: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices, opacities and probabilities; some vertices in one place, some transparent."""
    g = torch.Generator().manual_seed(seed)
    vertices = torch.randn(count, 3, generator=g)
    vertices[: count // 8] = vertices[: count // 8].round()
    opacity = torch.rand(count, generator=g)
    opacity[::5] = 0
    return vertices, opacity, torch.rand(count, classes, generator=g).softmax(dim=1)


@given(
    count=st.integers(0, 150),
    classes=st.integers(1, 7),
    seed=st.integers(0, 2**31),
    radius=st.sampled_from([0.05, 0.4, 1.5, 50.0]),
)
def test_it_is_the_ten_lines(count: int, classes: int, seed: int, radius: float) -> None:
    vertices, opacity, probabilities = field(count, classes, seed)
    g = torch.Generator().manual_seed(seed + 1)
    points = torch.cat((torch.randn(20, 3, generator=g), vertices[:12]))
    query = BallQuery(vertices, opacity, probabilities, radius=radius)
    columns, shares = query.columns(points)
    want = reference.point_columns(vertices, opacity, probabilities, points, radius=radius)
    scores = query.scores(points).sort(dim=1, descending=True).values
    clear = (
        torch.ones(len(points), dtype=torch.bool)
        if classes == 1
        else (scores[:, 0] - scores[:, 1] > 1e-6 * scores[:, 0]) | (scores[:, 0] == 0)
    )
    assert torch.equal(columns[clear], want[clear])
    assert torch.equal(columns >= 0, want >= 0)
    assert bool((shares[columns < 0] == 0).all())
    assert bool((shares[columns >= 0] >= 1 / classes - 1e-5).all())


def test_by_hand() -> None:
    """Distances 1 and 2; the far vertex is three times as opaque and wins, 2/3 * .2 < 1/3 * .6."""
    vertices = torch.tensor([[0.0, 0, 0], [3, 0, 0]])
    query = BallQuery(vertices, torch.tensor([0.2, 0.6]), torch.eye(2), radius=2.0)
    point = torch.tensor([[1.0, 0, 0]])
    torch.testing.assert_close(query.scores(point), torch.tensor([[0.4 / 3, 0.6 / 3]]))
    columns, shares = query.columns(point)
    assert columns.tolist() == [1]
    torch.testing.assert_close(shares, torch.tensor([0.6]))


def test_a_point_on_a_vertex_takes_that_vertex() -> None:
    """Though all others, a hair away, are of another class."""
    vertices = torch.cat((torch.zeros(1, 3), torch.full((50, 3), 1e-6)))
    probabilities = torch.zeros(51, 2)
    probabilities[0, 0], probabilities[1:, 1] = 1, 1
    query = BallQuery(vertices, torch.ones(51), probabilities, radius=1.0)
    assert query.columns(torch.zeros(1, 3))[0].tolist() == [0]
    assert query.columns(torch.full((1, 3), 1e-7))[0].tolist() == [1]


def test_the_border_belongs_to_the_ball_and_beyond_it_nothing_is_said() -> None:
    query = BallQuery(torch.zeros(1, 3), torch.ones(1), torch.ones(1, 3), radius=0.5)
    columns, shares = query.columns(torch.tensor([[0.5, 0, 0], [0.5001, 0, 0]]))
    assert columns.tolist() == [0, -1]
    torch.testing.assert_close(shares, torch.tensor([1 / 3, 0.0]))


def test_where_nothing_is_opaque_nothing_is_said() -> None:
    query = BallQuery(torch.zeros(1, 3), torch.zeros(1), torch.ones(1, 3), radius=0.5)
    assert query.columns(torch.zeros(1, 3))[0].tolist() == [-1]


def test_the_order_of_points_and_of_vertices_does_not_matter() -> None:
    vertices, opacity, probabilities = field(2000, 5, 1)
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(2))
    query = BallQuery(vertices, opacity, probabilities, radius=0.5)
    scores, (columns, shares) = query.scores(points), query.columns(points)
    order = torch.randperm(500, generator=torch.Generator().manual_seed(3))
    assert torch.equal(query.scores(points[order]), scores[order])
    moved = query.columns(points[order])
    assert torch.equal(moved[0], columns[order])
    assert torch.equal(moved[1], shares[order])
    order = torch.randperm(2000, generator=torch.Generator().manual_seed(4))
    other = BallQuery(vertices[order], opacity[order], probabilities[order], radius=0.5)
    torch.testing.assert_close(other.scores(points), scores)
    assert torch.equal(other.columns(points)[0], columns)


@pytest.mark.bits
def test_blocks_and_threads_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, opacity, probabilities = field(3000, 4, 5)
    points = torch.randn(999, 3, generator=torch.Generator().manual_seed(6))
    query = BallQuery(vertices, opacity, probabilities, radius=0.4)
    want, before = query.columns(points), _native.threads()
    monkeypatch.setattr("splatseg.street.field._POINTS", 100)
    try:
        for threads in (1, 3):
            _native.set_threads(threads)
            found = query.columns(points)
            assert torch.equal(found[0], want[0])
            assert torch.equal(found[1], want[1])
    finally:
        _native.set_threads(before)


def test_without_classes_or_vertices_nothing_is_said() -> None:
    for count, classes in ((0, 3), (4, 0), (0, 0)):
        query = BallQuery(
            torch.zeros(count, 3), torch.ones(count), torch.ones(count, classes), radius=1.0
        )
        assert query.columns(torch.zeros(2, 3))[0].tolist() == [-1, -1]


def test_bad_places_are_refused() -> None:
    vertices, opacity, probabilities = torch.zeros(2, 3), torch.ones(2), torch.ones(2, 3)
    with pytest.raises(ShapeError, match="^opacity: "):
        BallQuery(vertices, opacity[:1], probabilities, radius=1.0)
    with pytest.raises(ShapeError, match="^probabilities: "):
        BallQuery(vertices, opacity, probabilities[:1], radius=1.0)
    for bad in (math.nan, -0.1, 1.1):
        with pytest.raises(RangeError, match="^opacity: "):
            BallQuery(vertices, opacity * bad, probabilities, radius=1.0)
    for bad in (math.nan, math.inf, -1.0):
        with pytest.raises(RangeError, match="^probabilities: "):
            BallQuery(vertices, opacity, probabilities * bad, radius=1.0)
    for radius in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(RangeError, match="^radius: expected a positive length, got"):
            BallQuery(vertices, opacity, probabilities, radius=radius)
    query = BallQuery(vertices, opacity, probabilities, radius=1.0)
    with pytest.raises(ShapeError, match="^points: "):
        query.columns(torch.zeros(3, 2))
    with pytest.raises(RangeError, match="^points: "):
        query.columns(torch.full((1, 3), math.nan))
