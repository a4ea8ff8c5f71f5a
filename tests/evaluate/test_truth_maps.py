"""True label maps of surfaces: closed forms, exact rooms, lenses, points."""

import math
from dataclasses import replace

import pytest
import torch

from splatseg.core import Camera, LabelledMesh, LabelledPoints, LayerInfo, Renderable, map_ids
from splatseg.core.renderable import RenderableView
from splatseg.errors import InputError, RangeError
from splatseg.evaluate import PointSurfaceOptions, SurfaceField, truth_maps
from splatseg.synthetic import SyntheticScene, cameras, cast, look_at, room
from splatseg_bench.worlds import scene_mesh
from support import brute_rays as reference

LENSES = {
    "pinhole": {},
    "opencv": {"model": "opencv", "distortion": (-0.2, 0.05, 0.001, -0.002, 0.01)},
    "fisheye": {"model": "fisheye", "distortion": (0.02, -0.01, 0.003, 0.0)},
}


def camera(**changes) -> Camera:
    values = {
        "width": 40, "height": 30, "fx": 25.0, "fy": 27.0, "cx": 19.0, "cy": 16.0,
        "cam_from_world": torch.eye(4),
    }  # fmt: skip
    return Camera(**values | changes)


def look(field: SurfaceField, at: Camera, layer: str):
    with field.view(at) as view:
        assert isinstance(view, RenderableView)
        return view.label_map(layer).ids, view.signals().depth


def exact(scene: SyntheticScene, at: Camera):
    """Instances and depth of a generated scene by its own ray caster."""
    origin, directions = at.rays()
    distance, which = cast(scene, origin, directions.reshape(-1, 3))
    instances = torch.tensor([item.instance for item in scene.primitives], dtype=torch.int32)
    ids = torch.where(which >= 0, instances[which], -1).reshape(at.height, at.width)
    depth = distance.reshape(ids.shape) * (directions @ at.cam_from_world[2, :3])
    return ids, torch.where(ids >= 0, depth, 0.0).float()


@pytest.fixture(scope="module")
def boxes():
    """A generated room of boxes and planes: triangles are exactly what its ray caster knows."""
    whole = room(seed=3)
    flat = tuple(item for item in whole.primitives if item.shape in ("box", "plane"))
    return replace(whole, primitives=flat)


@pytest.fixture(scope="module")
def box_field(boxes) -> SurfaceField:
    return SurfaceField(scene_mesh(boxes))


@pytest.mark.parametrize("lens", LENSES)
def test_a_room_of_boxes_is_exact_in_every_pixel(boxes, box_field, lens) -> None:
    views = cameras(boxes, train=1, test=0, width=80, height=60)
    for view in views:
        at = replace(view.camera, **LENSES[lens])
        instances, depth = exact(boxes, at)
        classes = {id: boxes.class_of(id) for id in instances.unique().tolist() if id >= 0}
        with box_field.view(at) as seen:
            assert torch.equal(seen.label_map("instance").ids, instances)
            semantic = map_ids(instances, classes, default=-1)
            assert torch.equal(seen.label_map("semantic").ids.long(), semantic)
            torch.testing.assert_close(seen.signals().depth, depth, rtol=1e-6, atol=1e-6)
        assert len(classes) > 5


def test_round_solids_are_right_but_for_their_outlines() -> None:
    whole = room(seed=3)
    at = cameras(whole, train=1, test=0, width=160, height=120)[0].camera
    instances, _ = exact(whole, at)
    round_ids = {i.instance for i in whole.primitives if i.shape in ("sphere", "cylinder")}
    assert sum(int((instances == id).sum()) for id in round_ids) > 200
    wrong = {}
    for segments in (8, 96):
        ids, _ = look(SurfaceField(scene_mesh(whole, segments=segments)), at, "instance")
        wrong[segments] = int((ids != instances).sum())
    assert wrong[96] <= 4 < wrong[8]


@pytest.mark.parametrize("lens", LENSES)
def test_rays_go_where_the_camera_unprojects(lens) -> None:
    """What is met in a pixel's centre lies where `unproject` puts that pixel at its depth."""
    rng = torch.Generator().manual_seed(1)
    vertices = torch.randn(40, 3, generator=rng, dtype=torch.float64) + torch.tensor([0.0, 0, 3])
    faces = torch.randint(0, 40, (30, 3), generator=rng)
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=rng).double())[0]
    turn[:3, :3] *= torch.linalg.det(turn[:3, :3])
    turn[:3, 3] = torch.tensor([0.1, -0.2, 4.0])
    at = camera(cam_from_world=turn, **LENSES[lens])
    mesh = LabelledMesh(vertices=vertices, faces=faces, face_labels={"face": torch.arange(30)})
    ids, depth = look(SurfaceField(mesh), at, "face")
    hit = ids >= 0
    assert 0.1 < hit.double().mean() < 1
    places = at.unproject(at.pixel_centres()[hit], depth[hit].double())
    corners = vertices[faces[ids[hit].long()]]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = torch.nn.functional.normalize(normal, dim=-1)
    off = ((places - corners[:, 0]) * normal).sum(-1)
    assert float(off.abs().max()) < 1e-5
    origin, directions = at.rays()
    slow = reference.cast(vertices, faces, origin, directions.reshape(-1, 3))
    assert (slow.faces.reshape(ids.shape) == ids).double().mean() > 0.995


def test_a_vertex_labels_what_is_nearest_to_it_in_barycentric_weight() -> None:
    """A triangle across the view, corners on pixels (0, 0), (20, 0), (0, 20) of depth 2."""
    at = camera(fx=20.0, fy=20.0, cx=0.5, cy=0.5, width=21, height=21)
    mesh = LabelledMesh(
        vertices=torch.tensor([[0.0, 0, 2], [2, 0, 2], [0, 2, 2]]),
        faces=torch.tensor([[0, 1, 2]]),
        vertex_labels={"label": torch.tensor([4, 7, -1])},
        face_labels={"object": torch.tensor([0])},
    )
    field = SurfaceField(mesh)
    ids, depth = look(field, at, "label")
    rows, columns = torch.meshgrid(torch.arange(21), torch.arange(21), indexing="ij")
    weights = torch.stack((20 - rows - columns, columns, rows), -1)
    first, second = weights.sort(dim=-1, descending=True).values[..., :2].unbind(-1)
    sure = (first > second) & (weights > 0).all(dim=-1)
    expected = torch.tensor([4, 7, -1])[weights.argmax(dim=-1)]
    assert torch.equal(ids[sure].long(), expected[sure])
    assert int(sure.sum()) > 100
    outside = (weights < 0).any(dim=-1)
    assert (ids[outside] == -1).all()
    assert not depth[outside].any()
    assert torch.allclose(depth[sure], torch.tensor(2.0))
    with field.view(at) as view:
        sureness = view.confidence("label")
        assert (view.label_map("object").ids[sure] == 0).all()
        assert torch.equal(view.signals().alpha, (depth > 0).float())
    assert (sureness[outside] == -1).all()
    assert set(sureness[sure].tolist()) == {0.0, 1.0}


def test_views_in_blocks_of_pixels_are_the_same(box_field, boxes, monkeypatch) -> None:
    at = cameras(boxes, train=1, test=0, width=48, height=36)[0].camera
    ids, depth = look(box_field, at, "semantic")
    monkeypatch.setattr(truth_maps, "_PIXELS", 101)
    again, deep = look(box_field, at, "semantic")
    assert torch.equal(ids, again)
    assert torch.equal(depth, deep)


def test_a_field_tells_its_layers_and_labels_of_points() -> None:
    mesh = LabelledMesh(
        vertices=torch.eye(3),
        faces=torch.tensor([[0, 1, 2]]),
        vertex_labels={"label": torch.tensor([4, -1, 2])},
        face_labels={"object": torch.tensor([9])},
    )
    info = LayerInfo(names={4: "chair"})
    field = SurfaceField(mesh, infos={"label": info})
    assert isinstance(field, Renderable)
    assert field.layer_names == ("label", "object")
    assert field.layer("label").ids == (2, 4)
    assert field.layer("label").info == info
    assert field.layer("object").ids == (9,)
    found = field.labels_at(torch.tensor([[0.9, 0, 0], [0, 0.8, 0], [0, 0, 3.0]]), "label")
    assert found.ids.tolist() == [4, -1, 2]
    assert found.confidence.tolist() == [1, 0, 1]
    with pytest.raises(InputError, match="'object' are of faces"):
        field.labels_at(torch.zeros(1, 3), "object")
    with pytest.raises(InputError, match=r"labels of the surface \(label, object\), got 'class'"):
        field.layer("class")
    with pytest.raises(InputError, match="expected features"), field.view(camera()) as view:
        view.features("label")
    with pytest.raises(InputError, match="got 'other' too"):
        SurfaceField(mesh, infos={"other": info})
    with pytest.raises(InputError, match="labels of vertices, faces or points, got none"):
        SurfaceField(replace(mesh, vertex_labels={}, face_labels={}))


def wall(step: float = 0.1, *, gap: float = 0.0) -> LabelledPoints:
    """Points of a wall z = 2, ids 1 left and 2 right of x = 0, with a hole about the middle."""
    line = torch.arange(-3, 3 + step / 2, step, dtype=torch.float64)
    x, y = (part.reshape(-1) for part in torch.meshgrid(line, line, indexing="ij"))
    keep = torch.maximum(x.abs(), y.abs()) >= gap
    points = torch.stack((x, y, torch.full_like(x, 2.0)), dim=-1)[keep]
    return LabelledPoints(points=points, labels={"side": torch.where(points[:, 0] < -1e-9, 1, 2)})


@pytest.mark.parametrize("lens", LENSES)
def test_points_of_a_wall_show_a_wall(lens) -> None:
    at = camera(**LENSES[lens])
    ids, depth = look(SurfaceField(wall()), at, "side")
    torch.testing.assert_close(depth, torch.full_like(depth, 2.0))
    x = at.unproject(at.pixel_centres(), torch.full((30, 40), 2.0, dtype=torch.float64))[..., 0]
    # The points nearest to a place change half-way between the columns at -0.1 and 0.
    assert torch.equal(ids, torch.where(x < -0.05, 1, 2).int())


def test_normals_that_are_given_turn_the_discs() -> None:
    """Discs that are seen edge-on hide nothing."""
    cloud = wall()
    facing = replace(cloud, normals=torch.tensor([[0.0, 0, -3]]).expand(len(cloud), 3))
    aside = replace(cloud, normals=torch.tensor([[1.0, 0, 0]]).expand(len(cloud), 3))
    unknown = replace(cloud, normals=torch.zeros(len(cloud), 3))
    depths = [
        look(SurfaceField(one, points=PointSurfaceOptions(fill=0)), camera(), "side")[1]
        for one in (cloud, facing, unknown, aside)
    ]
    assert torch.allclose(depths[0], depths[1])
    assert torch.allclose(depths[0], depths[2])
    assert float(((depths[3] - 2).abs() > 1e-3).double().mean()) > 0.3


@pytest.mark.parametrize(
    ("options", "covered"),
    [
        ({"radius": 0.01, "fill": 0}, (0.0, 0.1)),
        ({"radius": 0.1, "fill": 0}, (1.0, 1.0)),
        ({"spread": 0.2, "fill": 0}, (0.05, 0.5)),
        ({"spread": 1.0, "fill": 0}, (1.0, 1.0)),
        ({"spread": 0.2, "neighbours": 40, "fill": 0}, (0.6, 1.0)),
        ({"radius": 0.01, "fill": 6}, (0.9, 1.0)),
    ],
)
def test_each_option_decides_how_much_is_covered(options, covered) -> None:
    _, depth = look(SurfaceField(wall(), points=PointSurfaceOptions(**options)), camera(), "side")
    assert covered[0] <= float((depth > 0).double().mean()) <= covered[1]


def test_holes_take_the_nearest_pixel_and_larger_ones_stay() -> None:
    """A hole of 1.2 at depth 2 is about 15 pixels across; what is behind is seen through it."""
    cloud = wall(gap=0.6)
    behind = LabelledPoints(
        points=torch.cat((cloud.points, wall().points * torch.tensor([3.0, 3, 2]))),
        labels={"side": torch.cat((cloud.labels["side"], torch.full((len(wall()),), 9)))},
    )
    seen = {
        fill: look(SurfaceField(behind, points=PointSurfaceOptions(fill=fill)), camera(), "side")
        for fill in (0, 3, 9)
    }
    for fill in (0, 3):
        ids, depth = seen[fill]
        assert int(ids[16, 19]) == 9
        assert float(depth[16, 19]) == pytest.approx(4.0)
    ids, depth = seen[9]
    assert not (ids == 9).any()
    assert torch.allclose(depth, torch.tensor(2.0))
    assert ids[16, 12:16].tolist() == [1] * 4
    assert ids[16, 23:27].tolist() == [2] * 4


def test_a_thing_before_a_wall_does_not_grow_by_filling() -> None:
    """Closing leaves straight outlines where they are."""
    card = wall(0.02).points * torch.tensor([0.1, 0.1, 0.5])
    cloud = LabelledPoints(
        points=torch.cat((wall().points, card)),
        labels={"side": torch.cat((torch.ones(len(wall())), torch.full((len(card),), 5))).long()},
    )
    areas = [
        int((look(SurfaceField(cloud, points=PointSurfaceOptions(fill=fill)), camera(), "side")[0]
             == 5).sum())
        for fill in (0, 3)
    ]  # fmt: skip
    assert areas[0] == areas[1] > 100


def test_a_point_far_from_all_others_stays_small() -> None:
    """It lies between the camera and the wall, 1 away from the nearest other point."""
    stray = torch.tensor([[0.05, 0.05, 1.0]]).double()
    cloud = LabelledPoints(
        points=torch.cat((wall().points, stray)),
        labels={"side": torch.cat((wall().labels["side"], torch.tensor([8])))},
        normals=torch.tensor([[0.0, 0, 1]]).expand(len(wall()) + 1, 3),
    )
    ids, _ = look(SurfaceField(cloud), camera(), "side")
    # Spacing 0.1, six neighbours within 0.14: a radius of 3 * 0.6 * 0.14 at depth 1 is 6 pixels.
    assert 0 < int((ids == 8).sum()) < 150


def test_the_plane_of_a_point_at_an_edge_is_that_of_its_neighbours() -> None:
    """A strip of points askew to the axes shows what it shows with its true normals."""
    line, width = torch.linspace(-1, 1, 41).double(), torch.linspace(0, 0.5, 11).double()
    u, v = (part.reshape(-1) for part in torch.meshgrid(line, width, indexing="ij"))
    axes = torch.linalg.qr(torch.tensor([[1.0, 0.2, 0.1], [0.1, 1, 0.5], [0, -0.6, 1]]).double())[0]
    points = u[:, None] * axes[0] + v[:, None] * axes[1] + torch.tensor([0.0, 0, 2]).double()
    cloud = LabelledPoints(points=points, labels={"a": torch.ones(len(points)).int()})
    given = replace(cloud, normals=axes[2].expand(len(points), 3))
    depths = [look(SurfaceField(one), camera(), "a")[1] for one in (cloud, given)]
    assert float((depths[1] > 0).double().mean()) > 0.05
    both = (depths[0] > 0) & (depths[1] > 0)
    torch.testing.assert_close(depths[0][both], depths[1][both])
    assert int(((depths[0] > 0) != (depths[1] > 0)).sum()) < 40


def test_points_alone_need_a_radius() -> None:
    one = LabelledPoints(points=torch.tensor([[0.0, 0, 2]]), labels={"a": torch.tensor([3])})
    with pytest.raises(InputError, match="radius: expected a radius for a point without"):
        SurfaceField(one)
    towards = replace(one, normals=torch.tensor([[0.0, 0, 1]]))
    ids, _ = look(SurfaceField(towards, points=PointSurfaceOptions(radius=0.5)), camera(), "a")
    # A hexagon of radius 0.5 has an area of 0.65, and a pixel at depth 2 one of 4 / (25 * 27).
    assert int((ids == 3).sum()) == pytest.approx(0.65 * 25 * 27 / 4, rel=0.1)
    alone = SurfaceField(one, points=PointSurfaceOptions(radius=0.5))
    assert alone.labels_at(torch.zeros(1, 3), "a").ids.tolist() == [3]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"radius": 0.0}, "radius: expected "),
        ({"radius": math.inf}, "radius: expected "),
        ({"spread": -1.0}, "spread: expected more than 0"),
        ({"neighbours": 2}, "neighbours: expected at least 3"),
        ({"fill": -1}, "fill: expected a value in"),
    ],
)
def test_options_that_cannot_be(options, words) -> None:
    with pytest.raises(RangeError, match=words):
        PointSurfaceOptions(**options)


def test_a_camera_on_a_straight_line_with_edges_sees_no_gaps() -> None:
    """Rays through the corners of a grid of triangles, from straight before it."""
    line = torch.arange(5, dtype=torch.float64)
    x, y = (part.reshape(-1) for part in torch.meshgrid(line, line, indexing="ij"))
    a = (torch.arange(4)[:, None] * 5 + torch.arange(4)).reshape(-1)
    faces = torch.cat((torch.stack((a, a + 1, a + 6), -1), torch.stack((a, a + 6, a + 5), -1)))
    mesh = LabelledMesh(
        vertices=torch.stack((x, y, torch.full_like(x, 1.0)), -1),
        faces=faces,
        face_labels={"one": torch.ones(len(faces), dtype=torch.int32)},
    )
    at = look_at((2.0, -0.0, 4.0), (2.0, 2.0, 1.0), width=8, height=8)
    straight = camera(
        width=4, height=4, fx=1.0, fy=1.0, cx=0.5, cy=0.5, cam_from_world=torch.eye(4)
    )
    ids, depth = look(SurfaceField(mesh), straight, "one")
    assert (ids == 1).all()
    assert torch.allclose(depth, torch.tensor(1.0))
    assert int((look(SurfaceField(mesh), at, "one")[0] == 1).sum()) > 0
